"""Calibration: the times of the first runs decide when, and how, the others are sharded."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from sierra.runners.cluster.sizing import ELEMENT_S, TIMEOUT_S, timing

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
