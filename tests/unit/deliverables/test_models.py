"""Models: predictions that are drawn with the data, and how far the data are from them."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path

import pytest

import sierra
from tests import projects, stores

MODELS = """
[models.mean_field]
expression = "population_size * t + 4"
column = "coverage"
label = "mean field"

[models.final]
sql = "SELECT population_size, 4.5 * population_size AS coverage FROM (VALUES (1), (2)) p(population_size)"
table = "swarm"
column = "coverage"
"""
PROGRAM = """\
import csv, sys

print("population_size,tick,coverage")
for row in csv.DictReader(open(sys.argv[1])):
    count = int(open(row["input"]).read().split('<swarm count="')[1].split('"')[0])
    assert count == int(row["population_size"])
    for tick in (0, 1, 2.5, 4):
        print(count, tick, count * tick + 5, sep=",")
"""


@pytest.fixture(scope="module")
def root(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stores.copy(recorded, tmp_path_factory.mktemp("models") / "project")


def declare(root: Path, text: str) -> str:
    """Write tables into `sierra.toml`; return the batch with two experiments."""
    (root / "sierra.toml").write_text(projects.CONFIG + text)
    return str(sierra.open(root).batches[0].batch)


def model(source: str, **keys: str) -> str:
    """Return a table of a model of the coverage."""
    more = "".join(f"{name} = {value}\n" for name, value in keys.items())
    return f"[models.m]\n{source}\ncolumn = 'coverage'\ntable = 'swarm'\n{more}"


def svg(root: Path, name: str) -> str:
    """Return the text of a figure's SVG on one line."""
    [file] = root.glob(f"figures/*/{name}.svg")
    return " ".join(re.sub(r"<[^>]+>", " ", file.read_text()).split())


def deviations(of: Mapping[object, float], data: Mapping[object, float]) -> list[float]:
    return [of[key] - data[key] for key in of]


@pytest.mark.integration
def test_models_are_drawn_with_their_deviation_in_the_figures_of_their_column(root: Path) -> None:
    batch = declare(root, MODELS)
    done = projects.quick(root, "figures", batch)
    assert done.returncode == 0
    assert "model" not in done.stderr
    means = projects.sql(
        root,
        f"SELECT population_size p, tick, avg(coverage) m FROM swarm WHERE run IN "
        f"(SELECT run FROM batch_runs WHERE batch = '{batch}') GROUP BY ALL",
    )
    data = {(row["p"], row["tick"]): row["m"] for row in means}
    off = deviations({(p, t): p * t + 4 for p, t in data}, data)
    over_time = svg(root, "swarm_coverage_timeseries")
    rmse = math.sqrt(sum(d * d for d in off) / len(off))
    assert f"model mean field: RMSE {rmse:.3g}, bias {sum(off) / len(off):.3g}" in over_time
    assert "final" not in over_time
    summary = svg(root, "swarm_coverage_summary")
    off = deviations({(p, 4): 4.5 * p for p in (1, 2)}, data)
    assert f"model final: RMSE {math.sqrt(sum(d * d for d in off) / 2):.3g}" in summary
    assert "model mean field: RMSE" in summary
    assert "-- expression: population_size * t + 4" in (next(root.glob("figures/*/*_summary.svg"))).read_text()


@pytest.mark.integration
def test_each_experiment_has_its_errors(root: Path) -> None:
    batch = declare(root, MODELS)
    found = json.loads(projects.quick(root, "models", batch, "--json").stdout)
    assert [(row["model"], row["population_size"], row["n"], row["compared"], row["intervals"]) for row in found] == [
        *(("mean_field", p, 2, 5, 5) for p in (1, 2)),
        *(("final", p, 2, 1, 1) for p in (1, 2)),
    ]
    for row in found:
        assert row["bias"] == pytest.approx(row["predicted"] - row["data"])
        assert abs(row["bias"]) <= row["rmse"] + 1e-12
        assert row["rmse"] <= abs(row["largest"]) + 1e-12
    ends = sierra.open(root).statistics(batch, "swarm", "coverage")
    assert [row["data"] for row in found[2:]] == pytest.approx(ends.column("mean").to_pylist())
    inside = [
        lo <= 4.5 * p <= hi for p, lo, hi in zip((1, 2), *(ends.column(e).to_pylist() for e in ("low", "high")), strict=True)
    ]
    assert [row["inside"] for row in found[2:]] == inside
    done = projects.quick(root, "models", batch, "final", "--format", "csv")
    assert [row["rmse"] for row in csv.DictReader(io.StringIO(done.stdout))] == [repr(row["rmse"]) for row in found[2:]]
    assert "final over all experiments: RMSE" in done.stderr


@pytest.mark.integration
def test_a_program_gets_the_experiments_with_their_inputs_and_its_result_is_recorded(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    (root / "model.py").write_text(PROGRAM)
    batch = declare(root, model("command = '{python} model.py {experiments}'"))
    rows = json.loads(projects.quick(root, "models", batch, "--json").stdout)
    assert [row["compared"] for row in rows] == [3, 3]  # 2.5 is no time of the data, and nothing is interpolated
    projects.quick(root, "figures", batch, "swarm_coverage_timeseries")
    assert "at 6 of 10 times" in svg(root, "swarm_coverage_timeseries")
    [row] = projects.sql(root, "SELECT definition FROM deliverables")
    recorded = json.loads(row["definition"])["models"]["m"]
    assert recorded["command"] == ["{python}", "model.py", "{experiments}"]
    assert set(recorded["files"]) == {"{project}/model.py"}
    assert projects.quick(root, "figures", batch, "--check").returncode == 0
    (root / "model.py").write_text(PROGRAM + "# the same values\n")
    assert projects.quick(root, "figures", batch, "--check").returncode == 0
    (root / "model.py").write_text(PROGRAM.replace("+ 5", "+ 6"))
    changed = projects.quick(root, "figures", batch, "--check")
    assert (changed.returncode, "model 'm' predicts other values now" in changed.stdout) == (1, True)
    (root / "model.py").write_text("raise SystemExit('no licence')")
    failing = projects.quick(root, "figures", batch, "--check")
    assert re.search(r"model 'm' fails now: python\S* ended with exit status 1: no licence; draw it again", failing.stdout)


SIZES = "FROM (VALUES (1), (2)) p(population_size)"


@pytest.mark.integration
@pytest.mark.parametrize(
    ("source", "code", "expected"),
    [
        (
            "expression = 'popluation_size'",
            2,
            "unknown name 'popluation_size' in 'popluation_size'; did you mean 'population_size'?",
        ),
        ("expression = 'noise * t'", 1, "the batch does not vary noise"),
        (
            "expression = '1 / (t - t)'",
            2,
            "it has no value for any experiment of the batch: '1 / (t - t)' has no value: division",
        ),
        ("expression = 'exp(9 ** t)'", 0, "no value for 4 of 10 times: 'exp(9 ** t)' has no value: it is too large"),
        ("expression = '__import__(1)'", 2, "unknown function '__import__'"),
        ("sql = 'SELECT 1 AS coverge'", 2, "it has no column 'coverage', which it should predict; it has coverge"),
        (f"sql = 'SELECT 1 AS populaton_size, 1 AS coverage {SIZES}'", 2, "no time; did you mean 'population_size'?"),
        (f"sql = 'SELECT 1 AS coverage {SIZES}'", 2, "it has more than one row for population_size = 1"),
        (f"""sql = "SELECT population_size, 'x' AS coverage {SIZES}" """, 2, "column 'coverage' has 'x', which is no number"),
        ("sql = 'SELECT 2 AS population_size, 1 AS coverage'", 0, "no value for 1 of 2 experiments: no row"),
        (f"sql = 'SELECT population_size, 0 / 0 AS coverage {SIZES}'", 2, "any experiment of the batch: not a number"),
        ("sql = 'SELECT 1 AS experiment, 1 AS coverage'", 0, "no value for 1 of 2 experiments: no row"),
        ("sql = 'SELECT [1] AS population_size, 1 AS coverage'", 2, "any experiment of the batch: no row"),
        ("sql = 'SELECT 1 AS scenario, 1 AS coverage'", 1, "the batch does not vary scenario"),
        ("sql = 'SELECT 1 AS coverage WHERE false'", 2, "[models.m]: its statement returns no rows"),
        ("sql = 'SELECT coverage FROM nowhere'", 2, "[models.m]: there is no table 'nowhere'"),
        ("sql = \"SELECT * FROM read_csv('/etc/passwd')\"", 2, "read_csv"),
        ("file = 'absent.sql'", 2, "cannot read absent.sql: No such file or directory"),
        ("command = 'true'", 1, "true printed nothing; it should print a table as CSV"),
        ("command = 'absent-program'", 1, "'absent-program' cannot be started: No such file or directory"),
        ("command = ['sh', '-c', 'echo no licence >&2; exit 3']", 1, "sh ended with exit status 3: no licence"),
        ("command = ['sh', '-c', 'sleep 60 & sleep 60']\nwall = 0.2", 1, "it did not end within 0.2 s (wall)"),
        (r"command = ['printf', '{experiments},coverage\n1\n']", 2, "row 2 of its CSV has 1 values, but the header has 2"),
        (r"command = ['printf', 'coverage,coverage\n1,1\n']", 2, "it printed two columns of one name"),
        ("command = '{pyhton} x'", 2, "[models.m] command: unknown placeholder {pyhton}"),
    ],
)
def test_a_model_without_values_is_one_line(root: Path, source: str, code: int, expected: str) -> None:
    batch = declare(root, model(source))
    done = projects.quick(root, "models", batch, "m")
    assert expected in done.stderr
    assert (done.returncode, done.stderr.strip().count("\n")) == (code, 0), done.stderr


@pytest.mark.integration
def test_a_figure_is_drawn_without_a_model_that_fails(root: Path) -> None:
    batch = declare(root, model("expression = '1 / (t - t)'") + "[models.other]\nexpression = 't'\ncolumn = 'coverage'\n")
    done = projects.quick(root, "figures", batch)
    assert (done.returncode, done.stderr.count("model m is left out")) == (0, 1)
    assert "without model m, which failed" in svg(root, "swarm_coverage_summary")
    assert "model other: RMSE" in svg(root, "swarm_coverage_summary")
    asked = projects.quick(root, "figures", batch, "swarm_coverage_summary")
    assert (asked.returncode, asked.stderr.count("\n")) == (1, 1)
    assert "figure swarm_coverage_summary was drawn without model m: it has no value" in asked.stderr
    both = projects.quick(root, "models", batch)
    assert (both.returncode, "other" in both.stdout) == (1, True)
    assert "model m has no prediction" in both.stderr


@pytest.mark.integration
def test_a_model_that_no_figure_shows_is_reported(root: Path) -> None:
    one = "[models.{}]\nexpression = '{}'\ncolumn = '{}'\n{}\n".format
    models = {
        "a": ("1", "coverage", "table = 'swrm'"),
        "b": ("1", "covrage", ""),
        "c": ("1", "coverage", "measure = 'mean'"),
        "d": ("1", "coverage", "figures = 'wrong'"),
        "e": ("1", "coverage", "figures = 'swarm_coverage_timeseries'"),
        "f": ("noise", "coverage", ""),
    }
    done = projects.quick(root, "figures", declare(root, "".join(one(name, *keys) for name, keys in models.items())))
    assert done.returncode == 0
    for expected in (
        "model a is in no figure: the batch has no output 'swrm'; did you mean 'swarm'?",
        "model b is in no figure: no output has column 'covrage'",
        "model c is in no figure: none shows 'coverage' as it predicts it",
        "model d: there is no figure 'wrong'; it has swarm_coverage_",
        "model e is left out: figure swarm_coverage_timeseries cannot show it: it predicts one number for each experiment",
        "model f is left out: the batch does not vary noise",
    ):
        assert expected in done.stderr


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("column = 'x'", "give exactly one of expression, sql, file, command"),
        ("column = 'x'\nsql = 'SELECT 1'\nexpression = '1'", "not expression and sql"),
        ("expression = '1'", "column"),
        ("column = 'x'\nexpression = '1'\nthreshold = 1", 'measure "time_to" and "threshold" must be used together'),
        ("column = 'x'\nexpresion = '1'", "expression"),
    ],
)
def test_an_invalid_table_is_an_error(root: Path, table: str, expected: str) -> None:
    declare(root, "")
    (root / "sierra.toml").write_text(projects.CONFIG + f"[models.m]\n{table}\n")
    done = projects.quick(root, "models")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert expected in done.stderr
