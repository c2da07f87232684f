"""Tests of the watch on the wall clock, with clocks that only the test moves."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.extensions.robots.agent import clock_watch
from sierra.extensions.robots.agent.clock_watch import ClockWatch, Course, distance

MS, SECOND = 1_000_000, 1_000_000_000
START = 1_700_000_000 * SECOND
Ahead = Callable[[float], float]


class Kernel:
    """The clocks of a machine, on which a service sets or slews the time. `ahead` is its error in ns after some seconds."""

    def __init__(self, ahead: Ahead) -> None:
        self.ahead = ahead
        self.now = 0

    def time_ns(self) -> int:
        return START + self.now + round(self.ahead(self.now / SECOND))

    def clock_gettime_ns(self, clock: int) -> int:
        """As on Linux, the clocks other than CLOCK_MONOTONIC_RAW are slewed together."""
        return self.now if clock == time.CLOCK_MONOTONIC_RAW else self.time_ns() - START


def course(ahead: Ahead) -> Course:
    """Return what a watch sees that looks at a clock ten times a second, for 10 s."""
    kernel = Kernel(ahead)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "time_ns", kernel.time_ns)
        patch.setattr(time, "clock_gettime_ns", kernel.clock_gettime_ns)
        watch = ClockWatch()
        for kernel.now in range(SECOND // 10, 10 * SECOND, SECOND // 10):
            watch.look()
        kernel.now = 10 * SECOND
        return watch.course()


@pytest.mark.parametrize(
    ("ahead", "uneven", "moved"),
    [
        (lambda s: 0, 0, 0),
        (lambda s: 1e6 * s, 0, 0),  # 1 ms in each second, evenly: 100 times the drift of a quartz clock
        (lambda s: 40 * MS * min(1, 2 * s), 38, 40),  # slewed by 40 ms within half a second
        (lambda s: 40 * MS if 3 < s < 4 else 0, 40, 40),  # set, and set back
        (lambda s: -25 * SECOND * (s > 5), 12_500, -25_000),
        (lambda s: -25 * SECOND * (s > 0.05), 24_750, -25_000),
    ],
    ids=["even", "drift", "slew", "there and back", "step", "early step"],
)
def test_a_watch_sees_how_uneven_a_clock_was(ahead: Ahead, uneven: int, moved: int):
    found = course(ahead)
    assert found.uneven == pytest.approx(uneven * MS, abs=0.01 * MS)
    assert found.moved == pytest.approx(moved * MS, abs=0.01 * MS)


@given(st.lists(st.integers(-50, 50), min_size=2, max_size=40))
def test_the_corners_tell_as_much_as_all_readings(walls: list[int]):
    with pytest.MonkeyPatch.context() as patch:
        readings = list(enumerate(walls))
        rest = iter(readings)
        patch.setattr(clock_watch, "read", lambda: next(rest))
        watch = ClockWatch()
        for _ in walls[2:]:
            watch.look()
        found = watch.course().uneven
    assert found == max(distance(one, readings[0], readings[-1]) for one in readings)
