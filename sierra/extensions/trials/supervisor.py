"""The supervisor of trials: a contract between the execution and the person who starts, watches and judges each run."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from enum import StrEnum
from typing import Protocol

from sierra.model import Pose, Status, Value
from sierra.runners.base import Beat
from sierra.util.lazy_definitions import dataclass, field


@dataclass(frozen=True, slots=True)
class Trial:
    """One run, as it is presented to the person before it begins."""

    run: str
    number: int
    """The number of the run in its experiment, from 0."""
    values: Mapping[str, Value]
    """The values of the variables."""
    position: int
    """Its place among the trials of this session, from 1."""
    total: int
    """Number of trials that this session needs, as far as it is known now."""
    block: int
    """The block of the order, from 0."""
    blocks: int
    """Number of blocks of the batch."""
    attempt: int = 0
    """The number of earlier trials of the run in this session."""
    poses: Sequence[Pose] = ()
    """The start poses of the robots 1, 2, …"""
    robots: Mapping[int, str] = field(default_factory=dict)
    """The names of the robots that take part, by place; empty if the runner does not know them. A base station has 0."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """The output of the declared commands, by name."""
    wait_s: float = 0.0
    """The seconds that must pass before the trial may begin."""


class Start(StrEnum):
    """A decision before a trial."""

    GO = "go"
    SKIP = "skip"
    ABORT = "abort"
    """End the session. Everything that was measured is kept."""


@dataclass(frozen=True, slots=True)
class Ended:
    """The end of a trial, before it is judged."""

    status: Status
    """The status that it has if the verdict is that it is valid."""
    reason: str | None
    """The reason why the status is not ok."""
    seconds: float
    stopped: bool
    """True if the person has stopped it."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """A person's judgement on a trial. A trial that is not valid is kept, does not count, and is repeated."""

    valid: bool
    reason: str | None = None
    note: str | None = None


class Attendant(Protocol):
    """Decides on one trial, and watches it. Each method is called several times per second, and returns at once."""

    def decide(self, *, ready: bool) -> Start | None:
        """Return the decision; None as long as there is none. It is called until there is one.

        `ready`: the trial is prepared, so that it begins at once. The decision is never GO before that, nor before
        `trial.wait_s` and the countdown have passed.
        """
        ...

    def watch(self, seconds: float, beats: Sequence[Beat]) -> bool:
        """Return True to stop the trial; it is called after GO, until the trial ends.

        `seconds` have passed since the decision; `beats` are the robots' last signs of life.
        """
        ...

    def ending(self, beats: Sequence[Beat], collecting_s: float | None) -> None:
        """Show that a trial ends on robots; it is called instead of `watch`, when there is nothing to decide any more.

        `collecting_s`: the time for which files have been collected from the robots; None while these are being stopped,
        without a decision of the person.
        """
        ...


class Supervisor(Protocol):
    """Starts, watches and judges trials for a person. Every method may raise KeyboardInterrupt, which ends the session.

    All methods are called in the main thread. A trial is recorded before `verdict` is called; without a verdict it does not
    count.
    """

    def begin(self, trials: int) -> str | None:
        """Return the operator's name, or None. This is called once, before the first trial."""
        ...

    def attending(self, trial: Trial) -> AbstractContextManager[Attendant]:
        """Present a trial, and yield who attends to it. The terminal is as before when the block ends, whatever happens."""
        ...

    def unready(self, reason: str) -> Start | None:
        """Decide on a trial that cannot begin, for example because a robot is lost. Nothing of it was executed.

        GO presents and prepares the trial again. None ends the session with the error whose text is `reason`.
        """
        ...

    def verdict(self, trial: Trial, ended: Ended) -> Verdict:
        """Return the verdict on a trial that has ended."""
        ...


class Agreeing:
    """A supervisor that starts every trial and finds it valid, for tests and for runs that nobody has to watch."""

    def __init__(self, operator: str | None = None) -> None:
        self._operator = operator

    def begin(self, trials: int) -> str | None:
        return self._operator

    def attending(self, trial: Trial) -> AbstractContextManager[Attendant]:
        return contextlib.nullcontext(AgreeingAttendant(trial.wait_s))

    def unready(self, reason: str) -> Start | None:
        return None

    def verdict(self, trial: Trial, ended: Ended) -> Verdict:
        return Verdict(valid=True)


class AgreeingAttendant:
    """Starts a trial when it is ready and some seconds have passed, and never stops it."""

    def __init__(self, wait_s: float = 0.0) -> None:
        self._allowed = time.monotonic() + wait_s

    def decide(self, *, ready: bool) -> Start | None:
        return Start.GO if ready and time.monotonic() >= self._allowed else None

    def watch(self, seconds: float, beats: Sequence[Beat]) -> bool:
        return False

    def ending(self, beats: Sequence[Beat], collecting_s: float | None) -> None:
        pass
