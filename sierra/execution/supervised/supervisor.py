"""The supervisor of trials: a contract between the execution and the person who starts, watches and judges each run."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

from sierra.execution.supervised.poses import Pose
from sierra.model import Status, Value
from sierra.runners.base import Beat


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


Watch = Callable[[float, Sequence[Beat]], bool]
"""It gets the seconds since the start and the robots' last signs of life, several times per second.

It returns True to stop the trial.
"""


class Supervisor(Protocol):
    """Starts, watches and judges trials for a person. Every method may raise KeyboardInterrupt, which ends the session.

    All methods are called in the main thread. A trial is recorded before `verdict` is called; without a verdict it does not
    count.
    """

    def begin(self, trials: int) -> str | None:
        """Return the operator's name, or None. This is called once, before the first trial."""
        ...

    def start(self, trial: Trial) -> Start:
        """Return the decision on a trial, after `trial.wait_s` and the countdown have passed."""
        ...

    def watching(self, trial: Trial) -> AbstractContextManager[Watch]:
        """Yield the function that watches the trial. The terminal is as before when the block ends, whatever happens."""
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

    def start(self, trial: Trial) -> Start:
        time.sleep(trial.wait_s)
        return Start.GO

    def watching(self, trial: Trial) -> AbstractContextManager[Watch]:
        return contextlib.nullcontext(lambda seconds, beats: False)

    def verdict(self, trial: Trial, ended: Ended) -> Verdict:
        return Verdict(valid=True)
