"""Tables of `sierra.toml` for papers: written with the figures, recorded, checked; several batches side by side."""

from __future__ import annotations

import csv
import io
import statistics
from pathlib import Path

import pytest

import sierra
from tests import projects, stores

pytestmark = pytest.mark.integration

CONFIG = (
    projects.CONFIG
    + """
[outputs.swarm]
file = "swarm.csv"
time = "tick"
units = { coverage = "m²" }

[figures.over_time]
column = "coverage"

[tables.peaks]
sql = "SELECT run, max(coverage) AS peak FROM swarm GROUP BY run"

[paper_tables.coverage]
column = "coverage"
caption = "50 % & more"
label = "tab:coverage"
footnote = "at the end"
formats = ["latex", "markdown", "html", "csv"]

[paper_tables.noises]
column = "coverage"
statistics = ["mean", "median"]
across = "population_size"
experiments = "population_size=1,2"
headers = { noise = "noise level" }
formats = ["csv"]

[paper_tables.one]
column = "coverage"
measure = "time_to"
threshold = 4.0
statistics = ["median", "km_median"]
experiments = "population_size=1 and noise=0.1"
formats = ["markdown"]

[paper_tables.rows]
sql = '''
SELECT batch, population_size, count(*) AS n, avg(peak) AS peak, avg(peak) - 1 AS peak_low, avg(peak) + 1 AS peak_high
FROM peaks JOIN runs USING (batch, run) GROUP BY ALL ORDER BY population_size, batch DESC
'''
formats = ["csv"]

[paper_tables.sums]
sql = "SELECT sum(coverage / 3) AS total, avg(coverage) AS mean, count(*) AS n FROM swarm"
digits = { total = 1 }
formats = ["csv"]
"""
)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A project with two batches that share runs, and their ids; the figures and tables of the first one are drawn."""
    root = projects.make(tmp_path_factory.mktemp("tables") / "project", CONFIG)
    project = sierra.open(root)
    first = project.run("population_size=1,2,4", "noise=0.1,0.5", runs=3, figures=False).batch
    second = project.run("population_size=1,2,4", "noise=0.1,0.5", runs=5, figures=False).batch
    done = projects.quick(root, "figures", first)
    assert done.returncode == 0, done.stderr
    return root, first, second


def rows(root: Path, name: str, folder: str = "*") -> list[list[str]]:
    (file,) = root.glob(f"figures/{folder}/{name}.csv")
    return list(csv.reader(io.StringIO(file.read_text())))


def finals(root: Path, batch: str, size: int, noise: float) -> list[float]:
    text = f"SELECT max_by(coverage, tick) AS last FROM swarm WHERE population_size = {size} AND noise = {noise} GROUP BY run"
    return [float(value) for value in sierra.open(root).sql(text, within=batch).column("last").to_pylist()]


def test_tables_are_written_with_the_figures_recorded_and_checked(drawn: tuple[Path, str, str]) -> None:
    root, first, _ = drawn
    (tex,) = root.glob("figures/*/coverage.tex")
    text = tex.read_text()
    assert text.startswith(f"% sierra {sierra.__version__} batch {first} data ")
    assert r"\caption{50 \% \& more}" in text
    assert "noise & coverage {[}m$^{2}$] " in text
    assert r"n = 3; 95 \% interval (t); at the end" in text
    assert {path.suffix for path in root.glob("figures/*/coverage.*")} == {".tex", ".md", ".html", ".csv"}
    page = tex.with_suffix(".html").read_text()
    assert page.index("-->") < page.index("<table"), "hyphens in SQL do not end the comment"
    assert page.count("-->") == 1
    said = projects.quick(root, "figures", "--check", first)
    assert (said.returncode, said.stdout.count("follows from the store")) == (0, 6)
    shown = projects.quick(root, "show", str(tex)).stdout
    assert "deliverable_kind  table" in shown
    assert "state: follows from the store" in shown


def test_numbers_are_those_of_the_runs_and_a_variable_can_be_side_by_side(drawn: tuple[Path, str, str]) -> None:
    root, first, _ = drawn
    assert rows(root, "coverage")[1][2].split(" ± ")[0] == f"{statistics.mean(finals(root, first, 1, 0.1)):.1f}"
    header, *found = rows(root, "noises")
    values = [f"{name} coverage [m²] (population size = {size})" for size in (1, 2) for name in ("mean", "median")]
    assert header == ["noise level", *values]
    assert [row[0] for row in found] == ["0.1", "0.5"]
    assert float(found[1][4]) == pytest.approx(statistics.median(finals(root, first, 2, 0.5)), rel=1e-3)


def test_notes_and_n_are_those_of_the_rows_that_are_shown(drawn: tuple[Path, str, str]) -> None:
    root, _, _ = drawn
    [file] = root.glob("figures/*/one.md")
    text = file.read_text()
    assert "n is too small for the 95 % interval of median in 1 row" in text


@pytest.mark.nightly
def test_batches_are_side_by_side_in_the_order_given(drawn: tuple[Path, str, str], tmp_path: Path) -> None:
    root = stores.copy(drawn[0], tmp_path / "project")
    _, first, second = drawn
    done = projects.quick(root, "figures", f"five={second[:9]}", f"a/b={first[:9]}")
    assert done.returncode == 0, done.stderr
    names = {Path(line).stem for line in done.stdout.splitlines()}
    assert names == {f"{name}_five_a_b" for name in ("over_time", "coverage", "noises", "one", "rows", "sums")}
    header, one, *_ = rows(root, "coverage_five_a_b", "*-*")
    assert header[:4] == ["population size", "noise", "coverage [m²] (five)", "n (five)"]
    assert (one[3], one[5]) == ("5", "3")
    assert one[2].split(" ± ")[0] == f"{statistics.mean(finals(root, second, 1, 0.1)):.1f}"
    header, *found = rows(root, "rows_five_a_b", "*-*")
    assert header == ["batch", "population size", "n", "peak"]
    assert [row[:3] for row in found[:2]] == [["five", "1", "10"], ["a/b", "1", "6"]]
    said = projects.quick(root, "figures", "--check", second)
    assert (said.returncode, said.stdout.count("follows from the store")) == (0, 6)


@pytest.mark.nightly
def test_sums_of_a_statement_are_the_same_each_time(drawn: tuple[Path, str, str]) -> None:
    root, first, second = drawn
    project = sierra.open(root)
    data = set()
    for _ in range(5):
        project.deliverables.draw_batches(first, second, name="sums")
        data |= {row["data"] for row in projects.sql(root, "SELECT data FROM deliverables WHERE starts_with(name, 'sums_')")}
    assert len(data) == 1
    header, row = rows(root, f"sums_{first[:10]}_{second[:10]}", "*-*")
    assert header == ["total", "mean", "n"]
    assert row[0].partition(".")[2].isdigit()
    assert row[2] == str(5 * 6 * (3 + 5))


BAD = {
    'column = "coverag"': "no output has 'coverag' as numeric columns",
    'sql = "SELEC 1"': "sql: ",
    'sql = "FROM sources"': "sql: table 'sources' has no column 'run', so its rows belong to no batch",
    'sql = "FROM nothing"': "sql: there is no table 'nothing'",
    'sql = "SELECT now() AS t FROM swarm"': "sql: ",
    'sql = "SELECT 1 AS one FROM swarm WHERE false"': "the table has no row",
    """sql = "FROM read_csv('/etc/passwd')" """: "sql: ",
    'column = "coverage"\nacross = "speed"': "across: the table has no variable 'speed'",
    'column = "coverage"\nexperiments = "noise=7"': "experiments 'noise=7': noise is never 7; noise is 0.1, 0.5",
    'column = "coverage"\nheaders = { x = "y" }': "headers: the table has no column 'x'",
    'sql = "SELECT batch, tick FROM swarm"\nacross = "batch"': "across: two rows have the same 'batch' and other values",
}


def test_a_table_that_cannot_be_made_is_one_line_and_the_others_are_made(drawn: tuple[Path, str, str], tmp_path: Path) -> None:
    root = stores.copy(drawn[0], tmp_path / "project")
    tables = "".join(f"[paper_tables.bad{k}]\n{table}\n" for k, table in enumerate(BAD))
    (root / "sierra.toml").write_text(f'{projects.CONFIG}\n{tables}\n[paper_tables.good]\ncolumn = "coverage"\n')
    done = projects.quick(root, "figures", drawn[1])
    assert done.returncode == 0
    assert "good.tex" in done.stdout
    notes = [line for line in done.stderr.splitlines() if "table bad" in line]
    assert [line.split(": ", 2)[1] for line in notes] == [f"table bad{k}" for k in range(len(BAD))]
    for line, message in zip(notes, BAD.values(), strict=True):
        assert line.split(": ", 2)[2].startswith(message)
    alone = projects.quick(root, "figures", drawn[1], "bad0")
    assert alone.returncode != 0
    assert alone.stderr.splitlines()[0].startswith("sierra: no output has 'coverag'")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('sql = "SELECT 1"\ncolumn = "coverage"', '"column" is for statistics'),
        ('column = "coverage"\ndigits = 2', '"digits" needs "sql"'),
        ('column = "coverage"\nlabel = "a b"', "label"),
        ('column = "coverage"\nformats = ["word"]', "formats"),
        ('column = "coverage"\n[figures.bad]\ncolumn = "coverage"', "[figures.bad] and [paper_tables.bad] would have files"),
    ],
)
def test_invalid_declarations_are_errors(tmp_path: Path, table: str, message: str) -> None:
    root = projects.make(tmp_path / "project", f"{projects.CONFIG}\n[paper_tables.bad]\n{table}\n")
    done = projects.quick(root, "figures")
    assert done.returncode == 2
    assert message in done.stderr


@pytest.mark.integration
def test_figures_of_batches_with_different_values_say_which(drawn: tuple[Path, str, str], tmp_path: Path) -> None:
    root, first = stores.copy(drawn[0], tmp_path / "project"), drawn[1]
    other = sierra.open(root).run("population_size=1,2", "noise=0.1,0.5", runs=3, figures=False).batch
    done = projects.quick(root, "figures", first, other, "swarm_coverage_summary")
    values = "population_size = 1, 2, 4; noise = 0.1, 0.5 and population_size = 1, 2; noise = 0.1, 0.5"
    assert (done.returncode, f"have different values: {values}" in done.stderr) == (1, True), done.stderr
