"""Records of a session: the batch and its inputs before anything executes, and the session at its end."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any

from sierra.containers import images
from sierra.execution import sessions
from sierra.execution.resolve_plan import Plan, context
from sierra.execution.sessions import Session
from sierra.model import Batch
from sierra.provenance import source
from sierra.runners.cluster.submission_record import Submission
from sierra.store.layout import SessionPaths
from sierra.store.objects import Objects
from sierra.store.order import stamp
from sierra.store.schema import arrow_schema
from sierra.store.segments import Writer, disk_errors
from sierra.store.store import Snapshot, Store
from sierra.util.fs import read_record, write_whole
from sierra.util.hashing import sha256

AT_A_TIME = 4_096
"""Number of members that are in memory as rows at a time."""
THERE = "SELECT blob FROM blobs SEMI JOIN objects USING (sha256)"
"""SQL: source files in the store with both their entry and their content; a repair may have removed the content."""
COUNTS = ("executed", "reexecuted", "reused", "failed", "missing", "interrupted")


def keep(plan: Plan, store: Store, session: Session) -> None:
    """Record the batch, its runs and their input files before anything executes.

    Records that the store has already are not written again, also if another session wrote them first.
    """
    batch, code = plan.batch, plan.source
    if code is None:  # a recorded batch, requested by its id
        return
    writer = store.writer(session.paths.segment, batch.id)
    with store.snapshot() as snapshot:
        known = _known_inputs(plan, snapshot)
        blobs = {row["blob"] for row in snapshot.rows(THERE)} if code.vcs == "none" else set()
    objects = Objects(writer.path("objects"))
    for _, files in plan.inputs.files(batch, lambda run: run.id not in known):
        for _, content in files:
            objects.add(content)
    listing = objects.add(code.manifest)
    if code.vcs == "none":  # git keeps its own
        files_of_source = source.contents(code, plan.project.root, blobs)
        writer.rows("blobs", ({"blob": blob, "sha256": objects.add(content)} for blob, content in files_of_source))
    if plan.image is not None:
        inside = images.examine(plan.project.root, store.paths, plan.image)
        objects.add(inside.listing)
        writer.rows("images", [inside.row()])
    objects.close()
    spec = batch.spec
    first = batch.experiments[0].runs[0]
    writer.rows("batches", [{**batch_row(plan), "lamport": stamp(session.number, session.id)}])
    writer.rows(
        "specs",
        [
            {
                "spec": batch.spec_id,
                "platform": spec.platform,
                "command": list(spec.command),
                "variables": json.dumps(dict(spec.environment), sort_keys=True),
                "source": spec.source,
                "image": spec.image,
                "host_access": list(spec.host_access),
                "files": [name for name, _ in first.inputs],
            }
        ],
    )
    writer.rows("sources", [code.row(listing)])
    writer.rows("environments", [plan.environment])
    writer.rows("programs", plan.programs.rows())
    writer.table("experiments", _experiments(batch))
    writer.tables("batch_runs", _members(batch))
    with sessions.exclusively(store.paths):
        if not is_kept(plan, store):
            store.publish(writer)


def close(
    plan: Plan, store: Store, session: Session, counts: Mapping[str, Any], *, started: datetime, runner: str, slots: int | None
) -> None:
    """Record the result of a session, with its environment. `slots` is None if runs execute on a cluster."""
    record = _row(plan, session, started, runner, slots or _allotted(session.paths))
    writer = store.writer(session.paths.segment, plan.batch.id)
    writer.rows("sessions", [record | {"ended": datetime.now(UTC)} | {name: counts[name] for name in COUNTS}])
    _write_around(plan, writer, executed=bool(counts["executed"]))
    store.publish(writer)


def prepare(plan: Plan, store: Store, session: Session, *, started: datetime, runner: str) -> None:
    """Prepare the record of a session whose process may end before its jobs do.

    Records everything except the result, which `finish` records.
    """
    writer = store.writer(session.paths.segment, plan.batch.id)
    _write_around(plan, writer, executed=True)
    store.publish(writer)
    record = {"runs": len({run.id for run in plan.batch.runs}), **_row(plan, session, started, runner, None)}
    with disk_errors(session.paths.root):
        write_whole(session.paths.asking, json.dumps(record, default=datetime.isoformat).encode())


def finish(store: Store, session: Session, *, interrupted: bool) -> None:
    """Record the result of a session that another process prepared; do nothing if none did."""
    if not session.paths.asking.exists():
        return
    record = read_record(session.paths.asking)
    runs, claimed = record.pop("runs"), len(sessions.claims(session.paths))
    [went] = store.rows(WENT, s=session.id)
    counts = {**went, "reused": runs - claimed, "missing": claimed - went["executed"], "interrupted": interrupted}
    record |= {"started": datetime.fromisoformat(record["started"]), "ended": datetime.now(UTC)}
    record["slots"] = _allotted(session.paths)
    writer = store.writer(session.paths.segment, record["batch"])
    writer.rows("sessions", [record | counts])
    store.publish(writer)


WENT = """
WITH mine AS (SELECT run, bool_or(status = 'ok') AS good, min(lamport) AS began FROM executions WHERE session = $s GROUP BY run)
SELECT count(*) AS executed, count(*) FILTER (NOT good) AS failed, count(*) FILTER (
    EXISTS (SELECT 1 FROM executions e WHERE e.run = mine.run AND e.session <> $s AND e.lamport < mine.began)
) AS reexecuted FROM mine
"""


def _allotted(session: SessionPaths) -> int | None:
    """Return how many runs of a submitted session execute at a time once all its elements run; None without a submission."""
    try:
        made = Submission.load(session)
    except FileNotFoundError:
        return None
    return len(made.counts) * made.cluster.cpus


def _row(plan: Plan, session: Session, started: datetime, runner: str, slots: int | None) -> dict[str, Any]:
    """Return the row of a session before it executes."""
    now = context(plan)
    return {
        "session": session.id,
        "batch": plan.batch.id,
        "query": plan.text,
        "started": started,
        "runner": runner,
        "engine": plan.engine.name,
        "slots": slots,
        "sierra": plan.environment["sierra"],
        "environment": plan.environment["environment"],
        "source": plan.source_id,
        "lamport": stamp(session.number, session.id),
        **{name: getattr(now, name) for name in ("programs", "ingest_rules", "batch_rules")},
    }


def _write_around(plan: Plan, writer: Writer, *, executed: bool) -> None:
    """Record the source of a session, and its environment and programs if it executed runs."""
    if plan.source:
        writer.rows("sources", [plan.source.row(sha256(plan.source.manifest))])
    if executed:
        writer.rows("environments", [plan.environment])
        writer.rows("programs", plan.programs.rows())


def is_kept(plan: Plan, store: Store) -> bool:
    """Check whether the store has the plan's batch."""
    return bool(store.rows("SELECT 1 FROM batches WHERE batch = $b LIMIT 1", b=plan.batch.id))


def _known_inputs(plan: Plan, snapshot: Snapshot) -> set[str]:
    """Return the runs of the batch whose input files the store has, because they belong to an earlier batch."""
    import pyarrow as pa

    spec = {"spec": plan.batch.spec_id}
    snapshot.views.make(("batch_runs",))
    if not snapshot.run("SELECT 1 FROM batch_runs WHERE spec = $spec LIMIT 1", spec):
        return set()
    snapshot.register("asked", pa.table({"run": [run.id for run in plan.batch.runs]}))
    return {row[0] for row in snapshot.run("SELECT DISTINCT run FROM batch_runs SEMI JOIN asked USING (run)")}


def batch_row(plan: Plan) -> dict[str, Any]:
    """Return the row of the table `batches` for a plan."""
    return {
        "batch": plan.batch.id,
        "created": datetime.now(UTC),
        "query": plan.text,
        "axes": (axes := [axis.name for axis in plan.batch.axes]),
        "controller": None if "controller" in axes else plan.query.controller or plan.project.config.controller,
        "scenario": None if "scenario" in axes else plan.query.scenario or plan.project.config.scenario,
        "overrides": [f"{change.path}={change.value}" for change in plan.query.sets],
        "platform": plan.batch.spec.platform,
        "experiments": len(plan.batch.experiments),
        "runs": len({run.id for run in plan.batch.runs}),
        "base_seed": plan.query.base_seed,
        "spec": plan.batch.spec_id,
        "template": plan.project.config.template,
        "template_sha256": plan.template_sha256,
    }


def _experiments(batch: Batch) -> Any:
    import pyarrow as pa

    columns: dict[str, Any] = {
        "experiment": [experiment.id for experiment in batch.experiments],
        "batch": [batch.id] * len(batch.experiments),
        "ordinal": [experiment.ordinal for experiment in batch.experiments],
    }
    for axis in batch.axes:
        values = [experiment.values[axis.name] for experiment in batch.experiments]
        kind = pa.string() if not axis.numeric else pa.int64() if all(isinstance(v, int) for v in values) else pa.float64()
        columns[axis.name] = pa.array(values, kind)
    return pa.table(columns)


def _members(batch: Batch) -> Iterator[Any]:
    import pyarrow as pa

    schema = arrow_schema("batch_runs")
    for at in range(0, len(batch.runs), AT_A_TIME):
        rows = (
            (batch.id, run.experiment, run.number, run.id, run.seed, first, others, batch.spec_id)
            for run in batch.runs[at : at + AT_A_TIME]
            for first, *others in ([digest for _, digest in run.inputs],)
        )
        columns = zip(zip(*rows, strict=True), schema, strict=True)
        yield pa.table([pa.array(column, field.type) for column, field in columns], schema)
