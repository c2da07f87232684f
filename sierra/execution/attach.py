"""Reattach to a session on a cluster: follow it to its end, or record what has finished and leave it."""

from __future__ import annotations

from sierra import runners
from sierra.execution import session_records
from sierra.execution.follow import follow
from sierra.execution.observer import Tally
from sierra.execution.sessions import Session
from sierra.ingest.recorder import Recorder
from sierra.ingest.recording_context import Context
from sierra.runners.base import Runner
from sierra.runners.cluster.submission_record import Submission
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass


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
    unfinished: int | None = None
    """Number of its runs that were not executed, if it was limited to a part of its batch; None if it was not."""


def attach(store: Store, session: Session, tally: Tally, *, detach: bool = False) -> Attached:
    """Follow a session that was taken over, and close it; with `detach`, record what has finished and leave it.

    Raises the errors of a runner that cannot continue.
    """
    cancelled = session.paths.cancelled.exists()
    try:
        context, runner = _submitted(session)
        followed = follow(runner, Recorder(store, session.paths, context), store, session, tally, None, detach=detach)
        unfinished = None
        if not followed.left:
            unfinished = session_records.finish(store, session, interrupted=session.paths.cancelled.exists())
        ended = not (cancelled or followed.left) and session.paths.cancelled.exists()  # by others, or on the cluster
        interrupted = followed.interrupted or ended
        return Attached(
            context.batch, len(tally.statuses), len(tally.failed), followed.left, interrupted, followed.notes, unfinished
        )
    finally:
        session.close()


def _submitted(session: Session) -> tuple[Context, Runner]:
    """Return the recorded context of a submitted session, and its runner.

    If either cannot be loaded, the session is left as it is, and the error is raised again.
    """
    try:
        context, made = Context.load(session.paths.context), Submission.load(session.paths)
        return context, runners.on_cluster(made.runner, made.scheduler, made.cluster)(1)
    except BaseException:
        session.leave()
        raise
