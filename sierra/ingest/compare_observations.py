"""Comparison of the files that the observed runs of a session used: a run that used others than its siblings is reported.

Runs of an experiment differ only in their seeds. A seed may choose a file by design: where each of these runs has read a file
of its own of the same kind (folder and ending), nothing is reported, unless the files are executed or are libraries.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from sierra.store.store import Snapshot, Store
from sierra.util.hashing import short
from sierra.util.lazy_definitions import regex
from sierra.util.text import few

NAMED = 3
TRACER = regex("(?:^|; )strace: ")
"""The beginning of the reason why the tracer cannot be used, as the worker writes it."""
SEEN = """
WITH seen AS (
    SELECT DISTINCT m.ordinal, e.run, e.execution, e.status IN ('ok', 'accepted') AND o.reason IS NULL AS complete, o.files
    FROM observations o JOIN executions e USING (execution)
    JOIN batch_runs m ON m.batch = e.batch AND m.run = e.run
    WHERE e.session = $session
),
used AS (
    SELECT DISTINCT s.ordinal, s.run, s.execution, s.complete, f.path, f.use, f.sha256
    FROM seen s JOIN files_read f USING (files)
    WHERE f.use IN ('executed', 'read') AND f.path NOT IN (
        SELECT w.path FROM files_written w JOIN executions e USING (execution) WHERE e.session = $session
    )
)"""
"""The files that observed runs used. A file that the session has changed itself is no input."""
CHANGED = """
SELECT path FROM used WHERE sha256 IS NOT NULL AND NOT starts_with(path, '{robot ')
GROUP BY path HAVING count(DISTINCT sha256) > 1 ORDER BY path
"""
DIFFERENT = r"""
, counted AS (
    SELECT u.*, n.runs, count(*) OVER (PARTITION BY u.ordinal, u.path) AS users,
        u.use = 'executed' OR regexp_matches(u.path, '\.so[.0-9]*$') AS code,
        regexp_replace(u.path, '[^/]*$', '') || '*' || regexp_extract(u.path, '\.[^./]*$') AS kind
    FROM used u JOIN (SELECT ordinal, count(*) AS runs FROM seen WHERE complete GROUP BY ordinal) n USING (ordinal)
    WHERE u.complete
),
own AS (SELECT * FROM counted WHERE users < runs),
chosen AS (SELECT ordinal, kind FROM own GROUP BY ordinal, kind, runs HAVING count(DISTINCT execution) = runs)
SELECT path, any_value(users) AS users, any_value(runs) AS runs, min(run) AS run
FROM own WHERE code OR (ordinal, kind) NOT IN (SELECT (ordinal, kind) FROM chosen)
GROUP BY ordinal, path ORDER BY path
"""


class _Different(NamedTuple):
    path: str
    users: int
    runs: int
    run: str


def notes(store: Store, session: str) -> Iterator[str]:
    """Yield a warning for files that changed between observed runs, and one for files that only some of the siblings used."""
    with store.snapshot() as snapshot:
        yield from _changed(snapshot, session)
        yield from _different(snapshot, session)


def changed_meanwhile(reasons: Iterable[str]) -> Iterator[str]:
    """Yield a warning with the files that changed while observed runs used them."""
    from sierra.worker.observed_record import CHANGED as MEANWHILE

    end = f": {MEANWHILE}"
    if names := list(dict.fromkeys(p.removesuffix(end) for reason in reasons for p in reason.split("; ") if p.endswith(end))):
        yield f"files may have changed while runs used them; the runs of this batch may not be comparable: {few(names, NAMED)}"


def incomplete(reasons: Iterable[str]) -> Iterator[str]:
    """Yield a warning with the reasons why no observation of a session is complete."""
    if why := list(reasons):
        yield f"no run was observed completely, so each edit of the source executes all runs again: {few(why, 1)}"


def why_untraced(reason: str) -> Iterator[str]:
    """Yield the end of an observation's reason if it says why the tracer cannot be used."""
    if match := TRACER.search(reason):
        yield reason[match.end() :]


def untraced(reasons: Iterable[str]) -> Iterator[str]:
    """Yield a note if runs could not be observed by a tracer, with the reasons."""
    if why := list(reasons):
        yield (
            f"runs are observed only in part, because {few(why, 1)}: changes of data and scripts outside the project are not "
            "noticed; sierra doctor says what is needed"
        )


def _changed(snapshot: Snapshot, session: str) -> Iterator[str]:
    if changed := snapshot.values(str, SEEN + CHANGED, session=session):
        yield f"files changed between observed runs of this batch, so that its runs are not comparable: {few(changed, NAMED)}"


def _different(snapshot: Snapshot, session: str) -> Iterator[str]:
    files = snapshot.select(_Different, SEEN + DIFFERENT, session=session)
    if files:
        named = [f"{file.path} (by {file.users} of {file.runs}, e.g. run {short(file.run)})" for file in files]
        what = "some observed runs used files that others of their experiment did not"
        yield f"{what}: {few(named, NAMED)}; see the table files_read"
