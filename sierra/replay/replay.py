"""Replay: execute recorded runs again, from the record alone, and compare the outcome with the record.

The source is restored to the replay's own folder, inputs come from the store, and programs are compared with the record
before anything executes. The executions are recorded as further executions of the same runs, with the purpose `replay`:
they are never effective in statistics, and existing records do not change.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from sierra import runners
from sierra.config.deliverable_tables import DerivedTable
from sierra.config.output_tables import Output
from sierra.config.project_file import LoadedProject
from sierra.containers.engines.base import Engine
from sierra.containers.images.image import AnyImage, here
from sierra.errors import Missing, NotFound, UsageError
from sierra.execution import commands, expected_durations, plan_from_record, recover, row_queries, targets
from sierra.execution.build.recorded import rebuild
from sierra.execution.observation import plan_files
from sierra.execution.observation.current_files import Current
from sierra.execution.observer import Observer, Relay, Tally
from sierra.execution.on_robots import configured
from sierra.execution.plan_from_record import Recalled
from sierra.execution.run_jobs import Service, Setup
from sierra.execution.sessions import Session
from sierra.ingest.recording_context import Context
from sierra.model import Run, Status, Value
from sierra.provenance import environment, fingerprint_programs, reported_versions
from sierra.provenance.change_guard import guard
from sierra.provenance.dependency_model import Kind, Programs, mentioned
from sierra.replay import compare_host_with_image, equivalence, on_robots, same_files
from sierra.replay.compare_outputs import compare_all
from sierra.replay.compare_values import Agreement, Verdict
from sierra.replay.equivalence import Metric
from sierra.replay.same_files import UsedFiles
from sierra.replay.variation import Variation
from sierra.replay.verdicts import Compared, OfExperiment, Replay, Tolerances, metric_rows, plain, verdict_rows
from sierra.store.lamport_clock import stamp
from sierra.store.layout import SessionPaths
from sierra.store.recorded_files import ChosenExecution, take, where
from sierra.store.row_mapper import of_fields
from sierra.store.row_types import EnvironmentRow, ReplayRow
from sierra.store.sql_names import column_names
from sierra.store.store import Found, Store
from sierra.store.table_layout import TableLayout
from sierra.templates.base import Files
from sierra.util.hashing import short
from sierra.util.lazy_logger import Log
from sierra.util.text import counted, like
from sierra.version import __version__

log = Log(__name__)

ARITHMETIC = ("machine", "cpu_flags", "gpus", "libc", "container")
"""Facts about a machine that may change the results of the same programs."""


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """Options of a replay."""

    slots: int
    runs: int | None = None
    """Number of runs to replay per experiment, from the first; None for all."""
    runner: str = "local"
    engine: str | None = None
    """Name of the engine; None for the one that was used before."""
    tolerances: Tolerances = field(default_factory=dict)
    """Tolerances that override those of the project."""
    keep: bool = False
    """True to keep the restored source and the folders of the runs."""
    only: frozenset[str] | None = None
    """Ids of the runs to replay; None for all."""
    image: AnyImage | None = None
    """The recorded image, if it is in another place than the pinned or recorded one."""
    earlier: frozenset[str] = frozenset()
    """Sessions of earlier replays. Their successful executions count, if programs, machine and isolation are the same."""
    variation: Variation = field(default_factory=Variation)
    """The ways in which runs are executed otherwise than they were recorded."""
    unattended: bool = False
    """True if robots may move without a person, although their trials are supervised."""

    def includes(self, one: ChosenExecution) -> bool:
        """Return whether a run is replayed."""
        return (self.runs is None or one.number < self.runs) and (self.only is None or one.run in self.only)


@dataclass(slots=True)
class _Record:
    """Recorded data of the runs to replay."""

    found: Found
    of: Recalled
    runs: list[ChosenExecution]
    named: int
    """Number of runs that the id names, including runs without a successful execution."""
    whole: bool
    """True if all successful runs of each experiment are replayed."""
    cells: dict[int, dict[str, Value | None]]
    """Values of each experiment, by its place in the batch."""
    seeds: dict[str, int]
    tables: dict[str, list[str]]
    """Columns of each output that is a table."""
    environment: str
    used: list[str]
    """Names of the Python distributions that executions were observed to use."""
    notes: list[str]


def replay(
    project: LoadedProject, store: Store, prefix: str, options: ReplayOptions, observer: Observer | None = None
) -> Replay:
    """Execute the runs of an id again and compare. `observer` receives deviations from the record, before anything executes.

    Raises NotFound for an unknown id, Missing if the source, a program or an input no longer exists.
    """
    if not os.access(store.paths.root, os.W_OK):
        raise Missing(f"cannot write to {store.paths.root}; use --no-record to replay without writing there")
    observer = observer or Observer()
    variation = options.variation
    recover.finish_dead(store)
    record = _look_up(store, store.resolve(prefix), options)
    project = targets.of_batch(project, store, record.of.batch)
    if record.of.spec.robots is not None:
        project = replace(project, config=configured(project.config))
    declared = _declared(record, project, options.tolerances)
    was = _metrics(project, store, record, declared) if variation.is_replay else None
    engine = plan_from_record.engine(
        store, record.of.batch, record.of.spec, options.engine, project.config.engines, hosted=True
    )
    image = options.image or plan_from_record.image(project, store, record.of.spec)
    runner = runners.find(options.runner, project.config.runner_tables)(options.slots)
    takes_robots = record.of.spec.robots is not None
    if takes_robots:
        on_robots.check(runner, options.runner, record.found.id)
        on_robots.check_attended(record.found.id, supervised=project.config.trials.supervised, unattended=options.unattended)
        record.notes.append(on_robots.note(store, [one.run for one in record.runs], judged=bool(project.config.equivalence)))
    began = datetime.now(UTC)
    session = Session(store.paths, project.config.store.place())
    kept = store.paths.kept(session.id) if options.keep else None
    try:
        session.take_number()
        log.info("replay of %s %s on %s with %s", record.found.kind, record.found.id, options.runner, engine.name)
        root = session.paths.source
        checkout = record.of.checkout(project, store)
        checkout.restore(root)
        built = None
        if record.of.build is not None:
            checkout.bring(root, record.of.build.inputs)
            observer.notice(f"building from the recorded source: {' '.join(record.of.build.row.command)}")
            built = rebuild(record.of.build, record.of.manifest, project, store, session, engine, image, on_robots=takes_robots)
            record.notes += [built.text] if built.different else []
        checkout.bring(root, (name for name, _ in checkout.used))
        checkout.supply(root)
        if image is not None and engine.name == "none" and takes_robots:
            record.notes.append(f"not executed in a container, but by the robots' own programs: {image.name} is not used")
        elif engine.name == "none" and (inside := here(image)) is not None:
            contents = plan_from_record.image_contents(store, inside.id)
            record.notes += compare_host_with_image.unlike(record.of.spec, contents, root)
        variables = commands.declared(record.of.spec.environment, root, project.root)
        now = reported_versions.with_versions(checkout.programs_in(root), project.config.programs, variables, root)
        around = of_fields(EnvironmentRow, environment.capture(__version__, project.config.environment.record))
        limits = variation.limits(project.config)
        setup = Setup(project, variation.spec(record.of.spec), engine, image, limits, root, around)
        service = Service(setup, store, session, stays=runner.stays)
        files = _used_files(store, record, now, root, variables["PATH"]) if image is None else None
        notes = (
            *record.notes,
            *service.isolation.notes,
            *now.notes,
            *_other_programs(record, now, root),
            *(files.notes if files else ()),
            *(() if takes_robots else _other_machine(store, record, around)),
        )
        for text in notes:
            observer.notice(text)
        context = Context(
            session.id,
            record.of.batch,
            variation.purpose,
            around.environment,
            now.id,
            record.of.outputs,
            record.of.success,
            number=session.number,
            raw=project.config.store.raw,
            readers=record.of.readers,
            engines=project.config.engines,
        )
        done = _done(store, record, options, replace(context, **service.isolation.context))
        rest = [one for one in record.runs if one.run not in done]
        made = {one.run: commands.execution_id(session.id, one.run) for one in rest}
        if begun := list(variation.records_before(made, record.of.batch)):
            _publish(store, session, record.of.batch, [begun])
        made |= {run: one.execution for run, one in done.items()}
        if done:
            runs = f"{len(done)} of {counted(len(record.runs), 'run')}"
            notes = (*notes, f"{runs} executed by an earlier call here, by the same programs")
            observer.notice(notes[-1])
        tally = Tally(Relay(observer, leave=False), len(rest))
        timed = runner.stays and variation.is_replay  # rendering takes longer than what was recorded
        times = expected_durations.recorded(store, [one.run for one in rest]) if timed else None
        source_guard = guard(root, b"", now)
        interrupted = (
            bool(rest)
            and service.execute(
                runner,
                context,
                ((run, variation.files(files)) for run, files in _inputs(record, rest, store)),
                len(rest),
                now,
                tally,
                times=times,
                doubt=lambda: service.doubt(source_guard),
                kept=kept,
            ).interrupted
        )
        failed = {run: tally.statuses[run] for run in tally.failed}
        interrupted = interrupted or session.paths.cancelled.exists()
        _leave(session.paths, kept)
        if interrupted:
            return Replay(session.id, record.found, (), notes, interrupted=True, of=record.named, kept=kept, built=built)
        compared = [
            replace(one, outputs=variation.compared(one.outputs)) for one in _compare(record, store, made, failed, declared)
        ]
        before = len(record.notes)
        if takes_robots:
            record.notes += on_robots.other_processors(store, [str(one.execution) for one in record.runs], list(made.values()))
        experiments = tuple(_experiments(project, store, record, compared, was, declared))
        late = record.notes[before:]
        for text in late:
            observer.notice(text)
        answer = Replay(
            session.id,
            record.found,
            experiments,
            (*notes, *late),
            interrupted=False,
            of=record.named,
            kept=kept,
            built=built,
            files=files,
            sessions=(session.id, *sorted({one.session for one in done.values()})),
        )
        _keep(answer, store, session, record, now, around, began, options, engine)
        return answer
    finally:
        session.close()


def unrecorded(
    project: LoadedProject, store: Store, prefix: str, options: ReplayOptions, observer: Observer | None = None
) -> Replay:
    """Replay without a record: a temporary store records everything, and is removed at the end.

    Raises the same errors as `replay`, and UsageError for options that need the record: to keep folders, or to use a cluster.
    """
    if options.keep:
        raise UsageError("--keep keeps folders in the store; remove --no-record")
    if runners.find(options.runner, project.config.runner_tables)(options.slots).stays:
        raise UsageError(f"runner {options.runner!r} needs the record to find its runs again; remove --no-record")
    found = store.resolve(prefix)
    project = targets.of_batch(project, store, found.batch or found.id)
    own = project.config.store.model_copy(update={"work_folder": None})  # the temporary store is in that folder already
    inner = replace(project, config=project.config.model_copy(update={"store": own}))
    with store.overlay(project.config.store.place()) as other:
        return replay(inner, other, prefix, options, observer)


def _look_up(store: Store, found: Found, options: ReplayOptions) -> _Record:
    with store.snapshot() as snapshot:
        named = take(snapshot, found)
        good = [one for one in named if one.status == "ok"]
        taken = [one for one in good if options.includes(one)]
        if not taken:
            raise NotFound(
                f"{found.kind} {short(found.id)} has no successful execution to compare with; execute it with sierra run"
            )
        snapshot.views.make(("batch_runs", "experiments", "batches"))
        batch = where(snapshot, found).batch
        snapshot.add_table("taken", execution=[str(one.judgement) for one in taken])
        by = snapshot.select(
            _RecordedBy,
            "SELECT DISTINCT programs, ingest_rules, environment "
            "FROM all_judgements e SEMI JOIN taken t ON t.execution = e.judgement ORDER BY ALL",
        )
        used = row_queries.used_distributions(snapshot, [row.programs for row in by])
        cells = snapshot.cells(batch)
        [(axes,)] = snapshot.run("SELECT axes FROM batches WHERE batch = $b", {"b": batch})
        tables = dict(snapshot.select(_Forms, TABLES))
        wrote = set(snapshot.values(str, WROTE))
        seeds: dict[str, int] = dict(snapshot.run("SELECT run, seed FROM batch_runs WHERE batch = $b", {"b": batch}))
    record = _Record(
        found=found,
        of=plan_from_record.recall(store, batch, by[0].programs, by[0].ingest_rules),
        runs=taken,
        named=len(named),
        whole=len(taken) == len(good) and found.kind in ("batch", "experiment"),
        cells={place: {axis: row[axis] for axis in axes} for place, row in cells.items()},
        seeds=seeds,
        tables={name: _columns(forms) for name, forms in sorted(tables.items())},
        environment=by[0].environment,
        used=used,
        notes=[],
    )
    left = sum(one.judgement in wrote for one in taken)
    if not left:
        raise Missing(f"{found.kind} {short(found.id)} wrote only logs, and logs are not compared")
    if left < len(taken):
        record.notes.append(f"{len(taken) - left} of {counted(len(taken), 'run')} wrote only logs, and logs are not compared")
    if without := len(named) - len(good):
        record.notes.append(f"not replayed: {without} of {counted(len(named), 'run')} without a successful execution")
    if len({(row.programs, row.ingest_rules) for row in by}) > 1:
        record.notes.append("not all runs were recorded with the same programs and rules; the first ones are used")
    return record


class _RecordedBy(NamedTuple):
    programs: str
    ingest_rules: str
    environment: str


class _Forms(NamedTuple):
    output: str
    forms: list[str]


def _columns(forms: list[str]) -> list[str]:
    """Return the columns of tables by their names in SQL, from the recorded forms of these tables."""
    named = (column_names(list(TableLayout.load(form).columns)) for form in forms)
    return list(dict.fromkeys(name for names in named for name in names))


TABLES = """
SELECT output, list(DISTINCT table_layout ORDER BY table_layout) AS forms FROM all_artifacts SEMI JOIN taken USING (execution)
WHERE kind = 'table' GROUP BY output
"""
"""SQL: the recorded forms of tables, by output."""
WROTE = "SELECT DISTINCT execution FROM all_artifacts SEMI JOIN taken USING (execution) WHERE kind <> 'log'"
"""SQL: the executions that left files or tables."""


def _declared(record: _Record, project: LoadedProject, tolerances: Tolerances) -> dict[str, Output]:
    """Return the rules for the comparison, by output.

    These are the recorded declarations, overridden by the project's current ones and by the requested tolerances.
    Raises UsageError for an unknown output or column.
    """
    declared = {**record.of.outputs, **project.config.outputs}
    known = sorted({*declared, *record.tables})
    if unknown := tolerances.keys() - {"*", *known}:
        raise UsageError(f"--set-tolerance: unknown output {min(unknown)!r}; known outputs: {', '.join(known) or 'none'}")
    for name, columns in tolerances.items():
        _check_columns(name, columns, record.tables)
    for name, output in declared.items():
        record.notes += _unused(name, output, record.tables.get(name))
    for name in known if tolerances else ():
        output = declared.get(name) or Output(file=name)
        asked = {**output.tolerance, **tolerances.get("*", {}), **tolerances.get(name, {})}
        declared[name] = output.model_copy(update={"tolerance": asked})
    return declared


def _check_columns(output: str, columns: Iterable[str], tables: Mapping[str, list[str]]) -> None:
    """Raise UsageError for a column that no table of that output has; `*` stands for all outputs, or for all columns."""
    known = sorted({name for table, names in tables.items() if output in ("*", table) for name in names})
    for column in columns:
        if known and column not in ("*", *known):
            where = "no output" if output == "*" else f"output {output!r}"
            has = "has the" if output == "*" else "has no"
            raise UsageError(f"--set-tolerance: {where} {has} column {column!r}; {like(column, known)}")


def _unused(name: str, output: Output, columns: list[str] | None) -> Iterator[str]:
    """Yield a line for each column that an output's declaration names and its table does not have."""
    for key, names in (("tolerance", output.tolerance), ("volatile", output.volatile)) if columns else ():
        for column in names:
            if column not in ("*", *(columns or ())):
                yield f"[outputs.{name}] {key}: the table has no column {column!r}; {like(column, columns or ())}"


def _metrics(
    project: LoadedProject, store: Store, record: _Record, declared: Mapping[str, Output]
) -> equivalence.Values | None:
    """Return the values of the recorded runs, by metric; None if experiments cannot be compared by metrics."""
    if not project.config.equivalence or record.found.kind not in ("batch", "experiment"):
        return None
    if not record.whole:
        record.notes.append("equivalence is tested only for whole experiments: replay without --runs")
        return None
    executions = {one.run: str(one.judgement) for one in record.runs}
    tables: dict[str, Output | DerivedTable] = {**project.config.tables, **declared}
    try:
        return equivalence.values(store, record.of.batch, executions, project.config.equivalence, tables)
    except NotFound as error:
        record.notes.append(f"[equivalence]: {error}; no experiment is tested for equivalence")
        return None


def _other_programs(record: _Record, now: Programs, root: Path) -> Iterator[str]:
    """Yield a line for each program that differs from the record; the code is in `root`."""
    of = record.of
    if now.id != of.fingerprint:
        words = mentioned(of.spec.words, root)
        built = {f"{{project}}/{one.name}" for one in of.build.products} if of.build else set()
        recorded = Programs(tuple(one.program() for one in of.programs if one.name not in built))
        now = Programs(tuple(one for one in now.all if one.name not in built))
        yield from (
            f"different programs: {line}" for line in fingerprint_programs.differences(recorded, now, words, record.used)
        )


def _used_files(store: Store, record: _Record, now: Programs, root: Path, search: str) -> UsedFiles:
    """Compare the files that the recorded executions used with those now; programs and products are compared elsewhere."""
    built = [str(root / one.name) for one in record.of.build.products] if record.of.build else []
    known = [one.path for one in now.all if one.kind != Kind.DISTRIBUTIONS] + built
    named = plan_files.folders(root, now, search)
    declared = "PATH" in record.of.spec.environment
    current = Current(named, search, declared, now.all[0].path if now.all else "", is_source_only=True)
    return same_files.compare(store, [str(one.execution) for one in record.runs], current, known)


def _other_machine(store: Store, record: _Record, around: EnvironmentRow) -> Iterator[str]:
    """Yield a line for each difference of the machine that may change arithmetic."""
    for row in store.select(EnvironmentRow, "SELECT * FROM environments WHERE environment = $e", e=record.environment):
        for name, was, found in environment.differing(row._asdict(), around._asdict()):
            if name in ARITHMETIC:
                old, new = (", ".join(one) or "none" if isinstance(one, list) else one or "none" for one in (was, found))
                yield f"different machine: {name} {'that differ: ' if isinstance(was, list) else ''}was {old}, is now {new}"


class _Done(NamedTuple):
    """A successful execution of an earlier replay."""

    run: str
    execution: str
    session: str


DONE = """
SELECT run, max(execution) AS execution, arg_max(session, execution) AS session FROM executions
WHERE (purpose = 'replay' AND list_contains($sessions, session) OR list_contains($executions, execution))
  AND list_contains($runs, run) AND status = 'ok'
  AND programs = $programs AND environment = $environment AND ingest_rules = $rules
  AND isolation IS NOT DISTINCT FROM $isolation
GROUP BY run
"""
"""SQL: one of these executions for each run."""


def _done(store: Store, record: _Record, options: ReplayOptions, context: Context) -> dict[str, _Done]:
    """Return the executions of earlier calls that count, by run: those that this replay would repeat."""
    if not (options.earlier or options.variation.finished):
        return {}
    rows = store.select(
        _Done,
        DONE,
        sessions=sorted(options.earlier),
        executions=sorted(options.variation.finished),
        runs=[one.run for one in record.runs],
        programs=context.programs,
        environment=context.environment,
        rules=context.ingest_rules,
        isolation=context.isolation and context.isolation.isolation,
    )
    return {row.run: row for row in rows}


def _inputs(record: _Record, runs: Sequence[ChosenExecution], store: Store) -> Iterator[tuple[Run, Files]]:
    """Yield each of these runs with its recorded inputs."""
    for taken, files in plan_from_record.inputs(store, {one.run: one for one in runs}.values()):
        yield Run(taken.run, taken.ordinal, taken.number, record.seeds[taken.run], (), b""), files


def _leave(session: SessionPaths, kept: Path | None) -> None:
    """Move the restored source to the folder where it is kept."""
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        session.source.rename(kept / session.source.name)


def _compare(
    record: _Record, store: Store, made: Mapping[str, str], failed: Mapping[str, Status], declared: Mapping[str, Output]
) -> Iterator[Compared]:
    done = [one for one in record.runs if one.run not in failed]
    with store.snapshot() as snapshot:
        pairs = [(str(one.judgement), made[one.run]) for one in done]
        for taken, outputs in zip(done, compare_all(snapshot, pairs, declared), strict=True):
            yield Compared(taken, made[taken.run], outputs)
        snapshot.views.make(("executions",))
        for taken in (one for one in record.runs if one.run in failed):
            execution = made[taken.run]
            [(reason,)] = snapshot.run("SELECT reason FROM executions WHERE execution = $e", {"e": execution}) or [("",)]
            yield Compared(taken, execution, {None: Agreement(Verdict.FAILED, reason or failed[taken.run])})


def _experiments(
    project: LoadedProject,
    store: Store,
    record: _Record,
    compared: Sequence[Compared],
    was: equivalence.Values | None,
    declared: Mapping[str, Output],
) -> Iterator[OfExperiment]:
    by_place: dict[int, list[Compared]] = {}
    for run in sorted(compared, key=lambda run: (run.taken.ordinal, run.taken.number)):
        by_place.setdefault(run.taken.ordinal, []).append(run)
    stochastic = {place: runs for place, runs in by_place.items() if was is not None and _wavers(runs)}
    now: equivalence.Values = {}
    if stochastic:
        executions = {run.taken.run: str(run.execution) for runs in stochastic.values() for run in runs}
        tables: dict[str, Output | DerivedTable] = {**project.config.tables, **declared}
        try:
            now = equivalence.values(store, record.of.batch, executions, project.config.equivalence, tables)
        except NotFound as error:
            record.notes.append(f"[equivalence]: {error}; the replay has no values to compare")
            now = {name: {} for name in project.config.equivalence}
    for place, runs in by_place.items():
        found: tuple[Metric, ...] = ()
        if place in stochastic and was is not None:
            names = [run.taken.run for run in runs]
            found = tuple(equivalence.compare(project.config.equivalence, was, now, place, names))
        yield OfExperiment(runs[0].taken.experiment, place, record.cells[place], tuple(runs), found)


def _wavers(runs: Sequence[Compared]) -> bool:
    """Check whether runs differ in values only: none failed, and their outputs have the same form."""
    different = [one for run in runs for one in run.outputs.values() if not one.verdict.fine]
    return bool(different) and all(one.verdict is Verdict.DIFFERENT and not one.form for one in different)


def _keep(
    answer: Replay,
    store: Store,
    session: Session,
    record: _Record,
    now: Programs,
    around: EnvironmentRow,
    began: datetime,
    options: ReplayOptions,
    engine: Engine,
) -> None:
    """Record the replay and its verdicts."""
    lamport = stamp(session.number, session.id)
    row = ReplayRow(
        replay=answer.id,
        kind=record.found.kind,
        target=record.found.id,
        batch=record.of.batch,
        started=began,
        ended=datetime.now(UTC),
        runner=options.runner,
        engine=engine.name,
        runs=len(answer.runs),
        verdict=answer.verdict,
        tolerances=json.dumps(plain(options.tolerances)) if options.tolerances else None,
        environment=around.environment,
        programs=now.id,
        lamport=lamport,
    )
    verdicts = (row for run in answer.runs for row in verdict_rows(answer.id, run))
    metrics = (row for one in answer.experiments for row in metric_rows(answer.id, one))
    own = options.variation.records(answer, ([row], verdicts, metrics), store, lamport)
    _publish(store, session, record.of.batch, [*own, [around], now.rows()])


def _publish(store: Store, session: Session, batch: str, records: Iterable[Iterable[NamedTuple]]) -> None:
    """Write records of a session, by table."""
    writer = store.writer(session.paths.segment, batch)
    for rows in records:
        writer.records(rows)
    store.publish(writer)
