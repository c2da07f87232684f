"""Status of cluster jobs: each session that was submitted and is not closed yet.

`standing` first records finished runs of sessions that no process follows; `seen` writes nothing. Each session needs one query
to its scheduler, and a second one while all its elements wait for the small task that probes nodes.
"""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from typing import NamedTuple

from sierra.errors import NotFound, SierraError
from sierra.execution import sessions
from sierra.execution.observer import Observer, ProgressCounter
from sierra.execution.sessions import Session
from sierra.runners.cluster import submission_record
from sierra.runners.cluster.submission_record import Submission
from sierra.runners.schedulers.base import State, Task
from sierra.store.layout import SessionPaths
from sierra.store.store import PREFIX, Store
from sierra.util.fs import read_record
from sierra.util.lazy_definitions import dataclass, replace

AT_ONCE = 8
"""Parallel queries to schedulers; one that cannot be reached takes long to fail."""
PROBED = "nodes are tested first"


@dataclass(frozen=True, slots=True)
class ClusterSession:
    """Status of one submission: its query, its progress, and the process that follows it."""

    session: str
    batch: str
    query: str | None
    """Text of the query; None for a replay."""
    runner: str
    scheduler: str
    """Name and version of the scheduler."""
    jobs: tuple[str, ...]
    """Ids of the jobs, as far as they are known."""
    array_tasks: int
    runs: int
    since: datetime
    done: int = 0
    """Number of recorded runs, successful or not."""
    failed: int = 0
    """Number of these that failed."""
    queued: int | None = None
    """Number of elements that wait for a node, as the scheduler reports; None if it cannot be reached. `running` likewise."""
    running: int | None = None
    waits: str = ""
    """Reason why they wait, in the scheduler's words; empty if it gives none."""
    stuck: str | None = None
    """Reason why elements will never start, in the scheduler's words."""
    attended: str | None = None
    """Process that follows the session; None without one."""
    cancelled: bool = False
    ended: bool = False
    """True if everything is recorded and no job of the session is left."""
    target: str | None = None
    """Target that the batch was requested for."""

    @property
    def is_gone(self) -> bool:
        """Check whether the scheduler no longer has jobs of the session although the session has not ended."""
        return self.queued == 0 and self.running == 0 and not (self.stuck or self.ended)


def standing(store: Store, prefix: str | None = None, observer: Observer | None = None) -> list[ClusterSession]:
    """Return the sessions on clusters, oldest first: all, or those of the batch or session whose id starts with `prefix`.

    Records finished runs first. `observer` receives notices. Raises NotFound.
    """
    observer = observer or Observer()
    submissions = [row for paths in named(store, prefix) if (row := submitted(paths))]
    rows = [_recorded(store, row, observer) for row in submissions]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        rows = list(pool.map(partial(_with_report, store), rows))
    rows = [
        _recorded(store, row, observer) if row.is_gone else row for row in rows
    ]  # sessions that ended between the two queries
    return sorted(_with_counts(store, rows), key=lambda row: (row.since, row.session))


def seen(store: Store, runs: AbstractSet[str]) -> list[ClusterSession]:
    """Return the status of all submissions with some of these runs; record nothing. `done` counts runs that are recorded."""
    chosen = (paths for paths in sessions.submitted(store.paths) if not runs.isdisjoint(sessions.claims(paths)))
    submissions = [row for paths in chosen if (row := submitted(paths))]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return _with_counts(store, list(pool.map(partial(_with_report, store), submissions)))


def _with_counts(store: Store, rows: list[ClusterSession]) -> list[ClusterSession]:
    """Return the status of sessions with the numbers of recorded runs."""
    counts = counted(store, [row.session for row in rows])
    return [replace(row, done=counts[row.session][0], failed=counts[row.session][1]) for row in rows]


def claimed(store: Store) -> dict[str, str]:
    """Return the runs that were submitted to clusters, and the session of each; runs that are recorded already are included."""
    return {run: paths.root.name for paths in sessions.submitted(store.paths) for run in sessions.claims(paths)}


def named(store: Store, prefix: str | None) -> list[SessionPaths]:
    """Return the sessions on clusters: all, or those whose batch or session id starts with `prefix`.

    Raises NotFound if no batch or session has such an id.
    """
    on_clusters = sessions.submitted(store.paths)
    if prefix is None:
        return on_clusters
    try:
        batch = store.resolve(prefix)
        if batch.kind != "batch":
            raise NotFound(f"{prefix!r} is a {batch.kind}; only batches and sessions can be on a cluster")
    except NotFound:
        begin = prefix.lower()
        mine = [paths for paths in on_clusters if PREFIX.fullmatch(begin) and paths.root.name.startswith(begin)]
        if not mine:
            raise
        return mine
    return [paths for paths in on_clusters if (row := submitted(paths)) and row.batch == batch.id]


def submitted(paths: SessionPaths) -> ClusterSession | None:
    """Return the status that a session's folder shows; None if the session has been closed."""
    try:
        submission = Submission.load(paths)
        sent = submission_record.sent(paths)
        since = sent[0].when if sent else paths.submission.stat().st_mtime
    except FileNotFoundError:
        return None
    return ClusterSession(
        session=paths.root.name,
        batch=submission.batch,
        query=_asked(paths, "query"),
        target=_asked(paths, "target"),
        runner=submission.runner,
        scheduler=submission.version,
        jobs=tuple(job_sent.job for job_sent in sent if job_sent.job is not None),
        array_tasks=len(submission.counts),
        runs=submission.runs,
        since=datetime.fromtimestamp(since, UTC),
        cancelled=paths.cancelled.exists(),
    )


def counted(store: Store, chosen: list[str]) -> dict[str, tuple[int, int]]:
    """Return for each session the number of runs that it executed, and how many of these failed."""
    counts = dict.fromkeys(chosen, (0, 0))
    return counts | {row.session: (row.executed, row.failed) for row in store.select(SessionCounts, COUNTS, s=chosen)}


class SessionCounts(NamedTuple):
    """Numbers of runs that a session executed, and of those that failed."""

    session: str
    executed: int
    failed: int


COUNTS = """
WITH mine AS (
    SELECT session, run, bool_or(status IN ('ok', 'accepted')) AS good FROM executions
    WHERE list_contains($s, session) GROUP BY ALL
)
SELECT session, count(*) AS executed, count(*) FILTER (NOT good) AS failed FROM mine GROUP BY session
"""


def _asked(paths: SessionPaths, name: str) -> str | None:
    """Return a text of what a session was asked; None if there is none, as for a replay."""
    try:
        value = read_record(paths.asking).get(name)
    except FileNotFoundError:
        return None
    return value if isinstance(value, str) else None


def _recorded(store: Store, row: ClusterSession, observer: Observer) -> ClusterSession:
    """Return the status after finished runs are recorded, by this process or by the one that follows the session.

    If the session is cancelled, end its jobs first.
    """
    from sierra.execution.follow import attach  # loads all that records runs

    paths = store.paths.session(row.session)
    session = Session.adopted(store.paths, paths)
    if session is None:
        return replace(row, attended=sessions.holder(paths)) if paths.submission.exists() else replace(row, ended=True)
    try:
        counter = ProgressCounter(observer, row.runs, leave=not paths.cancelled.exists())
        attached = attach(store, session, counter, detach=True)
    except SierraError as error:
        observer.notice(f"session {row.session}: {error}")
        return replace(row, ended=not paths.submission.exists())
    return replace(row, ended=not attached.left)


def _with_report(store: Store, row: ClusterSession) -> ClusterSession:
    """Return the status with the scheduler's report on the elements."""
    if row.ended:
        return replace(row, queued=0, running=0)
    paths = store.paths.session(row.session)
    try:
        submission = Submission.load(paths)
        scheduler = submission_record.scheduler_of(submission, paths)
        tasks = scheduler.look(submission_record.name_of(paths))
        if tasks is None:
            return row
        by = {state: [task for task in tasks if task.state is state] for state in State}
        before = submission.probed and by[State.QUEUED] and not by[State.RUNNING]
        probing = (before and scheduler.look(submission_record.name_of(paths, "probe"))) or ()
    except FileNotFoundError:
        return replace(row, queued=0, running=0, ended=True)
    except SierraError:
        return row
    queued, running = (len(submission_record.elements(paths, by[state])) for state in (State.QUEUED, State.RUNNING))
    stuck = [task for task in (*tasks, *probing) if task.state is State.STUCK]
    never = "; ".join(dict.fromkeys(scheduler.explain(task.reason or "no reason given") for task in stuck)) or None
    return replace(row, queued=queued, running=running, waits=_reason_to_wait(tasks, probing), stuck=never)


def _reason_to_wait(tasks: tuple[Task, ...], probing: tuple[Task, ...]) -> str:
    """Return the reason why elements wait: the probe of nodes while its task lives (it may wait too), else the scheduler's."""
    if any(task.state is State.RUNNING for task in probing):
        return PROBED
    if any(task.state is State.QUEUED for task in probing):
        return ": ".join(filter(None, (PROBED, submission_record.waits(probing))))
    return submission_record.waits(tasks)
