"""Records of a session: the batch and its inputs before anything executes, and the session at its end.

Also: programs of the project that git ignores and that executions used: the store keeps small ones, so that replays have them.

A program is a file that was executed, or that is an ELF file or a script: for example `build/libcontroller.so`. Data is not
kept, except files of the source that git would restore with other bytes. The records of programs and of observed files have
their SHA-256. Products of `[build]` are not kept, because a replay builds them again, and neither are files of a virtual
environment, which a replay uses where it is.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sierra.containers import images
from sierra.containers.images import record
from sierra.containers.images.image import Image, ImageVariants, every
from sierra.errors import Damaged, Missing, QueryError
from sierra.execution import sessions, shared_files
from sierra.execution.observation.reusable_executions import unused_changes
from sierra.execution.plan import Plan, context
from sierra.execution.reuse import FileCheck, State, check
from sierra.execution.sessions import Session
from sierra.model import IN_PROJECT, Batch
from sierra.provenance import source
from sierra.provenance.hash_cache import VENV
from sierra.store import spec_rows
from sierra.store.lamport_clock import stamp
from sierra.store.layout import SessionPaths
from sierra.store.objects import Objects
from sierra.store.read_lock import alone
from sierra.store.row_mapper import of_fields
from sierra.store.row_types import (
    BatchRow,
    BatchRunRow,
    BlobRow,
    ImageRow,
    ReusedExecutionRow,
    SessionRow,
    StaleSessionRow,
)
from sierra.store.schema import sql_types
from sierra.store.segments import SUFFIX, Writer, disk_errors
from sierra.store.store import Snapshot, Store
from sierra.util import processors
from sierra.util.fs import read_record, unescaped, write_whole
from sierra.util.hashing import sha256

if TYPE_CHECKING:
    from sierra.execution.summary import Summary


MAGIC = (b"\x7fELF", b"#!")
CONVERTED = "converted"
"""The use of a file of the source that git would restore with other bytes."""
KEPT = ("executed", CONVERTED)


class _Used(NamedTuple):
    path: str
    use: str
    sha256: str


OBSERVED = """
SELECT DISTINCT f.path, f.use, f.sha256
FROM observations o JOIN executions e USING (execution) JOIN files_read f USING (files)
WHERE e.session = $s AND starts_with(f.path, $inside) AND f.use IN ('executed', 'read') AND f.sha256 IS NOT NULL ORDER BY ALL
"""


def contents(plan: Plan, store: Store, session: str) -> Iterator[bytes]:
    """Yield the programs to keep that the store does not have, the smallest first, up to the limit of `[source]`."""
    if plan.source is None:  # a recorded batch
        return
    used = _used(plan, store, session)
    if not used:
        return
    with store.snapshot() as snapshot:
        stored = snapshot.kept_sizes(file.sha256 for file in used.values())
    left = plan.project.config.source.max_ignored
    for size, path, file in sorted((path.stat().st_size, path, file) for path, file in used.items() if path.is_file()):
        if size > left:
            return
        content = b"" if file.sha256 in stored else path.read_bytes()
        if (file.use in KEPT or content.startswith(MAGIC)) and sha256(content) == file.sha256:
            left -= size
            yield content


def _used(plan: Plan, store: Store, session: str) -> Mapping[Path, _Used]:
    """Return the project's files outside the source that are known to be used."""
    converted = plan.source.converted if plan.source else {}
    derived = [_Used(file.name, str(file.kind), file.sha256) for file in plan.programs.all if file.name.startswith(IN_PROJECT)]
    observed = [] if plan.project.config.observe == "none" else store.select(_Used, OBSERVED, s=session, inside=IN_PROJECT)
    root, known = plan.project.root, source.paths(plan.source.manifest) if plan.source else set()
    products = {file.name for file in plan.build.products} if plan.build else set()
    files = {file.path.removeprefix(IN_PROJECT): file for file in (*derived, *observed)}
    lossy = {root / unescaped(name): _Used(name, CONVERTED, sha256) for name, sha256 in converted.items()}
    return lossy | {
        root / name: file
        for name, file in files.items()
        if os.fsencode(name) not in known and name not in products and not _is_in_environment(root, name)
    }


def _is_in_environment(root: Path, name: str) -> bool:
    return any((root / folder / VENV).is_file() for folder in Path(name).parents)


LASTING = tuple(f"{table}{SUFFIX}" for table in ("executions", "findings", "judgements", "builds"))
"""Files of segments that tell about executions, whatever comes of a request."""


def keep(plan: Plan, store: Store, session: Session) -> None:
    """Record the batch, its runs and their input files before anything executes, unless the store has the batch.

    Records that the store has already are not written again, also if another session wrote them first. Raises QueryError for an
    axis that cannot be told from a recorded one.
    """
    batch, code = plan.batch, plan.source
    if code is None:  # a recorded batch, requested by its id
        return
    with store.snapshot() as snapshot:
        if is_kept(plan, snapshot):
            return
        _check_axes(batch, snapshot)
        seen = set(snapshot.listing.names)
        known = _known_inputs(plan, snapshot)
        stored = shared_files.stored(plan.shared_files, snapshot)
        blobs = _stored_blobs(snapshot) if code.vcs == "none" else set()
    writer = store.writer(session.paths.segment, batch.id)
    objects = Objects(writer.path("objects"))
    for _, files in plan.inputs.files(batch, lambda run: run.id not in known):
        for _, content in files:
            objects.add(content)
    shared_files.keep(plan.shared_files, plan.project.root, objects, stored)
    writer.records(plan.shared_files)
    listing = objects.add(code.manifest)
    if code.vcs == "none":  # git keeps its own
        files_of_source = source.contents(code, plan.project.root, blobs)
        writer.records(BlobRow(blob, objects.add(content)) for blob, content in files_of_source)
    if isinstance(plan.image, Image):
        writer.records([_row_of_image(plan, store, plan.image, objects)])
    objects.close()
    writer.records([code.row(listing)])
    _write_batch(plan, session, writer)
    with sessions.exclusively(store.paths):
        if store.names() == seen or not is_kept(plan, store):
            store.publish(writer)


def _stored_blobs(snapshot: Snapshot) -> set[str]:
    """Return the source files with both their entry and their content; a repair may have removed the content."""
    snapshot.views.make(("blobs",))
    blobs: dict[str, str] = dict(snapshot.run("SELECT blob, sha256 FROM blobs"))
    kept = snapshot.kept_sizes(blobs.values())
    return {blob for blob, digest in blobs.items() if digest in kept}


def _check_axes(batch: Batch, snapshot: Snapshot) -> None:
    """Raise QueryError if an axis and a recorded one differ only in upper and lower case: they would be one column in SQL."""
    recorded = set(snapshot.values(str, "SELECT DISTINCT unnest(axes) FROM batches"))
    other = {name.lower(): name for name in sorted(recorded)}
    for axis in (axis.name for axis in batch.axes if axis.name not in recorded):
        if axis.lower() in other:
            raise QueryError(
                f"{axis!r} and the recorded variable {other[axis.lower()]!r} differ only in upper and lower case, which SQL "
                "ignores, so that their values would be in one column; rename the variable in sierra.toml"
            )


def withdraw(store: Store, session: Session) -> None:
    """Remove what a session has recorded if its request was refused: nothing was started, and nobody else needs it.

    Others do not record again what the store has already, so that whoever lives, or has recorded anything since the session
    began, may need it.
    """
    own = [segment for folder, segment in store.published if folder == session.paths.segment]
    with sessions.exclusively(store.paths) as locked, alone(store.paths.reading) as unread:
        if not (own and locked and unread) or _has_begun(session.paths):
            return
        others = [paths for paths in sessions.all_of(store.paths) if paths.root.name != session.id]
        only_added = {path.name for path in store.paths.segments.iterdir()} == {
            *session.seen,
            *(segment.name for segment in own),
        }
        if only_added and not others and not any((segment / name).exists() for segment in own for name in LASTING):
            for number, segment in enumerate(reversed(own)):
                with contextlib.suppress(OSError):
                    segment.rename(session.paths.root / f"withdrawn.{number}")


def _has_begun(session: SessionPaths) -> bool:
    """Check whether a worker, or a job on a cluster, may have executed runs of a session."""
    if session.journal.exists():
        return True
    from sierra.runners.cluster import submission_record

    return session.sent.exists() and any(submission_record.jobs(session))


def keep_variants(plan: Plan, store: Store, session: Session) -> None:
    """Record the images for several processors that the plan's image stands for, unless the store has them.

    An image that is not available here is left out: only a host with its processor needs it.
    """
    if not isinstance(plan.image, ImageVariants):
        return
    recorded = set(store.values(str, "SELECT image FROM images"))
    rows = [] if plan.image.id in recorded else [record.row(plan.image)]
    writer = store.writer(session.paths.segment, plan.batch.id)
    objects = Objects(writer.path("objects"))
    for image in _for_hosts(plan, plan.image):
        if image.id not in recorded:
            with contextlib.suppress(Missing, Damaged):
                rows.append(_row_of_image(plan, store, image, objects))
    objects.close()
    writer.records(rows)
    store.publish(writer)


def _for_hosts(plan: Plan, image: ImageVariants) -> tuple[Image, ...]:
    """Return the images that the hosts of a plan may need."""
    return (image.on(processors.here()),) if plan.batch.spec.robots is None else every(image)


def _row_of_image(plan: Plan, store: Store, image: Image, objects: Objects) -> ImageRow:
    """Return the row of an image, and add the list of its files. Raises Missing, Damaged."""
    inside = images.examine(plan.project.root, store.paths, image)
    objects.add(inside.listing)
    return inside.row()


def keep_for_trial(plan: Plan, store: Store, session: Session) -> None:
    """Record a batch in the store of a trial, without its inputs and its source."""
    writer = store.writer(session.paths.segment, plan.batch.id)
    writer.records(plan.shared_files)
    _write_batch(plan, session, writer)
    store.publish(writer)


def _write_batch(plan: Plan, session: Session, writer: Writer) -> None:
    """Write the records of a batch, its experiments and its runs, and of the machine."""
    writer.records([batch_row(plan, _lamport(session))])
    writer.records([spec_rows.of_batch(plan.batch)])
    _write_host(plan, writer)
    _write_experiments(plan.batch, writer)
    writer.records(_members(plan.batch))


def keep_check(plan: Plan, store: Store, session: Session) -> tuple[FileCheck, dict[str, State]]:
    """Record and return which executions do not count in this session, or count although source or programs differ.

    Return also the state of each run.
    """
    checked, recorded = check(plan, store)
    if checked.stale or checked.reusable:
        writer = store.writer(session.paths.segment, plan.batch.id)
        writer.records(StaleSessionRow(session.id, execution, file.path) for execution, file in checked.stale.items())
        writer.records(ReusedExecutionRow(session.id, run, reused.execution) for run, reused in checked.reusable.items())
        writer.records(unused_changes(plan, store, session.id, checked.reusable.values(), checked.stale))
        store.publish(writer)
    return checked, recorded


def close(plan: Plan, store: Store, session: Session, summary: Summary, begun: SessionRow) -> None:
    """Record the result of a session, with its environment."""
    writer = store.writer(session.paths.segment, plan.batch.id)
    counts = Counts(summary.executed, summary.reexecuted, summary.failed)
    writer.records([_ended(session, begun, counts, summary.reused, summary.missing, interrupted=summary.interrupted)])
    _write_source_and_host(plan, writer, executed=bool(summary.executed))
    if summary.executed:
        _write_programs(plan, store, session, writer)
    store.publish(writer)


def prepare(plan: Plan, store: Store, session: Session, begun: SessionRow, left_out: int | None = None) -> None:
    """Prepare the record of a session whose process may end before its jobs do.

    Records everything except the result, which `finish` records. `left_out`: the session is limited to a part of the batch, and
    so many other runs have no successful execution; None if it is not limited.
    """
    writer = store.writer(session.paths.segment, plan.batch.id)
    _write_source_and_host(plan, writer, executed=True)
    _write_programs(plan, store, session, writer)
    store.publish(writer)
    known = {name: value for name, value in begun._asdict().items() if name not in RESULT}
    record = {"runs": len({run.id for run in plan.batch.runs}), "left_out": left_out, **known}
    with disk_errors(session.paths.root):
        write_whole(session.paths.asking, json.dumps(record, default=datetime.isoformat).encode())


def finish(store: Store, session: Session, *, interrupted: bool) -> int | None:
    """Record the result of a session that another process prepared; do nothing if none did.

    If the session was limited to a part of its batch, return how many of its runs were not executed; otherwise None.
    """
    if not session.paths.asking.exists():
        return None
    fields = read_record(session.paths.asking)
    try:
        runs = int(fields.pop("runs"))
        left_out = fields.pop("left_out", None)
        others = int(left_out or 0)
        started = datetime.fromisoformat(fields["started"])
        begun = of_fields(
            SessionRow, {"build": None, "target": None, **fields, **NO_RESULT, "started": started, "ended": started}
        )
    except (KeyError, TypeError, ValueError) as error:
        raise Damaged(f"{session.paths.asking}: was not written by this version of SIERRA; use the other version") from error
    claimed = len(sessions.claims(session.paths))
    [counts] = store.select(Counts, COUNTS, s=session.id)
    writer = store.writer(session.paths.segment, begun.batch)
    reused, missing = runs - claimed - others, claimed - counts.executed
    writer.records([_ended(session, begun, counts, reused, missing + others, interrupted=interrupted)])
    store.publish(writer)
    return None if left_out is None else missing


class Counts(NamedTuple):
    """Numbers of runs that a session executed, had executed again, and that failed."""

    executed: int
    reexecuted: int
    failed: int


COUNTS = """
WITH mine AS (
    SELECT run, bool_or(status IN ('ok', 'accepted')) AS good, min(lamport) AS began
    FROM executions WHERE session = $s GROUP BY run
)
SELECT count(*) AS executed, count(*) FILTER (
    EXISTS (SELECT 1 FROM executions e WHERE e.run = mine.run AND e.session <> $s AND e.lamport < mine.began)
) AS reexecuted, count(*) FILTER (NOT good) AS failed FROM mine
"""
NO_RESULT = {**dict.fromkeys((*Counts._fields, "reused", "missing"), 0), "interrupted": False}
RESULT = ("ended", *NO_RESULT)
"""Columns of a session that are known at its end."""


def begun(plan: Plan, session: Session, *, started: datetime, runner: str, slots: int | None) -> SessionRow:
    """Return the record of a session without a result. `slots` is None if runs execute on a cluster."""
    now = context(plan)
    fields = {
        "session": session.id,
        "batch": plan.batch.id,
        "query": plan.text,
        "started": started,
        "ended": started,
        "runner": runner,
        "engine": plan.engine.name,
        "slots": slots,
        "sierra": plan.environment.sierra,
        "environment": plan.environment.environment,
        "source": plan.source_id,
        "lamport": _lamport(session),
        "programs": now.programs,
        "ingest_rules": now.ingest_rules,
        "batch_rules": now.batch_rules,
        "build": plan.build.recipe.id if plan.build else None,
        "target": plan.target,
    }
    return of_fields(SessionRow, fields | NO_RESULT)


def _ended(session: Session, begun: SessionRow, counts: Counts, reused: int, missing: int, *, interrupted: bool) -> SessionRow:
    return begun._replace(
        **counts._asdict(),
        ended=datetime.now(UTC),
        slots=begun.slots or _cores(session.paths),
        reused=reused,
        missing=missing,
        interrupted=interrupted,
    )


def _cores(session: SessionPaths) -> int | None:
    """Return how many runs of a submitted session execute at a time once all its array tasks run; None without a submission."""
    try:
        from sierra.runners.cluster.submission_record import Submission

        submission = Submission.load(session)
    except FileNotFoundError:
        return None
    return len(submission.counts) * submission.at_once


def _lamport(session: Session) -> int:
    """Return the Lamport number of the batches and the end of a session, which has taken its number."""
    lamport = stamp(session.number, session.id)
    if lamport is None:
        raise ValueError(f"session {session.id} has not taken a number")
    return lamport


def _write_host(plan: Plan, writer: Writer) -> None:
    writer.records([plan.environment])
    writer.records(plan.programs.rows())


def _write_source_and_host(plan: Plan, writer: Writer, *, executed: bool) -> None:
    """Record the source of a session, and its environment and programs if it executed runs."""
    if plan.source:
        writer.records([plan.source.row(sha256(plan.source.manifest))])
    if executed:
        _write_host(plan, writer)


def _write_programs(plan: Plan, store: Store, session: Session, writer: Writer) -> None:
    """Keep programs of the project that git ignores."""
    found = list(contents(plan, store, session.id))
    if found:
        objects = Objects(writer.path("objects"))
        for content in found:
            objects.add(content)
        objects.close()


def is_kept(plan: Plan, records: Store | Snapshot) -> bool:
    """Check whether the store has the plan's batch."""
    return bool(records.values(str, "SELECT batch FROM batches WHERE batch = $b LIMIT 1", b=plan.batch.id))


def _known_inputs(plan: Plan, snapshot: Snapshot) -> set[str]:
    """Return the runs of the batch whose input files the store has, because they belong to an earlier batch."""
    spec = {"spec": plan.batch.spec_id}
    snapshot.views.make(("batch_runs",))
    if not snapshot.run("SELECT 1 FROM batch_runs WHERE spec = $spec LIMIT 1", spec):
        return set()
    snapshot.add_table("asked", run=(run.id for run in plan.batch.runs))
    return {row[0] for row in snapshot.run("SELECT DISTINCT run FROM batch_runs SEMI JOIN asked USING (run)")}


def batch_row(plan: Plan, lamport: int = 0) -> BatchRow:
    """Return the row of the table `batches` for a plan."""
    axes = [axis.name for axis in plan.batch.axes]
    return BatchRow(
        batch=plan.batch.id,
        created=datetime.now(UTC),
        query=plan.text,
        axes=axes,
        controller=None if "controller" in axes else plan.query.controller or plan.project.config.controller,
        scenario=None if "scenario" in axes else plan.query.scenario or plan.project.config.scenario,
        overrides=[f"{change.path}={change.value}" for change in plan.query.sets],
        platform=plan.batch.spec.platform,
        experiments=len(plan.batch.experiments),
        runs=len({run.id for run in plan.batch.runs}),
        base_seed=plan.query.base_seed,
        spec=plan.batch.spec_id,
        template=" ".join(plan.project.config.template_paths),
        template_sha256=plan.template_sha256,
        lamport=lamport,
    )


def _write_experiments(batch: Batch, writer: Writer) -> None:
    """Write the table `experiments`; each independent variable is a further column."""
    columns = sql_types("experiments")
    for axis in batch.axes:
        whole = all(isinstance(experiment.values[axis.name], int) for experiment in batch.experiments)
        columns[axis.name] = "VARCHAR" if not axis.numeric else "BIGINT" if whole else "DOUBLE"
    rows = ([one.id, batch.id, one.ordinal, *(one.values[axis.name] for axis in batch.axes)] for one in batch.experiments)
    writer.table("experiments", columns, rows)


def _members(batch: Batch) -> Iterator[BatchRunRow]:
    for run in batch.runs:
        first, *others = (digest for _, digest in run.inputs)
        yield BatchRunRow(batch.id, run.experiment, run.number, run.id, run.seed, first, others, batch.spec_id)
