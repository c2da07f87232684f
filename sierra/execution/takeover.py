"""Takeover of unattended sessions on a cluster, by batch or session id: follow them or cancel them."""

from __future__ import annotations

import contextlib
import time

from sierra.errors import Busy, Missing, NotFound
from sierra.execution import sessions, sum_up
from sierra.execution.cluster_status import ClusterSession, counted, named, submitted
from sierra.execution.follow import Attached, attach
from sierra.execution.observer import Observer, ProgressCounter
from sierra.execution.sessions import Session
from sierra.execution.summary import Summary
from sierra.runners.cluster import submission_record
from sierra.runners.cluster.submission_record import Submission
from sierra.store.layout import SessionPaths
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass, replace

PATIENCE_S = 60.0
"""Maximum seconds to wait until the process that follows a session ends it after another process cancelled it."""
POLL_S = 0.2


@dataclass(frozen=True, slots=True)
class Cancelled:
    """Result of cancelling a session."""

    session: str
    batch: str
    kept: int
    """Number of runs that were executed and are recorded. `failed`: how many of these failed."""
    failed: int
    missing: int
    """Number of runs that were not executed."""
    ending: str | None = None
    """Process that still has to end the session; None if it has ended."""


def follow(store: Store, prefix: str, observer: Observer) -> Summary:
    """Follow a batch's unattended sessions, or one session, to the end; return the state of the batch then.

    Raises NotFound if none is on a cluster, Busy if other processes follow all of them.
    """
    rows = on_clusters(store, prefix)
    attached: list[Attached] = []
    left: list[str] = []
    busy: list[str] = []
    for row in rows:
        if attached and attached[-1].interrupted:
            left.append(row.session)
            continue
        session = Session.adopted(store.paths, store.paths.session(row.session))
        if session is None:
            busy.append(_busy(store, row))
            continue
        if row.query is None:
            observer.notice(
                f"session {row.session} belongs to a replay that has ended: its runs are recorded, but not compared"
            )
        attached.append(attach(store, session, _counter(store, row, observer)))
        left += [row.session] if attached[-1].left else []
    if not attached:
        raise Busy("; ".join(busy))
    parts = [followed.unfinished for followed in attached]
    summary = sum_up.of_recorded(
        store,
        rows[0].batch,
        executed=sum(followed.executed for followed in attached),
        failed=sum(followed.failed for followed in attached),
        interrupted=attached[-1].interrupted,
        detached=tuple(left),
        unfinished=None if None in parts else sum(part or 0 for part in parts),
        notes=(*busy, *(note for followed in attached for note in followed.notes)),
    )
    return replace(summary, sessions=tuple(row.session for row in rows))


def cancel(store: Store, prefix: str, observer: Observer) -> list[Cancelled]:
    """Cancel the sessions of a batch on clusters, or one session; finished runs are recorded.

    Raises the same errors as `follow`, and Missing if a scheduler cannot be reached. The sessions stay marked as cancelled, so
    that the next `sierra` command that looks at them cancels the jobs.
    """
    rows = on_clusters(store, prefix)
    for row in rows:
        with contextlib.suppress(FileNotFoundError):  # it has been closed
            store.paths.session(row.session).cancelled.touch()
    return [_cancel(store, row, observer) for row in rows]


def on_clusters(store: Store, prefix: str) -> list[ClusterSession]:
    """Return the sessions on clusters for this id prefix, attended or not. Raises NotFound if there are none."""
    rows = [row for paths in named(store, prefix) if (row := submitted(paths))]
    if not rows:
        raise NotFound(
            f"{prefix!r} has no jobs on a cluster; sierra ls --jobs lists cluster jobs, sierra ls lists recorded batches"
        )
    return rows


def _busy(store: Store, row: ClusterSession) -> str:
    return f"session {row.session} is followed by {sessions.holder(store.paths.session(row.session))}"


def _counter(store: Store, row: ClusterSession, observer: Observer) -> ProgressCounter:
    """Return the counter of one session; runs that are recorded count as reused."""
    before, failed = counted(store, [row.session])[row.session]
    return ProgressCounter(observer, row.runs, before, failed)


def _cancel(store: Store, row: ClusterSession, observer: Observer) -> Cancelled:
    """End one session: take it over, or let the process that follows it end it."""
    paths = store.paths.session(row.session)
    session, ending = Session.adopted(store.paths, paths), None
    if session is None and paths.submission.exists():
        session, ending = _request_end(store, paths)
    if session is not None:
        attach(store, session, ProgressCounter(observer, row.runs, leave=False), detach=True)
    done, failed = counted(store, [row.session])[row.session]
    return Cancelled(row.session, row.batch, done, failed, row.runs - done, ending)


def _request_end(store: Store, paths: SessionPaths) -> tuple[Session | None, str | None]:
    """Let the process that follows a session end it.

    Returns the session if that process has left it, or the name of the process if it has not ended the session in time.
    """
    holder = sessions.holder(paths)
    with contextlib.suppress(FileNotFoundError, Missing):
        submission = Submission.load(paths)
        submission_record.scheduler_of(submission, paths).cancel(submission_record.name_of(paths))
    until = time.monotonic() + PATIENCE_S
    while paths.submission.exists():
        if (session := Session.adopted(store.paths, paths)) is not None:
            return session, None
        if time.monotonic() > until:
            return None, holder
        time.sleep(POLL_S)
    return None, None
