"""Reasons for new runs: differences between a plan and the most similar recorded batch."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from sierra.containers import images
from sierra.containers.container_setup import other_host_access
from sierra.containers.images import record
from sierra.containers.images.image import Image
from sierra.errors import Damaged, Missing, NotFound
from sierra.execution import around, row_queries
from sierra.execution.observation import stale_sessions
from sierra.execution.plan import Plan
from sierra.execution.session_records import batch_row, is_kept
from sierra.explain.plan_changes import Aspect, Basis, NewRuns, PlanChange
from sierra.provenance import fingerprint_programs, source
from sierra.provenance.dependency_model import Programs, mentioned
from sierra.provenance.source import suggest_exclusions
from sierra.provenance.source.manifest import changed
from sierra.store.row_types import ImageRow, SharedFileRow
from sierra.store.store import Snapshot, Store

if TYPE_CHECKING:
    from sierra.containers.images.image_contents import Contents


class Recorded(NamedTuple):
    """A recorded batch: its query, and what its runs were made from."""

    batch: str
    query: str
    runs: int
    controller: str | None
    scenario: str | None
    base_seed: int
    overrides: list[str]
    template: str
    """The paths of the templates; empty if there is none."""
    template_sha256: str
    platform: str
    command: list[str]
    variables: str
    source: str | None
    image: str | None
    host_access: list[str] | None
    around: str | None
    robots: str | None
    target: str | None
    """The target of its last session."""
    files: list[str]
    shared_files: str | None


COLUMNS = """
SELECT b.batch, b.query, b.runs, b.controller, b.scenario, b.base_seed, b.overrides, b.template, b.template_sha256, b.platform,
       r.command, r.variables, r.source, r.image, r.host_access, r.around, r.robots, s.target, r.files,
       r.shared_files
FROM batches b JOIN specs r USING (spec) LEFT JOIN (
    SELECT batch, max(lamport) AS asked, nullif(arg_max(coalesce(target, ''), lamport), '') AS target
    FROM sessions GROUP BY batch
) s USING (batch)
"""
LIKE = f"""{COLUMNS} WHERE b.axes = $axes AND b.batch <> $batch
ORDER BY coalesce(s.target, '') = $target DESC, coalesce(s.asked, b.lamport) DESC LIMIT 1
"""
THIS = f"{COLUMNS} WHERE b.batch = $batch"


class Known(NamedTuple):
    """The number of recorded batches with one id (0 or 1), and the programs of the last session of that batch."""

    kept: int
    programs: str | None


KNOWN = """
SELECT (SELECT count(*) FROM batches WHERE batch = $batch) AS kept,
       (SELECT arg_max(programs, lamport) FROM sessions WHERE batch = $batch) AS programs
"""
QUERY = ("query", "runs", "controller", "scenario", "base_seed")
OTHER_SETTINGS = PlanChange(Aspect.SETTINGS)


def why_new(plan: Plan, store: Store | None) -> NewRuns:
    """Return the differences between a plan and the last batch over the same axes."""
    if store is None:
        return NewRuns(Basis.EMPTY_STORE)
    if is_kept(plan, store):
        return NewRuns(Basis.SAME_BATCH)
    before = _similar(plan, store)
    if before is None:
        return NewRuns(Basis.NOTHING)
    return NewRuns(Basis.BATCH, before.batch, before.query, _changes(plan, store, before))


def why_other(plan: Plan, store: Store, batch: str) -> tuple[PlanChange, ...]:
    """Return the differences between a plan and a recorded batch."""
    [before] = store.select(Recorded, THIS, batch=batch)
    return _changes(plan, store, before)


def why_again(plan: Plan, store: Store) -> tuple[PlanChange, ...]:
    """Return the reasons why a repeated query executes runs again.

    There are none for a query that is not a repetition, or that executes nothing again.
    """
    with store.snapshot() as snapshot:
        [known] = snapshot.select(Known, KNOWN, batch=plan.batch.id)
        before = None if known.kept else _similar(plan, snapshot)
    if known.kept:
        return other_programs(plan, store) if known.programs not in (None, plan.programs.id) else ()
    if before is None or _query(plan, before):
        return ()
    return _changes(plan, store, before)


def _similar(plan: Plan, store: Store | Snapshot) -> Recorded | None:
    """Return the last other batch over the same axes, if possible for the same target."""
    axes = [axis.name for axis in plan.batch.axes]
    rows = store.select(Recorded, LIKE, axes=axes, batch=plan.batch.id, target=plan.target or "")
    return rows[0] if rows else None


def _changes(plan: Plan, store: Store, before: Recorded) -> tuple[PlanChange, ...]:
    changes = (*_spec(plan, store, before), *_image(plan, store, before), *_source(plan, store, before))
    if before.template_sha256 != plan.template_sha256:
        changes += (_template(plan, before),)
    return (*changes, *_query(plan, before)) or (OTHER_SETTINGS,)


def _template(plan: Plan, before: Recorded) -> PlanChange:
    """Return the difference between two templates, of which one may not exist."""
    was, now = before.template, " ".join(plan.project.config.template_paths)
    if was and now:
        return PlanChange(Aspect.TEMPLATE, now)
    return PlanChange(Aspect.NEW_TEMPLATE, now) if now else PlanChange(Aspect.NO_TEMPLATE, was)


LAST_PROGRAMS = """
SELECT programs FROM executions SEMI JOIN asked USING (run) WHERE purpose = 'run' ORDER BY lamport DESC LIMIT 1
"""


def other_programs(plan: Plan, store: Store) -> tuple[PlanChange, ...]:
    """Return the programs that differ from those of the last execution of the plan's runs, which other batches may have too."""
    words = mentioned(plan.batch.spec.words, plan.project.root)
    with store.snapshot() as snapshot:
        stale = stale_sessions.find(plan, snapshot)
        snapshot.add_table("asked", run=(run.id for run in plan.batch.runs))
        last = snapshot.values(str, LAST_PROGRAMS)
        recorded = Programs(tuple(row.program() for row in row_queries.programs(snapshot, last)))
        used = row_queries.used_distributions(snapshot, last)
    lines = [
        *fingerprint_programs.differences(recorded, plan.programs, words, used),
        *([stale_sessions.reason(stale)] if stale else []),
    ]
    return tuple(PlanChange(Aspect.PROGRAM, details=(line,)) for line in lines)


def _spec(plan: Plan, store: Store, before: Recorded) -> Iterator[PlanChange]:
    """Yield the differences in command, variables, platform, and the names and neighbours of input files."""
    spec = plan.batch.spec
    if before.command != list(spec.command):
        yield PlanChange(Aspect.COMMAND, was=" ".join(before.command), now=" ".join(spec.command))
    old = around.described(around.recorded(before.around), around.commands_of_robots(before.robots))
    new = around.described(spec.around, spec.robots)
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            yield PlanChange(Aspect.AROUND, name, old.get(name), new.get(name))
    variables: dict[str, str] = json.loads(before.variables)
    for name in sorted(variables.keys() | spec.environment.keys()):
        was, now = variables.get(name), spec.environment.get(name)
        if was != now:
            yield PlanChange(Aspect.VARIABLE, name, was, now)
    if before.platform != spec.platform:
        yield PlanChange(Aspect.PLATFORM, was=before.platform, now=spec.platform)
    if before.files != (names := list(plan.batch.runs[0].names)):
        yield PlanChange(Aspect.INPUT_NAMES, was=", ".join(before.files), now=", ".join(names))
    if before.shared_files != spec.shared_files:
        yield PlanChange(Aspect.SHARED_FILES, details=_beside(plan, store, before.shared_files))


SHARED = "SELECT * FROM shared_files WHERE shared = $s"


def _beside(plan: Plan, store: Store, before: str | None) -> tuple[str, ...]:
    """Return the names of the files beside the inputs that differ."""
    rows = store.select(SharedFileRow, SHARED, s=before) if before else []
    was, now = ({(row.name, row.sha256, row.executable) for row in some} for some in (rows, plan.shared_files))
    return tuple(sorted({name for name, *_ in was ^ now}))


def _image(plan: Plan, store: Store, before: Recorded) -> Iterator[PlanChange]:
    """Yield the differences of the image, of its content, and of the host access of runs."""
    spec = plan.batch.spec
    if before.image != spec.image:
        row = _row(store, before.image)
        was = _called(row.name if row else None, before.image)
        yield PlanChange(Aspect.IMAGE, was=was, now=_called(plan.image.name if plan.image else None, spec.image))
        yield from _images(plan, store, row)
    if reach := other_host_access(before.host_access or (), spec.host_access):
        yield PlanChange(Aspect.HOST_ACCESS, ", ".join(reach))


def _images(plan: Plan, store: Store, row: ImageRow | None) -> Iterator[PlanChange]:
    """Yield the differences between the content of a recorded image and that of a plan; of several, each with its own."""
    words = mentioned(plan.batch.spec.words, plan.project.root)
    if row is None or plan.image is None:
        return
    if isinstance(plan.image, Image):
        pairs = [(row.image, plan.image)]
    else:
        was, now = record.variants(row), plan.image.ids
        yield PlanChange(Aspect.VARIANTS, details=tuple(record.changes(was, now)))
        pairs = [(was[one], plan.image.known[one]) for one in record.changed(was, now) if one in plan.image.known]
    for identity, image in pairs:
        old, new = _recorded(store, identity), images.contents(store.paths, image) or _recorded(store, image.id)
        if old and new:
            yield _inside(old, new, words)


def _called(name: str | None, identity: str | None) -> str:
    text = images.short(identity) if identity else "none"
    return f"{name} ({text})" if name else text


def _row(store: Store, identity: str | None) -> ImageRow | None:
    return next(iter(store.select(ImageRow, "SELECT * FROM images WHERE image = $i LIMIT 1", i=identity)), None)


def _recorded(store: Store, identity: str) -> Contents | None:
    """Return the record of an image; None if it cannot be read, which `sierra fsck` reports."""
    from sierra.execution import plan_from_record

    with contextlib.suppress(Missing, NotFound, Damaged):
        return plan_from_record.image_contents(store, identity)
    return None


def _inside(was: Contents, now: Contents, words: frozenset[str]) -> PlanChange:
    """Return the packages that differ or, if none do, the files."""
    from sierra.containers.images.diff import files, packages

    changed_packages = packages(was.packages, now.packages, words)
    if texts := [f"{change.text} ({manager})" for manager, changes in changed_packages.items() for change in changes]:
        return PlanChange(Aspect.PACKAGES, details=tuple(texts))
    texts = [change.text for change in files(was.listing, now.listing)]
    return PlanChange(Aspect.FILES if texts else Aspect.SAME_CONTENT, details=tuple(texts))


FILES = "SELECT files FROM sources WHERE tree = $t LIMIT 1"


def _source(plan: Plan, store: Store, before: Recorded) -> Iterator[PlanChange]:
    if before.source == plan.batch.spec.source:
        return
    recorded = store.values(str, FILES, t=before.source)
    if not recorded or plan.source is None:
        yield PlanChange(Aspect.SOURCE)
        return
    paths = changed(store.object(recorded[0]), plan.source.manifest)
    yield PlanChange(Aspect.SOURCE, details=tuple(paths))
    advice = suggest_exclusions.advice(map(os.fsencode, paths), source.paths(plan.source.manifest))
    if advice != suggest_exclusions.ONLY_SAID:
        yield PlanChange(Aspect.EXCLUSIONS, details=(advice,))


def _query(plan: Plan, before: Recorded) -> tuple[PlanChange, ...]:
    """Return the differences in the query."""
    now = batch_row(plan)
    settings = [(name, getattr(before, name), getattr(now, name)) for name in QUERY if name not in now.axes]
    settings.append(("target", before.target, plan.target))
    added = [change for change in now.overrides if change not in before.overrides]
    removed = [change for change in before.overrides if change not in now.overrides]
    return (
        *(PlanChange(Aspect.QUERY, name, was, value) for name, was, value in settings if was != value),
        *(PlanChange(Aspect.SET_ADDED, change) for change in added),
        *(PlanChange(Aspect.SET_REMOVED, change) for change in removed),
    )
