"""Replay: execute recorded runs again, from the record alone, and compare the outcome with the record.

The source is restored to the replay's own folder, inputs come from the store, and programs are compared with the record
before anything executes. The executions are recorded as further executions of the same runs, with the purpose `replay`:
they are never effective in statistics, and existing records do not change.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from sierra import runners
from sierra.config import extensions
from sierra.config.output_tables import Output
from sierra.config.project_file import LoadedProject
from sierra.containers.images.image import here
from sierra.errors import Missing, UsageError
from sierra.execution import commands, expected_durations, plan_from_record, recover, session_records, targets
from sierra.execution.build.recorded import Rebuilt, rebuild
from sierra.execution.checkout import Checkout
from sierra.execution.members import configured
from sierra.execution.observer import Observer, ProgressCounter
from sierra.execution.run_jobs import JobService, Setup
from sierra.execution.run_limits import RunLimits
from sierra.execution.sessions import Session
from sierra.ingest.recording_context import Context
from sierra.model import Status
from sierra.provenance import environment, reported_versions
from sierra.provenance.change_guard import guard
from sierra.provenance.dependency_model import Programs
from sierra.replay import compare_host, find_record
from sierra.replay.compare_host import other_machine, other_programs, unlike_image, used_files
from sierra.replay.find_record import Record
from sierra.replay.judge_experiments import compare_runs, judge, recorded_metrics
from sierra.replay.options import ReplayOptions
from sierra.replay.same_files import UsedFiles, used_gpu
from sierra.replay.verdicts import OfExperiment, Replay, Tolerances, metric_rows, plain, verdict_rows
from sierra.store.lamport_clock import stamp
from sierra.store.row_mapper import of_fields
from sierra.store.row_types import EnvironmentRow, ReplayRow
from sierra.store.sql_names import stored_name
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.lazy_logger import Log
from sierra.util.text import counted, like
from sierra.util.version import __version__
from sierra.worker.gpus import without_limit

log = Log(__name__)


def replay(
    project: LoadedProject, store: Store, prefix: str, options: ReplayOptions, observer: Observer | None = None
) -> Replay:
    """Execute the runs of an id again and compare. `observer` receives deviations from the record, before anything executes.

    Raises NotFound for an unknown id, Missing if the source, a program or an input no longer exists.
    """
    if not os.access(store.paths.root, os.W_OK):
        raise Missing(f"cannot write to {store.paths.root}; use --no-record to replay without writing there")
    recover.finish_dead(store, observer or Observer())
    prepared = _Prepared(project, store, prefix, options)
    session = Session(store.paths, prepared.project.config.store.place())
    try:
        session.take_number()
        return _Replaying(prepared, session, observer or Observer()).answer()
    except Exception:
        session_records.withdraw(store, session)
        raise
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
    if runners.find(options.runner, project.config.runners)(options.slots).stays:
        raise UsageError(f"runner {options.runner!r} needs the record to find its runs again; remove --no-record")
    resolved = store.resolve(prefix)
    project = targets.of_batch(project, store, resolved.batch or resolved.id)
    own = project.config.store.model_copy(update={"work_folder": None})  # the temporary store is in that folder already
    inner = replace(project, config=project.config.model_copy(update={"store": own}))
    with store.overlay(project.config.store.place()) as other:
        return replay(inner, other, prefix, options, observer)


class _Prepared:
    """The record of the runs to replay, with its rules, engine, image and runner: all that needs no session."""

    def __init__(self, project: LoadedProject, store: Store, prefix: str, options: ReplayOptions) -> None:
        self.store = store
        self.options = options
        self.began = datetime.now(UTC)
        self.record = record = find_record.find(store, store.resolve(prefix), options)
        self.spec = record.of.spec
        self.takes_robots = self.spec.robots is not None
        project = targets.of_batch(project, store, record.of.batch)
        self.project = replace(project, config=configured(project.config)) if self.takes_robots else project
        self.rules = declared_rules(record, self.project, options.tolerances)
        is_replay = options.variation.is_replay
        self.metrics = recorded_metrics(self.project, store, record, self.rules) if is_replay else None
        engines = self.project.config.engines
        self.engine = plan_from_record.engine(store, record.of.batch, self.spec, options.engine, engines, hosted=True)
        self.image = options.image or plan_from_record.image(self.project, store, self.spec)
        self.runner = runners.find(options.runner, self.project.config.runners)(options.slots)
        if self.takes_robots:
            self._check_robots()

    def _check_robots(self) -> None:
        config, id = self.project.config, self.record.found.id
        inputs = (files for _, files in find_record.inputs(self.record, self.record.runs, self.store))
        compare_host.check_fleet(self.runner, self.options.runner, id, inputs, self.project.robot_groups)
        if not self.options.unattended:
            compare_host.check_attended(id, self.project)
        runs = [one.run for one in self.record.runs]
        self.record.notes += extensions.called("replay_notes", self.store, runs, bool(config.equivalence))


@dataclass(frozen=True, slots=True)
class _Code:
    """The recorded source, restored to a folder, with what is beside it here."""

    root: Path
    built: Rebuilt | None
    search: str
    """The PATH of its programs."""
    programs: Programs
    environment: EnvironmentRow


@dataclass(frozen=True, slots=True)
class _Executed:
    """The executions that are compared with the record."""

    counter: ProgressCounter
    executions: Mapping[str, str]
    """The execution of each run."""
    earlier: Mapping[str, Finished]
    """The executions of earlier calls, by run."""
    interrupted: bool


class _Replaying:
    """One replay in its session: restore the source, execute the runs, compare them, and record the verdicts."""

    def __init__(self, prepared: _Prepared, session: Session, observer: Observer) -> None:
        self._of = prepared
        self._store = prepared.store
        self._record = prepared.record
        self._options = prepared.options
        self._session = session
        self._observer = observer
        self._kept = self._store.paths.kept(session.id) if self._options.keep else None
        self._notes: list[str] = []
        """All deviations from the record that the observer has received."""

    def answer(self) -> Replay:
        """Replay, and return the verdicts."""
        of, resolved = self._of, self._record.found
        log.info("replay of %s %s on %s with %s", resolved.kind, resolved.id, self._options.runner, of.engine.name)
        code = self._restored()
        limits = self._limits()
        spec = self._options.variation.spec(of.spec)
        setup = Setup(of.project, spec, of.engine, of.image, limits, code.root, code.environment)
        service = JobService(setup, self._store, self._session, stays=of.runner.stays)
        files = used_files(self._store, self._record, code.programs, code.root, code.search) if of.image is None else None
        self._say(self._deviations(code, service, files))
        executed = self._execute(code, service)
        self._leave_source()
        experiments = () if executed.interrupted else self._judged(executed)
        sessions = (self._session.id, *sorted({execution.session for execution in executed.earlier.values()}))
        answer = Replay(
            self._session.id,
            resolved,
            experiments,
            tuple(self._notes),
            interrupted=executed.interrupted,
            of=self._record.named,
            kept=self._kept,
            built=code.built,
            files=None if executed.interrupted else files,
            used_gpu=self._differs_with_gpu(experiments),
            sessions=() if executed.interrupted else sessions,
        )
        if not executed.interrupted:
            self._keep(answer, code)
        return answer

    def _say(self, notes: Iterable[str]) -> None:
        for text in notes:
            self._notes.append(text)
            self._observer.notice(text)

    def _limits(self) -> RunLimits:
        """Return the limits of each execution: where this machine has no GPU, runs execute without."""
        project, batch, runner = self._of.project.config, self._record.of.batch, self._of.runner
        limits = self._options.variation.limits(project, self._store, batch)
        if runner.stays or runner.remote or not (note := without_limit(limits.most.gpus)):
            return limits
        self._say([note])
        return limits.changed(lambda each: replace(each, gpus=None))

    def _restored(self) -> _Code:
        """Restore the recorded source, with its products and the files that runs used, and look at programs and machine."""
        of, root = self._of, self._session.paths.source
        checkout = self._record.of.checkout(of.project, self._store)
        checkout.restore(root)
        built = self._built(checkout, root)
        checkout.bring(root, (name for name, _ in checkout.used))
        checkout.supply(root)
        variables = commands.declared(of.spec.environment, root, of.project.root)
        programs = checkout.programs_in(root)
        programs = reported_versions.with_versions(programs, of.project.config.programs, variables, root)
        captured = environment.capture(__version__, of.project.config.environment.record)
        return _Code(root, built, variables["PATH"], programs, of_fields(EnvironmentRow, captured))

    def _built(self, checkout: Checkout, root: Path) -> Rebuilt | None:
        """Build the products of the recorded source again; return None if it has none."""
        of, recorded = self._of, self._record.of
        if recorded.build is None:
            return None
        checkout.bring(root, recorded.build.inputs)
        self._observer.notice(f"building from the recorded source: {' '.join(recorded.build.row.command)}")
        return rebuild(
            recorded.build,
            recorded.manifest,
            of.project,
            self._store,
            self._session,
            of.engine,
            of.image,
            on_robots=of.takes_robots,
        )

    def _deviations(self, code: _Code, service: JobService, files: UsedFiles | None) -> Iterator[str]:
        """Yield a line for each deviation from the record."""
        yield from self._record.notes
        if code.built and code.built.different:
            yield code.built.text
        yield from self._other_isolation(code.root)
        yield from service.isolation.notes
        yield from code.programs.notes
        yield from other_programs(self._record, code.programs, code.root)
        yield from files.notes if files else ()
        if not self._of.takes_robots:
            yield from other_machine(self._store, self._record, code.environment)

    def _other_isolation(self, root: Path) -> Iterator[str]:
        """Yield a line for each difference to the recorded image, if there is one, and runs execute outside of it."""
        of = self._of
        if of.image is None or of.engine.name != "none":
            return
        if of.takes_robots:
            yield f"not executed in a container, but by the robots' own programs: {of.image.name} is not used"
        elif (inside := here(of.image)) is not None:
            contents = plan_from_record.image_contents(self._store, inside.id)
            yield from unlike_image(of.spec, contents, root)

    def _execute(self, code: _Code, service: JobService) -> _Executed:
        """Execute the runs that no earlier call has executed in the same way."""
        variation, session = self._options.variation, self._session
        context = self._context(code)
        earlier = finished(self._store, self._record, self._options, replace(context, **service.isolation.context))
        rest = [taken for taken in self._record.runs if taken.run not in earlier]
        executions = {taken.run: commands.execution_id(session.id, taken.run) for taken in rest}
        if begun := list(variation.records_before(executions, self._record.of.batch)):
            self._publish([begun])
        if earlier:
            runs = f"{len(earlier)} of {counted(len(self._record.runs), 'run')}"
            self._say([f"{runs} executed by an earlier call here, by the same programs"])
        counter = ProgressCounter(self._observer, len(rest), leave=False)
        timed = self._of.runner.stays and variation.is_replay  # rendering takes longer than what was recorded
        unchanged = guard(code.root, b"", code.programs)
        followed = rest and service.execute_jobs(
            self._of.runner,
            context,
            ((run, variation.files(files)) for run, files in find_record.inputs(self._record, rest, self._store)),
            len(rest),
            code.programs,
            counter,
            times=expected_durations.recorded(self._store, [taken.run for taken in rest]) if timed else None,
            doubt=lambda: service.doubt(unchanged),
            kept=self._kept,
            experiments={taken.ordinal for taken in rest},
        )
        interrupted = bool(followed and followed.interrupted) or session.paths.cancelled.exists()
        return _Executed(counter, executions | {run: finish.execution for run, finish in earlier.items()}, earlier, interrupted)

    def _context(self, code: _Code) -> Context:
        recorded, config = self._record.of, self._of.project.config
        return Context(
            self._session.id,
            recorded.batch,
            self._options.variation.purpose,
            code.environment.environment,
            code.programs.id,
            recorded.outputs,
            recorded.success,
            number=self._session.number,
            raw=config.store.raw,
            readers=recorded.readers,
            engines=config.engines,
        )

    def _leave_source(self) -> None:
        """Move the restored source to the folder where it is kept."""
        if self._kept is not None:
            self._kept.mkdir(parents=True, exist_ok=True)
            source = self._session.paths.source
            source.rename(self._kept / source.name)

    def _judged(self, executed: _Executed) -> tuple[OfExperiment, ...]:
        """Compare the executions with the record."""
        of, record = self._of, self._record
        failed = {run: executed.counter.statuses[run] for run in executed.counter.failed}
        counts = self._options.variation.compared
        runs = compare_runs(record, self._store, executed.executions, failed, of.rules)
        compared = [replace(run, outputs=counts(run.outputs)) for run in runs]
        before = len(record.notes)
        if of.takes_robots:
            recorded = [str(taken.execution) for taken in record.runs]
            record.notes += compare_host.other_processors(self._store, recorded, list(executed.executions.values()))
        experiments = tuple(judge(of.project, self._store, record, compared, of.metrics, of.rules))
        self._say(record.notes[before:])
        return experiments

    def _differs_with_gpu(self, experiments: Iterable[OfExperiment]) -> bool:
        """Return True if values differ, and the recorded executions used a GPU, which may be the cause."""
        differ = any(run.verdict == "different" for one in experiments for run in one.runs)
        return differ and used_gpu(self._store, [str(one.execution) for one in self._record.runs])

    def _keep(self, answer: Replay, code: _Code) -> None:
        """Record the replay and its verdicts."""
        lamport = stamp(self._session.number, self._session.id)
        tolerances = self._options.tolerances
        row = ReplayRow(
            replay=answer.id,
            kind=self._record.found.kind,
            target=self._record.found.id,
            batch=self._record.of.batch,
            started=self._of.began,
            ended=datetime.now(UTC),
            runner=self._options.runner,
            engine=self._of.engine.name,
            runs=len(answer.runs),
            verdict=answer.verdict,
            tolerances=json.dumps(plain(tolerances)) if tolerances else None,
            environment=code.environment.environment,
            programs=code.programs.id,
            lamport=lamport,
        )
        verdicts = (row for run in answer.runs for row in verdict_rows(answer.id, run))
        metrics = (row for experiment in answer.experiments for row in metric_rows(answer.id, experiment))
        own = self._options.variation.records(answer, ([row], verdicts, metrics), self._store, lamport)
        self._publish([*own, [code.environment], code.programs.rows()])

    def _publish(self, records: Iterable[Iterable[NamedTuple]]) -> None:
        """Write records of the session, by table."""
        writer = self._store.writer(self._session.paths.segment, self._record.of.batch)
        for rows in records:
            writer.records(rows)
        self._store.publish(writer)


def declared_rules(record: Record, project: LoadedProject, tolerances: Tolerances) -> dict[str, Output]:
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
            if column not in ("*", *(columns or ())) and stored_name(column, columns or ()) not in (columns or ()):
                yield f"[outputs.{name}] {key}: the table has no column {column!r}; {like(column, columns or ())}"


class Finished(NamedTuple):
    """An execution of an earlier call that need not be repeated."""

    run: str
    execution: str
    session: str


FINISHED = """
SELECT run, max(execution) AS execution, arg_max(session, execution) AS session FROM executions
WHERE (purpose = 'replay' AND list_contains($sessions, session) OR list_contains($executions, execution))
  AND list_contains($runs, run) AND (status IN ('ok', 'accepted') OR list_contains($failed, run))
  AND programs = $programs AND environment = $environment AND ingest_rules = $rules
  AND isolation IS NOT DISTINCT FROM $isolation
GROUP BY run
"""
"""SQL: one of these executions for each run."""


def finished(store: Store, record: Record, options: ReplayOptions, context: Context) -> dict[str, Finished]:
    """Return the executions of earlier calls that count, by run: those that this replay would repeat."""
    if not (options.earlier or options.variation.finished):
        return {}
    rows = store.select(
        Finished,
        FINISHED,
        sessions=sorted(options.earlier),
        executions=sorted(options.variation.finished),
        runs=[run.run for run in record.runs],
        failed=[run.run for run in record.runs if not Status(str(run.status)).is_result],
        programs=context.programs,
        environment=context.environment,
        rules=context.ingest_rules,
        isolation=context.isolation and context.isolation.isolation,
    )
    return {row.run: row for row in rows}
