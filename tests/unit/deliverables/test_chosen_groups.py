"""Figures show chosen controllers and scenarios, in the order that they name."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from tests import projects

CONFIG = (
    projects.CONFIG
    + """
[controllers.depth0]
changes = []
[controllers."depth0.CRW"]
label = "random walk"
changes = [{ set = "//swarm/@controller", value = "a" }]
[controllers."depth0.DPO"]
changes = [{ set = "//swarm/@controller", value = "b" }]
[controllers.plain]
changes = [{ set = "//swarm/@controller", value = "c" }]
[figures.f]
kind = "bar"
table = "swarm"
column = "coverage"
"""
)


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with a batch of three controllers, of which the runs of one fail, and one of a single controller."""
    simulator = projects.SIMULATOR + "sys.exit('controller=\"c\"' in arena)\n"
    folder = projects.make(tmp_path_factory.mktemp("groups") / "project", CONFIG, simulator=simulator)
    projects.quick(folder, "run", "population_size=2", "--controller", "depth0.DPO", "--no-figures")
    done = projects.quick(folder, "run", "controller=depth0.CRW,depth0.DPO,plain", "--no-figures")
    assert done.returncode == 1, done.stderr
    return folder


def draw(folder: Path, *lines: str, query: str = "controller=depth0.CRW,depth0.DPO,plain") -> tuple[str, str]:
    """Return the small print and the SQL of the figure, or "" and the message of one line."""
    (folder / "sierra.toml").write_text("\n".join([CONFIG, *lines, ""]))
    found = projects.quick(folder, "sql", f"SELECT batch FROM batches WHERE query = '{query}'").stdout.split()[-1]
    done = projects.quick(folder, "figures", found, "f")
    if done.returncode:
        (line,) = done.stderr.splitlines()
        return "", line
    with Image.open(folder / done.stdout.splitlines()[0]) as image:
        image.load()
        held = image.text  # type: ignore[attr-defined]
    return held["Description"], (folder / done.stdout.splitlines()[2]).read_text()


def places(svg: str, *words: str) -> list[int]:
    return [svg.index(f">{word}<") for word in words]


@pytest.mark.integration
def test_controllers_are_shown_in_the_order_of_their_names_and_labels(batch: Path) -> None:
    note, svg = draw(batch, 'controllers = ["depth0.DPO", "random walk"]')
    assert note == "mean, 95 % CI (Student's t), n = 2; only controllers depth0.DPO, random walk"
    first, second = places(svg, "depth0.DPO", "random walk")
    assert first < second
    assert ">plain<" not in svg
    note, svg = draw(batch)
    second, first = places(svg, "depth0.DPO", "random walk")
    assert first < second, "without a choice, the order is that of the query"


@pytest.mark.integration
def test_a_category_stands_for_its_controllers_and_where_holds_too(batch: Path) -> None:
    note, svg = draw(batch, 'controllers = "depth0"', 'where = "tick < 3 OR tick > 100"')
    assert note.endswith("; only rows where tick < 3 OR tick > 100; only controller depth0")
    assert places(svg, "random walk", "depth0.DPO")
    assert "-- only rows where tick &lt; 3 OR tick &gt; 100; only controller depth0" in svg


@pytest.mark.integration
def test_chosen_controllers_whose_runs_failed_are_reported(batch: Path) -> None:
    note, _ = draw(batch, 'controllers = ["plain", "depth0.CRW"]')
    assert "; 2 of 4 runs missing; only controllers plain, depth0.CRW" in note
    assert "no row of output 'swarm' belongs to a run of the chosen groups" in draw(batch, 'controllers = ["plain"]')[1]


@pytest.mark.nightly
def test_a_batch_with_one_controller_is_drawn_if_it_is_chosen(batch: Path) -> None:
    assert draw(batch, 'controllers = ["depth0.DPO"]', query="population_size=2")[0]
    _, line = draw(batch, 'controllers = ["plain"]', query="population_size=2")
    assert "controllers: this batch has no controller 'plain'; it has depth0.DPO" in line


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ('controllers = ["depth0.CRV"]', "controllers: this batch has no controller 'depth0.CRV'; did you mean 'depth0.CRW'?"),
        ('scenarios = ["low"]', "scenarios: this batch has no scenarios"),
        ('where = "trick < 3"\ncontrollers = ["plain"]', "where = 'trick < 3': "),
    ],
)
def test_wrong_choices_are_one_line(batch: Path, line: str, complaint: str) -> None:
    assert complaint in draw(batch, line)[1]


@pytest.mark.integration
def test_statistics_for_people_have_labels_and_those_for_programs_have_names(batch: Path) -> None:
    draw(batch)
    ids = projects.quick(batch, "sql", "SELECT batch FROM batches WHERE query LIKE 'controller=%'").stdout.split()[-1]
    for format in ("latex", "markdown", "html", "table"):
        text = projects.quick(batch, "stats", "swarm", "coverage", "-b", ids, "-f", format).stdout
        assert ("random walk" in text, "depth0.CRW" in text, "depth0.DPO" in text) == (True, False, True), format
    for format in ("csv", "json"):
        text = projects.quick(batch, "stats", "swarm", "coverage", "-b", ids, "-f", format).stdout
        assert ("random walk" in text, "depth0.CRW" in text) == (False, True), format


@pytest.mark.integration
def test_conditions_of_tables_take_labels_and_names(batch: Path) -> None:
    table = '[paper_tables.t]\ntable = "swarm"\ncolumn = "coverage"\nexperiments = "controller={}"\n'
    for word in ("random walk", "depth0.CRW"):
        (batch / "sierra.toml").write_text(CONFIG + table.format(word))
        found = projects.quick(batch, "sql", "SELECT batch FROM batches WHERE query LIKE 'controller=%'").stdout.split()[-1]
        done = projects.quick(batch, "figures", found, "t")
        assert done.returncode == 0, done.stderr
        text = next((batch / line).read_text() for line in done.stdout.splitlines() if line.endswith(".tex"))
        assert ("random walk" in text, "depth0" in text, "plain" in text) == (True, False, False)
