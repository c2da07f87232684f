"""A replay executes recorded runs from the record alone, and reports how far the results agree."""

from __future__ import annotations

import json
import venv
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

import sierra
from sierra.config.output_tables import Tolerance
from sierra.provenance import environment
from sierra.replay.compare_values import Rules, Verdict, of_tables, of_texts, worst
from sierra.worker import machine
from tests import projects, stores
from tests.unit.maintenance.test_fsck import seal

NOISY = projects.SIMULATOR.replace("count * tick", "__import__('time').time_ns() % 1000 + count * tick")
JITTER = projects.SIMULATOR.replace("count * tick", "(1 + 1e-13 * __import__('random').random()) * count * tick")
STAMPED = projects.SIMULATOR + "open('log.txt', 'w').write(f'# written {__import__(\"time\").time_ns()}\\nfine\\n')\n"
Make = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Return a function that makes a project outside git."""
    return lambda simulator=projects.SIMULATOR, more="": projects.make(
        tmp_path / "project", projects.CONFIG + more, simulator=simulator
    )


@pytest.fixture(params=["git", pytest.param("none", marks=pytest.mark.nightly)])
def make_either(request: pytest.FixtureRequest, make: Make) -> Make:
    """Return a function that makes a project, once in git and once outside."""
    return lambda *words: projects.commit(make(*words)) if request.param == "git" else make(*words)


def ask(root: Path, *query: str) -> str:
    return stores.ask(root, *(query or ("population_size=1,2",)))


def replay(root: Path, *words: str) -> tuple[int, dict[str, Any]]:
    ended = projects.quick(root, "replay", *words, "--json")
    return ended.returncode, json.loads(ended.stdout) if ended.stdout else {"stderr": ended.stderr}


@pytest.mark.integration
def test_outputs_with_the_same_bytes_are_identical(make_either: Make) -> None:
    root = make_either()
    batch = ask(root)
    code, said = replay(root, batch[:10])
    assert (code, said["verdict"], said["runs"], said["counts"]) == (0, "identical", 4, {"identical": 4})
    rows = sierra.open(root).sql("SELECT purpose, count(*) AS n FROM executions GROUP BY 1 ORDER BY 1").to_pylist()
    assert rows == [{"purpose": "replay", "n": 4}, {"purpose": "run", "n": 4}]


@pytest.mark.integration
def test_the_recorded_source_is_restored_and_the_project_stays_unchanged(make_either: Make) -> None:
    root = make_either()
    batch = ask(root)
    (root / "sim.py").write_text(projects.SIMULATOR.replace("count * tick", "count * tick + 1"))
    (root / "arena.xml").write_text("<arena/>")
    assert replay(root, batch)[1]["verdict"] == "identical"
    assert "tick + 1" in (root / "sim.py").read_text()
    assert not list(root.glob(".sierra/work/*/source"))


@pytest.mark.integration
def test_experiments_runs_executions_and_a_limited_number_of_runs_can_be_replayed(make: Make) -> None:
    root = make()
    batch = ask(root)
    project = sierra.open(root)
    [row] = project.sql("SELECT experiment FROM experiments LIMIT 1").to_pylist()
    [one] = project.sql("SELECT run, execution FROM executions LIMIT 1").to_pylist()
    assert [replay(root, key)[1]["runs"] for key in (row["experiment"], one["run"], one["execution"])] == [2, 1, 1]
    assert replay(root, batch, "--runs", "1")[1]["runs"] == 2


@pytest.mark.integration
def test_differences_are_named_and_replays_are_never_effective(make: Make) -> None:
    root = make(NOISY)
    batch = ask(root)
    before = sierra.open(root).sql("SELECT * FROM swarm ORDER BY ALL")
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (1, "different")
    first = next(output for output in said["outputs"] if output["verdict"] == "different")
    assert (first["path"], first["column"]) == ("swarm.csv", "coverage")
    assert first["max_abs"] > 0
    assert f"row {first['row']}: 'coverage' was {first['recorded_value']} and is {first['replayed_value']}" in first["reason"]
    assert sierra.open(root).sql("SELECT * FROM swarm ORDER BY ALL").equals(before)


@pytest.mark.integration
def test_a_declared_tolerance_is_applied_and_the_greatest_difference_is_reported(make: Make) -> None:
    root = make(JITTER, '[outputs.swarm]\nfile = "swarm.csv"\n')
    batch = ask(root)
    assert replay(root, batch)[0] == 1
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + "tolerance = { coverage = { rel = 1e-12 } }\n")
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (0, "within tolerance")
    assert all(0 < output["max_rel"] < 1e-12 for output in said["outputs"] if output["verdict"] == "within tolerance")


@pytest.mark.nightly
def test_a_date_differs_until_it_is_declared_volatile(make: Make) -> None:
    root = make(STAMPED, '[outputs.log]\nfile = "log.txt"\n')
    batch = ask(root)
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (1, "different")
    assert any(output["reason"].startswith("line 1 was '# written") for output in said["outputs"])
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + "volatile = ['^# written']\n")
    assert [replay(root, batch)[0], replay(root, batch)[1]["verdict"]] == [0, "equal"]


@pytest.mark.integration
def test_a_changed_program_is_reported_before_the_verdict_and_a_missing_one_is_an_error(tmp_path: Path) -> None:
    program = tmp_path / "sim"
    program.write_text("#!/bin/sh\nprintf 'tick,v\\n0,1\\n' > out.csv\n")
    program.chmod(0o755)
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", str(program)))
    batch = ask(root)
    program.write_text("#!/bin/sh\nprintf 'tick,v\\n0,2\\n' > out.csv\n")
    code, said = replay(root, batch)
    assert code == 1
    assert said["notes"][0].startswith("different programs: sim: ")
    program.unlink()
    ended = projects.quick(root, "replay", batch)
    assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)
    assert "was not found" in ended.stderr


@pytest.mark.nightly
def test_another_machine_is_reported_before_the_verdict(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    root = make()
    batch = ask(root)
    facts = machine.facts()
    monkeypatch.setattr(environment, "facts", lambda: {**facts, "cpu_flags": ["avx", "gone"], "libc": "musl 1.2"})
    other = sierra.open(root).replay(batch)
    assert other.verdict == "identical"
    [flags, libc] = other.notes
    assert flags.startswith("different machine: cpu_flags that differ: was ")
    assert "gone" in flags.partition(", is ")[2]
    assert libc == f"different machine: libc was {facts['libc']}, is now musl 1.2"


@pytest.mark.integration
def test_a_replayed_run_that_fails_has_the_verdict_failed(make: Make, tmp_path: Path) -> None:
    slow = tmp_path / "slow"
    root = make(f"{projects.SIMULATOR}import os, time\nif os.path.exists({str(slow)!r}):\n    time.sleep(60)\n")
    batch = ask(root)
    slow.touch()
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + "[limits]\nwall = 0.001\n")
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (1, "failed")
    assert "ran longer than its limit" in said["outputs"][0]["reason"]


@pytest.mark.integration
def test_a_moved_project_has_the_same_ids_and_verdict(make_either: Make, tmp_path: Path) -> None:
    root = make_either()
    batch = ask(root)
    moved = tmp_path / "else where" / "moved"
    moved.parent.mkdir()
    root.rename(moved)
    assert replay(moved, batch)[1]["verdict"] == "identical"
    assert ask(moved) == batch


SHUFFLED = projects.SIMULATOR.replace(
    "import sys\n", "import os, random, sys\nshuffled = random.Random(os.urandom(8))\n"
).replace("count * tick", "sum(sorted((0.1 * k for k in range(50)), key=lambda _: shuffled.random())) + count * tick")
UNORDERED = projects.SIMULATOR.replace(
    "for tick in range(5)", "for tick in sorted(range(5), key=lambda _: __import__('os').urandom(4))"
)
STOCHASTIC = projects.SIMULATOR.replace("count * tick", "__import__('random').SystemRandom().gauss(0, 0.01) + count * tick")
DECLARED = '[outputs.swarm]\nfile = "swarm.csv"\ntime = "tick"\n'
METRIC = '[equivalence.coverage]\ntable = "swarm"\ncolumn = "coverage"\n'


def declare(root: Path, text: str) -> None:
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + text)


@pytest.mark.nightly
def test_sums_in_another_order_are_within_a_tolerance_of_the_command_line(make: Make) -> None:
    root = make(SHUFFLED, DECLARED)
    batch = ask(root)
    assert replay(root, batch)[1]["verdict"] == "different"
    code, said = replay(root, batch, "--set-tolerance", "coverage=ulp:8")
    assert (code, said["verdict"], said["by_output"]) == (0, "within tolerance", {"swarm.csv": "within tolerance"})
    code, said = replay(root, batch, "--set-tolerance", "swarm.coverage=abs:1e-300,rel:1e-13")
    assert (code, said["verdict"]) == (0, "within tolerance")
    [asked] = sierra.open(root).sql("SELECT DISTINCT tolerances FROM replays WHERE tolerances LIKE '%rel%'").to_pylist()
    assert json.loads(asked["tolerances"]) == {"swarm": {"coverage": {"abs": 1e-300, "rel": 1e-13}}}


@pytest.mark.parametrize("text", ["coverage", "coverage=1", "=rel:1", "coverage=rel:x", "coverage=far:1", "coverage=rel:-1"])
def test_an_invalid_tolerance_is_refused(make: Make, text: str) -> None:
    ended = projects.quick(make(), "replay", "774d", "--set-tolerance", text)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)


@pytest.mark.nightly
def test_a_tolerance_of_an_unknown_output_is_refused_before_any_run_executes(make: Make) -> None:
    root = make()
    ended = projects.quick(root, "replay", ask(root), "--set-tolerance", "swamp.coverage=rel:1")
    assert (ended.returncode, "unknown output 'swamp'; known outputs: swarm" in ended.stderr) == (2, True)
    assert not sierra.open(root).sql("SELECT 1 FROM executions WHERE purpose <> 'run'").num_rows


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("covrage=rel:1", "no output has the column 'covrage'; did you mean 'coverage'?"),
        ("swarm.coverag=rel:1", "output 'swarm' has no column 'coverag'; did you mean 'coverage'?"),
        ("swarm.xyz=rel:1", "output 'swarm' has no column 'xyz'; it has coverage, tick"),
    ],
)
def test_a_tolerance_of_an_unknown_column_is_refused_with_a_suggestion(make: Make, text: str, said: str) -> None:
    root = make()
    ended = projects.quick(root, "replay", ask(root), "--set-tolerance", text)
    assert (ended.returncode, ended.stderr) == (2, f"sierra: --set-tolerance: {said}\n")
    assert not sierra.open(root).sql("SELECT 1 FROM executions WHERE purpose <> 'run'").num_rows


@pytest.mark.nightly
def test_declared_columns_that_are_missing_are_reported(make: Make) -> None:
    root = make()
    batch = ask(root)
    declare(root, f'{DECLARED}volatile = ["wall"]\ntolerance = {{ covrage = {{ rel = 1.0 }}, "*" = {{ abs = 1.0 }} }}\n')
    assert replay(root, batch)[1]["notes"] == [
        "[outputs.swarm] tolerance: the table has no column 'covrage'; did you mean 'coverage'?",
        "[outputs.swarm] volatile: the table has no column 'wall'; it has tick, coverage",
    ]


@pytest.mark.nightly
def test_a_volatile_column_that_differs_is_named(make: Make) -> None:
    root = make(NOISY, f'{DECLARED}volatile = ["coverage"]\n')
    code, said = replay(root, ask(root))
    assert (code, said["verdict"]) == (0, "equal")
    whys = {one["reason"] for one in said["outputs"] if one["verdict"] == "equal"}
    assert whys == {"only volatile columns differ: 'coverage'"}


@pytest.mark.nightly
def test_rows_in_another_order_differ_until_the_output_is_declared_unordered(make: Make) -> None:
    root = make(UNORDERED, f'{DECLARED}time_order = "any"\n')
    batch = ask(root)
    assert replay(root, batch)[1]["verdict"] == "different"
    declare(root, "ordered = false\n")
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (0, "equal")
    assert {one["reason"] for one in said["outputs"] if one["verdict"] == "equal"} == {"the same rows in another order"}


@pytest.mark.nightly
def test_the_time_of_the_first_difference_and_its_growth_are_reported(make: Make) -> None:
    grows = projects.SIMULATOR.replace("count * tick", "(tick > 2) * tick * __import__('time').time_ns() % 7919 + count * tick")
    root = make(grows, DECLARED)
    code, said = replay(root, ask(root), "--runs", "1")
    first = next(one for one in said["outputs"] if one["verdict"] == "different")
    assert code == 1
    assert "row 3 (at 3): 'coverage' was" in first["reason"]
    assert [until for until, _ in first["growth"]] == [0, 1, 2, 3, 4]
    assert [far > 0 for _, far in first["growth"]] == [False, False, False, True, True]


@pytest.mark.nightly
def test_stochastic_runs_are_equivalent_if_a_declared_metric_is_equivalent(make: Make) -> None:
    root = make(STOCHASTIC, f"{DECLARED}{METRIC}margin = 0.5\n")
    batch = sierra.open(root).run("population_size=1,2", runs=8, figures=False).batch
    code, said = replay(root, batch)
    assert (code, said["verdict"], said["counts"]) == (0, "equivalent", {"different": 16})
    for experiment in said["experiments"]:
        [metric] = experiment["metrics"]
        assert (experiment["verdict"], metric["n"], metric["margin"], metric["equivalent"]) == ("equivalent", 8, 0.5, True)
        assert metric["power"] > 0.99
        assert f"is within ±0.5, n = 8, p = {metric['p']:.2g}, power {metric['power']:.2f}" in metric["reason"]
    rows = sierra.open(root).sql("SELECT metric, n, equivalent FROM equivalences").to_pylist()
    assert rows == [{"metric": "coverage", "n": 8, "equivalent": True}] * 2


@pytest.mark.nightly
def test_stochastic_nanoseconds_since_1970_are_compared_with_all_their_digits(make: Make) -> None:
    """Floats near 1.76e18 are multiples of 256, far more than the runs differ by."""
    late = "1764 * 10**15 + int(__import__('random').SystemRandom().gauss(0, 10))"
    simulator = projects.SIMULATOR.replace("count * tick + noise * (seed % 100)", late)
    root = make(simulator, f"{DECLARED}{METRIC}margin = 60\n")
    batch = sierra.open(root).run("population_size=1", runs=12, figures=False).batch
    code, said = replay(root, batch)
    [[metric]] = [experiment["metrics"] for experiment in said["experiments"]]
    assert (code, said["verdict"], metric["equivalent"]) == (0, "equivalent", True)
    assert 0 < metric["high"] - metric["low"] < 100
    assert metric["recorded_mean"] == pytest.approx(1.764e18)


@pytest.mark.nightly
def test_runs_differ_if_the_margin_is_too_narrow_and_the_power_is_reported(make: Make) -> None:
    root = make(STOCHASTIC, f"{DECLARED}{METRIC}margin = 1e-6\n")
    batch = ask(root)
    ended = projects.quick(root, "replay", batch)
    assert ended.returncode == 1
    assert "not shown to be equivalent: population_size=1: coverage: mean difference" in ended.stdout
    assert "power 0.00" in ended.stdout


@pytest.mark.nightly
def test_equivalence_needs_whole_experiments_and_never_hides_failed_runs(make: Make) -> None:
    root = make(STOCHASTIC, f"{DECLARED}{METRIC}margin = 0.5\n")
    batch = ask(root)
    code, said = replay(root, batch, "--runs", "1")
    assert (code, said["verdict"], said["notes"]) == (
        1,
        "different",
        ["equivalence is tested only for whole experiments: replay without --runs"],
    )
    declare(root, '[limits]\noutput = "1 B"\n')
    assert replay(root, batch)[1]["verdict"] == "failed"


@pytest.mark.nightly
def test_a_metric_of_a_missing_column_is_reported_and_not_evaluated(make: Make) -> None:
    root = make(STOCHASTIC, DECLARED + METRIC.replace('"coverage"', '"x"') + "margin = 0.5\n")
    code, said = replay(root, ask(root))
    assert (code, said["verdict"]) == (1, "different")
    assert said["notes"][0].startswith("[equivalence]: output 'swarm'")


@pytest.mark.integration
def test_a_metric_without_a_value_in_the_replay_is_reported(make: Make, tmp_path: Path) -> None:
    twice = f"sorted(list(range(5)) * (1 + __import__('os').path.exists({str(tmp_path / 'flag')!r})))"
    simulator = STOCHASTIC.replace("range(5)", twice)
    root = make(simulator, f"{DECLARED}{METRIC}margin = 0.5\n")
    batch = ask(root)
    (tmp_path / "flag").touch()
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (1, "different")
    assert any("[equivalence]" in note and "the replay has no values to compare" in note for note in said["notes"])


@pytest.mark.nightly
def test_verdicts_are_written_as_junit_on_request(make: Make, tmp_path: Path) -> None:
    root = make(NOISY)
    batch = ask(root)
    assert replay(root, batch, "--junit", str(tmp_path / "replay.xml"))[0] == 1
    suites = etree.parse(tmp_path / "replay.xml").getroot().findall("testsuite")
    assert [(suite.get("name"), suite.get("tests")) for suite in suites] == [
        ("population_size=1", "2"),
        ("population_size=2", "2"),
    ]
    failures = [case.find("failure") for suite in suites for case in suite]
    assert any(failure is not None and "row " in str(failure.text) for failure in failures)
    ended = projects.quick(root, "replay", batch, "--junit", str(tmp_path / "no" / "replay.xml"))
    assert (ended.returncode, "does not exist" in ended.stderr) == (3, True)


@pytest.mark.nightly
def test_an_option_keeps_the_restored_source_and_the_folders_of_runs(make_either: Make) -> None:
    root = make_either()
    batch = ask(root)
    kept = Path(replay(root, batch, "--keep")[1]["kept"])
    assert (kept / "source" / "sim.py").read_text() == projects.SIMULATOR
    assert len(list(kept.glob("*/output/swarm.csv"))) == 4
    assert ask(root) == batch, "what is kept is no part of the project's source"


@pytest.mark.nightly
def test_options_choose_the_runner_and_the_engine_of_a_replay(make: Make) -> None:
    root = make()
    batch = ask(root)
    assert replay(root, batch, "--on", "local", "--engine", "none")[0] == 0
    for words in (("--on", "cloud"), ("--engine", "docker")):
        ended = projects.quick(root, "replay", batch, *words)
        assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)


NUMBERS = st.lists(st.one_of(st.none(), st.floats(allow_nan=True, allow_infinity=True)), max_size=12)


@given(NUMBERS)
def test_equal_tables_are_equal(values: list[float | None]) -> None:
    table = pa.table({"v": pa.array(values, pa.float64())})
    assert of_tables(table, table).verdict is Verdict.EQUAL


@given(NUMBERS, st.integers(0, 11))
def test_one_changed_or_added_value_is_located(values: list[float | None], place: int) -> None:
    other = [*values]
    if place < len(values):
        other[place] = 0.5 if values[place] != 0.5 else None
        found = of_tables(*(pa.table({"v": pa.array(v, pa.float64())}) for v in (values, other)))
        assert (found.verdict, found.row, found.column) == (Verdict.DIFFERENT, place, "v")
    else:
        found = of_tables(*(pa.table({"v": pa.array(v, pa.float64())}) for v in (values, [*values, 1.0])))
        assert found.verdict is Verdict.DIFFERENT


@pytest.mark.parametrize(
    ("was", "now", "tolerance", "verdict"),
    [
        ([1.0, 2.0], [1.0, 2.0 + 1e-9], Tolerance(abs=1e-8), Verdict.WITHIN),
        ([1.0, 2.0], [1.0, 2.0 + 1e-9], Tolerance(abs=1e-10), Verdict.DIFFERENT),
        ([1e9, 1.0], [1e9 + 1, 1.0], Tolerance(rel=1e-8), Verdict.WITHIN),
        ([1.0], [1.0 + 2**-52], Tolerance(ulp=1), Verdict.WITHIN),
        ([1.0], [1.0 + 2**-51], Tolerance(ulp=1), Verdict.DIFFERENT),
        ([0.0], [1e-300], Tolerance(rel=1), Verdict.DIFFERENT),
        ([1.0], [float("nan")], Tolerance(abs=1e300, rel=1e300), Verdict.DIFFERENT),
        ([1.0], [float("inf")], Tolerance(abs=1e300, rel=1e300), Verdict.DIFFERENT),
        ([1.0], [None], Tolerance(abs=1e300), Verdict.DIFFERENT),
        ([1.7976931348623157e308], [0.5], Tolerance(), Verdict.DIFFERENT),
        ([1.7976931348623157e308], [1.7976931348623155e308], Tolerance(ulp=1), Verdict.WITHIN),
    ],
)
def test_absolute_relative_and_ulp_tolerances_decide_the_verdict(
    was: list[Any], now: list[Any], tolerance: Tolerance, verdict: Verdict
) -> None:
    tables = [pa.table({"v": pa.array(values, pa.float64())}) for values in (was, now)]
    assert of_tables(*tables, Rules({"*": tolerance})).verdict is verdict


def test_a_tolerance_applies_to_one_column() -> None:
    tables = [pa.table({"a": [1.0], "b": [value]}) for value in (1.0, 1.1)]
    assert of_tables(*tables, Rules({"a": Tolerance(abs=1)})).verdict is Verdict.DIFFERENT
    assert of_tables(*tables, Rules({"b": Tolerance(abs=1)})).verdict is Verdict.WITHIN
    assert of_tables(*tables, Rules(volatile=["b"])).verdict is Verdict.EQUAL


def test_other_columns_and_unequal_large_integers_differ() -> None:
    assert of_tables(pa.table({"a": [1]}), pa.table({"b": [1]}), Rules({"*": Tolerance(abs=9)})).verdict is Verdict.DIFFERENT
    assert of_tables(pa.table({"a": [2**60]}), pa.table({"a": [2**60 + 1]})).verdict is Verdict.DIFFERENT


def test_texts_are_compared_by_lines() -> None:
    assert of_texts(b"a\nb\n", b"a\nc\n").row == 1
    assert of_texts(b"a\n", b"a\nc\n").verdict is Verdict.DIFFERENT
    assert of_texts(b"# 1\na\n", b"# 2\na\n", ["^#"]).verdict is Verdict.EQUAL


def test_the_worst_verdict_is_the_verdict_of_the_replay() -> None:
    assert worst([Verdict.IDENTICAL, Verdict.WITHIN, Verdict.EQUAL]) is Verdict.WITHIN
    assert not worst([Verdict.FAILED, Verdict.DIFFERENT]).fine


def test_integers_and_floats_are_compared_exactly_and_booleans_are_not_numbers() -> None:
    def of(was: pa.Array, now: pa.Array) -> Verdict:
        return of_tables(pa.table({"v": was}), pa.table({"v": now})).verdict

    assert of(pa.array([1, 2]), pa.array([1.0, 2.0])) is Verdict.EQUAL
    assert of(pa.array([2**53 + 1]), pa.array([2.0**53])) is Verdict.DIFFERENT
    assert of(pa.array([2**63 + 1], pa.uint64()), pa.array([2.0**63])) is Verdict.DIFFERENT
    assert of(pa.array([True, False]), pa.array([1, 0])) is Verdict.DIFFERENT
    assert of(pa.array([None], pa.bool_()), pa.array([None], pa.int64())) is Verdict.EQUAL


@pytest.mark.nightly
def test_an_experiment_of_several_batches_is_replayed_with_its_values(make: Make) -> None:
    root = make()
    for query in ("population_size=4", "population_size=1,2,4", "population_size=4,5"):
        ask(root, query)
        [row] = sierra.open(root).sql("SELECT DISTINCT experiment FROM experiments WHERE population_size = 4").to_pylist()
        code, said = replay(root, row["experiment"])
        assert (code, said["verdict"], said["experiments"][0]["values"]) == (0, "identical", {"population_size": 4})


@pytest.mark.nightly
def test_runs_without_comparable_outputs_are_not_reported_as_identical(make: Make) -> None:
    only_logs = "import sys, time\nprint(time.time_ns())\n"
    root = make(only_logs + "if b'count=\"2\"' in open(sys.argv[1], 'rb').read(): open('x.txt', 'w').write('x')\n")
    batch = ask(root, "population_size=1")
    ended = projects.quick(root, "replay", batch)
    assert (ended.returncode, "wrote only logs, and logs are not compared" in ended.stderr) == (3, True)
    code, said = replay(root, ask(root))
    assert (code, said["notes"]) == (0, ["2 of 4 runs wrote only logs, and logs are not compared"])


@pytest.mark.nightly
def test_a_changed_program_that_git_ignores_and_that_is_not_kept_is_used_and_reported(tmp_path: Path) -> None:
    config = projects.CONFIG.replace("python3 sim.py", "build/sim") + "[source]\nmax_ignored = 0\n"
    root = projects.make(tmp_path / "project", config)
    program = root / "build" / "sim"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\nprintf 'tick,v\\n0,1\\n' > out.csv\n")
    program.chmod(0o755)
    (root / ".gitignore").write_text("build\n")
    projects.commit(root)
    batch = ask(root)
    code, said = replay(root, batch)
    assert (code, said["verdict"], said["notes"]) == (0, "identical", [])
    program.write_text("#!/bin/sh\nprintf 'tick,v\\n0,2\\n' > out.csv\n")
    code, said = replay(root, batch)
    assert (code, said["notes"][0].startswith("different programs: {project}/build/sim: ")) == (1, True)


@pytest.mark.nightly
def test_a_replay_uses_the_python_environment_of_the_project(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3", ".venv/bin/python"))
    venv.create(root / ".venv", symlinks=True)
    [installed] = root.glob(".venv/lib/python3*/site-packages")
    (installed / "used.py").write_text("")
    (root / "sim.py").write_text("import used\n" + projects.SIMULATOR)
    (root / ".gitignore").write_text(".venv\n")
    projects.commit(root)
    code, said = replay(root, ask(root))
    assert (code, said["verdict"], said["notes"]) == (0, "identical", [])


@pytest.mark.integration
def test_rows_missing_from_the_store_are_an_error(make: Make) -> None:
    root = make(NOISY)
    batch = ask(root)
    [file] = stores.files(root, "output.swarm")
    pq.write_table(pq.read_table(file).slice(0, 17), file)
    seal(file.parent)
    ended = projects.quick(root, "replay", batch)
    assert (ended.returncode, ended.stderr.count("\n")) == (1, 1)
    assert "the store has 2 of the 5 rows that execution " in ended.stderr


@pytest.mark.integration
def test_the_same_bytes_are_different_if_the_record_lacks_some_of_their_rows(make: Make) -> None:
    root = make()
    batch = ask(root)
    file = min(stores.files(root, "output.swarm"))
    lost = pq.read_table(file).column("execution")[0].as_py()
    pq.write_table(pq.read_table(file).slice(1), file)
    artifacts = pq.read_table(file.with_name("artifacts.parquet"))
    rows = artifacts.to_pylist()
    for row in rows:
        if (row["execution"], row["path"]) == (lost, "swarm.csv"):
            row.update(rows=row["rows"] - 1, counted=None)  # as recorded by versions that did not count rows
    pq.write_table(pa.Table.from_pylist(rows, schema=artifacts.schema), file.with_name("artifacts.parquet"))
    seal(file.parent)
    code, said = replay(root, batch)
    assert (code, said["verdict"], said["counts"]) == (1, "different", {"identical": 3, "different": 1})
    assert "the same bytes, but the recorded table has 4 of 5 rows (see sierra fsck)" in json.dumps(said)


@pytest.mark.integration
def test_skipped_runs_are_counted_next_to_the_verdict(make: Make) -> None:
    lacking = "import os\nif count == 2 and seed % 2 == 0: os.remove('swarm.csv')\n"  # no error of the program itself
    root = make(projects.SIMULATOR + lacking, more='[outputs.swarm]\nfile = "swarm.csv"\n')
    batch = ask(root, "population_size=1,2", "montecarlo.C4")
    [(good,)] = [row.values() for row in sierra.open(root).sql("SELECT count(*) FROM effective").to_pylist()]
    assert 0 < good < 16
    code, said = replay(root, batch)
    assert (code, said["verdict"], said["runs"], said["of"]) == (0, "identical", good, 16)
    assert f"identical ({good} of 16 runs: {good} identical)" in projects.quick(root, "replay", batch).stdout


def test_columns_of_lists_and_structures_are_compared() -> None:
    def table(*values: Any) -> pa.Table:
        return pa.table({"list": [[1.5, value] for value in values], "struct": [{"x": value} for value in values]})

    nan = float("nan")
    assert of_tables(table(1.0, None, nan), table(1.0, None, nan)).verdict is Verdict.EQUAL
    assert of_tables(table(1.0, 2.0), table(2.0, 1.0), Rules(ordered=False)).verdict is Verdict.EQUAL
    said = of_tables(table(1.0, 2.0), table(1.0, 3.0))
    assert (said.verdict, said.row, said.column) == (Verdict.DIFFERENT, 1, "list")


def test_outputs_that_are_entirely_volatile_are_reported() -> None:
    assert "all columns" in of_tables(pa.table({"v": [1]}), pa.table({"v": [2]}), Rules(volatile=["v"])).reason
    assert "all lines" in of_texts(b"a\n", b"b\n", ["^"]).reason


def change(root: Path, table: str, **columns: list[Any]) -> None:
    """Write other values into a table of a store, as an attacker could."""
    for file in list(root.glob(f".sierra/segments/*/{table}.parquet")):
        rows = pq.read_table(file)
        for name, values in columns.items():
            place = rows.schema.get_field_index(name)
            field = rows.schema.field(place)
            rows = rows.set_column(place, field, pa.array(values * rows.num_rows, field.type))
        pq.write_table(rows, file)
        seal(file.parent)


@pytest.mark.integration
@pytest.mark.parametrize("name", ["../../../x", "/tmp/sierra-x", "..", "a/../../../../x", ""])
def test_an_input_path_outside_the_folder_in_a_hostile_store_is_refused(make: Make, name: str) -> None:
    root = make()
    batch = ask(root)
    change(root, "specs", files=[[name]])
    index = root / ".sierra" / "numbers"
    before = {*root.parent.rglob("*"), index}
    ended = projects.quick(root, "replay", batch)
    assert (ended.returncode, ended.stderr.count("\n")) == (1, 1)
    assert f"the record names the path {name!r}, which is not inside" in ended.stderr
    logs = root / ".sierra" / "logs"
    assert {*root.parent.rglob("*"), index} - {logs, *logs.glob("*.log")} == before - {logs, *logs.glob("*.log")}


@pytest.mark.nightly
def test_files_copied_into_a_restored_source_stay_in_it(make: Make, tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared" / "map.csv").write_text("x")
    root = make(projects.SIMULATOR + "open(sys.argv[2]).read()\n")
    (root / "maps").symlink_to("../shared")
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("{input}", "{input} {project}/maps/map.csv"))
    code, said = replay(root, ask(root), "--keep")
    assert (code, said["verdict"]) == (0, "identical")
    kept = Path(said["kept"], "source", "maps")
    assert (kept.is_symlink(), (kept / "map.csv").read_text()) == (False, "x")


def table(**columns: list[Any]) -> pa.Table:
    return pa.table(columns)


def test_equal_values_are_reported_with_the_digits_that_are_stored() -> None:
    assert of_tables(table(v=[0.1]), table(v=[0.1])).reason == (
        "the same values (fractions: the 17 digits that a double holds), but different bytes"
    )
    assert of_tables(table(v=[1]), table(v=[1])).reason == "the same values, but different bytes"
    beside = of_tables(table(v=[0.1], when=[1]), table(v=[0.1], when=[2]), Rules(volatile=["when"]))
    assert beside.reason == (
        "only volatile columns differ: 'when'; all other values are the same (fractions: the 17 digits that a double holds)"
    )
    old, new = (
        pa.table({"v": pa.array([Decimal(text)], pa.decimal128(38, 30))}) for text in (f"0.{'1' * 20}1", f"0.{'1' * 20}2")
    )
    said = of_tables(old, new)
    assert (said.verdict, said.max_abs) == (Verdict.DIFFERENT, pytest.approx(1e-21))
    assert said.reason.startswith(f"row 0: 'v' was 0.{'1' * 20}1")


def test_differences_of_large_integers_are_exact() -> None:
    said = of_tables(table(v=[2**53]), table(v=[2**53 + 1]))
    assert (said.verdict, said.max_abs) == (Verdict.DIFFERENT, 1.0)
    assert "largest difference 1" in said.reason
    assert of_tables(table(v=[2**60 + 1]), table(v=[2**60 + 300])).max_abs == 299
    assert of_tables(table(v=[2**53]), table(v=[2**53 + 1]), Rules({"v": Tolerance(abs=1)})).verdict is Verdict.WITHIN
    assert of_tables(table(v=[2**53 + 1]), table(v=[2.0**53])).max_abs == 1


def test_missing_values_nan_and_infinity_have_no_reported_distance() -> None:
    for was, now in ((1.0, None), (1.0, float("nan")), (1.0, float("inf")), (None, 1.0)):
        said = of_tables(pa.table({"v": pa.array([was], pa.float64())}), pa.table({"v": pa.array([now], pa.float64())}))
        assert "difference" not in said.reason
        assert "None" not in said.reason
    assert (
        "'v' was 1.0 and is missing"
        in of_tables(table(v=[1.0, 2.0]), pa.table({"v": pa.array([None, 2.0], pa.float64())})).reason
    )
    said = of_tables(table(v=[0.0]), table(v=[0.5]))
    assert "largest difference 0.5;" in said.reason
    assert "relative" not in said.reason


def test_all_differing_columns_are_named_or_counted() -> None:
    old, new = ({f"c{n}": [0.0, 0.0, float(n) if now else 0.0] for n in range(7)} for now in (False, True))
    said = of_tables(table(**old), table(**new))
    assert (said.row, said.column) == (2, "c1")
    assert "; 6 columns differ: 'c1' in 1 of 3 rows, 'c2' in 1 of 3 rows" in said.reason
    assert said.reason.endswith(" and 2 more")


def test_shared_rows_and_columns_are_compared_if_others_were_added_or_removed() -> None:
    wide = {f"column{n}": [1.0, 2.0] for n in range(500)}
    said = of_tables(table(**wide, gone=[1, 1]), table(**wide, new=[1, 1]))
    assert said.reason == "different columns: missing 'gone', new 'new'; 500 columns in both: the same"
    said = of_tables(table(**wide, gone=[1, 1]), table(**{**wide, "column7": [1.0, 3.0]}))
    assert (said.verdict, said.form, said.row, said.column) == (Verdict.DIFFERENT, True, 1, "column7")
    assert "different columns: missing 'gone'; 500 columns in both: row 1: 'column7' was 2.0 and is 3.0" in said.reason
    assert len(of_tables(table(**wide), table(x=[1, 1])).reason) < 200
    assert of_tables(table(v=[1, 2]), table(v=[1, 2, 3])).reason == "2 rows were recorded, 3 found; the first 2 are the same"
    said = of_tables(table(v=[1, 2, 3]), table(v=[1, 5]))
    assert (
        said.reason
        == "3 rows were recorded, 2 found; row 1: 'v' was 2 and is 5; largest difference 3 (relative 1.5); in 1 of 2 rows"
    )


def test_differing_bytes_of_binary_files_are_counted_and_not_displayed() -> None:
    said = of_texts(b"\x93NUMPY\0" + bytes(1000), b"\x93NUMPY\0" + bytes(500) + b"\1" * 500)
    assert said.reason == "binary: 500 of 1007 bytes differ, the first at offset 507"
    assert (
        of_texts(b"\0a", b"\0ab").reason == "2 bytes were recorded, 3 found; binary: 0 of 2 bytes differ, the first at offset 2"
    )
    assert of_texts(b"a\nb\nc\n", b"a\nx\ny\n").reason == "line 2 was 'b' and is 'x'; 2 of 4 lines differ"


@pytest.mark.integration
@given(st.lists(st.text(max_size=300), min_size=1, max_size=3), st.lists(st.text(max_size=300), min_size=1, max_size=3))
def test_a_report_is_one_short_line_for_any_content(one: list[str], other: list[str]) -> None:
    wide = {f"{n}{one[0]}": other for n in range(99)}
    for found in (
        of_tables(table(v=one), table(v=other)),
        of_tables(table(**wide), table(b=other)),
        of_tables(table(**wide), table(v=one)),
    ):
        assert len(found.reason) < 700
        assert "\n" not in found.reason
