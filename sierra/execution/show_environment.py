"""Where the executions of a batch or a run took place: isolations, image, programs and environment, as recorded."""

from __future__ import annotations

import json
from typing import NamedTuple

from sierra.execution.row_queries import RecordedProgram, programs
from sierra.execution.shown_records import ShownEnvironment, ShownImage, ShownIsolation
from sierra.store.layout import STORE, WORK
from sierra.store.row_types import (
    EnvironmentRow,
    ImageRow,
    IsolationRow,
)
from sierra.store.store import Snapshot


class _Isolations(NamedTuple):
    isolation: str
    executions: int


ISOLATIONS = """
SELECT isolation, count(*) AS executions
FROM executions e SEMI JOIN (SELECT run FROM batch_runs WHERE batch = $b) USING (run)
WHERE purpose = 'run' AND isolation IN (SELECT isolation FROM isolations) GROUP BY isolation ORDER BY max(lamport) DESC
"""


def isolations(snapshot: Snapshot, batch: str) -> list[ShownIsolation]:
    """Return the isolations of the executions of a batch's runs, most recent first."""
    rows = snapshot.select(_Isolations, ISOLATIONS, b=batch)
    return [_shown(snapshot, row.isolation, row.executions) for row in rows]


def isolation(snapshot: Snapshot, identity: str | None) -> ShownIsolation | None:
    """Return one isolation; None if the execution had none."""
    return None if identity is None else _shown(snapshot, identity)


def _shown(snapshot: Snapshot, identity: str, executions: int | None = None) -> ShownIsolation:
    from sierra.containers.container_setup import limits

    rows = snapshot.select(IsolationRow, "SELECT * FROM isolations WHERE isolation = $i", i=identity)
    if not rows:
        return ShownIsolation(identity, None, executions, {}, {})
    return ShownIsolation(identity, rows[0], executions, json.loads(rows[0].mounts or "{}"), limits(rows[0]._asdict()))


def image(snapshot: Snapshot, identity: str | None) -> ShownImage | None:
    """Return one image; None if there was none."""
    if identity is None:
        return None
    rows = snapshot.select(ImageRow, "SELECT * FROM images WHERE image = $i", i=identity)
    if not rows:
        return ShownImage(identity, None, {}, {})
    columns = {"manifests": rows[0].manifests, "labels": rows[0].labels, "variables": rows[0].variables}
    decoded = {name: json.loads(text or "{}") for name, text in columns.items()}
    return ShownImage(identity, rows[0], json.loads(rows[0].packages or "{}"), decoded)


def used_programs(snapshot: Snapshot, identity: str | None) -> list[RecordedProgram]:
    """Return one set of programs.

    A replay's copy of a project's program, which no longer exists, is left out if the project's own is recorded too.
    """
    used = programs(snapshot, [identity]) if identity else []
    lasting = [program for program in used if f"/{STORE}/{WORK}/" not in program.path]
    names = {program.name for program in lasting}
    return [program for program in used if program in lasting or program.name not in names]


def environment(snapshot: Snapshot, identity: str | None) -> ShownEnvironment | None:
    """Return one environment; None if none is recorded."""
    rows = snapshot.select(EnvironmentRow, "SELECT * FROM environments WHERE environment = $e", e=identity)
    if not rows:
        return None
    limits, variables = (json.loads(text or "{}") for text in (rows[0].limits, rows[0].variables))
    return ShownEnvironment(rows[0], limits, variables, rows[0].distributions.splitlines())
