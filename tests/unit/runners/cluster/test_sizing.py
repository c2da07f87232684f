"""Calibration: the times of the first runs decide when, and how, the others are sharded. Runs that are too long are refused."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError
from sierra.model import Times
from sierra.runners.cluster.sizing import ELEMENT_S, TIMEOUT_S, note_on_gpus, size, slots_of, timing
from sierra.runners.schedulers.base import Bounds

LATE_S, LONG_S = TIMEOUT_S + 1, ELEMENT_S + 50


@pytest.mark.parametrize(
    ("durations", "waited", "lasted", "over", "seconds"),
    [
        pytest.param([1.0, 3.0], 9.0, 8.0, True, 2.0, id="all first runs have ended"),
        pytest.param([1.0, None], 9.0, 8.0, True, 1.0, id="one has failed"),
        pytest.param([None, None], 9.0, 8.0, True, None, id="all have failed"),
        pytest.param([], LATE_S, None, False, None, id="no node was free"),
        pytest.param([], LATE_S, LONG_S, False, LONG_S, id="they last long"),
        pytest.param([100.0], LATE_S, LONG_S, False, (100.0 + LONG_S) / 2, id="one has ended and the other lasts long"),
    ],
)
def test_what_the_first_runs_tell(
    durations: Sequence[float | None], waited: float, lasted: float | None, seconds: float | None, *, over: bool
) -> None:
    result = timing(durations, waited, lasted, over=over)
    assert result is not None
    assert result.seconds == seconds


@pytest.mark.parametrize(("waited", "lasted"), [(TIMEOUT_S, None), (LATE_S, ELEMENT_S)])
def test_first_runs_that_may_tell_more_are_waited_for(waited: float, lasted: float | None) -> None:
    assert timing([1.0], waited, lasted, over=False) is None


SHORT = Bounds(wall_s=3600.0, whose={"wall_s": "MaxTime of partition short"})


@pytest.mark.parametrize(
    ("times", "wall", "bounds", "refusal"),
    [
        pytest.param(Times((4000.0, 10.0), (), ""), None, SHORT, "took 4000 s, .* 3600 s .MaxTime of partition short.: use a"),
        pytest.param(Times((10.0,), (), "", there=4000.0), None, SHORT, "4000 s there before, .*: use a partition that allows"),
        pytest.param(Times((10.0,), (), "", there=900.0), 600.0, SHORT, "900 s there before, .* 600 s .wall.: raise wall"),
        pytest.param(Times((10.0,), (), "", there=900.0), 600.0, Bounds(), "raise wall"),
    ],
)
def test_a_run_that_takes_longer_than_an_array_task_may_is_refused(
    times: Times, wall: float | None, bounds: Bounds, refusal: str
) -> None:
    with pytest.raises(ConfigError, match=refusal):
        size(2, times, ClusterTable(wall=wall), bounds)


@pytest.mark.parametrize(
    ("times", "wall", "bounds"),
    [
        pytest.param(Times((4000.0,), (0,), ""), None, SHORT, id="it is only estimated to be long"),
        pytest.param(Times((4000.0,), (), ""), 3600.0, SHORT, id="it took long elsewhere, and wall is set"),
        pytest.param(Times((4000.0,), (), "", there=3000.0), 3600.0, SHORT, id="it is faster there"),
        pytest.param(Times((4000.0,), (), "", 4000.0, continues=True), None, SHORT, id="it continues from its checkpoint"),
        pytest.param(Times((4000.0,), (), ""), None, Bounds(), id="the site has no limit"),
        pytest.param(None, None, SHORT, id="nothing is known"),
    ],
)
def test_a_run_that_may_be_short_enough_is_submitted(times: Times | None, wall: float | None, bounds: Bounds) -> None:
    assert size(1, times, ClusterTable(wall=wall), bounds).elements == 1


@pytest.mark.parametrize(
    ("cpus", "gpus", "limit", "slots", "note"),
    [
        (4, 4, 1.0, 4, ""),
        (4, 2, 0.5, 4, ""),
        (4, None, None, 4, ""),
        (8, 2, 1.0, 2, "executes 2 runs at a time: its GPUs suffice for no more ([limits] gpus = 1), although it has 8 cores"),
        (8, 3, 2.0, 1, "executes 1 run at a time: its GPUs suffice for no more ([limits] gpus = 2), although it has 8 cores"),
        (1, 4, 1.0, 1, "executes 1 run at a time, which use 1 of its 4 GPUs; request fewer, or more cpus"),
        (1, 2, 0.5, 1, "executes 1 run at a time, which use 1 of its 2 GPUs"),
        (1, 3, 2.0, 1, "executes 1 run at a time, which use 2 of its 3 GPUs"),
    ],
)
def test_cores_and_gpus_of_an_array_task_that_do_not_fit_are_noted(
    cpus: int, gpus: int | None, limit: float | None, slots: int, note: str
) -> None:
    table = ClusterTable(cpus=cpus, gpus=gpus)
    assert slots_of(table, limit) == slots
    assert note in note_on_gpus(table, limit)
    assert bool(note) == bool(note_on_gpus(table, limit))


def test_fewer_runs_at_a_time_take_more_or_longer_array_tasks() -> None:
    table, times = ClusterTable(cpus=8, gpus=1), Times((600.0,) * 24, (), "")
    both = size(24, times, table, Bounds()), size(24, times, table, Bounds(), gpus=1.0)
    assert [sized.elements for sized in both] == [4, 24]
    fixed = table.model_copy(update={"array_tasks": 1})
    assert [size(24, times, fixed, Bounds(), gpus=limit).expected_s for limit in (None, 1.0)] == [600.0 * 3 + 525.0, 600.0 * 24]


def test_runs_with_several_cores_leave_an_array_task_fewer_at_a_time() -> None:
    table, times = ClusterTable(cpus=8), Times((600.0,) * 24, (), "")
    assert [size(24, times, table, Bounds(), cores=cores).elements for cores in (1, 3, 8)] == [4, 16, 24]
    with pytest.raises(
        ConfigError, match=r"request 9 cores each \(\[limits\] cores\), but an array task has 8; set cpus = 9 or more"
    ):
        size(24, times, table, Bounds(), cores=9)


@pytest.mark.parametrize(("gpus", "limit", "cure"), [(None, 0.5, "has none; set gpus = 1"), (2, 4.0, "has 2; set gpus = 4")])
def test_an_array_task_with_too_few_gpus_for_a_run_is_refused(gpus: int | None, limit: float, cure: str) -> None:
    with pytest.raises(ConfigError, match=rf"request {limit:g} GPUs? each \(\[limits\] gpus\), but an array task {cure}"):
        size(2, None, ClusterTable(gpus=gpus), Bounds(), gpus=limit)
