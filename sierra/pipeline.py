"""The order of things: query → design → inputs → execute → record → analyse → deliver.

`plan` and `run` read as that list. Each step turns values into values and knows nothing of the others; what they
left behind is in the store. Everything is idempotent: asking again executes only what has no good execution.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sierra import engines, inputs, jobs, platforms, query, sessions
from sierra.config import LoadedProject, Project
from sierra.design import design
from sierra.engines import Engine
from sierra.errors import ConfigError, Missing, UsageError
from sierra.expansion import Expansion
from sierra.hashing import sha256
from sierra.model import Batch, Design, Job, Limits, Query, Recipe, Result, Run, Set, Status
from sierra.paths import CONFIG, DRAWN, FIGURES, PYPROJECT, STORE, ProjectPaths, SessionPaths
from sierra.provenance import environment, programs, source
from sierra.record import Context, Recorder, find_odd
from sierra.runners import Runner, orphans
from sierra.runners.journal import Journal
from sierra.runners.local import Local
from sierra.sessions import Session
from sierra.store import Question, Store
from sierra.store.objects import Objects
from sierra.store.tables import check_name
from sierra.version import __version__

POLL_S = 0.05
JOIN_S = 0.2
SHOWN_FAILURES = 20


@dataclass(frozen=True, slots=True)
class Plan:
    """A query with all that its answer depends on, and nothing executed yet."""

    project: LoadedProject
    query: Query
    text: str
    batch: Batch
    expansion: Expansion
    source: source.Source
    programs: programs.Programs
    environment: Mapping[str, Any]
    engine: Engine
    limits: Limits
    template_sha256: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class State:
    """What the store has of a run: good, or why it must execute."""

    good: bool
    why: str
    executions: int = 0


@dataclass(frozen=True, slots=True)
class Progress:
    """How far an asking has come."""

    total: int
    reused: int
    done: int
    failed: int
    running: int
    elsewhere: int = 0


@dataclass(frozen=True, slots=True)
class Failure:
    """A run without a good execution, and the end of its log."""

    run: str
    experiment: Mapping[str, Any]
    number: int
    status: str
    reason: str
    log: str | None


@dataclass(frozen=True, slots=True)
class Summary:
    """The answer to a query, as far as it went. `failed` and `missing` are runs without a good execution."""

    batch: str
    query: str
    experiments: int
    runs: int
    executed: int
    reused: int
    failed: int
    missing: int
    interrupted: bool
    failures: tuple[Failure, ...] = ()
    notes: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()
    undrawn: str | None = None
    """Why no figure could be written at all (a full disk, a file in the way); the answer itself is recorded."""


Watch = Callable[[Progress], None]


def ask(
    project: LoadedProject,
    words: Sequence[str],
    *,
    runs: int | None = None,
    controller: str | None = None,
    scenario: str | None = None,
    sets: Sequence[tuple[str, str]] = (),
) -> Query:
    """The query that these words are: criteria, or the name of one in `sierra.toml`.

    `sets` are pairs of an XPath and a value. Raises QueryError, UsageError.
    """
    if runs is not None and runs < 1:
        raise UsageError(f"{runs} runs per experiment; ask for 1 or more")
    config = project.config
    named = config.queries.get(words[0]) if len(words) == 1 else None
    criteria = query.parse_all(named.criteria if named else words)
    return Query(
        criteria=criteria,
        runs=runs or (named and named.runs) or config.runs,
        controller=controller or (named and named.controller) or None,
        scenario=scenario or (named and named.scenario) or None,
        sets=tuple(Set(path, value, why=f"--set {path}") for path, value in sets),
        base_seed=config.seed.base,
    )


def plan(project: LoadedProject, asked: Query, *, engine: str = "none") -> Plan:
    """All that a query's answer depends on. Nothing is executed or written (but the source's tree, by git).

    Raises what is wrong with project, query, template, source or programs.
    """
    config, root = project.config, project.root
    _check_outputs(project)
    template = inputs.read(root / config.template)
    platform = platforms.find(config.platform, config)
    contained = engines.find(engine)
    command = jobs.command(platform, root)
    variables = jobs.environment(platform, config)
    own = (STORE, *_drawn(root), CONFIG, PYPROJECT if project.file.name == PYPROJECT else CONFIG, *_inside(config.template))
    code = source.capture(root, paths=config.source.paths, without=own)
    unversioned = programs.beside((*command, *variables.values()), root, source.paths(code.manifest))
    recipe = Recipe(config.platform, command, variables, code.tree, contained.image())
    designed = design(asked, config, platform, template)
    expansion = Expansion(designed, template, platform, recipe)
    return Plan(
        project=project,
        query=asked,
        text=" ".join(query.text(criterion) for criterion in asked.criteria),
        batch=expansion.batch(),
        expansion=expansion,
        source=code,
        programs=programs.find(jobs.fill(command, root), jobs.search_path(variables), root, unversioned),
        environment=environment.capture(__version__),
        engine=contained,
        limits=jobs.limits(config),
        template_sha256=template.sha256,
        notes=(*_doubts(designed, command), *_texts(designed, config, template)),
    )


def _drawn(root: Path) -> list[str]:
    """The folders that figures were drawn to; what else is in `figures` is the project's."""
    return [f"{FIGURES}/{memory.parent.name}" for memory in ProjectPaths(root).figures.glob(f"*/{DRAWN}")]


def _inside(template: str) -> list[str]:
    """The template, where it lies in the project: it is hashed by what is made from it."""
    path = os.path.normpath(template)
    return [] if path.startswith((os.pardir, os.sep)) else [path]


def _doubts(designed: Design, command: Sequence[str]) -> Iterator[str]:
    """What is allowed, and yet hardly meant."""
    mentioned = " ".join(command)
    if designed.query.runs > 1 and not designed.per_run and "{seed}" not in mentioned:
        yield 'the seed goes nowhere: say where with seed = "XPATH", or {seed} in the command (SIERRA_SEED has it too)'
    if "{input}" not in mentioned and "{run}" not in mentioned:
        yield "the command does not name {input}: unless it finds the generated file itself, all experiments are the same"


def _texts(designed: Design, config: Project, template: inputs.Template) -> Iterator[str]:
    """Texts as values of a variable where the template has a number: a range that was mistyped, perhaps."""
    for axis in designed.axes:
        variable = config.variables.get(axis.name)
        if variable is not None and variable.set is not None and not axis.numeric:
            here = template.find(variable.set)
            if here and all(re.fullmatch(r"\s*[+-]?\d+(\.\d*)?\s*", value) for value in here):
                yield f"{axis.name} gets texts ({axis.values[0]!r}, …), and the template has {here[0].strip()} there"


def run(plan: Plan, store: Store, *, slots: int, fail_fast: bool = False, watch: Watch = lambda progress: None) -> Summary:
    """Execute what has no good execution yet, record it, and say how it went.

    Ends what runs, and keeps what has finished, when interrupted (KeyboardInterrupt).
    """
    finish_dead(store)
    began = datetime.now(UTC)
    if is_answered(plan, store):
        return _summary(plan, store)
    session = Session(store.paths)
    try:
        if is_kept(plan, store):
            find_odd(store, session.paths, _context(plan, session.id))
        else:
            keep(plan, store, session.paths)
        asking = _Asking(plan, store, session, slots, fail_fast, watch)
        asking.answer()
        return _close(asking, began)
    finally:
        session.close()


def is_answered(plan: Plan, store: Store) -> bool:
    """Whether the last asking of all was this one, by the same programs and rules, and every run is good: nothing is to do."""
    context = _context(plan, "")
    with store.ask() as question:
        question.views.make(("sessions",))
        last = question.run("SELECT arg_max(batch, ended), arg_max(programs, ended), arg_max(rules, ended) FROM sessions")
        same = last == [(plan.batch.id, context.programs, context.rules)]
        return same and all(state.good for state in states(plan, question).values())


def states(plan: Plan, asked: Store | Question | None) -> dict[str, State]:
    """What the store has of each run of the batch."""
    runs = dict.fromkeys((run.id for run in plan.batch.runs), State(False, "new"))
    if asked is None:
        return runs
    import pyarrow as pa

    seen: dict[tuple[Any, ...], State] = {}
    with asked.ask() if isinstance(asked, Store) else contextlib.nullcontext(asked) as question:
        question.register("asked", pa.table({"run": list(runs)}))
        question.run("SET threads = 1")  # of 100,000 runs, each thread would hold its own
        question.views.make(("executions",))
        parameters = {"programs": plan.programs.id, "reading": _context(plan, "").reading}
        for run, *found in question.each(STATES, parameters):
            key = tuple(found)
            runs[run] = seen.get(key) or seen.setdefault(key, _state(*found))
    return runs


STATES = """
SELECT run, bool_or(ok AND programs = $programs AND reading = $reading), bool_or(ok AND reading = $reading),
       bool_or(ok), arg_max(reason, ended), count(*)
FROM (SELECT *, status = 'ok' AS ok FROM executions) e JOIN asked USING (run)
WHERE purpose = 'run' GROUP BY run
"""


def _state(good: bool, same_reading: bool, ever: bool, reason: str | None, executions: int) -> State:
    if good:
        return State(True, "reused", executions)
    if same_reading:
        return State(False, "executed with other programs", executions)
    return State(False, "[outputs] or [success] have changed" if ever else f"failed: {reason}", executions)


def keep(plan: Plan, store: Store, session: SessionPaths) -> None:
    """Record what is asked, before anything executes: the batch, its runs, and their input files.

    What the store has already is not recorded again, also where another asking was quicker.
    """
    batch = plan.batch
    writer = store.writer(session.segment, batch.id)
    known = _known_inputs(plan, store)
    objects = Objects(writer.path("objects"))
    for _, files in plan.expansion.files(batch, lambda run: run.id not in known):
        for _, content in files:
            objects.add(content)
    listing = objects.add(plan.source.manifest)
    objects.close()
    recipe = batch.recipe
    first = batch.experiments[0].runs[0]
    writer.rows("batches", [_batch_row(plan)])
    writer.rows(
        "recipes",
        [
            {
                "recipe": batch.recipe_id,
                "platform": recipe.platform,
                "command": list(recipe.command),
                "variables": _json(recipe.environment),
                "source": recipe.source,
                "image": recipe.image,
                "files": [name for name, _ in first.inputs],
            }
        ],
    )
    writer.rows("sources", [plan.source.row(listing)])
    writer.rows("environments", [plan.environment])
    writer.rows("programs", plan.programs.rows())
    writer.table("experiments", _experiments(batch))
    writer.table("members", _members(batch))
    with sessions.exclusively(store.paths):
        if not is_kept(plan, store):
            store.publish(writer)


def is_kept(plan: Plan, store: Store) -> bool:
    """Whether the store knows what is asked."""
    return bool(store.rows("SELECT 1 FROM batches WHERE batch = $b LIMIT 1", b=plan.batch.id))


def finish_dead(store: Store) -> int:
    """End what dead sessions left running, and record what had finished there; how many executions that were."""
    recovered = 0
    with sessions.dead(store.paths) as found:
        if found:
            orphans.end(found)
        for paths in found:
            recovered += _recover(store, paths)
    return recovered


def _recover(store: Store, paths: SessionPaths) -> int:
    """Record what a session's journal says has finished, and the store does not have yet."""
    results = [event for event in Journal(paths.journal).read() if isinstance(event, Result)]
    if not results:
        return 0
    context = Context.load(paths.context)
    rows = store.rows("SELECT execution FROM executions WHERE session = $s", s=context.session)
    recorded = {row["execution"] for row in rows}
    recorder = Recorder(store, paths, context)
    missing = [result for result in results if result.execution not in recorded]
    for result in missing:
        recorder.add(result)
    recorder.flush()
    find_odd(store, paths, context)
    return len(missing)


class _Asking:
    """One asking while it is answered: what is done, what failed, what others do."""

    def __init__(self, plan: Plan, store: Store, session: Session, slots: int, fail_fast: bool, watch: Watch) -> None:
        self.plan = plan
        self.store = store
        self.session = session
        self.slots = slots
        self.interrupted = False
        self.attempted: set[str] = set()
        self.failed: set[str] = set()
        self._fail_fast = fail_fast
        self._watch = watch
        self.reused: set[str] = set()
        self._total = len({run.id for run in plan.batch.runs})
        self._context = _context(plan, session.id)

    def answer(self) -> None:
        """Execute what is missing; wait for what other sessions execute, and take over what they leave."""
        before: dict[str, State] = {}
        while not self.interrupted:
            recorded = len(self.store.segments())
            now = states(self.plan, self.store)
            wanted = {run for run, state in now.items() if not state.good}
            if not before:
                before, self.reused = now, now.keys() - wanted
            # What another session executed since this asking began, and without success, has been tried.
            self.failed |= {run for run in wanted if now[run].executions > before[run].executions}
            wanted -= self.failed | self.attempted
            if not wanted or (self._fail_fast and self.failed):
                return
            mine = self.session.claim(wanted)
            if len(self.store.segments()) != recorded:
                continue  # what is claimed now may have been executed since the store was asked
            if mine:
                tried = len(self.attempted)
                self._execute(mine)
                if len(self.attempted) == tried and not self.interrupted:
                    raise Missing(f"{self.session.paths.root}: the worker has ended, and said of no run how it went")
            else:
                self._wait(wanted)

    def _execute(self, wanted: AbstractSet[str]) -> None:
        self._context.save(self.session.paths.context)
        recorder = Recorder(self.store, self.session.paths, self._context)
        runner: Runner = Local(self.slots)
        with _noted() as signals:
            try:
                runner.submit(self._jobs(wanted), self.session.paths)
                self._follow(runner, recorder, signals)
                find_odd(self.store, self.session.paths, self._context)
            except BaseException:
                self._give_up(runner)
                raise
        self.interrupted = bool(signals)

    def _give_up(self, runner: Runner) -> None:
        """End what runs, and record by the journal what had finished; if that fails too, whoever asks next does so."""
        self.session.recorded = False
        with contextlib.suppress(Exception):
            runner.stop()
            while runner.look().alive:
                time.sleep(POLL_S)
        with contextlib.suppress(Missing, OSError):
            _recover(self.store, self.session.paths)
            self.session.recorded = True

    def _jobs(self, wanted: AbstractSet[str]) -> Iterator[Job]:
        maker = jobs.Maker(self.plan.batch.recipe, self.plan.project.root, self.plan.engine, self.plan.limits, self.session.id)
        sent: set[str] = set()
        for run, files in self.plan.expansion.files(self.plan.batch, lambda run: run.id in wanted):
            if run.id not in sent:
                sent.add(run.id)
                yield maker.job(run, files)

    def _follow(self, runner: Runner, recorder: Recorder, signals: Sequence[int]) -> None:
        """Look again and again until all has ended; a signal and the first failure (with `fail_fast`) end it early."""
        alive, told = True, 0
        while alive:
            look = runner.look()
            self._take(look.results, recorder)
            if recorder.due():
                self._flushed(recorder)
            self._tell(look.running)
            if len(signals) > told or (self._fail_fast and self.failed and not told):
                told = max(len(signals), 1)
                runner.stop()
            alive = look.alive
            if alive:
                time.sleep(POLL_S)
        self._flushed(recorder)
        self._tell(0)

    def _take(self, results: Sequence[Result], recorder: Recorder) -> None:
        for result in results:
            status = recorder.add(result)
            if status is not Status.INTERRUPTED:
                self.attempted.add(result.run)
                if status is not Status.OK:
                    self.failed.add(result.run)

    def _flushed(self, recorder: Recorder) -> None:
        self.failed |= {run for run, _, _ in recorder.flush()}

    def _wait(self, wanted: AbstractSet[str]) -> None:
        """Other sessions execute what is wanted: until one of them ends, or has recorded something."""
        known = len(self.store.segments())
        with _noted() as signals:
            while not signals and sessions.others(self.session.store, self.session.id) & wanted:
                self._tell(0, elsewhere=len(wanted))
                time.sleep(JOIN_S)
                finish_dead(self.store)
                if len(self.store.segments()) != known:
                    break
        self.interrupted = bool(signals)

    def _tell(self, running: int, elsewhere: int = 0) -> None:
        self._watch(Progress(self._total, len(self.reused), len(self.attempted), len(self.failed), running, elsewhere))


@contextlib.contextmanager
def _noted() -> Iterator[list[int]]:
    """Signals to end that arrive meanwhile: noted, so that nothing is torn apart (in the main thread; others get none)."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    heeded = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in heeded:
        signal.signal(number, lambda got, _: noted.append(got))
    try:
        yield noted
    finally:
        for number, handler in heeded.items():
            signal.signal(number, handler)


def _close(asking: _Asking, began: datetime) -> Summary:
    """Count by what the store says now, record the session, and sum up."""
    plan, store = asking.plan, asking.store
    bad = {run for run, state in states(plan, store).items() if not state.good}
    failed = bad & (asking.attempted | asking.failed)
    summary = _summary(
        plan, store, executed=asking.attempted, failed=failed, missing=bad - failed, interrupted=asking.interrupted
    )
    counts = {name: getattr(summary, name) for name in ("executed", "reused", "failed", "missing", "interrupted")}
    record = {
        **counts,
        "session": asking.session.id,
        "batch": plan.batch.id,
        "query": plan.text,
        "started": began,
        "ended": datetime.now(UTC),
        "runner": "local",
        "engine": plan.engine.name,
        "slots": asking.slots,
        "sierra": plan.environment["sierra"],
        "environment": plan.environment["environment"],
        "source": plan.source.id,
        **{name: getattr(_context(plan, ""), name) for name in ("programs", "reading", "rules")},
    }
    writer = store.writer(asking.session.paths.segment, plan.batch.id)
    writer.rows("sessions", [record])
    writer.rows("sources", [plan.source.row(sha256(plan.source.manifest))])
    if asking.attempted:
        writer.rows("environments", [plan.environment])
        writer.rows("programs", plan.programs.rows())
    store.publish(writer)
    return summary


def _summary(
    plan: Plan,
    store: Store,
    *,
    executed: AbstractSet[str] = frozenset(),
    failed: AbstractSet[str] = frozenset(),
    missing: AbstractSet[str] = frozenset(),
    interrupted: bool = False,
) -> Summary:
    """What is told of an asking that executed some runs; what is neither `failed` nor `missing` is good."""
    runs = len({run.id for run in plan.batch.runs})
    return Summary(
        batch=plan.batch.id,
        query=plan.text,
        experiments=len(plan.batch.experiments),
        runs=runs,
        executed=len(executed),
        reused=runs - len(executed | failed | missing),
        failed=len(failed),
        missing=len(missing),
        interrupted=interrupted,
        failures=tuple(failures(plan, store, failed)),
        notes=plan.notes,
    )


def failures(plan: Plan, store: Store, failed: AbstractSet[str]) -> Iterator[Failure]:
    """The first failed runs of a batch, with why and the end of their logs."""
    shown: list[tuple[Run, Mapping[str, Any]]] = []
    for experiment in plan.batch.experiments:
        shown += [(run, experiment.values) for run in experiment.runs if run.id in failed]
    shown = shown[:SHOWN_FAILURES]
    if not shown:
        return
    rows = store.rows(
        "SELECT run, arg_max(status, ended) AS status, arg_max(reason, ended) AS reason, "
        "arg_max(coalesce(log, ''), ended) AS log FROM executions WHERE list_contains($runs, run) GROUP BY run",
        runs=[run.id for run, _ in shown],
    )
    said = {row["run"]: row for row in rows}
    for run, values in shown:
        row = said[run.id]
        yield Failure(run.id, values, run.number, row["status"], row["reason"] or "", row["log"] or None)


def _context(plan: Plan, session: str) -> Context:
    config = plan.project.config
    return Context(
        session=session,
        batch=plan.batch.id,
        purpose="run",
        environment=plan.environment["environment"],
        programs=plan.programs.id,
        outputs=config.outputs,
        success=config.success,
    )


def _check_outputs(project: LoadedProject) -> None:
    for name in project.config.outputs:
        if not check_name(name):
            raise ConfigError(f"{project.file}: [outputs.{name}]: the store has a table {name!r} of its own; take another name")
    root = ProjectPaths(project.root)
    if root.store.exists() and not root.store.is_dir():
        raise Missing(f"{root.store} is a file; the store is to be a folder there")


def _known_inputs(plan: Plan, store: Store) -> set[str]:
    """Runs of the batch whose input files the store has: those that belong to an earlier batch."""
    import pyarrow as pa

    with store.ask() as question:
        question.register("asked", pa.table({"run": [run.id for run in plan.batch.runs]}))
        question.views.make(("members",))
        return {row[0] for row in question.run("SELECT DISTINCT run FROM members JOIN asked USING (run)")}


def _batch_row(plan: Plan) -> dict[str, Any]:
    return {
        "batch": plan.batch.id,
        "created": datetime.now(UTC),
        "query": plan.text,
        "axes": [axis.name for axis in plan.batch.axes],
        "controller": plan.query.controller or plan.project.config.controller,
        "scenario": plan.query.scenario or plan.project.config.scenario,
        "sets": [f"{change.path}={change.value}" for change in plan.query.sets],
        "platform": plan.batch.recipe.platform,
        "experiments": len(plan.batch.experiments),
        "runs": len({run.id for run in plan.batch.runs}),
        "base_seed": plan.query.base_seed,
        "recipe": plan.batch.recipe_id,
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


def _members(batch: Batch) -> Any:
    import pyarrow as pa

    runs = batch.runs
    return pa.table(
        {
            "batch": pa.array([batch.id]).take(pa.array([0] * len(runs))),
            "ordinal": [run.experiment for run in runs],
            "number": [run.number for run in runs],
            "run": [run.id for run in runs],
            "seed": [run.seed for run in runs],
            "input": [run.inputs[0][1] for run in runs],
            "recipe": pa.array([batch.recipe_id]).take(pa.array([0] * len(runs))),
        }
    )


def _json(value: Mapping[str, str]) -> str:
    import json

    return json.dumps(dict(value), sort_keys=True)
