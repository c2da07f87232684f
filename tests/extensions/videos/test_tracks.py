"""Tracks of several runs are put side by side by time, not by number."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pytest

from sierra.deliverables.figures import style
from sierra.errors import UsageError
from sierra.extensions.videos.tracks import aligned, digits, frame_times, rounding, uneven

if TYPE_CHECKING:
    from sierra.extensions.videos.tracks import State


class Listed:
    def __init__(self, **states: float) -> None:
        self.times = np.array([float(time[1:].replace("_", ".")) for time in states])
        self._values = list(states.values())

    def states(self) -> Iterator[State]:
        for value in self._values:
            yield (np.array([[value]]),)


def shown(tracks: list[Listed], step: float | None) -> list[tuple[float, ...]]:
    times = frame_times(tracks, step)
    rows = aligned(tracks, times, carry=step is not None)
    values = [[float("nan") if state is None else float(state[0].item()) for state in row] for row in rows]
    return [(time, *row) for time, row in zip(times.tolist(), values, strict=True)]


def test_a_track_without_a_state_at_a_time_has_none() -> None:
    tracks = [Listed(t0=1, t1=2, t3=4), Listed(t1=5, t2=6)]
    nan = float("nan")
    np.testing.assert_array_equal(shown(tracks, None), [(0, 1, nan), (1, 2, 5), (2, nan, 6), (3, 4, nan)])


def test_with_a_step_values_are_carried_but_not_beyond_the_end() -> None:
    tracks = [Listed(t0=1, t0_3=2, t0_9=4), Listed(t0_3=5, t0_6=6)]
    nan = float("nan")
    np.testing.assert_allclose(shown(tracks, 0.3), [(0, 1, nan), (0.3, 2, 5), (0.6, 2, 6), (0.9, 4, nan)])


def test_times_since_1970_are_told_apart_and_roundings_are_not() -> None:
    since = 1.7e9
    clock = [Listed(t0=1, t0_1=2, t0_2=3, t0_3=4), Listed(t0=5, t0_1=6, t0_2=7, t0_3=8)]
    for track in clock:
        track.times = track.times + since
    clock[1].times[1:] += 2.4e-7
    both = [(1, 5), (2, 6), (3, 7), (4, 8)]
    assert [row[1:] for row in shown(clock, None)] == both
    assert [row[1:] for row in shown(clock, 0.1)] == both
    added = [Listed(t0=1, t0_1=2, t0_2=3, t0_3=4), Listed(t0=5, t0_1=6, t0_2=7, t0_3=8)]
    added[1].times[3] = 0.1 + 0.2
    assert [row[1:] for row in shown(added, None)] == both
    assert rounding([Listed(t0=1), Listed()]) < 1e-300


def test_uneven_times_are_found_and_rounding_is_not_taken_for_it() -> None:
    assert uneven(np.linspace(1e6, 1e6 + 10, 101)) is None
    assert uneven(np.array([0.0, 1.0, 2.0, 4.0])) == (1.0, 2.0)


def test_times_are_written_so_that_frames_differ() -> None:
    for times in ([0.0], [1234567.0, 1234568.0], [0.25, 12345.5, 12345.75], [1.7e9 + 0.1, 1.7e9 + 0.2], [-0.5, 9e6]):
        written = [style.number(time, digits(np.array(times))) for time in times]
        assert [float(text.replace("−", "-")) for text in written] == times
    assert digits(np.arange(1000) * 0.1) == 6


def test_too_many_frames_and_no_frame_are_refused() -> None:
    with pytest.raises(UsageError, match="10000001 frames are too many"):
        frame_times([Listed(t0=1, t10=1)], 1e-6)
    with pytest.raises(UsageError, match="no time with a value"):
        frame_times([Listed()], None)
