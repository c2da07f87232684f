"""Reattach to a session on a cluster: follow it to its end, or record what has finished and leave it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from sierra import runners
from sierra.execution import records
from sierra.execution.follow import Following, Observer
from sierra.execution.sessions import Session
from sierra.ingest.consistency import find_odd
from sierra.ingest.context import Context
from sierra.ingest.recorder import Recorder
from sierra.model import Status
from sierra.runners.base import Runner
from sierra.runners.cluster.submission import Submission
from sierra.store.store import Store
from sierra.util.signals import noted


@dataclass(frozen=True, slots=True)
class Attached:
    """Progress of a reattached session on a cluster."""

    batch: str
    executed: int
    """Number of runs that were recorded while it was followed. `failed`: how many of these did not succeed."""
    failed: int
    left: bool
    """True if the session continues without this process; False if it has ended."""
    interrupted: bool
    """True if the user or another process ended it while it was followed."""
    notes: tuple[str, ...] = ()


def attach(store: Store, session: Session, observer: Observer, leave: Callable[[], bool], *, detach: bool = False) -> Attached:
    """Follow a session that was taken over, and close it; with `detach`, record what has finished and leave it.

    Raises the errors of a runner that cannot continue.
    """
    done: dict[str, Status] = {}
    cancelled = session.paths.cancelled.exists()

    def took(run: str, status: Status) -> None:
        done[run] = status
        observer.took(run, status)

    try:
        context, runner = _submitted(session)
        recorder = Recorder(store, session.paths, context)
        with noted(detach) as signals:
            following = Following(runner, recorder, store, session, replace(observer, took=took), leave=leave)
            following.go_on(signals)
        if not following.left:
            find_odd(store, session.paths, context)
            records.finish(store, session, interrupted=session.paths.cancelled.exists())
        failed = sum(status is not Status.OK for status in done.values())
        notes = () if following.left else tuple(recorder.notes())
        ended = not (cancelled or following.left) and session.paths.cancelled.exists()  # by others, or on the cluster
        return Attached(context.batch, len(done), failed, following.left, (bool(signals) and not detach) or ended, notes)
    finally:
        session.close()


def _submitted(session: Session) -> tuple[Context, Runner]:
    """Return the recorded context of a submitted session, and its runner.

    If either cannot be loaded, the session is left as it is, and the error is raised again.
    """
    try:
        context, made = Context.load(session.paths.context), Submission.load(session.paths)
        return context, runners.find(made.runner, {made.runner: made.cluster})(1)
    except BaseException:
        session.leave()
        raise
