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


def show(found: Sequence[ClusterSession], *, long: bool = False) -> None:
    """Print a line for each session on a cluster, and explanations below."""

    rows = [dict(zip(COLUMNS, _row(one, long=long), strict=True)) for one in found]
    columns = [name for name in COLUMNS if any(row[name] != "" for row in rows)]
    table(
        columns, [[row[name] for name in columns] for row in rows], right=("runs", "done", "failed"), width=0 if long else None
    )
    for one in found:
        if one.stuck:
            print(f"{short(one.batch)} ({one.session[:SESSION]}) cannot start: {readable(one.stuck)}")


def lines(found: Sequence[ClusterSession]) -> list[str]:
    """Return a line for each session of a batch on clusters."""
    from sierra.cli.ask_detach import named

    texts = []
    for one in found:
        follower = f", followed by {one.attended}" if one.attended else ""
        stuck = f": {readable(one.stuck)}" if one.stuck else ""
        how = "the jobs are gone; sierra ls --jobs records the finished runs" if one.is_gone else state(one)
        texts.append(f"on {one.runner} now, {named(one.jobs)} (session {one.session[:SESSION]}): {how}{follower}{stuck}")
    return texts


def state(one: ClusterSession) -> str:
    """Return the state of a session's array job in a few words."""

    if one.ended:
        return "ended"
    words = ["cancelled"] if one.cancelled else []
    if one.queued is None:
        words.append("unreachable")
    elif one.queued or one.running:
        queued = f"{one.queued} queued" + (f" ({readable(one.waits)})" if one.waits else "")
        words += [text for count, text in ((one.queued, queued), (one.running, f"{one.running} running")) if count]
    elif not one.stuck:
        words.append("gone: use sierra attach" if not one.attended else "gone")
    return ", ".join([*words, *(["cannot start"] if one.stuck else [])])


def _row(one: ClusterSession, *, long: bool) -> Sequence[object]:
    query = readable(one.query or "(a replay)")
    return (
        one.batch if long else short(one.batch),
        query if long or len(query) <= LONGEST else f"{query[: LONGEST - 1]}…",
        one.target or "",
        one.session if long else one.session[:SESSION],
        one.runner,
        few(one.jobs, 3) or "unknown",
        one.runs,
        one.done,
        one.failed,
        state(one),
        one.attended or "",
        one.since,
    )
