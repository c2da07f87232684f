"""After any fault, the next `sierra run` completes the store as an undisturbed run does. See tests/soak."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest

from tests.soak import steps
from tests.soak.faults import Action
from tests.soak.steps import Place, Wanted, undisturbed
from tests.tiers import at_night

KILLED = (
    "driver os.mkdir .sierra 1",
    "driver os.rename .sierra/format 1",
    "driver open .sierra/work/lock 1",
    "driver os.mkdir .sierra/work/# 1",
    "driver open .sierra/work/#/owner.# 1",
    "driver fcntl.flock .sierra/work/#/lock 1",
    "driver open .sierra/work/#/claims.json 1",
    "driver os.rename .sierra/work/#/context.json 1",
    "worker open .sierra/work/#/journal.jsonl 1",
    "worker os.mkdir .sierra/work/#/# 5",
    "worker open .sierra/work/#/#/input.xml 2",
    "worker open .sierra/work/#/#/stdout 3",
    "worker os.rmdir .sierra/work/#/#/home 4",
    "driver os.mkdir .sierra/work/#/segment 2",
    "driver open .sierra/work/#/segment/MANIFEST 1",
    "driver os.rename .sierra/segments/#-# 1",
    "driver os.rename .sierra/segments/#-# 2",
    "driver os.remove swarm.csv 5",
    "driver os.rmdir .sierra/work/#/# 12",
    "driver os.remove .sierra/work/#/submission.json 1",
    "driver os.remove .sierra/work/#/claims.json 1",
    "driver os.remove .sierra/work/#/journal.jsonl 1",
    "driver os.remove lock 1",
    "driver os.rmdir .sierra/work/# 1",
)
"""Points at which SIERRA or its worker is killed; `python -m tests.soak --points` lists all points."""

REFUSED: tuple[tuple[str, Action], ...] = (
    ("driver os.mkdir .sierra/work/# 1", "EACCES"),
    ("driver open .sierra/work/#/claims.json 1", "ENOSPC"),
    ("worker os.mkdir .sierra/work/#/#/output 3", "ENOSPC"),
    ("worker open .sierra/work/#/#/input.xml 6", "EIO"),
    ("driver open .sierra/work/#/segment/MANIFEST 1", "ENOSPC"),
    ("driver os.rename .sierra/segments/#-# 2", "EIO"),
    ("driver os.remove swarm.csv 1", "EIO"),
    ("driver os.rename .sierra/segments/#-# 1", "interrupt"),
)
"""Points at which the system refuses an operation, or the user presses Ctrl-C."""

TIDYING = (
    ("gc", "driver os.mkdir .sierra/work/#/old 1"),
    ("gc", "driver os.rename .sierra/segments/#-# 1"),
    ("gc", "driver os.rename .sierra/work/#/old/#-# 1"),
    ("rm", "driver os.rename .sierra/segments/#-# 1"),
    ("rm", "driver os.rename .sierra/work/#/old/#-# 1"),
    ("rm", "driver os.remove output.#.parquet 1"),
)
"""Points at which a command that rewrites the store is killed."""

INDEXING = (
    "driver os.mkdir TMPDIR/sierra-index-# 1",
    "driver open TMPDIR/sierra-index-#/.# 1",
    "driver fcntl.flock TMPDIR/sierra-index-#/.# 1",
    "driver os.rename TMPDIR/sierra-index-#/.sierra-scratch 1",
    "driver open TMPDIR/sierra-index-#/index 1",
    "driver os.mkdir .sierra/index 1",
    "driver open .sierra/index/.#-#-#.duckdb.#.# 1",
    "driver os.rename .sierra/index/#-#-#.duckdb 1",
    "driver os.remove .sierra/index/.#-#-#.duckdb.#.# 1",
    "driver os.remove TMPDIR/sierra-index-#/index 1",
    "driver os.rmdir TMPDIR/sierra-index-# 1",
)
"""Points of a process that builds an index, in their order; DuckDB writes it between the fifth and the sixth."""
ACTIONS: tuple[Action, ...] = ("kill", "ENOSPC", "EIO", "EACCES", "interrupt")
FAULTS_OF_BUILDERS: list[tuple[str, Action]] = [
    ("driver os.rename .sierra/index/#-#-#.duckdb 1", "kill"),
    *((point, ACTIONS[number % len(ACTIONS)]) for number, point in enumerate(INDEXING)),
    *((point, "kill") for point in INDEXING[1::5]),
]


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Use an own folder for temporary files."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr(tempfile, "tempdir", None)


@pytest.fixture
def wanted(tmp_path_factory: pytest.TempPathFactory) -> Wanted:
    """Return the content of the store after undisturbed runs."""
    return undisturbed(tmp_path_factory.getbasetemp() / "soak")


@pytest.fixture
def place(tmp_path: Path) -> Place:
    """Return a folder for a step, with a fixed random seed."""
    return Place(tmp_path, Random(1), " two  blanks ")


@pytest.mark.each_case
@pytest.mark.parametrize("point", [*KILLED[1::12], *at_night(set(KILLED) - set(KILLED[1::12]))])
def test_a_kill_at_any_point_of_a_run_loses_no_results(place: Place, wanted: Wanted, point: str) -> None:
    assert "not reached" not in steps.fault_at_a_point(place, wanted, point, "kill")


@pytest.mark.nightly
@pytest.mark.parametrize(("point", "action"), REFUSED)
def test_a_refused_operation_loses_no_results(place: Place, wanted: Wanted, point: str, action: Action) -> None:
    assert "not reached" not in steps.fault_at_a_point(place, wanted, point, action)


@pytest.mark.nightly
@pytest.mark.parametrize(("command", "point"), TIDYING)
def test_a_kill_while_the_store_is_rewritten_loses_no_results(place: Place, wanted: Wanted, command: str, point: str) -> None:
    done = steps.fault_in_maintenance(place, wanted, (command, "--yes"), point, "kill")
    assert "not reached" not in done


@pytest.mark.each_case
@pytest.mark.usefixtures("temporary")
@pytest.mark.parametrize(("point", "action"), [FAULTS_OF_BUILDERS[0], *at_night(FAULTS_OF_BUILDERS[1:])])
def test_a_fault_of_a_builder_of_indexes_changes_nothing(place: Place, wanted: Wanted, point: str, action: Action) -> None:
    assert "not reached" not in steps.fault_while_indexing(place, wanted, point, action)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(
    "step", [steps.flipped_bit, steps.fuzzed_calls, steps.fuzzed_settings, steps.full_disk, steps.many_at_once]
)
def test_the_store_stays_sound_after_each_step(
    step: Callable[[Place, Wanted], str], seed: int, tmp_path: Path, wanted: Wanted, require: Any
) -> None:
    require("the right to mount a disk", there="left out" not in step(Place(tmp_path, Random(seed)), wanted))


@pytest.mark.nightly
@pytest.mark.parametrize("days", [-400, 2])
def test_a_wrong_clock_does_not_change_results(place: Place, wanted: Wanted, days: int, require: Any) -> None:
    require("faketime")
    steps.jumping_clock(place, wanted, days)
