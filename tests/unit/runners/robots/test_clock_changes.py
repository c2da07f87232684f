"""Tests of remarks on clocks that were set during a run."""

from __future__ import annotations

import queue

import pytest

from sierra.links.clock import Clock
from sierra.runners.robots import clock_changes
from sierra.runners.robots.agent_link import AgentLink
from sierra.runners.robots.trial import Part
from sierra.worker import worker
from tests.support.local_link import LocalLink

SECOND = 10**9


def part(shift_s: float, seconds: float, *steps: float) -> Part:
    """Return a part whose offset has changed in some seconds."""
    job: worker.Job = {}  # type: ignore[typeddict-item]
    agent = AgentLink("ada", LocalLink.__new__(LocalLink), 1.0, queue.SimpleQueue())
    ended = {"why": None, "end": None, "problems": [], "steps": list(steps)}
    first, last = Clock(0, 1000, 0), Clock(round(shift_s * SECOND), 1000, round(seconds * SECOND))
    return Part(1, "robot", agent, {}, job, clock=first, clock_after=last, ended=ended)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (part(0.04, 10), None),
        (part(0.06, 10), "its wall clock has drifted by +0.06 s in 10 s"),
        (part(0.09, 3600), None),  # 25 parts in a million, evenly: a line through both measurements is right
        (part(-0.5, 3600), "its wall clock has drifted by -0.5 s in 3.6e+03 s"),
        (part(0, 10, 25.0, -25.0), "its wall clock has moved by +25, -25 s while the run was executed"),
    ],
)
def test_a_clock_that_was_set_is_remarked(made: Part, said: str | None):
    assert clock_changes.remark(made, 0.05) == said


def test_a_limit_of_the_drift_fails_a_run():
    assert clock_changes.failure(part(0.09, 3600), None) is None
    assert clock_changes.failure(part(0.09, 3600), 0.1) is None
    assert clock_changes.failure(part(0.09, 3600), 0.05) == (
        "has a clock that moved by +0.09 s during the run, more than clock_drift = 0.05 in [runners.robots]"
    )
    assert "moved by -25 s" in str(clock_changes.failure(part(0, 10, 0.1, -25.0), 1.0))
