"""Plug-ins of all kinds in files of the project: used by all commands, recorded with their code, refused in packages."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sierra
from tests import plugins, projects

SIMULATOR = projects.SIMULATOR.replace("swarm.csv", "walk.track").replace('print("tick,coverage", file=file)', "pass")
CONFIG = """
[outputs.walk]
file = "walk.track"
format = "Track"
time = "tick"
[queries.main]
criteria = "population_size=1,2"
runs = 3
[figures.dots]
kind = "Dots"
table = "walk"
column = "distance"
[figures.lines]
kind = "summary"
table = "walk"
column = "distance"
center = "Extreme"
[comparisons.sizes]
table = "walk"
column = "distance"
by = "population_size"
method = "Welch"
[plugins]
readers = ["reading.py:Track"]
figures = ["drawing.py:Dots"]
statistics = ["extremes.py:Extreme"]
comparisons = ["testing.py:Welch"]
"""
READER = """
from sierra.plugin import NoOptions
from .scale import FACTOR
class Track:
    contract = 1
    Options = NoOptions
    def __init__(self, options): pass
    def read(self, path):
        rows = [line.split(",") for line in path.read_text().splitlines()]
        return {"tick": [int(tick) for tick, _ in rows], "distance": [float(value) * FACTOR for _, value in rows]}
"""
FIGURE = """
from sierra.plugin import Needs, NoOptions
class Dots:
    contract = 1
    Options = NoOptions
    uses = frozenset()
    def __init__(self, options): pass
    def needs(self, request):
        (column,) = request.columns
        return Needs(rows={"dots": f'SELECT "# t", "{column}" AS y FROM data ORDER BY ALL'}, shows="rows")
    def notes(self, drawing): return ["the first way"]
    def draw(self, drawing):
        from sierra.deliverables.figures import style
        figure = style.blank()
        figure.add_subplot().plot(style.column(drawing.rows["dots"], "y"))
        return figure
"""
STATISTIC = """
from sierra.plugin import Estimate, Function, NoOptions
class Extreme:
    contract = 1
    Options = NoOptions
    interval = ""
    def __init__(self, options): pass
    def definition(self): return Function(lambda values: Estimate(min(values), None, None))
"""
REFUSED = "is not imported: it is Python code of a package, and nothing of a package is imported"


def make(folder: Path) -> Path:
    """Write a project with four kinds of plug-ins; return its folder."""
    projects.make(folder, projects.CONFIG + CONFIG, simulator=SIMULATOR)
    comparison = (plugins.SOURCE / "tortoise" / "comparison.py").read_text()
    texts = {"reading": READER, "scale": "FACTOR = 1\n", "drawing": FIGURE, "extremes": STATISTIC, "testing": comparison}
    for name, text in texts.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def change(folder: Path, file: str, before: str, after: str) -> None:
    text = (folder / file).read_text()
    assert before in text
    (folder / file).write_text(text.replace(before, after))


def said(folder: Path, *words: str, code: int = 0) -> str:
    done = projects.quick(folder, *words)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def largest(folder: Path) -> float:
    return float(str(projects.sql(folder, "SELECT max(distance) AS most FROM walk")[0]["most"]))


@pytest.fixture
def executed(tmp_path: Path) -> Path:
    folder = make(tmp_path / "p")
    assert "6 runs: 6 executed" in said(folder, "run", "main")
    return folder


@pytest.mark.integration
def test_reader_figure_statistic_and_comparison_of_the_project_are_used_and_recorded(executed: Path) -> None:
    assert largest(executed) > 0
    assert "Welch's t test" in said(executed, "compare", "sizes")
    assert "Extreme" in said(executed, "stats", "walk", "distance", "--statistic", "Extreme")
    said(executed, "report")
    rows = {row["name"]: row for row in projects.sql(executed, "SELECT name, made_by, sql FROM deliverables")}
    assert any(text.startswith("drawing.py ") for text in rows["dots"]["made_by"])
    assert any(text.startswith("testing.py ") for text in rows["sizes"]["made_by"])
    assert "-- Extreme: no interval, of extremes.py " in rows["lines"]["sql"]
    [declared] = {row["declared"] for row in projects.sql(executed, "SELECT declared FROM ingest_rules")}
    assert json.loads(declared)["readers"]["Track"]["files"] == {"reading.py": READER, "scale.py": "FACTOR = 1\n"}


@pytest.mark.integration
def test_changed_files_never_give_old_results(executed: Path) -> None:
    before = largest(executed)
    change(executed, "drawing.py", "the first way", "the second way")
    change(executed, "extremes.py", "min(values)", "max(values)")
    checked = said(executed, "figures", "--check", code=1)
    assert "dots: drawing.py has changed since; draw it again with: sierra figures" in checked
    assert "lines: the store has other data now" in checked
    said(executed, "figures")
    assert "dots: follows from the store" in said(executed, "figures", "--check")
    change(executed, "scale.py", "1", "10")
    said(executed, "run", "main")
    assert largest(executed) == pytest.approx(10 * before)


@pytest.mark.integration
def test_replay_reads_with_the_recorded_reader(executed: Path) -> None:
    batch = sierra.open(executed).batches[-1].batch
    change(executed, "scale.py", "1", "10")
    assert "identical" in said(executed, "replay", batch)
    for name in ("scale", "reading"):
        (executed / f"{name}.py").unlink()
    assert "identical" in said(executed, "replay", batch)
    assert "6 reused" in said(executed, "run", batch, "--no-figures")
    assert "reading.py does not exist" in said(executed, "run", "main", code=2)
    assert "Extreme" not in said(executed, "stats", "walk", "distance")


@pytest.mark.integration
def test_package_shows_its_records_and_imports_no_plugin(executed: Path, tmp_path: Path) -> None:
    batch = sierra.open(executed).batches[-1].batch
    with (executed / "sierra.toml").open("a") as file:
        file.write('[package]\ntitle = "x"\nauthors = [{ name = "A B" }]\nlicense = "MIT"\n')
    said(executed, "package", batch, "--yes", "-o", str(tmp_path / "x.zip"))
    assert "population_size" in said(tmp_path, "open", "x.zip", "stats", "walk", "distance")
    refused = said(tmp_path, "open", "x.zip", "stats", "walk", "distance", "--statistic", "Extreme", code=2)
    assert refused == f"sierra: [plugins]: extremes.py:Extreme {REFUSED}\n"
    refused = said(tmp_path, "open", "x.zip", "compare", "sizes", code=2)
    assert f"[plugins]: testing.py:Welch {REFUSED}" in refused
    report = said(tmp_path, "open", "x.zip", "report", "--to", "r.html")
    assert f"figure dots could not be drawn: [plugins]: drawing.py:Dots {REFUSED}" in report
    reproduced = projects.quick(tmp_path, "reproduce", "x.zip", "--into", "new", "--yes")
    assert f"[plugins]: reading.py:Track {REFUSED}" in reproduced.stdout + reproduced.stderr
    other = make(tmp_path / "other")
    said(other, "open", str(tmp_path / "x.zip"), "import")
    change(other, "scale.py", "1", "10")
    refused = said(other, "replay", batch, code=2)
    assert refused.startswith("sierra: the reader 'Track' of reading.py is not imported: its code came in a package")


RUNNER = """
from sierra.plugin import Local, NoOptions
class Here(Local):
    name = "Here"
    contract = 1
    Options = NoOptions
    def __init__(self, slots, options): super().__init__(slots)
"""


@pytest.mark.integration
def test_runner_of_the_project_executes_runs(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "p", projects.CONFIG + '[plugins]\nrunners = ["own.py:Here"]\n')
    (folder / "own.py").write_text(RUNNER)
    assert "1 run: 1 executed" in said(folder, "run", "noise=1", "--runs", "1", "--on", "Here", "--no-figures")
    change(folder, "own.py", 'name = "Here"', 'name = "there"')
    told = "the runner 'Here' of own.py calls itself 'there'; set name = 'Here', because its class has that name"
    assert told in said(folder, "run", "noise=2", "--on", "Here", code=2)


@pytest.mark.integration
@pytest.mark.parametrize("file", ["reading.py", "drawing.py", "extremes.py", "testing.py", "scale.py"])
def test_file_that_is_not_python_is_reported_in_one_line(tmp_path: Path, file: str) -> None:
    folder = make(tmp_path / "p")
    (folder / file).write_text("def f(:")
    told = said(folder, "run", "main", code=2)
    assert f"{file} is not Python: SyntaxError: invalid syntax" in told
    assert told.count("\n") == 1
