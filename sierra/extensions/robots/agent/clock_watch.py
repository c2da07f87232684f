"""A watch on the wall clock: how far it is from an even course.

Services that set the time (chrony, NTP) let the wall clock step, or let it run faster or slower for some time. Then
CLOCK_MONOTONIC also runs faster or slower, but CLOCK_MONOTONIC_RAW does not. It counts at the rate of the machine's crystal,
which may be wrong but is even.

A watch keeps only the corners of the convex hull of its readings (Andrew's monotone chain), because the reading that is
farthest from a straight line is one of them, whatever the line is.

This file is also executed on robots, with Python 3.8 or newer and nothing but the standard library.
"""

from __future__ import annotations

import time
from typing import NamedTuple, Tuple

Reading = Tuple[int, int]
"""The even clock and the wall clock at the same moment, in ns."""


class Course(NamedTuple):
    """The distance of a wall clock from an even course, in ns."""

    uneven: int
    """Its largest distance from the straight line between the first and the last reading."""
    moved: int
    """By how much it was set, as far as this is known; 0 for a clock that has drifted evenly."""


TRIES = 3  # because another process may execute between the two clocks


class ClockWatch:
    """A watch on the wall clock of this machine, from now on."""

    def __init__(self) -> None:
        self.first = read()
        self.upper, self.lower = [self.first], [self.first]

    def look(self) -> Reading:
        """Read the clocks. Only what the readings show is known about the time between them."""
        reading = read()
        for corners, side in ((self.upper, 1), (self.lower, -1)):
            while len(corners) > 1 and side * turn(corners[-2], corners[-1], reading) >= 0:
                corners.pop()
            corners.append(reading)
        return reading

    def now_ns(self) -> int:
        """Return the time that the wall clock would have if it had moved evenly since the beginning."""
        return read()[0] - self.first[0] + self.first[1]

    def moved_ns(self) -> int:
        """Return by how much the wall clock is ahead of `now_ns`."""
        even, wall = read()
        return wall - self.first[1] - (even - self.first[0])

    def course(self) -> Course:
        """Return how far the wall clock was from an even course until now."""
        last = self.look()
        uneven = max(distance(corner, self.first, last) for corner in (*self.upper, *self.lower))
        moved = last[1] - self.first[1] - (last[0] - self.first[0])
        if abs(moved) > 3 * uneven:  # a single step is off the line by half of itself at least
            moved = 0
        return Course(uneven, moved if abs(moved) > uneven else uneven)


def read() -> Reading:
    """Read both clocks."""
    return min(_tried() for _ in range(TRIES))[1]


def _tried() -> tuple[int, Reading]:
    """Return how long a reading took, and the reading."""
    before = even_ns()
    wall = time.time_ns()
    took = even_ns() - before
    return took, (before + took // 2, wall)


def even_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


def turn(first: Reading, second: Reading, third: Reading) -> int:
    """Return a number above 0 if the way through three points turns to the left, and one below 0 if it turns to the right."""
    return (second[0] - first[0]) * (third[1] - first[1]) - (second[1] - first[1]) * (third[0] - first[0])


def distance(reading: Reading, first: Reading, last: Reading) -> int:
    """Return how far the wall clock of a reading is from the line between two others."""
    rise = (last[1] - first[1]) * (reading[0] - first[0]) // max(1, last[0] - first[0])
    return abs(reading[1] - first[1] - rise)
