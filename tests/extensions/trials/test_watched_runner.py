"""A watched runner: who ends a trial, and the time in which its files are collected."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from sierra.extensions.trials.supervisor import Start
from sierra.extensions.trials.watched_runner import WatchedRunner
from sierra.model import Result, Status
from sierra.runners.base import Beat, Look, Work
from sierra.runners.local import Local
from sierra.store.layout import SessionPaths

RUNNING, STOPPING = Look((), 1, alive=True), Look((), 1, alive=True, stopping=True)
COLLECTING, CLOSING = Look((), 1, alive=True, stopping=True, collecting=True), Look((), 0, alive=True)


class Scripted(Local):
    """A runner whose looks are given."""

    def __init__(self, *looks: Look) -> None:
        super().__init__(1)
        self._looks = list(looks)
        self.stops = 0

    def submit(self, work: Work, session: SessionPaths) -> None:
        pass

    def look(self) -> Look:
        return self._looks.pop(0)

    def stop(self) -> None:
        self.stops += 1


class Person:
    """A person who presses a key at one of the looks at a running trial; `seen` has what was shown."""

    def __init__(self, key_at: int = 99) -> None:
        self._key_at = key_at
        self.seen: list[str] = []

    def decide(self, *, ready: bool) -> Start | None:
        return Start.GO

    def watch(self, seconds: float, beats: Sequence[Beat]) -> bool:
        self.seen.append("running")
        return len(self.seen) > self._key_at

    def ending(self, beats: Sequence[Beat], collecting_s: float | None) -> None:
        self.seen.append("stopping" if collecting_s is None else "collecting")


def end(stopped: str | None = None) -> Look:
    """Return the last look, with the result of the run."""
    result = Result("r", "e", "/nowhere", 0.0, 1.0, 0, None, stopped, 0.0, 0.0, 0, "h", 0, ())
    return Look((result,), 0, alive=False)


def follow(person: Person, *looks: Look) -> tuple[WatchedRunner, Scripted, list[Look]]:
    runner = Scripted(*looks)
    watched = WatchedRunner(runner, person, ends=False)
    watched.submit(Work(iter(()), 1, "b"), SessionPaths(Path("/nowhere")))
    return watched, runner, [watched.look() for _ in range(len(looks) + 1)]


def test_a_run_that_ends_by_itself_cannot_be_stopped_while_its_files_are_collected(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(1000))
    monkeypatch.setattr("time.monotonic", lambda: float(next(clock)))
    person = Person()
    watched, runner, looks = follow(person, RUNNING, STOPPING, COLLECTING, COLLECTING, CLOSING, end())
    assert person.seen == ["running", "running", "stopping", "collecting", "collecting", "collecting"]
    assert (watched.stopped, runner.stops) == (False, 0)
    assert [look.watched for look in looks] == [True, True, True, False, False, False, False]
    assert watched.seconds < 10, "collecting is no part of it"


@pytest.mark.parametrize(("stopped", "expected"), [(Status.INTERRUPTED, Status.STOPPED), (None, None), ("time", "time")])
def test_a_person_has_stopped_a_run_only_if_it_was_not_over_before(stopped: str | None, expected: str | None) -> None:
    person = Person(key_at=1)
    watched, runner, looks = follow(person, RUNNING, STOPPING, COLLECTING, end(stopped))
    assert person.seen == ["running", "running", "collecting"]
    assert runner.stops == 1
    assert watched.stopped is (stopped == Status.INTERRUPTED)
    assert looks[-1].results[0].stopped == expected
