"""Statistics and figures of derived tables: as of outputs, and what cannot be computed is one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sierra
from sierra.errors import UsageError
from sierra.store.batch_data import BatchData
from tests import projects, stores

ENDS = "SELECT run, max(coverage) AS most, max(coverage) > 5 AS good FROM swarm GROUP BY run"
COUNTS = "SELECT experiment, count(*) AS n FROM samples GROUP BY ALL"
TABLES = {
    "ends": ENDS,
    "halves": "SELECT run, population_size, tick, coverage / 2 AS half FROM swarm",
    "late": "SELECT run, coverage FROM swarm WHERE tick > 1",
    "lost": "SELECT tick, avg(coverage) AS m FROM swarm GROUP BY tick",
    "foreign": "SELECT upper(run) AS run, coverage FROM swarm",
    "nobody": "SELECT NULL AS run, 1 AS v FROM swarm",
    "first": "SELECT run, coverage FROM swarm WHERE run = (SELECT min(run) FROM swarm)",
    "empty": "SELECT run, coverage FROM swarm WHERE tick > 99",
    "twice": "SELECT run, tick, coverage FROM swarm, range(2)",
    "wrong": "SELECT run, covrage FROM swarm",
}


@pytest.fixture(scope="module")
def root(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = stores.copy(recorded, tmp_path_factory.mktemp("derived") / "project")
    tables = "".join(f"[tables.{name}]\nsql = '''{sql}'''\n" for name, sql in TABLES.items())
    (root / "sierra.toml").write_text(projects.CONFIG + tables)
    return root


@pytest.mark.integration
def test_statistics_of_a_derived_table_are_those_of_its_values(root: Path) -> None:
    project = sierra.open(root)
    batch = project.batches[0].batch
    ours = project.statistics(batch, "ends", "most")
    theirs = project.statistics(batch, "swarm", "coverage")
    for name in ("experiment", "population_size", "n", "mean", "sd", "low", "high", "median"):
        assert ours.column(name).to_pylist() == theirs.column(name).to_pylist()
    times = project.statistics(batch, "halves", "half", measure=None)
    assert times.column("t").to_pylist() == [0, 1, 2, 3, 4] * 2
    halved = [2 * mean for mean in times.column("mean").to_pylist()]
    assert halved == pytest.approx(project.statistics(batch, "swarm", "coverage", measure=None).column("mean").to_pylist())


@pytest.mark.integration
def test_a_flag_is_a_rate_with_the_interval_of_a_rate(root: Path) -> None:
    project = sierra.open(root)
    rates = project.statistics(project.batches[0].batch, "ends", "good")
    assert set(rates.column("interval").to_pylist()) == {"Wilson"}
    assert all(
        0 <= low <= mean <= high <= 1
        for low, mean, high in zip(*(rates.column(c).to_pylist() for c in ("low", "mean", "high")), strict=True)
    )


@pytest.mark.integration
def test_runs_without_rows_are_not_only_called_missing(root: Path) -> None:
    project = sierra.open(root)
    found = project.statistics(project.batches[0].batch, "first", "coverage")
    assert "3 of 4 runs missing or without such rows" in found.arrow.schema.metadata[b"sierra:note"].decode()


@pytest.mark.integration
def test_the_plan_for_a_rate_uses_the_interval_of_a_rate(root: Path) -> None:
    project = sierra.open(root)
    planned = project.studies.runs_needed(project.batches[0].batch, half_width=0.1, table="ends", column="good")
    rates = project.statistics(project.batches[0].batch, "ends", "good").column("mean").to_pylist()
    assert {0.0, 1.0} & set(rates), "runs that all agree have no standard deviation"
    assert all(one.runs is not None and one.runs >= 16 for one in planned.experiments)
    assert "the interval is Wilson's, because the column is a rate" in planned.notes


@pytest.mark.integration
def test_unordered_rows_without_a_time_count_by_their_mean(root: Path) -> None:
    project = sierra.open(root)
    batch = project.batches[0].batch
    found = project.statistics(batch, "late", "coverage")
    mean = project.sql("SELECT avg(coverage) AS m FROM swarm WHERE tick > 1 AND population_size = 1", within=batch).column("m")
    assert found.column("mean").to_pylist()[0] == pytest.approx(mean.to_pylist()[0])
    assert b"its SQL does not order the rows" in found.schema.metadata[b"sierra:note"]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (("lost", "m"), 2, "[tables.lost]: it has no column 'run', so there are no statistics over runs"),
        (("foreign", "coverage"), 2, "which is no run of batch"),
        (("nobody", "v"), 2, "[tables.nobody]: it has a row without a run"),
        (("empty", "coverage"), 1, "[tables.empty]: its statement returns no rows for batch"),
        (("wrong", "covrage"), 2, 'Candidate bindings: "coverage"'),
        (("twice", "coverage"), 2, "more than one row at the same time"),
        (("halves", "population_size"), 2, "no numeric column 'population_size'; it has tick, half"),
        (("ends", "mist"), 2, "no numeric column 'mist'"),
        (("end", "most"), 2, "this batch has no output 'end'; its outputs: empty, ends"),
    ],
)
def test_what_statistics_cannot_use_is_one_line(root: Path, words: tuple[str, ...], code: int, expected: str) -> None:
    done = projects.quick(root, "stats", *words, "-b", sierra.open(root).batches[0].batch)
    assert (done.returncode, done.stderr.count("\n"), done.stdout) == (code, 1, ""), done.stderr
    assert expected in done.stderr


@pytest.mark.integration
def test_other_figures_are_drawn_if_a_table_cannot_be_made(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    (root / "sierra.toml").write_text(
        projects.CONFIG
        + f"[tables.ends]\nsql = '{ENDS}'\nunits = {{ most = 'm' }}\n[tables.wrong]\nsql = 'FROM swrm'\n"
        + "[figures.good]\nkind = 'summary'\ntable = 'ends'\ncolumn = 'most'\n[figures.bad]\ntable = 'wrong'\ncolumn = 'x'\n"
    )
    batch = sierra.open(root).batches[0].batch
    done = projects.quick(root, "figures", batch)
    assert "good.svg" in done.stdout
    assert "figure bad: [tables.wrong]: there is no table 'swrm'; did you mean 'swarm'?" in done.stderr
    [svg] = root.glob("figures/*/good.svg")
    before = svg.read_bytes()
    asked = projects.quick(root, "figures", batch, "bad")
    assert (asked.returncode, asked.stderr.count("\n")) == (2, 1)
    projects.quick(root, "figures", batch)
    assert svg.read_bytes() == before


@pytest.mark.nightly
def test_a_figure_can_have_its_own_statement_and_its_files_contain_all_sql(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    figure = "[figures.{}]\nkind = 'summary'\ncolumn = 'm'\nsql = '{}'\n"
    own = figure.format("own", "SELECT run, 2 * most AS m FROM ends") + figure.format(
        "wrong", "SELECT run, now() AS m FROM ends"
    )
    (root / "sierra.toml").write_text(projects.CONFIG + f"[tables.ends]\nsql = '{ENDS}'\n" + own)
    batch = sierra.open(root).batches[0].batch
    done = projects.quick(root, "figures", batch)
    assert "figure wrong: sql: now() gives another value each time" in done.stderr
    [svg] = root.glob("figures/*/own.svg")
    text = svg.read_text()
    assert text.index(f"[tables.ends]\n{ENDS.split(' >')[0]}") < text.index("-- sql\nSELECT run, 2 * most AS m FROM ends")
    asked = projects.quick(root, "figures", batch, "--check")
    assert asked.returncode == 0, asked.stdout + asked.stderr
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("max(coverage) AS most", "min(coverage) AS most"))
    asked = projects.quick(root, "figures", batch, "--check")
    assert (asked.returncode, "the store has other data now" in asked.stdout + asked.stderr) == (1, True)


def test_a_name_that_a_column_and_a_variable_share_is_the_variable_in_conditions(root: Path) -> None:
    project = sierra.open(root)
    with BatchData(project.store, project.batches[0].batch) as frame:
        frame.samples("halves", "half", "tick", "population_size > 1 AND population_size_ > 1")
        counts = {row["experiment"]: row["n"] for row in frame.sql(COUNTS).to_pylist()}
        assert (list(counts), frame.experiments_with("halves", "population_size > 1")) == ([1], {1})
        frame.data("halves", "tick", "population_size > 1")
        assert "population_size" in frame.sql("FROM data").column_names


def test_a_condition_uses_columns_only(root: Path) -> None:
    with BatchData(sierra.open(root).store, sierra.open(root).batches[0].batch) as frame:
        frame.data("swarm", "tick", "tick > 1 AND NOT (coverage BETWEEN 1 AND 2) -- late")
        for text in ("tick > ", "true) UNION SELECT (1", "run IN (FROM runs)", "random() < 1", "EXISTS (FROM read_csv('x'))"):
            with pytest.raises(UsageError, match="where = "):
                frame.data("swarm", "tick", text)


MANY = "(SELECT count(*) FROM range(1000000000000000) a, range(1000000000000) b) > tick"


@pytest.mark.integration
@pytest.mark.parametrize(
    ("condition", "said"),
    [
        (MANY, "the statement did not end within 0.2 s"),
        (f"population_size > 0 OR {MANY}", "the statement did not end within 0.2 s"),
        ("len((SELECT list(range) FROM range(1000000000))) > tick", "out of memory: the statements of a command have 0.1 GB"),
    ],
)
def test_the_limits_hold_for_a_condition(root: Path, tmp_path: Path, condition: str, said: str) -> None:
    own = stores.copy(root, tmp_path / "project")
    wall = 0.2 if "within" in said else 300
    figure = f'[figures.f]\ntable = "swarm"\ncolumn = "coverage"\nwhere = "{condition}"\n'
    (own / "sierra.toml").write_text(f'{projects.CONFIG}{figure}[sql]\nwall = {wall}\nmemory = "100 MB"\n')
    done = projects.quick(own, "figures", sierra.open(own).batches[0].batch, "f")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert f"where = '{condition}': {said}" in done.stderr


@pytest.mark.integration
def test_a_rate_over_all_runs_counts_the_failed_ones(tmp_path: Path) -> None:
    failing = projects.SIMULATOR + "if seed % 2:\n    sys.exit(1)\n"
    sql = "SELECT run, status = 'ok' AS success FROM runs"
    root = projects.make(tmp_path / "p", projects.CONFIG + f'[tables.outcome]\nsql = "{sql}"\n', simulator=failing)
    done = projects.quick(root, "run", "population_size=1", "--runs", "8", "--no-figures")
    good = sierra.open(root).sql("SELECT count(*) AS n FROM runs WHERE status = 'ok'").to_pylist()[0]["n"]
    assert (done.returncode, 0 < good < 8) == (1, True)
    [row] = sierra.open(root).statistics(None, "outcome", "success").to_pylist()
    assert (row["n"], row["mean"], row["interval"]) == (8, good / 8, "Wilson")


NOTED = """\
import json, sys
with open("walk.jsonl", "w") as file:
    for tick in range(3):
        pose = {"x": 1.5 * tick, "y": 0.0}
        print(json.dumps({"tick": tick, "v": tick, "end": "done", "pose": pose, "near": [1] * tick}), file=file)
"""


@pytest.mark.nightly
def test_columns_without_a_figure_are_named_with_what_to_write(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p", simulator=NOTED)
    batch = projects.run(root, "population_size=1")[0]["batch"]
    done = projects.quick(root, "figures", batch, "--json")
    [note] = [one for one in done.stderr.splitlines() if "no figure of" in one]
    assert "'end', 'pose', 'near' of output 'walk'" in note
    line = note.partition("for example: ")[2]
    name, _, sql = line.partition(" sql = ")
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + f"{name}\nsql = {sql}\n")
    [row] = sierra.open(root).statistics(batch, name.strip("[]").removeprefix("tables."), "rate").to_pylist()
    assert (row["n"], row["mean"]) == (2, 1.0)


STOCHASTIC = projects.SIMULATOR.replace("count * tick", "__import__('random').SystemRandom().gauss(0, 0.01) + count * tick")


@pytest.mark.integration
def test_a_replay_compares_derived_tables_made_from_the_new_executions(tmp_path: Path) -> None:
    config = (
        projects.CONFIG
        + '[outputs.swarm]\nfile = "swarm.csv"\ntime = "tick"\n[tables.ends]\nsql = """'
        + "SELECT run, max(coverage) AS most FROM swarm GROUP BY run"
        + '"""\n[equivalence.most]\ntable = "ends"\ncolumn = "most"\nmargin = 0.5\n'
    )
    root = projects.make(tmp_path / "p", config, simulator=STOCHASTIC)
    batch = sierra.open(root).run("population_size=1", runs=8, figures=False).batch
    done = projects.quick(root, "replay", batch, "--json")
    said = json.loads(done.stdout)
    [metric] = said["experiments"][0]["metrics"]
    assert (done.returncode, said["verdict"], metric["n"]) == (0, "equivalent", 8)
    assert 0 < abs(metric["difference"]) < 0.1
