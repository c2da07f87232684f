"""The printed form of the state of cluster jobs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sierra.cli.output import readable, table
from sierra.util.hashing import short
from sierra.util.text import few

if TYPE_CHECKING:
    from sierra.execution.cluster_status import ClusterSession

COLUMNS = (
    "batch",
    "query",
    "target",
    "session",
    "runner",
    "jobs",
    "runs",
    "done",
    "failed",
    "state",
    "followed by",
    "submitted",
)
LONGEST = 40
"""The largest length of a query in a list."""
SESSION = 8
"""The number of digits of a session's id that are shown; its jobs have them in their names, too."""


def show(sessions: Sequence[ClusterSession], *, long: bool = False) -> None:
    """Print a line for each session on a cluster, and explanations below."""

    rows = [dict(zip(COLUMNS, _row(session, long=long), strict=True)) for session in sessions]
    columns = [name for name in COLUMNS if any(row[name] != "" for row in rows)]
    table(
        columns, [[row[name] for name in columns] for row in rows], right=("runs", "done", "failed"), width=0 if long else None
    )
    for session in sessions:
        if session.stuck:
            print(f"{short(session.batch)} ({session.session[:SESSION]}) cannot start: {readable(session.stuck)}")


def lines(sessions: Sequence[ClusterSession]) -> list[str]:
    """Return a line for each session of a batch on clusters."""
    from sierra.cli.ask_detach import named

    texts = []
    for session in sessions:
        follower = f", followed by {session.attended}" if session.attended else ""
        stuck = f": {readable(session.stuck)}" if session.stuck else ""
        how = "the jobs are gone; sierra ls --jobs records the finished runs" if session.is_gone else state(session)
        where = f"on {session.runner} now, {named(session.jobs)} (session {session.session[:SESSION]})"
        texts.append(f"{where}: {how}{follower}{stuck}")
    return texts


def state(session: ClusterSession) -> str:
    """Return the state of a session's array job in a few words."""

    if session.ended:
        return "ended"
    words = ["cancelled"] if session.cancelled else []
    if session.queued is None:
        words.append("unreachable")
    elif session.queued or session.running:
        queued = f"{session.queued} queued" + (f" ({readable(session.waits)})" if session.waits else "")
        words += [text for count, text in ((session.queued, queued), (session.running, f"{session.running} running")) if count]
    elif not session.stuck:
        words.append("gone: use sierra attach" if not session.attended else "gone")
    return ", ".join([*words, *(["cannot start"] if session.stuck else [])])


def _row(session: ClusterSession, *, long: bool) -> Sequence[object]:
    query = readable(session.query or "(a replay)")
    return (
        session.batch if long else short(session.batch),
        query if long or len(query) <= LONGEST else f"{query[: LONGEST - 1]}…",
        session.target or "",
        session.session if long else session.session[:SESSION],
        session.runner,
        few(session.jobs, 3) or "unknown",
        session.runs,
        session.done,
        session.failed,
        state(session),
        session.attended or "",
        session.since,
    )
