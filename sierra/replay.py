"""Executing recorded runs again, from the record alone, and saying how far they agree with it.

The source is restored to a folder of the replay's own, inputs come from the store, programs are compared with the record
before anything executes. What is executed is recorded as further executions of the same runs, with the purpose `replay`:
these never count in statistics, and nothing that was recorded changes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sierra import hosted, jobs, metrics, recalled, recovery, runners
from sierra.agreement import Agreement, Verdict
from sierra.asking import Progress, Watch
from sierra.config import LoadedProject, Output
from sierra.containment import Containment, contain
from sierra.errors import Missing, NotFound, UsageError
from sierra.following import Ears, Following
from sierra.hashing import short
from sierra.metrics import Metric
from sierra.model import Job, Run, Status
from sierra.outcomes import compare_all
from sierra.paths import SessionPaths
from sierra.provenance import environment, programs, versions
from sierra.provenance.program import Programs
from sierra.provenance.seen import Seen, seen
from sierra.recalled import Recalled
from sierra.recording import Context, Recorder
from sierra.runners import Runner, Work, needed
from sierra.sessions import Session
from sierra.signals import noted
from sierra.states import seconds
from sierra.store import Found, Store
from sierra.store.files import Taken, take, where
from sierra.verdicts import Compared, OfExperiment, Replay, Tolerances, metric_rows, plain, verdict_rows
from sierra.version import __version__

ARITHMETIC = ("machine", "cpu_flags", "gpus", "libc", "container")
"""What of a machine may change the results of the same programs."""


@dataclass(frozen=True, slots=True)
class How:
    """How to replay."""

    slots: int
    runs: int | None = None
    """The first so many of each experiment alone."""
    runner: str = "local"
    engine: str | None = None
    """What contains them; that which did, where it is not said."""
    tolerances: Tolerances = field(default_factory=dict)
    """Instead of what the project declares."""
    keep: bool = False
    """Whether to leave the restored source and the folders of the runs."""


@dataclass(slots=True)
class _Record:
    """What the store has of what is replayed."""

    found: Found
    of: Recalled
    runs: list[Taken]
    named: int
    """How many runs the id names, also such as have no good execution."""
    whole: bool
    """Whether all good runs of each experiment are among them."""
    cells: dict[int, dict[str, Any]]
    """The values of each experiment, by its place in the batch."""
    seeds: dict[str, int]
    tables: list[str]
    """The outputs that are tables."""
    environment: str
    notes: list[str]


def replay(
    project: LoadedProject,
    store: Store,
    prefix: str,
    how: How,
    watch: Watch = lambda progress: None,
    say: Callable[[str], None] = lambda text: None,
) -> Replay:
    """Execute again what an id names, and compare. `say` hears what is other than it was recorded, before anything executes.

    Raises NotFound for what is not there, Missing for what is needed and gone: the source, a program, an input.
    """
    recovery.finish_dead(store)
    record = _look_up(store, store.resolve(prefix), how.runs)
    declared = _declared(record, project, how.tolerances)
    was = _metrics(project, store, record, declared)
    engine = recalled.engine(store, record.of.batch, record.of.recipe, how.engine, hosted=True)
    image = recalled.image(project, store, record.of.recipe)
    runner = runners.find(how.runner, project.config.runners)(how.slots)
    began = datetime.now(UTC)
    session = Session(store.paths)
    kept = store.paths.kept(session.id) if how.keep else None
    try:
        root = session.paths.source
        checkout = record.of.checkout(project, store)
        checkout.make(root)
        if image is not None and engine.name == "none":
            hosted.check(record.of.recipe, recalled.inside(store, image.id), root)
        variables = jobs.declared(record.of.recipe.environment, root, project.root)
        now = versions.asked(checkout.programs_in(root), project.config.programs, variables, root)
        around = environment.capture(__version__, project.config.environment.record)
        contained = contain(
            engine,
            image,
            record.of.recipe,
            project.config.container,
            jobs.limits(project.config),
            code=root,
            project=project.root,
            store=store.paths,
            session=session.id,
            elsewhere=runner.stays,
        )
        notes = (
            *record.notes,
            *contained.notes,
            *now.notes,
            *_other_programs(record.of, now),
            *_other_machine(store, record, around),
        )
        for text in notes:
            say(text)
        context = Context(
            session.id,
            record.of.batch,
            "replay",
            around["environment"],
            now.id,
            record.of.outputs,
            record.of.success,
            raw=project.config.store.raw,
            **contained.context,
        )
        maker = jobs.Maker(
            record.of.recipe,
            root,
            engine,
            jobs.limits(project.config),
            session.id,
            project.root,
            image=image,
            box=contained.box,
            script=session.paths.worker if runner.stays else None,
        )
        made = {job.run: job for job in _jobs(record, store, maker)}
        search = jobs.declared(record.of.recipe.environment, root, project.root, image=image)["PATH"]
        work = Work(
            made.values(),
            len(made),
            record.of.batch,
            (*needed(now, search), *contained.needed),
            seconds(record.of.recipe, store) if runner.stays else None,
            record=environment.recorded(project.config.environment.record),
            around=around,
        )
        try:
            doubt = _doubt(seen(root, b"", now), contained)
            failed, interrupted = _execute(store, session, context, work, runner, watch, say, kept, doubt)
        finally:
            contained.close()
        _leave(session.paths, kept)
        if interrupted:
            return Replay(session.id, record.found, (), notes, interrupted=True, of=record.named, kept=kept)
        compared = _compare(record, store, made, failed, declared)
        experiments = tuple(_experiments(project, store, record, list(compared), was, declared))
        answer = Replay(session.id, record.found, experiments, notes, interrupted=False, of=record.named, kept=kept)
        _keep(answer, store, session, record, now, around, began, how, contained)
        return answer
    finally:
        session.close()


def _look_up(store: Store, found: Found, runs: int | None) -> _Record:
    import pyarrow as pa

    with store.ask() as question:
        named = take(question, found)
        good = [one for one in named if one.status == "ok"]
        taken = [one for one in good if runs is None or one.number < runs]
        if not taken:
            raise NotFound(f"{found.kind} {short(found.id)} has no good execution to compare with; sierra run makes one")
        question.views.make(("members", "experiments", "batches"))
        batch = where(question, found).batch
        question.register("taken", pa.table({"execution": [str(one.judgement) for one in taken]}))
        by = question.sql(
            "SELECT DISTINCT programs, reading, environment "
            "FROM judged e SEMI JOIN taken t ON t.execution = e.judgement ORDER BY ALL"
        ).to_pylist()
        cells = question.sql("SELECT * FROM experiments WHERE batch = $b", b=batch).to_pylist()
        [(axes,)] = question.run("SELECT axes FROM batches WHERE batch = $b", {"b": batch})
        tables = question.sql(
            "SELECT DISTINCT output FROM judged_artifacts SEMI JOIN taken USING (execution) WHERE kind = 'table' ORDER BY 1"
        )
        wrote = {row[0] for row in question.run(WROTE)}
        seeds = dict(question.run("SELECT run, seed FROM members WHERE batch = $b", {"b": batch}))
    record = _Record(
        found=found,
        of=recalled.recall(store, batch, by[0]["programs"], by[0]["reading"]),
        runs=taken,
        named=len(named),
        whole=len(taken) == len(good) and found.kind in ("batch", "experiment"),
        cells={row["ordinal"]: {axis: row[axis] for axis in axes} for row in cells},
        seeds=seeds,
        tables=tables.column(0).to_pylist(),
        environment=by[0]["environment"],
        notes=[],
    )
    left = sum(one.judgement in wrote for one in taken)
    if not left:
        raise Missing(f"{found.kind} {short(found.id)} left nothing but logs, which are not compared")
    if left < len(taken):
        record.notes.append(f"{len(taken) - left} of {len(taken)} runs left nothing but logs, which are not compared")
    if without := len(named) - len(good):
        record.notes.append(f"{without} of {len(named)} runs have no good execution to compare with; they are left out")
    if len({(row["programs"], row["reading"]) for row in by}) > 1:
        record.notes.append("not all runs were recorded with the same programs and rules; those of the first are heeded")
    return record


WROTE = "SELECT DISTINCT execution FROM judged_artifacts SEMI JOIN taken USING (execution) WHERE kind <> 'log'"
"""The executions that left files, or tables."""


def _declared(record: _Record, project: LoadedProject, tolerances: Tolerances) -> dict[str, Output]:
    """The rules to compare by: of outputs as they were recorded, as the project has them now, with the tolerances asked for."""
    declared = {**record.of.outputs, **project.config.outputs}
    known = sorted({*declared, *record.tables})
    if unknown := tolerances.keys() - {"*", *known}:
        raise UsageError(f"--set-tolerance: no output {min(unknown)!r}; there is {', '.join(known) or 'none'}")
    for name in known if tolerances else ():
        output = declared.get(name) or Output(file=name)
        asked = {**output.tolerance, **tolerances.get("*", {}), **tolerances.get(name, {})}
        declared[name] = output.model_copy(update={"tolerance": asked})
    return declared


def _metrics(project: LoadedProject, store: Store, record: _Record, declared: Mapping[str, Output]) -> metrics.Values | None:
    """What the recorded runs come to, by metric; None where experiments cannot be compared by metrics."""
    if not project.config.equivalence or record.found.kind not in ("batch", "experiment"):
        return None
    if not record.whole:
        record.notes.append("equivalence is judged of whole experiments alone: replay without --runs")
        return None
    executions = {one.run: str(one.judgement) for one in record.runs}
    try:
        return metrics.values(store, record.of.batch, executions, project.config.equivalence, declared)
    except NotFound as error:
        record.notes.append(f"[equivalence]: {error}; no experiment is judged by it")
        return None


def _other_programs(of: Recalled, now: Programs) -> Iterator[str]:
    """What is other about the programs, by name."""
    if now.id != of.fingerprint:
        yield from (f"other programs: {line}" for line in programs.told(of.programs, now))


def _other_machine(store: Store, record: _Record, around: Mapping[str, Any]) -> Iterator[str]:
    """What is other about the machine that may change arithmetic."""
    for row in store.rows("SELECT * FROM environments WHERE environment = $e", e=record.environment):
        for name, was, found in environment.differing(row, around):
            if name in ARITHMETIC:
                old, new = (", ".join(one) or "none" if isinstance(one, list) else one or "none" for one in (was, found))
                yield f"other machine: {name} {'that differ: ' if isinstance(was, list) else ''}was {old}, is {new}"


def _jobs(record: _Record, store: Store, maker: jobs.Maker) -> Iterator[Job]:
    """A job for each run, with the inputs that are recorded."""
    for taken, files in recalled.inputs(store, {one.run: one for one in record.runs}.values()):
        yield maker.job(Run(taken.run, taken.ordinal, taken.number, record.seeds[taken.run], (), b""), files)


def _execute(
    store: Store,
    session: Session,
    context: Context,
    work: Work,
    runner: Runner,
    watch: Watch,
    say: Callable[[str], None],
    kept: Path | None,
    doubt: Callable[[], str | None],
) -> tuple[dict[str, Status], bool]:
    """Execute; how runs ended that did not end well, and whether it was interrupted."""
    context.save(session.paths.context)
    done: dict[str, Status] = {}

    def took(run: str, status: Status) -> None:
        done[run] = status

    def bad() -> dict[str, Status]:
        return {run: status for run, status in done.items() if status is not Status.OK}

    def tell(running: int, queued: int, waits: str) -> None:
        watch(Progress(work.count, 0, len(done), len(bad()), running, queued=queued, waits=waits))

    with noted() as signals:
        ears = Ears(took, tell, say)
        recorder = Recorder(store, session.paths, context, kept, doubt)
        following = Following(runner, recorder, store, session, ears, leave=lambda: False)
        following.execute(work, signals)
    return bad(), bool(signals) or session.paths.cancelled.exists()


def _doubt(files: Seen, contained: Containment) -> Callable[[], str | None]:
    """What says why executions cannot be ascribed to the programs, or to the image, that were there when they began."""
    return lambda: files.doubt() or contained.doubt()


def _leave(session: SessionPaths, kept: Path | None) -> None:
    """Put the restored source where it is kept."""
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        session.source.rename(kept / session.source.name)


def _compare(
    record: _Record, store: Store, made: Mapping[str, Job], failed: Mapping[str, Status], declared: Mapping[str, Output]
) -> Iterator[Compared]:
    done = [one for one in record.runs if one.run not in failed]
    with store.ask() as question:
        pairs = [(str(one.judgement), made[one.run].execution) for one in done]
        for taken, outputs in zip(done, compare_all(question, pairs, declared), strict=True):
            yield Compared(taken, made[taken.run].execution, outputs)
        question.views.make(("executions",))
        for taken in (one for one in record.runs if one.run in failed):
            execution = made[taken.run].execution
            [(reason,)] = question.run("SELECT reason FROM executions WHERE execution = $e", {"e": execution}) or [("",)]
            yield Compared(taken, execution, {None: Agreement(Verdict.FAILED, reason or failed[taken.run])})


def _experiments(
    project: LoadedProject,
    store: Store,
    record: _Record,
    compared: Sequence[Compared],
    was: metrics.Values | None,
    declared: Mapping[str, Output],
) -> Iterator[OfExperiment]:
    by_place: dict[int, list[Compared]] = {}
    for run in sorted(compared, key=lambda run: (run.taken.ordinal, run.taken.number)):
        by_place.setdefault(run.taken.ordinal, []).append(run)
    stochastic = {place: runs for place, runs in by_place.items() if was is not None and _wavers(runs)}
    now: metrics.Values = {}
    if stochastic:
        executions = {run.taken.run: str(run.execution) for runs in stochastic.values() for run in runs}
        now = metrics.values(store, record.of.batch, executions, project.config.equivalence, declared)
    for place, runs in by_place.items():
        found: tuple[Metric, ...] = ()
        if place in stochastic and was is not None:
            names = [run.taken.run for run in runs]
            found = tuple(metrics.compare(project.config.equivalence, was, now, place, names))
        yield OfExperiment(runs[0].taken.experiment, place, record.cells[place], tuple(runs), found)


def _wavers(runs: Sequence[Compared]) -> bool:
    """Whether runs differ in values alone: none failed, and what they wrote is of the same form."""
    different = [one for run in runs for one in run.outputs.values() if not one.verdict.fine]
    return bool(different) and all(one.verdict is Verdict.DIFFERENT and not one.form for one in different)


def _keep(
    answer: Replay,
    store: Store,
    session: Session,
    record: _Record,
    now: Programs,
    around: Mapping[str, Any],
    began: datetime,
    how: How,
    contained: Containment,
) -> None:
    """Record the replay and its verdicts."""
    writer = store.writer(session.paths.segment, record.of.batch)
    writer.rows(
        "replays",
        [
            {
                "replay": answer.id,
                "kind": record.found.kind,
                "target": record.found.id,
                "batch": record.of.batch,
                "started": began,
                "ended": datetime.now(UTC),
                "runner": how.runner,
                "engine": contained.engine.name,
                "runs": len(answer.runs),
                "verdict": str(answer.verdict),
                "tolerances": json.dumps(plain(how.tolerances)) if how.tolerances else None,
                "environment": around["environment"],
                "programs": now.id,
            }
        ],
    )
    writer.rows("verdicts", (row for run in answer.runs for row in verdict_rows(answer.id, run)))
    writer.rows("equivalences", (row for one in answer.experiments for row in metric_rows(answer.id, one)))
    writer.rows("environments", [around])
    writer.rows("programs", now.rows())
    store.publish(writer)
