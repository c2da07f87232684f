"""Changes of clocks during a run, and the error that they add to stamps.

Stamps of a robot are converted by a line through two measurements of its offset to the clock of this host, before and after the
run. That is wrong as far as one of both clocks has not moved evenly in between, because it was set or slewed. Both are watched
meanwhile (see `sierra.extensions.robots.agent.clock_watch`).
"""

from __future__ import annotations

from sierra.extensions.robots.agent.clock_watch import Course
from sierra.extensions.robots.trial import Part

UNEVEN = 1e-6
"""The error of the line that no watch sees, in seconds per second, because the rates of crystals change with the temperature.

If the rate of a crystal stays within 1e-6 of its mean, its clock is off an even course by half of that. There are two clocks.
"""
HERE = "the wall clock of this machine"


def error_ns(part: Part, here: Course | None) -> int | None:
    """Return the largest error of the line in ns, without that of the measurements; None if there is no line.

    `here` is the course of the clock of this host. A measurement may be off the line through the readings of a watch, too.
    """
    if part.clock is None or part.clock_after is None or part.course is None or here is None:
        return None
    unseen = UNEVEN * abs(part.clock_after.at_ns - part.clock.at_ns)
    return 2 * (part.course.uneven + here.uneven) + round(unseen)


def remark(part: Part, here: Course | None, clock_error: float) -> str | None:
    """Return why stamps of a robot cannot be converted; None if they can, or if its clock was not measured twice.

    `clock_error` is the error that is allowed, in seconds.
    """
    if part.course is None or here is None or 2 * (part.course.uneven + here.uneven) <= clock_error * 1e9:
        return None
    whose, course = ("its wall clock", part.course) if part.course.uneven >= here.uneven else (HERE, here)
    return f"{whose} has moved by {course.moved / 1e9:+.3g} s while the run was executed"


def failure(part: Part, here: Course | None, limit: float | None) -> str | None:
    """Return that the clock of a robot has moved by more than `limit` seconds; None if it has not, or without a limit.

    A change against the clock of this host counts only if that one was not set.
    """
    if part.course is None or limit is None:
        return None
    change = 0 if failure_here(here, limit) else _change(part)
    return _too_far(max(change, part.course.moved, key=abs), limit)


def failure_here(here: Course | None, limit: float | None) -> str | None:
    """Return that the clock of this host was set by more than `limit` seconds; None if it was not, or without a limit."""
    return None if here is None or limit is None else _too_far(here.moved, limit)


def _too_far(moved_ns: int, limit: float) -> str | None:
    if abs(moved_ns) <= limit * 1e9:
        return None
    moved = f"has a clock that moved by {moved_ns / 1e9:+.3g} s during the run"
    return f"{moved}, more than clock_drift = {limit:g} in [runners.robots]"


def _change(part: Part) -> int:
    """Return by how much a robot's offset has changed, in ns; 0 if it was not measured twice."""
    return part.clock_after.offset_ns - part.clock.offset_ns if part.clock and part.clock_after else 0
