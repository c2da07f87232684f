"""Executing recorded runs again, from the record alone, and saying how far they agree with it.

The source is restored to a folder of the replay's own, inputs come from the store, programs are compared with the record
before anything executes. What is executed is recorded as further executions of the same runs, with the purpose `replay`:
these never count in statistics, and nothing that was recorded changes.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sierra import engines, jobs, recovery, runners
from sierra.agreement import Agreement, Verdict, worst
from sierra.asking import Progress, Watch
from sierra.config import LoadedProject, Output, Success
from sierra.engines import Engine
from sierra.errors import Missing, NotFound
from sierra.following import Following, noted
from sierra.hashing import short
from sierra.model import Job, Recipe, Run, Status
from sierra.outcomes import compare
from sierra.provenance import environment, programs, source
from sierra.record import Context, Recorder, rules_of
from sierra.sessions import Session
from sierra.store import Found, Store
from sierra.store.files import Recorded, Taken, contents, recorded, take
from sierra.version import __version__


@dataclass(frozen=True, slots=True)
class Compared:
    """One run, executed again: its outputs by path, each with how far it agrees. The key None is the run as a whole."""

    taken: Taken
    execution: str | None
    outputs: Mapping[str | None, Agreement]

    @property
    def verdict(self) -> Verdict:
        return worst(agreement.verdict for agreement in self.outputs.values())


@dataclass(frozen=True, slots=True)
class Replay:
    """The answer to a replay."""

    id: str
    found: Found
    runs: tuple[Compared, ...]
    notes: tuple[str, ...]
    """What is other than it was recorded, before any verdict."""
    interrupted: bool

    @property
    def verdict(self) -> Verdict:
        return worst(run.verdict for run in self.runs)

    @property
    def counts(self) -> Counter[Verdict]:
        return Counter(run.verdict for run in self.runs)


@dataclass(slots=True)
class _Record:
    """All that the store has of what is replayed."""

    found: Found
    batch: str
    runs: list[Taken]
    recipe: Recipe
    manifest: bytes
    programs: dict[str, str]
    """SHA-256 by name."""
    fingerprint: str
    outputs: dict[str, Output]
    success: Success
    inputs: dict[str, list[Recorded]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def replay(
    project: LoadedProject,
    store: Store,
    prefix: str,
    *,
    runs: int | None = None,
    slots: int,
    runner: str = "local",
    watch: Watch = lambda progress: None,
) -> Replay:
    """Execute again what an id names, at most `runs` of each experiment, and compare.

    Raises NotFound for what is not there, Missing for what is needed and gone: the source, a program, an input.
    """
    recovery.finish_dead(store)
    record = _look_up(store, store.resolve(prefix), runs)
    engine = _engine(record.recipe)
    session = Session(store.paths)
    try:
        root = session.paths.source
        _restore(record, project.root, root, store)
        now = _programs(record, project.root, root)
        notes = (*record.notes, *_other_programs(record, now))
        around = environment.capture(__version__)
        context = Context(session.id, record.batch, "replay", around["environment"], now.id, record.outputs, record.success)
        began = datetime.now(UTC)
        maker = jobs.Maker(record.recipe, root, engine, jobs.limits(project.config), session.id)
        made = {job.run: job for job in _jobs(record, store, maker)}
        failed, interrupted = _execute(store, session, context, list(made.values()), runners.find(runner)(slots), watch)
        compared = tuple(_compare(project, record, store, made, failed)) if not interrupted else ()
        answer = Replay(session.id, record.found, compared, notes, interrupted)
        _keep(answer, store, session, record, now, around, began, runner, engine)
        return answer
    finally:
        session.close()


def _look_up(store: Store, found: Found, runs: int | None) -> _Record:
    with store.ask() as question:
        named = take(question, found)
        taken = [one for one in named if one.status == "ok" and (runs is None or one.number < runs)]
        if not taken:
            raise NotFound(f"{found.kind} {short(found.id)} has no good execution to compare with; sierra run makes one")
        [batch, recipe] = question.run("SELECT batch, recipe FROM members WHERE run = $r LIMIT 1", {"r": taken[0].run})[0]
        batch = found.id if found.kind == "batch" else found.batch or batch
        made = question.sql("SELECT * FROM recipes WHERE recipe = $r", r=recipe).to_pylist()[0]
        wanted = {one.execution for one in taken}
        kept = question.sql(
            "SELECT DISTINCT programs, reading FROM executions WHERE list_contains($e, execution)", e=sorted(map(str, wanted))
        ).to_pylist()
        declared = question.sql("SELECT declared FROM readings WHERE reading = $r", r=kept[0]["reading"]).to_pylist()
        used = question.sql("SELECT name, sha256 FROM programs WHERE programs = $p", p=kept[0]["programs"]).to_pylist()
        files = question.sql("SELECT files FROM sources WHERE tree = $t LIMIT 1", t=made["source"]).to_pylist()
        inputs: dict[str, list[Recorded]] = {}
        for file in recorded(question, taken):
            if file.kind == "input":
                inputs.setdefault(file.taken.run, []).append(file)
    if not declared:
        raise Missing(f"{found.kind} {short(found.id)} was recorded by a SIERRA that could not replay; run it again first")
    outputs, success = rules_of(json.loads(declared[0]["declared"]))
    record = _Record(
        found=found,
        batch=batch,
        runs=taken,
        recipe=Recipe(made["platform"], tuple(made["command"]), json.loads(made["variables"]), made["source"], made["image"]),
        manifest=store.object(files[0]["files"]) if files else b"",
        programs={row["name"]: row["sha256"] for row in used},
        fingerprint=kept[0]["programs"],
        outputs=outputs,
        success=success,
        inputs=inputs,
    )
    if left := sum(one.status != "ok" for one in named):
        record.notes.append(f"{left} of {len(named)} runs have no good execution to compare with; they are left out")
    if len(kept) > 1:
        record.notes.append("not all runs were recorded with the same programs and rules; those of the first are heeded")
    return record


def _engine(recipe: Recipe) -> Engine:
    if recipe.image is not None:
        raise Missing(f"it was executed in the image {recipe.image}, and containers are not there yet")
    return engines.find("none")


def _restore(record: _Record, project: Path, root: Path, store: Store) -> None:
    """The recorded source in `root`; what it lacks of the project's files that the command names is copied."""

    def content(blob: str) -> bytes | None:
        rows = store.rows("SELECT sha256 FROM blobs WHERE blob = $b", b=blob)
        return store.object(rows[0]["sha256"]) if rows else None

    if record.recipe.source is None:
        root.mkdir(parents=True)
    else:
        source.restore(record.recipe.source, record.manifest, project, root, content)
    for name in record.programs:
        inside = name.removeprefix("{project}/")
        if inside != name and not Path(inside).is_absolute() and ".." not in Path(inside).parts:
            _copy(project / inside, root / inside, name)


def _copy(there: Path, here: Path, name: str) -> None:
    if not there.is_file():
        raise Missing(f"{there} is not there; runs need {name}, and the recorded source does not hold it")
    here.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(there, here)


def _programs(record: _Record, project: Path, root: Path) -> programs.Programs:
    """The programs that the recorded command starts here and now."""
    command, variables = record.recipe.command, record.recipe.environment
    more = programs.beside((*command, *variables.values()), root, source.paths(record.manifest))
    return programs.find(jobs.fill(command, root), jobs.search_path(variables), root, more)


def _other_programs(record: _Record, now: programs.Programs) -> Iterator[str]:
    """What is other about the programs, by name."""
    if now.id == record.fingerprint:
        return
    then = {programs.called(name): digest for name, digest in record.programs.items()}
    here = {program.called: program for program in now.all}
    for name, was, program in programs.differing(then, here):
        if program is None:
            yield f"other programs: {name} was recorded, and is not started now"
        elif was is None:
            yield f"other programs: {name} ({program.path}) was not recorded"
        else:
            yield f"other programs: {name} was {short(was)}, and {program.path} is {short(program.sha256)}"


def _jobs(record: _Record, store: Store, maker: jobs.Maker) -> Iterator[Job]:
    """A job for each run, with the inputs that are recorded."""
    bytes_of: dict[str, bytes] = {}
    with store.ask() as question:
        for content in contents(question, [file for files in record.inputs.values() for file in files]):
            bytes_of[content.file.sha256 or ""] = b"".join(content.pieces)
        question.views.make(("members",))
        seeds = dict(question.run("SELECT run, seed FROM members WHERE batch = $b", {"b": record.batch}))
    for taken in {one.run: one for one in record.runs}.values():
        files = tuple((file.path.removeprefix("input/"), file.sha256 or "") for file in record.inputs.get(taken.run, ()))
        run = Run(taken.run, taken.ordinal, taken.number, seeds[taken.run], files)
        yield maker.job(run, tuple((name, bytes_of[digest]) for name, digest in files))


def _execute(
    store: Store, session: Session, context: Context, work: Sequence[Job], runner: Any, watch: Watch
) -> tuple[dict[str, Status], bool]:
    """Execute; how runs ended that did not end well, and whether it was interrupted."""
    context.save(session.paths.context)
    done: dict[str, Status] = {}

    def took(run: str, status: Status) -> None:
        done[run] = status

    def bad() -> dict[str, Status]:
        return {run: status for run, status in done.items() if status is not Status.OK}

    with noted() as signals:
        following = Following(
            runner,
            Recorder(store, session.paths, context),
            store,
            session,
            took,
            lambda running: watch(Progress(len(work), 0, len(done), len(bad()), running)),
        )
        following.execute(work, signals)
    return bad(), bool(signals)


def _compare(
    project: LoadedProject, record: _Record, store: Store, made: Mapping[str, Job], failed: Mapping[str, Status]
) -> Iterator[Compared]:
    declared = {**record.outputs, **project.config.outputs}
    with store.ask() as question:
        question.views.make(("executions", "artifacts"))
        for taken in record.runs:
            execution = made[taken.run].execution
            if taken.run in failed:
                [(reason,)] = question.run("SELECT reason FROM executions WHERE execution = $e", {"e": execution}) or [("",)]
                yield Compared(taken, execution, {None: Agreement(Verdict.FAILED, reason or failed[taken.run])})
            else:
                yield Compared(taken, execution, compare(question, store, str(taken.execution), execution, declared))


def _keep(
    answer: Replay,
    store: Store,
    session: Session,
    record: _Record,
    now: programs.Programs,
    around: Mapping[str, Any],
    began: datetime,
    runner: str,
    engine: Engine,
) -> None:
    """Record the replay and its verdicts."""
    if answer.interrupted:
        return
    writer = store.writer(session.paths.segment, record.batch)
    writer.rows(
        "replays",
        [
            {
                "replay": answer.id,
                "kind": record.found.kind,
                "target": record.found.id,
                "batch": record.batch,
                "started": began,
                "ended": datetime.now(UTC),
                "runner": runner,
                "engine": engine.name,
                "runs": len(answer.runs),
                "verdict": str(answer.verdict),
                "environment": around["environment"],
                "programs": now.id,
            }
        ],
    )
    writer.rows("verdicts", (row for run in answer.runs for row in verdict_rows(answer.id, run)))
    writer.rows("environments", [around])
    writer.rows("programs", now.rows())
    store.publish(writer)


def verdict_rows(replay: str, run: Compared) -> Iterator[dict[str, Any]]:
    """The records of `verdicts` for one run."""
    for path, agreement in run.outputs.items():
        yield {
            "replay": replay,
            "run": run.taken.run,
            "recorded": run.taken.execution,
            "execution": run.execution,
            "path": path,
            "verdict": str(agreement.verdict),
            "why": agreement.why,
            "row": agreement.row,
            "column": agreement.column,
            "was": agreement.recorded,
            "found": agreement.found,
            "abs": agreement.abs,
            "rel": agreement.rel,
            "ulp": agreement.ulp,
        }
