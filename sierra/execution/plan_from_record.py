"""Plans rebuilt from the store: code, inputs, programs and rules of a batch, without the query that made them.

A replay executes such a plan. So does `run` with a batch id: missing runs are executed with the recorded code, whatever the
project's files are now.
"""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from sierra.config.output_tables import Output, Success
from sierra.config.plugin_registry import Tables
from sierra.config.project_file import LoadedProject
from sierra.containers import container_setup, engines, images
from sierra.containers.engines.base import Engine
from sierra.containers.images import record
from sierra.containers.images.image import AnyImage, Image, ImageVariants
from sierra.containers.images.image_contents import Contents
from sierra.design.query.query_request import repeated
from sierra.errors import Damaged, Missing, NotFound, UsageError
from sierra.execution import row_queries, run_limits, targets
from sierra.execution.build import recorded as recorded_build
from sierra.execution.build.recorded import RecordedBuild
from sierra.execution.checkout import Checkout
from sierra.execution.plan import Plan
from sierra.execution.resolve_plan import found_or, this_environment
from sierra.execution.row_queries import RecordedProgram, axis_values, required_row
from sierra.ingest.base import Used, check_formats, restored
from sierra.ingest.recording_context import rules_of
from sierra.model import Axis, Batch, Criterion, Experiment, Listed, Query, Run, RunSpec
from sierra.provenance.change_guard import guard
from sierra.provenance.dependency_model import NOTHING
from sierra.store.recorded_files import INPUT_FOLDER, ChosenExecution, Recorded, contents, recorded
from sierra.store.row_types import BatchRow, ImageRow, IngestRulesRow, SourceRow, SpecRow
from sierra.store.spec_rows import run_spec
from sierra.store.store import Store
from sierra.templates.base import Files
from sierra.util.fs import inside
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, field

AT_A_TIME = 512
"""Number of runs whose input files are in memory at a time."""


class Last(NamedTuple):
    """Programs, rules, source and query that a batch used last, each None if none is recorded."""

    programs: str | None
    ingest_rules: str | None
    source: str | None
    query: str | None


LAST = """
WITH asked AS (
    SELECT programs, ingest_rules, source, query, lamport FROM sessions WHERE batch = $b
    UNION ALL SELECT programs, ingest_rules, NULL, NULL, place FROM all_judgements e LEFT JOIN origins o USING (batch)
    WHERE batch = $b AND purpose = 'run' AND e.packages IS NOT DISTINCT FROM o.packages
)
SELECT arg_max(programs, lamport) AS programs, arg_max(ingest_rules, lamport) AS ingest_rules,
       arg_max(source, lamport) AS source, arg_max(query, lamport) AS query
FROM asked
"""


LAST_DECLARED = """
WITH used AS (
    SELECT ingest_rules, lamport FROM sessions ANTI JOIN imported_sessions USING (session)
    UNION ALL SELECT ingest_rules, place FROM all_judgements WHERE purpose = 'run' AND packages IS NULL
)
SELECT declared FROM ingest_rules WHERE ingest_rules = (SELECT arg_max(ingest_rules, lamport) FROM used) LIMIT 1
"""


def last_outputs(store: Store) -> Mapping[str, Output]:
    """Return the output declarations that were used last."""
    declared = store.values(str, LAST_DECLARED)
    return rules_of(json.loads(declared[0]))[0] if declared else {}


@dataclass(frozen=True, slots=True)
class Recalled:
    """Everything that the runs of one batch have in common."""

    batch: str
    spec: RunSpec
    manifest: bytes
    """Manifest of the source: the list of its files."""
    commit: str | None
    programs: Sequence[RecordedProgram]
    fingerprint: str
    outputs: Mapping[str, Output]
    success: Success
    readers: Used
    """Readers of other packages and of files of the project, with the recorded options."""
    build: RecordedBuild | None = None
    """The build that made the products from the source."""
    observed: Mapping[str, str] = field(default_factory=dict)
    """The SHA-256 of the project's files that executions were observed to use, by name."""

    def checkout(self, project: LoadedProject, store: Store) -> Checkout:
        """Return the checkout that restores the code."""
        used = tuple((program.name, program.kind) for program in self.programs)
        container = project.config.container if self.spec.image else None
        mounted = container_setup.data(NOTHING, container, project.root) if container else NOTHING
        built = {product.name: product.sha256 for product in self.build.products} if self.build else {}
        digests = {program.name: program.sha256 for program in self.programs}
        return Checkout(
            project.root,
            self.spec,
            self.manifest,
            used,
            store.blob,
            mounted,
            self.commit,
            built,
            digests,
            self.observed,
            store.kept,
            project.config.source.git or self.commit is not None,
        )


class _Observed(NamedTuple):
    path: str
    sha256: str


OBSERVED = """
SELECT f.path, arg_max(f.sha256, e.lamport) AS sha256
FROM observations o JOIN executions e USING (execution) JOIN files_read f USING (files)
WHERE e.programs = $p AND e.purpose = 'run' AND e.run IN (SELECT run FROM batch_runs WHERE batch = $b)
AND starts_with(f.path, '{project}/') AND f.use IN ('executed', 'read') AND f.sha256 IS NOT NULL GROUP BY f.path
"""


def recall(store: Store, batch: str, programs: str, ingest_rules: str) -> Recalled:
    """Return the recorded plan of a batch for one set of programs and one set of rules."""
    with store.snapshot() as snapshot:
        row = required_row(SpecRow, snapshot, SPEC, b=batch)
        rules = required_row(IngestRulesRow, snapshot, "SELECT * FROM ingest_rules WHERE ingest_rules = $r", r=ingest_rules)
        used = row_queries.programs(snapshot, [programs])
        build = recorded_build.find(snapshot, row.source, programs)
        observed = {file.path: file.sha256 for file in snapshot.select(_Observed, OBSERVED, b=batch, p=programs)}
        code = snapshot.select(SourceRow, "SELECT * FROM sources WHERE tree = $t LIMIT 1", t=row.source)
    outputs, success, readers = rules_of(json.loads(rules.declared))
    manifest, commit = (store.object(code[0].files), code[0].commit) if code else (b"", None)
    check_formats(outputs, readers)
    own = readers and store.values(int, OWN_RULES, r=ingest_rules)
    readers = restored(readers, refused="" if own else "its code came in a package, and nothing of a package is imported")
    return Recalled(batch, run_spec(row), manifest, commit, used, programs, outputs, success, readers, build, observed)


OWN_RULES = """
SELECT 1 FROM all_sessions ANTI JOIN imported_sessions USING (session) WHERE ingest_rules = $r
UNION ALL SELECT 1 FROM all_judgements WHERE packages IS NULL AND ingest_rules = $r
LIMIT 1
"""
"""SQL that finds a row if executions of this store's own were evaluated by these rules, which have the code of readers."""


def spec(store: Store, batch: str) -> RunSpec:
    """Return the recorded specification of a batch's runs."""
    with store.snapshot() as snapshot:
        return run_spec(required_row(SpecRow, snapshot, SPEC, b=batch))


SPEC = "SELECT r.* FROM specs r JOIN batches b USING (spec) WHERE b.batch = $b"


def engine(store: Store, batch: str, spec: RunSpec, name: str | None, tables: Tables, *, hosted: bool) -> Engine:
    """Return the engine for the runs of a spec: the requested one, or the one that this batch used last.

    `tables` are `[engines.…]`.

    Raises UsageError if the engine does not fit the spec.
    """
    if spec.image is None:
        if name not in (None, "none"):
            raise UsageError(f"--engine {name}: batch {short(batch)} was executed without an image; remove the option")
        return engines.find("none")
    if name == "none" and not hosted:
        raise UsageError(
            f"batch {short(batch)} was executed in an image, and its missing runs need it too; remove --engine none"
        )
    if name is None:
        used = "SELECT engine FROM sessions WHERE batch = $b AND engine <> 'none' ORDER BY lamport DESC LIMIT 1"
        name = next(iter(store.values(str, used, b=batch)), "podman")
    return engines.find(name, tables)


def image(project: LoadedProject, store: Store, spec: RunSpec) -> AnyImage | None:
    """Return the image of a spec: the pinned one with this id, under any name, or the recorded one. Raises Missing.

    Images for several processors may lack some that are neither pinned nor recorded.
    """
    if spec.image is None:
        return None
    pinned = {variant.id: variant for variant in images.all_pinned(project.root).values()}
    if spec.image in pinned:
        return pinned[spec.image]
    row = _image_row(store, spec.image)
    if ids := record.variants(row):
        known = {processor: _variant(store, variant, pinned) for processor, variant in ids.items()}
        return ImageVariants(row.name or row.image, ids, {name: variant for name, variant in known.items() if variant})
    return _contents(store, row).image


def _variant(store: Store, identity: str, pinned: Mapping[str, Image]) -> Image | None:
    """Return the image with this id; None if it is neither pinned nor recorded."""
    with contextlib.suppress(Missing):
        return pinned.get(identity) or image_contents(store, identity).image
    return None


def image_contents(store: Store, identity: str) -> Contents:
    """Return the record of an image for one processor. Raises Missing."""
    return _contents(store, _image_row(store, identity))


def _contents(store: Store, row: ImageRow) -> Contents:
    if row.files is None:
        raise Missing(f"{row.image} is not one image, but images for several processors")
    return Contents.of_row(row, store.object(row.files))


def _image_row(store: Store, identity: str) -> ImageRow:
    rows = store.select(ImageRow, "SELECT * FROM images WHERE image = $i LIMIT 1", i=identity)
    if not rows:
        raise Missing(f"the image {identity} is neither pinned nor recorded; import it with sierra image import, then pin it")
    return rows[0]


def inputs(store: Store, runs: Iterable[ChosenExecution]) -> Iterator[tuple[ChosenExecution, Files]]:
    """Yield the recorded input files of these runs.

    Raises Damaged if one is not in the store, or if its name leads out of the folder of its run.
    """
    pending = iter(runs)
    with store.snapshot() as snapshot:
        while some := list(itertools.islice(pending, AT_A_TIME)):
            files: dict[str, list[Recorded]] = {row.run: [] for row in some}
            listed = recorded(snapshot, some, inputs=True)
            for name in {file.path.removeprefix(INPUT_FOLDER) for file in listed}:
                inside(store.paths.work, name)
            for file in listed:
                files[file.taken.run].append(file)
            bytes_of = {row.file.sha256: b"".join(row.pieces) for row in contents(snapshot, listed)}
            for row in some:
                if not files[row.run]:
                    raise Damaged(f"the input of run {short(row.run)} is not in the store")
                yield row, tuple((file.path.removeprefix(INPUT_FOLDER), bytes_of[file.sha256]) for file in files[row.run])


@dataclass(frozen=True, slots=True)
class Inputs:
    """Recorded input files of a batch; see `sierra.execution.plan.Inputs`."""

    store: Store

    def files(self, batch: Batch, wanted: Callable[[Run], bool]) -> Iterator[tuple[Run, Files]]:
        runs = {run.id: run for run in batch.runs if wanted(run)}
        taken = (ChosenExecution("", run.experiment, run.number, run.id, None, None, "none") for run in runs.values())
        for one, files in inputs(self.store, taken):
            yield runs[one.run], files


def plan(project: LoadedProject, store: Store, prefix: str, *, contained: str | None = None) -> Plan:
    """Return the plan that executes a recorded batch as it was recorded. Raises NotFound, Missing."""
    named = store.resolve(prefix)
    if named.kind != "batch":
        of = f": sierra run {short(named.batch)}" if named.batch else ""
        raise NotFound(f"{prefix!r} is a {named.kind}; missing runs can only be executed for a whole batch{of}")
    with store.snapshot() as snapshot:
        row = required_row(BatchRow, snapshot, "SELECT * FROM batches WHERE batch = $b", b=named.id)
        [last] = snapshot.select(Last, LAST, b=named.id)
    project = targets.of_batch(project, store, named.id)
    if last.ingest_rules is None or last.programs is None:
        raise Missing(f"batch {short(named.id)}: none of its sessions has finished; submit its query instead: {row.query}")
    recalled = recall(store, named.id, last.programs, last.ingest_rules)
    checkout = recalled.checkout(project, store)
    used, lacking = found_or(NOTHING, checkout.programs)
    batch = _batch(store, row, recalled.spec)
    text = last.query or row.query
    return Plan(
        project=project,
        request=repeated(row._asdict(), len(batch.experiments[0].runs), targets.recorded(store, named.id)),
        query=Query(
            tuple(Criterion(axis.name, Listed(axis.values)) for axis in batch.axes),
            len(batch.experiments[0].runs),
            row.controller,
            row.scenario,
            (),
            row.base_seed,
        ),
        text=text,
        batch=batch,
        inputs=Inputs(store),
        source=None,
        source_id=last.source,
        checkout=checkout,
        programs=used,
        environment=this_environment(project.config),
        engine=engine(store, named.id, recalled.spec, contained, project.config.engines, hosted=False),
        image=image(project, store, recalled.spec),
        limits=run_limits.of_experiments(project.config, batch.experiments),
        template_sha256=row.template_sha256,
        outputs=recalled.outputs,
        success=recalled.success,
        readers=recalled.readers,
        seen=guard(project.root, b"", used),
        build=recalled.build.state(recalled.manifest) if recalled.build else None,
        lacking=lacking,
    )


def _batch(store: Store, row: BatchRow, spec: RunSpec) -> Batch:
    """Return a batch as it is recorded."""
    with store.snapshot(row.batch) as snapshot:
        names = tuple(required_row(SpecRow, snapshot, "SELECT * FROM specs WHERE spec = $r", r=row.spec).files)
        cells = snapshot.cells(row.batch)
        snapshot.views.make(("batch_runs",))
        runs: dict[int, list[Run]] = {}
        for ordinal, number, run, seed, first, others in snapshot.each(MEMBERS, {"b": row.batch}):
            digests = bytes.fromhex("".join((first, *(others or ()))))
            runs.setdefault(ordinal, []).append(Run(run, ordinal, number, seed, names, digests))
    experiments = tuple(
        Experiment(str(cell["experiment"]), ordinal, axis_values(row.axes, cell), tuple(runs[ordinal]))
        for ordinal, cell in cells.items()
    )
    axes = tuple(Axis(name, tuple(dict.fromkeys(experiment.values[name] for experiment in experiments))) for name in row.axes)
    return Batch(row.batch, axes, experiments, spec, row.spec)


MEMBERS = "SELECT ordinal, number, run, seed, input, other_inputs FROM batch_runs WHERE batch = $b ORDER BY ordinal, number"
