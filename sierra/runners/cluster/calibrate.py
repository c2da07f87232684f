"""Calibration: a few runs execute first if nobody knows how long runs take. Their times decide the number of elements.

The first runs are element 0 of their session, and their results are used like any others. The other runs wait in one file
(`SessionPaths.rest`). They are submitted when one of these happens:

- The first runs have ended.
- The first runs have lasted as long as an element should take, which tells enough.
- No process waits any more, because no node became free or because the following process leaves. Then the number of elements is
  the one for unknown durations.

The next process that follows the session continues this. If the submitting process is killed before that, only the first runs
have been submitted.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

from sierra.model import Result
from sierra.runners.cluster import submission_record
from sierra.runners.cluster.result_log_reader import Ended, Event, Pack
from sierra.runners.cluster.sizing import ELEMENT_S
from sierra.store.layout import SessionPaths
from sierra.util.lazy_definitions import dataclass
from sierra.worker.array_task import Started

TIMEOUT_S = 120.0
"""Seconds to wait for a node."""


@dataclass(frozen=True, slots=True)
class Timing:
    """The result of a calibration."""

    seconds: float | None
    """Duration of a run in seconds; None if the first runs could not tell."""
    how: str
    """The explanation for the user."""


class Calibration:
    """The progress of one session's first runs."""

    def __init__(self, session: SessionPaths) -> None:
        self._session = session
        self._packs: dict[Path, Pack] = {}
        self._durations: dict[str, float | None] = {}
        """Durations of the runs that have ended; None for a run that failed."""
        self._since: float | None = None
        """The time when the first of them was seen to have begun."""

    def result(self, *, over: bool) -> Timing | None:
        """Return the result; None as long as more may be learned. `over`: all first runs have ended, or were given up."""
        self._read()
        good = [seconds for seconds in self._durations.values() if seconds is not None]
        if over:
            seconds = _mean(good)
            how = "the first runs have failed" if seconds is None else f"the first runs took {seconds:.3g} s"
            return Timing(seconds, how)
        if self._since is None:
            late = self._waited() > TIMEOUT_S
            return Timing(None, f"no node was available for the first runs within {TIMEOUT_S:g} s") if late else None
        lasted = time.monotonic() - self._since
        late = lasted > ELEMENT_S
        return Timing(_mean([*good, lasted]), f"one of the first runs has not ended within {ELEMENT_S:g} s") if late else None

    def _read(self) -> None:
        """Read what their element has recorded since the last call."""
        for path in self._session.results.glob("0.*.pack"):
            with contextlib.suppress(OSError):  # a later call may be able to read it
                self._add(self._packs.setdefault(path, Pack(path)).read())

    def _add(self, events: Iterator[Event]) -> None:
        for event in events:
            match event:
                case Started() if self._since is None:
                    self._since = time.monotonic()
                case Ended():
                    self._durations[event.result.execution] = _seconds(event.result)

    def _waited(self) -> float:
        """Return the seconds since the first runs were submitted."""
        now = time.time()
        return now - min((one.when for one in submission_record.sent(self._session)), default=now)


def _seconds(result: Result) -> float | None:
    """Return a run's duration if it ended successfully, as far as this is known before the run is recorded; else None."""
    well = result.exit_code == 0 and result.error is None and result.stopped is None
    return result.ended - result.started if well else None


def _mean(seconds: list[float]) -> float | None:
    return sum(seconds) / len(seconds) if seconds else None
