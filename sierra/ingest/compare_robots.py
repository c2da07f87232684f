"""Comparison of the robots of a batch over its runs: one whose kernel, packages, workspaces or files have changed is reported.

Runs of a batch are compared across its sessions, because a batch on robots may take days. Nothing is executed again: a robot's
software can only be compared when the robot is there.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby, pairwise
from operator import attrgetter
from typing import NamedTuple

from sierra.provenance import environment
from sierra.store.row_types import EnvironmentRow
from sierra.store.store import Snapshot, Store
from sierra.util.text import few

NAMED = 3
ROBOT = "{robot "
"""The beginning of the name of a file on a robot: `{robot NAME}/usr/bin/python3`, and `{robot NAME}{home}/…`."""
ENVIRONMENTS = """
SELECT r.robot, r.environment FROM robots r JOIN executions e USING (execution)
WHERE e.run IN (SELECT run FROM batch_runs WHERE batch = $batch) AND e.purpose = 'run' AND r.environment IS NOT NULL
GROUP BY ALL ORDER BY r.robot, min(e.lamport), r.environment
"""
FILES = """
SELECT f.path FROM executions e JOIN observations o USING (execution) JOIN files_read f USING (files)
WHERE e.run IN (SELECT run FROM batch_runs WHERE batch = $batch) AND e.purpose = 'run'
AND starts_with(f.path, $robot) AND f.use IN ('executed', 'read') AND f.sha256 IS NOT NULL
GROUP BY f.path HAVING count(DISTINCT f.sha256) > 1 ORDER BY f.path
"""


class _Used(NamedTuple):
    robot: str
    environment: str


def notes(store: Store, batch: str) -> Iterator[str]:
    """Yield a warning for each robot with other software than in earlier runs of a batch, and one for changed files."""
    with store.snapshot() as snapshot:
        if not snapshot.holds("robots"):
            return
        used = snapshot.select(_Used, ENVIRONMENTS, batch=batch)
        for robot, rows in groupby(used, attrgetter("robot")):
            if names := list(dict.fromkeys(_changes(snapshot, [row.environment for row in rows]))):
                yield f"{robot} was not the same in all runs of this batch: {few(names, NAMED)} changed (see environments)"
        if snapshot.holds("observations") and (paths := snapshot.values(str, FILES, batch=batch, robot=ROBOT)):
            yield f"files on robots changed between observed runs of this batch: {few(paths, NAMED)}"


def _changes(snapshot: Snapshot, identities: list[str]) -> Iterator[str]:
    """Yield the names of the facts in which each environment differs from the one before."""
    if len(identities) < 2:
        return
    statement = "SELECT * FROM environments WHERE list_contains($e, environment)"
    rows = {row.environment: row._asdict() for row in snapshot.select(EnvironmentRow, statement, e=identities)}
    for before, after in pairwise(rows[identity] for identity in identities if identity in rows):
        yield from (name for name, _, _ in environment.differing(before, after))
