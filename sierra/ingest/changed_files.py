"""Judgement of executions during which files of the source changed: do they count, and by which observations?

An execution that was observed counts if it did not use any of these files. For one that was not observed, observed executions
of its session with its experiment or its seed stand, as for reuse: it counts if one of its experiment was observed completely
and has succeeded, and if none of them used any of the files. That is known at the end of the session.

A run that only listed a folder has not used the changed files whose names it has seen there. Other runs of its experiment may
have listed the folder at another time, and so it stands for them only if the file was never removed or replaced.
"""

from __future__ import annotations

import posixpath
from collections.abc import Collection
from typing import NamedTuple

from sierra.ingest.observations import observed
from sierra.ingest.recording_context import Context
from sierra.ingest.success import Judgement
from sierra.model import Status
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass

TABLES = ("batch_runs", "executions", "observations", "files_read", "files_written", "listings")
UNOBSERVED = "no run of its experiment was observed, which would tell whether it uses the file"
BY_SIBLINGS = """
WITH members AS (SELECT DISTINCT run, ordinal, seed FROM batch_runs WHERE batch = $batch),
using_sets AS (
    SELECT files FROM files_read SEMI JOIN changed USING (path)
    UNION SELECT f.files FROM files_read f JOIN changed c ON f.path = c.folder
    WHERE f.use = 'listed' AND (c.absent = 'true' OR NOT coalesce(
        (SELECT bool_or(list_contains(l.names, c.file)) FROM listings l WHERE l.sha256 = f.sha256), false
    ))
),
seen AS (
    SELECT m.ordinal, m.seed, o.reason IS NULL AND e.status IN ('ok', 'accepted') AS good,
           o.reason IS NULL AND len(o.notes) = 0 AND o.files NOT IN (FROM using_sets)
           AND o.execution NOT IN (SELECT execution FROM files_written SEMI JOIN changed USING (path)) AS is_unconcerned
    FROM observations o JOIN executions e USING (execution) JOIN members m USING (run)
    WHERE e.session = $session AND e.purpose = 'run'
),
experiments AS (SELECT ordinal, bool_or(good) AS good, bool_and(is_unconcerned) AS is_unconcerned FROM seen GROUP BY ordinal),
seeds AS (SELECT seed, bool_and(is_unconcerned) AS is_unconcerned FROM seen GROUP BY seed)
SELECT m.run, CASE WHEN NOT bool_and(coalesce(x.is_unconcerned, true) AND coalesce(s.is_unconcerned, true)) THEN false
    WHEN bool_and(coalesce(x.good, false)) THEN true END AS counts
FROM members m SEMI JOIN doubted USING (run) LEFT JOIN experiments x USING (ordinal) LEFT JOIN seeds s USING (seed)
GROUP BY m.run
"""


@dataclass(frozen=True, slots=True)
class Doubt:
    """The reason why results may not belong to the code, the programs or the image of their session."""

    reason: str
    files: frozenset[str] | None = None
    """The files that have changed, as in the table `files_read`; None if the doubt concerns every execution."""
    absent: frozenset[str] = frozenset()
    """The changed files that were removed or replaced, so that their names may have been absent for a time."""
    by_siblings: bool = True
    """True if observed executions may stand for others."""

    def failed(self, judgement: Judgement, why: str = "") -> Judgement:
        """Return an execution's judgement as failed because of this doubt."""
        reason = f"{self.reason}; {why}" if why else self.reason
        return Judgement(judgement.result, Status.FAILED, reason)


class _Verdict(NamedTuple):
    run: str
    counts: bool | None


def by_observation(judgement: Judgement, doubt: Doubt) -> Judgement | None:
    """Return the judgement of an execution if its own observation decides it; None if others must stand for it."""
    if not judgement.status.is_result:
        return judgement
    if doubt.files is None:
        return doubt.failed(judgement)
    seen = observed(judgement.result)
    if seen is None:
        return None if doubt.by_siblings else doubt.failed(judgement)
    return doubt.failed(judgement) if seen.concerned(doubt.files) else judgement


def by_siblings(store: Store, context: Context, runs: Collection[str], doubt: Doubt) -> dict[str, bool]:
    """Return for unobserved executions of these runs in a session if they count; those of which nobody knows are left out."""
    if doubt.files is None:
        return dict.fromkeys(runs, False)
    if not runs:
        return {}
    with store.snapshot() as snapshot:
        if not snapshot.holds("observations"):
            return {}
        snapshot.views.make(TABLES)
        snapshot.add_table("doubted", run=sorted(set(runs)))
        paths = sorted(doubt.files)
        folders, names = map(posixpath.dirname, paths), map(posixpath.basename, paths)
        absent = ["true" if path in doubt.absent else "false" for path in paths]
        snapshot.add_table("changed", path=paths, folder=folders, file=names, absent=absent)
        verdicts = snapshot.select(_Verdict, BY_SIBLINGS, batch=context.batch, session=context.session)
    return {verdict.run: verdict.counts for verdict in verdicts if verdict.counts is not None}
