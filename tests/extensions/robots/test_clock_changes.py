"""Tests of remarks on clocks that were set or slewed during a run."""

from __future__ import annotations

import queue

import pytest

from sierra.extensions.hosts.clock import Clock
from sierra.extensions.robots import clock_changes
from sierra.extensions.robots.agent.clock_watch import Course
from sierra.extensions.robots.agent_link import AgentLink
from sierra.extensions.robots.trial import Part
from sierra.worker.job import Job
from tests.support.local_link import LocalLink

SECOND, MS = 10**9, 10**6
EVEN = Course(0, 0)


def part(shift_s: float, seconds: float, uneven_s: float = 0, moved_s: float = 0) -> Part:
    """Return a part whose offset has changed in some seconds, and whose agent has seen how even its clock was."""
    job: Job = {}  # type: ignore[typeddict-item]
    agent = AgentLink("ada", LocalLink.__new__(LocalLink), 1.0, queue.SimpleQueue())
    first, last = Clock(0, 1000, 0), Clock(round(shift_s * SECOND), 1000, round(seconds * SECOND))
    course = Course(round(uneven_s * SECOND), round(moved_s * SECOND))
    return Part(1, "robot", agent, {}, job, clock=first, clock_after=last, course=course)


@pytest.mark.parametrize(
    ("made", "here", "error_ms", "said"),
    [
        (part(0.04, 10), EVEN, 0.01, None),  # evenly: a line through both measurements is right
        (part(-0.5, 3600), EVEN, 3.6, None),
        # slewed within half a second, or set and set back: the line is wrong by up to 38 ms and up to 40 ms
        (part(0.04, 10, 0.02, 0.04), EVEN, 40.01, None),
        (part(0.04, 10, 0.038, 0.04), EVEN, 76.01, "its wall clock has moved by +0.04 s while the run was executed"),
        (part(0, 10, 0.04, 0.04), EVEN, 80.01, "its wall clock has moved by +0.04 s while the run was executed"),
        (part(-25, 10, 20, -25), EVEN, 40_000.01, "its wall clock has moved by -25 s while the run was executed"),
        (
            *(part(25, 10), Course(13 * SECOND, -25 * SECOND), 26_000.01),
            "the wall clock of this machine has moved by -25 s while the run was executed",
        ),
    ],
)
def test_a_clock_that_was_set_is_an_error_or_a_remark(made: Part, here: Course, error_ms: float, said: str | None):
    assert clock_changes.error_ns(made, here) == pytest.approx(error_ms * MS)
    assert clock_changes.remark(made, here, 0.05) == said


def test_a_larger_error_that_is_allowed_is_told_as_well():
    slewed = part(0.9, 10, 0.8, 0.9)
    assert clock_changes.remark(slewed, EVEN, 2.0) is None
    assert clock_changes.error_ns(slewed, EVEN) == pytest.approx(1.6 * SECOND, rel=0.001)


def test_nothing_is_known_about_a_clock_that_nobody_watched():
    lost = part(0.04, 10)
    lost.course = lost.clock_after = None
    assert clock_changes.error_ns(lost, EVEN) is None
    assert clock_changes.remark(lost, EVEN, 0.05) is None
    assert clock_changes.failure(lost, EVEN, 0.05) is None


def test_a_limit_of_the_drift_fails_a_run():
    assert clock_changes.failure(part(0.09, 3600), EVEN, None) is None
    assert clock_changes.failure(part(0.09, 3600), EVEN, 0.1) is None
    assert clock_changes.failure(part(0.09, 3600), EVEN, 0.05) == (
        "has a clock that moved by +0.09 s during the run, more than clock_drift = 0.05 in [runners.robots]"
    )
    assert "moved by -25 s" in str(clock_changes.failure(part(0, 10, 25, -25), EVEN, 1.0))


def test_a_step_of_this_machine_is_no_drift_of_robots():
    here = Course(13 * SECOND, -25 * SECOND)
    assert clock_changes.failure(part(25, 10), here, 1.0) is None
    assert "moved by +3 s" in str(clock_changes.failure(part(28, 10, 2, 3), here, 1.0))
    assert "moved by -25 s" in str(clock_changes.failure_here(here, 1.0))
    assert clock_changes.failure_here(here, None) is None
    assert clock_changes.failure_here(EVEN, 1.0) is None
