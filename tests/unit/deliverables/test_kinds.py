"""Kinds of figures are plug-ins: a package adds one with keys of its own, and SIERRA computes what it needs."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from tests import plugins, projects

DOTS = """
from typing import ClassVar
from pydantic import Field
from sierra.plugin import Needs, Table, UsageError

class Keys(Table):
    most: int = Field(5, ge=1, description="largest number of rows")

class Dots:
    contract = 1
    Options: ClassVar[type[Table]] = Keys
    uses: ClassVar[frozenset[str]] = frozenset()

    def __init__(self, options):
        self._most = options.most

    def needs(self, request):
        if not request.axes:
            raise UsageError("dots need a variable")
        sql = f'SELECT "# experiment", "# t", "{request.columns[0]}" AS y FROM data ORDER BY ALL LIMIT {self._most}'
        return Needs(rows={"dots": sql}, shows="each dot a row")

    def notes(self, drawing):
        return [f"{drawing.rows['dots'].num_rows} rows"]

    def draw(self, drawing):
        from sierra.deliverables.figures import style
        figure = style.blank()
        rows = drawing.rows["dots"]
        figure.add_subplot().plot(style.column(rows, "# t"), style.column(rows, "y"), "o")
        return figure
"""


@pytest.fixture
def dots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project, where a package with the kind `dots` is installed, and a batch."""
    place = plugins.write(tmp_path / "site", "dotted", {"sierra.figures dots": "Dots"}, DOTS)
    monkeypatch.syspath_prepend(str(place))
    folder = projects.make(tmp_path / "project")
    assert projects.quick(folder, "run", "population_size=1,2", "--runs", "2", "--no-figures").returncode == 0
    return folder


def declare(folder: Path, *lines: str) -> None:
    with (folder / "sierra.toml").open("a") as file:
        file.writelines(f"{line}\n" for line in ("", "[figures.f]", *lines))


def said(png: Path) -> str:
    with Image.open(png) as image:
        image.load()
        held: dict[str, str] = image.text  # type: ignore[attr-defined]
    return held["Description"]


def test_a_kind_of_another_package_draws_rows_that_it_queried(dots: Path) -> None:
    declare(dots, 'kind = "dots"', "most = 3")
    done = projects.quick(dots, "figures")
    assert done.returncode == 0, done.stderr
    (png,) = dots.glob("figures/*/f.png")
    assert said(png) == "each dot a row; 3 rows"


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        (("mots = 3",), "unknown key 'mots'; did you mean 'most'?"),
        (("most = 0",), "kind 'dots': most should be greater than or equal to 1, not 0"),
        (('measure = "mean"',), '"measure" needs kind "summary", "box", "violin"'),
    ],
)
def test_wrong_keys_of_an_added_kind_are_refused_before_anything_executes(
    dots: Path, lines: tuple[str, ...], complaint: str
) -> None:
    declare(dots, 'kind = "dots"', *lines)
    for words in (("run", "population_size=4"), ("figures",)):
        done = projects.quick(dots, *words)
        assert (done.returncode, complaint in done.stderr) == (2, True), done.stderr
        assert "Traceback" not in done.stderr


def test_doctor_and_schema_list_the_keys_of_an_added_kind(dots: Path) -> None:
    assert "figure dots" in projects.quick(dots, "doctor").stdout
    assert "#most = 5" in projects.quick(dots, "schema", "--toml").stdout
