"""Recorded runs are executed again from the record alone, and how far they agree is said."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sierra
from sierra.agreement import Verdict, of_tables, of_texts, worst
from sierra.config import Tolerance
from tests import projects

NOISY = projects.SIMULATOR.replace("count * tick", "__import__('time').time_ns() % 1000 + count * tick")
JITTER = projects.SIMULATOR.replace("count * tick", "(1 + 1e-13 * __import__('random').random()) * count * tick")
STAMPED = projects.SIMULATOR + "open('log.txt', 'w').write(f'# written {__import__(\"time\").time_ns()}\\nfine\\n')\n"
Make = Callable[..., Path]


@pytest.fixture(params=["git", "none"])
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Make:
    """Makes a project, in git and outside."""

    def make(simulator: str = projects.SIMULATOR, more: str = "") -> Path:
        root = projects.make(tmp_path / "project", projects.CONFIG + more, simulator=simulator)
        if request.param == "git":
            for words in (("init", "-q"), ("add", "."), ("commit", "-q", "-m", "first")):
                subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], cwd=root, check=True)
        return root

    return make


def ask(root: Path, *query: str) -> str:
    batch: str = sierra.open(root).run(*(query or ("population_size=1,2",)), figures=False).batch
    return batch


def replay(root: Path, *words: str) -> tuple[int, dict[str, Any]]:
    ended = projects.sierra(root, "replay", *words, "--json")
    return ended.returncode, json.loads(ended.stdout) if ended.stdout else {"stderr": ended.stderr}


def test_the_same_bytes_are_identical(make: Make) -> None:
    root = make()
    batch = ask(root)
    code, said = replay(root, batch[:10])
    assert (code, said["verdict"], said["runs"], said["counts"]) == (0, "identical", 4, {"identical": 4})
    rows = sierra.open(root).sql("SELECT purpose, count(*) AS n FROM executions GROUP BY 1 ORDER BY 1").to_pylist()
    assert rows == [{"purpose": "replay", "n": 4}, {"purpose": "run", "n": 4}]


def test_the_old_source_is_restored_and_nothing_of_the_projects_is_touched(make: Make) -> None:
    root = make()
    batch = ask(root)
    (root / "sim.py").write_text(projects.SIMULATOR.replace("count * tick", "count * tick + 1"))
    (root / "arena.xml").write_text("<arena/>")
    assert replay(root, batch)[1]["verdict"] == "identical"
    assert "tick + 1" in (root / "sim.py").read_text()
    assert not list(root.glob(".sierra/work/*/source"))


def test_an_experiment_a_run_and_an_execution_can_be_replayed_and_fewer_runs(make: Make) -> None:
    root = make()
    batch = ask(root)
    project = sierra.open(root)
    [row] = project.sql("SELECT experiment FROM experiments LIMIT 1").to_pylist()
    [one] = project.sql("SELECT run, execution FROM executions LIMIT 1").to_pylist()
    assert [replay(root, key)[1]["runs"] for key in (row["experiment"], one["run"], one["execution"])] == [2, 1, 1]
    assert replay(root, batch, "--runs", "1")[1]["runs"] == 2


def test_what_differs_is_named_and_never_counts(make: Make) -> None:
    root = make(NOISY)
    batch = ask(root)
    before = sierra.open(root).sql("SELECT * FROM swarm ORDER BY ALL")
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (1, "different")
    first = next(output for output in said["outputs"] if output["verdict"] == "different")
    assert (first["path"], first["column"]) == ("swarm.csv", "coverage")
    assert first["abs"] > 0
    assert f"row {first['row']}: 'coverage' was {first['recorded']} and is {first['found']}" in first["why"]
    assert sierra.open(root).sql("SELECT * FROM swarm ORDER BY ALL").equals(before)


def test_a_declared_tolerance_is_kept_to_and_what_was_reached_is_said(make: Make) -> None:
    root = make(JITTER, '[outputs.swarm]\nfile = "swarm.csv"\n')
    batch = ask(root)
    assert replay(root, batch)[0] == 1
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + "tolerance = { coverage = { rel = 1e-12 } }\n")
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (0, "within tolerance")
    assert all(0 < output["rel"] < 1e-12 for output in said["outputs"] if output["verdict"] == "within tolerance")


def test_a_date_differs_until_it_is_declared_volatile(make: Make) -> None:
    root = make(STAMPED, '[outputs.log]\nfile = "log.txt"\n')
    batch = ask(root)
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (1, "different")
    assert any(output["why"].startswith("line 1 was '# written") for output in said["outputs"])
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + "volatile = ['^# written']\n")
    assert [replay(root, batch)[0], replay(root, batch)[1]["verdict"]] == [0, "equal"]


def test_another_program_is_said_before_the_verdict_and_a_missing_one_ends_all(tmp_path: Path) -> None:
    program = tmp_path / "sim"
    program.write_text("#!/bin/sh\nprintf 'tick,v\\n0,1\\n' > out.csv\n")
    program.chmod(0o755)
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", str(program)))
    batch = ask(root)
    program.write_text("#!/bin/sh\nprintf 'tick,v\\n0,2\\n' > out.csv\n")
    code, said = replay(root, batch)
    assert code == 1
    assert said["notes"][0].startswith("other programs: sim was ")
    program.unlink()
    ended = projects.sierra(root, "replay", batch)
    assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)
    assert "is not there" in ended.stderr


def test_a_run_that_fails_now_is_failed(make: Make) -> None:
    root = make()
    batch = ask(root)
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + "[limits]\nwall = 0.001\n")
    code, said = replay(root, batch)
    assert (code, said["verdict"]) == (1, "failed")
    assert "ran longer than its limit" in said["outputs"][0]["why"]


def test_where_the_project_moved_ids_and_verdict_are_the_same(make: Make, tmp_path: Path) -> None:
    root = make()
    batch = ask(root)
    moved = tmp_path / "else where" / "moved"
    moved.parent.mkdir()
    root.rename(moved)
    assert replay(moved, batch)[1]["verdict"] == "identical"
    assert ask(moved) == batch


NUMBERS = st.lists(st.one_of(st.none(), st.floats(allow_nan=True, allow_infinity=True)), max_size=12)


@given(NUMBERS)
def test_what_is_the_same_agrees_with_itself(values: list[float | None]) -> None:
    table = pa.table({"v": pa.array(values, pa.float64())})
    assert of_tables(table, table, {}).verdict is Verdict.EQUAL


@given(NUMBERS, st.integers(0, 11))
def test_one_value_more_or_less_is_found_where_it_is(values: list[float | None], place: int) -> None:
    other = [*values]
    if place < len(values):
        other[place] = 0.5 if values[place] != 0.5 else None
        found = of_tables(*(pa.table({"v": pa.array(v, pa.float64())}) for v in (values, other)), {})
        assert (found.verdict, found.row, found.column) == (Verdict.DIFFERENT, place, "v")
    else:
        found = of_tables(*(pa.table({"v": pa.array(v, pa.float64())}) for v in (values, [*values, 1.0])), {})
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
def test_tolerances(was: list[Any], now: list[Any], tolerance: Tolerance, verdict: Verdict) -> None:
    tables = [pa.table({"v": pa.array(values, pa.float64())}) for values in (was, now)]
    assert of_tables(*tables, {"*": tolerance}).verdict is verdict


def test_a_tolerance_is_of_one_column() -> None:
    tables = [pa.table({"a": [1.0], "b": [value]}) for value in (1.0, 1.1)]
    assert of_tables(*tables, {"a": Tolerance(abs=1)}).verdict is Verdict.DIFFERENT
    assert of_tables(*tables, {"b": Tolerance(abs=1)}).verdict is Verdict.WITHIN
    assert of_tables(*tables, {}, ["b"]).verdict is Verdict.EQUAL


def test_other_columns_and_large_whole_numbers_differ() -> None:
    assert of_tables(pa.table({"a": [1]}), pa.table({"b": [1]}), {"*": Tolerance(abs=9)}).verdict is Verdict.DIFFERENT
    assert of_tables(pa.table({"a": [2**60]}), pa.table({"a": [2**60 + 1]}), {}).verdict is Verdict.DIFFERENT


def test_texts_are_compared_by_lines() -> None:
    assert of_texts(b"a\nb\n", b"a\nc\n").row == 1
    assert of_texts(b"a\n", b"a\nc\n").verdict is Verdict.DIFFERENT
    assert of_texts(b"# 1\na\n", b"# 2\na\n", ["^#"]).verdict is Verdict.EQUAL


def test_the_worst_verdict_is_that_of_all() -> None:
    assert worst([Verdict.IDENTICAL, Verdict.WITHIN, Verdict.EQUAL]) is Verdict.WITHIN
    assert not worst([Verdict.FAILED, Verdict.DIFFERENT]).fine
