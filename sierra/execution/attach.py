"""Following what another process has submitted to a cluster, to its end or for a while."""

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
    """How far a session on a cluster has come."""

    batch: str
    executed: int
    """Runs that were recorded meanwhile; so `failed`."""
    failed: int
    left: bool
    """Whether it goes on without this process; else it has ended."""
    interrupted: bool
    """Whether the user, or somebody else, has ended it meanwhile."""
    notes: tuple[str, ...] = ()


def attach(store: Store, session: Session, observer: Observer, leave: Callable[[], bool], *, detach: bool = False) -> Attached:
    """Follow a session that was adopted, and close it; with `detach`, record what has finished and leave it.

    Raises what a runner raises that can't go on.
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
        ended = not (cancelled or following.left) and session.paths.cancelled.exists()  # by others, or on a cluster
        return Attached(context.batch, len(done), failed, following.left, (bool(signals) and not detach) or ended, notes)
    finally:
        session.close()


def _submitted(session: Session) -> tuple[Context, Runner]:
    """What was submitted, and its runner. Where that can't be had here and now, the session is left as it is."""
    try:
        context, made = Context.load(session.paths.context), Submission.load(session.paths)
        return context, runners.find(made.runner, {made.runner: made.cluster})(1)
    except BaseException:
        session.leave()
        raise
