"""Observation of a run: the files that it executed, read, looked for and did not find, listed, wrote and removed.

A *way* to observe is an object with the methods of `Way`: see `observers`. For each run, a way gives an `Observation`. A caller

1. asks `way.trouble()` once, and observes with another way if there is a reason not to use this one;
2. starts `observation.prefixed(argv, environment, cwd)` instead of argv, in the same environment, folder, session and group;
3. takes no process for one of the run's for which `observation.is_tracer(pid)` holds: it must not be signalled or counted;
4. calls `observation.look(pids)` with the run's processes while they live, as often as it likes (once a second is enough);
5. has ended all processes of the run, calls `observation.end()`, which waits for the tracer, and then `observation.trace()`.

All of this must happen before the run's folder is removed. `observation.trace(living=True)` tells what programs that go on have
done until now. docs/explanation/observation.md describes the lists of a trace, and how they are found.
"""

from __future__ import annotations

from typing import Callable, Iterable, Mapping, NamedTuple, Protocol, Sequence

LISTS = frozenset(("executed", "read", "found", "missed", "refused", "listed", "written", "removed"))
REREAD = ("reread", "reread_new")
SETTLE_S = 10.0  # for the tracer to end after all processes of the run have ended


class Trace(NamedTuple):
    """The files that a run used and changed: see docs/explanation/observation.md. Paths are sorted."""

    way: str
    executed: tuple[str, ...] = ()
    read: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    missed: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    listed: tuple[str, ...] = ()
    written: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    reread: tuple[str, ...] = ()
    reread_new: tuple[str, ...] = ()
    links: Mapping[str, str] = {}
    channels: tuple[tuple[str, str], ...] = ()
    reasons: tuple[str, ...] = ()
    disturbed: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """True if everything was seen."""
        return not self.reasons

    @property
    def reason(self) -> str | None:
        """Why the trace is not complete, in one line; None if it is."""
        return "; ".join(self.reasons) or None


class Observation(Protocol):
    """The observation of one run: see the module's text for the order of calls. Nothing here raises an error of a way's own."""

    began: int
    """The time of its begin, in ns since the epoch, by the clock that gives files of the log's file system their times."""

    def prefixed(self, argv: Sequence[str], environment: Mapping[str, str], cwd: str, *, conducted: bool = False) -> list[str]:
        """Return the words to start. They are argv itself if the program would not start: the error is then the usual one.

        `conducted`: this program only starts those of the run (see `conductor`). What it does itself is left out.
        """

    def is_tracer(self, pid: int) -> bool:
        """Return whether a process belongs to the observation, and not to the run."""

    def look(self, pids: Iterable[int]) -> None:
        """Look at living processes of the run. May be called at any time, also with processes that have ended."""

    def limit(self) -> None:
        """Keep the log below its limit. Call it at times while the run lives."""

    def end(self, candidates: Callable[[], Iterable[int]] | None = None, seconds: float = SETTLE_S) -> None:
        """Wait until the tracer has ended, and kill it after so many seconds.

        `candidates` are the processes among which it may be (by default all), for a caller that is its subreaper. A process
        whose tracer hangs does not end for its parent, even if it is killed. So call this with 0 seconds, too, if a run that
        was killed does not end.
        """

    def trace(self, stderr: str | None = None, check_stop: Callable[[], None] = ..., *, living: bool = False) -> Trace:
        """Return what was seen. Never fails, whatever the log contains; calls `check_stop` at times, which may raise.

        `stderr` is the file with the run's standard error. A tracer writes its own messages there, too. `living`: return what
        was seen until now; call it by one thread at a time.
        """


class Way(Protocol):
    """A way to observe runs. An object without state except what `trouble` has found out; used by several threads."""

    name: str
    sees: frozenset[str]
    """The lists of `Trace` that it fills completely. If one is lacking, no trace of it is complete."""

    def trouble(self) -> str | None:
        """Return why this way cannot be used here, in one line; None if it can. Finds out once."""

    def begin(self, log: str, cwd: str, own: Sequence[str] = ()) -> Observation:
        """Begin to observe a run that starts in the folder `cwd`. Its own folders are that above `cwd`, and `own`.

        `log` is a file that is made, outside the run's folder and on the same file system. The caller removes it.
        """


def nothing() -> None:
    """Do nothing: the default of `check_stop`."""
