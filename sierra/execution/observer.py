"""The observer of an execution: it receives progress and notices, and decides what happens to cluster jobs."""

from __future__ import annotations

from collections.abc import Mapping

from sierra.model import Status
from sierra.util.lazy_definitions import dataclass
from sierra.util.lazy_logger import Log

log = Log(__name__)


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a session, in numbers of runs."""

    total: int
    reused: int
    done: int
    failed: int
    running: int
    elsewhere: int = 0
    """Number of runs that another session executes."""
    queued: int = 0
    """Number of elements (of array jobs) that wait for a node."""
    waits: str = ""
    """Reason why they wait, in the scheduler's words."""
    share: float = 0.0
    """The share of the work that is done, by the expected durations of the runs; by their number, if these are not known."""


class Observer:
    """Receives progress and notices, and decides. This one ignores all, and leaves cluster jobs running."""

    def planning(self, done: int, experiments: int, runs: int) -> None:
        """Receive the progress of planning: so many of the experiments are done; all of them have `runs` runs."""

    def progress(self, progress: Progress) -> None:
        """Receive progress, several times per second."""

    def notice(self, text: str) -> None:
        """Receive a message that the user should see at once."""

    def leave(self) -> bool:
        """Decide what happens when the user interrupts: return True to leave jobs on a cluster running, False to end them."""
        return True


class ProgressCounter:
    """Counts the runs of a session as they end, and reports the counts to an observer."""

    def __init__(self, observer: Observer, total: int, reused: int = 0, failed: int = 0, *, leave: bool | None = None) -> None:
        """`total` is the number of runs; `reused` of them have a result already. `failed` more have failed before.

        `leave`: the decision about jobs on a cluster: see `Observer.leave`; None to let the observer decide.
        """
        self.observer = observer
        self.decision = leave
        self.total = total
        self.reused = reused
        self.statuses: dict[str, Status] = {}
        """Status of each run that has ended. It may change later, if recording finds a problem."""
        self.failed: set[str] = set()
        """The runs that have ended without success."""
        self.doubted = False
        """True if runs have failed because files of the source have changed meanwhile."""
        self._failed_before = failed
        self._seconds: Mapping[str, float] = {}
        self._done_s = self._all_s = 0.0

    def leave(self) -> bool:
        """Return the decision about jobs on a cluster; ask the observer if there is none yet."""
        return self.observer.leave() if self.decision is None else self.decision

    def expect(self, seconds: Mapping[str, float]) -> None:
        """Receive the expected seconds of runs that will be executed; nothing if they are not known, or do not differ."""
        self._seconds, self._done_s, self._all_s = seconds, 0.0, sum(seconds.values())

    def ended(self, run: str, status: Status) -> None:
        """Count a run that has ended. It is called again if the status changes."""
        log.debug("run %s: %s", run, status)
        if run not in self.statuses:
            self._done_s += self._seconds.get(run, 0.0)
        self.statuses[run] = status
        if status.is_result:
            self.failed.discard(run)
        else:
            self.failed.add(run)

    def report(self, running: int, queued: int = 0, waits: str = "", elsewhere: int = 0) -> None:
        """Report the progress to the observer."""
        done, failed = len(self.statuses), self._failed_before + len(self.failed)
        own = max(1, self.total - self.reused)
        known = self._all_s and len(self._seconds) == own  # not in later rounds, nor if other sessions execute some runs
        share = self._done_s / self._all_s if known else done / own
        self.observer.progress(Progress(self.total, self.reused, done, failed, running, elsewhere, queued, waits, share))
