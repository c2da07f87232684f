"""Runs that go first, where nobody knows how long runs take: what they take decides how many elements the others become.

They are element 0 of their session, and results as any others. The others lie in one file (`SessionPaths.rest`) and are not
handed over until these have ended, or run for as long as an element is to take, which tells enough; or until nobody waits any
more, for want of a node or because who follows leaves: then there are as many elements as where nobody knows. Whoever follows
next goes on with it; a submitter that is killed in between has handed over these runs alone.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sierra.model import Result
from sierra.runners.cluster import submission
from sierra.runners.cluster.result_log import Ended, Event, Pack, Started
from sierra.runners.cluster.sizing import ELEMENT_S
from sierra.store.layout import SessionPaths

PATIENCE_S = 120.0
"""How long a node is waited for."""


@dataclass(frozen=True, slots=True)
class Told:
    """What runs that went first have told."""

    seconds: float | None
    """What a run takes; None where they could not tell."""
    how: str
    """In words."""


class Calibration:
    """The first runs of one session, as far as they have come."""

    def __init__(self, session: SessionPaths) -> None:
        self._session = session
        self._packs: dict[Path, Pack] = {}
        self._took: dict[str, float | None] = {}
        """Of those that have ended, how long they took; None of one that failed."""
        self._since: float | None = None
        """When they were first seen to have begun."""

    def told(self, *, over: bool) -> Told | None:
        """What they tell; None as long as they may tell more. `over`: all of them have ended, or were given up."""
        self._read()
        good = [seconds for seconds in self._took.values() if seconds is not None]
        if over:
            took = _mean(good)
            how = "the runs that went first have failed" if took is None else f"the runs that went first took {took:.3g} s"
            return Told(took, how)
        if self._since is None:
            late = self._waited() > PATIENCE_S
            return Told(None, f"no node was to be had within {PATIENCE_S:g} s for the runs that go first") if late else None
        lasted = time.monotonic() - self._since
        late = lasted > ELEMENT_S
        return Told(_mean([*good, lasted]), f"a run that went first has not ended within {ELEMENT_S:g} s") if late else None

    def _read(self) -> None:
        """What their element has recorded since the last time."""
        for path in self._session.results.glob("0.*.pack"):
            with contextlib.suppress(OSError):  # it can be read later, perhaps
                self._take(self._packs.setdefault(path, Pack(path)).read())

    def _take(self, events: Iterator[Event]) -> None:
        for event in events:
            match event:
                case Started() if self._since is None:
                    self._since = time.monotonic()
                case Ended():
                    self._took[event.result.execution] = _seconds(event.result)

    def _waited(self) -> float:
        """Seconds since they were handed over."""
        now = time.time()
        return now - min((one.when for one in submission.sent(self._session)), default=now)


def _seconds(result: Result) -> float | None:
    """How long a run took that ended as it should, as far as can be told before it is recorded."""
    well = result.exit_code == 0 and result.error is None and result.stopped is None
    return result.ended - result.started if well else None


def _mean(seconds: list[float]) -> float | None:
    return sum(seconds) / len(seconds) if seconds else None
