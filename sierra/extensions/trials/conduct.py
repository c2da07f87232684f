"""Conduct of supervised trials: one after the other, block by block, each with a decision before and a verdict after it.

A trial that is not valid is asked for again at the end of its block. An execution is recorded with the remark that nobody has
judged it, and the verdict is added to the store afterwards. So nothing counts that nobody has judged, whatever happens between.

Also: order in which supervised runs are executed: shuffled in blocks, because batteries, floors and operators drift.

A block has the same number of runs of each experiment, so that a drift is spread over all experiments alike (a randomised
complete block design). The order follows from the batch's id: on every machine, and if a batch is continued another day,
it is the same.

Also: facts that are recorded with a trial: hashes of declared files, and what declared commands print.
"""

from __future__ import annotations

import json
import random
import subprocess
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from sierra.errors import Missing
from sierra.execution import commands, members
from sierra.execution.plan import context
from sierra.execution.session_steps import Core, Outcome
from sierra.extensions.trials import poses
from sierra.extensions.trials.supervisor import Ended, Start, Supervisor, Trial, Verdict
from sierra.extensions.trials.table import Trials
from sierra.extensions.trials.watched_runner import WatchedRunner
from sierra.ingest.consistency import find_inconsistent
from sierra.model import Batch, Run, Status
from sierra.runners.base import NamesRobots, Runner
from sierra.store.row_types import TrialRow
from sierra.store.store import Store
from sierra.util.hashing import sha256
from sierra.util.json_types import JsonView
from sierra.util.regular_files import read_regular

TIMEOUT_S = 30.0
KEPT = 1000
"""The number of characters that are kept of what a command prints."""


def of_files(trials: Trials, root: Path) -> dict[str, str]:
    """Return the SHA-256 of each declared file, by path. Raises Missing."""
    found = {}
    for name in trials.files:
        try:
            found[name] = sha256(read_regular(root / name))
        except OSError as error:
            raise Missing(f"[trials] files: {name} cannot be read: {error.strerror}") from error
    return found


def of_commands(trials: Trials, root: Path) -> dict[str, str]:
    """Return what each declared command prints to standard output, by name. Raises Missing for a command that fails."""
    return {name: _printed(name, commands.fill(words, root), root) for name, words in trials.commands.items()}


def _printed(name: str, argv: tuple[str, ...], root: Path) -> str:
    command = f"[trials.commands] {name}: {argv[0]}"
    try:
        ended = subprocess.run(argv, cwd=root, stdin=subprocess.DEVNULL, capture_output=True, timeout=TIMEOUT_S, check=False)
    except OSError as error:
        raise Missing(f"{command} cannot be started: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise Missing(f"{command} did not end within {TIMEOUT_S:g} s") from error
    if ended.returncode:
        said = ended.stderr.decode("utf-8", "replace").strip().splitlines()[-1:]
        raise Missing(": ".join([f"{command} ended with status {ended.returncode}", *said]))
    return ended.stdout.decode("utf-8", "replace").strip()[:KEPT]


class OrderedRun(NamedTuple):
    """A run's place in the order."""

    block: int
    """The block, from 0. Without blocks, all runs are in block 0."""
    run: Run


def order_seed(batch: Batch) -> int:
    """Return the number that the order of a batch derives from."""
    return int(batch.id[:8], 16)


def ordered(batch: Batch, trials: Trials) -> list[OrderedRun]:
    """Return the runs of a batch, each once, in the order in which they are executed."""
    unique = list({run.id: run for run in reversed(batch.runs)}.values())[::-1]
    if trials.order == "as-designed":
        return [OrderedRun(0, run) for run in unique]
    generator = random.Random(f"order {order_seed(batch)}")
    if trials.order == "random":
        return [OrderedRun(0, run) for run in _shuffled(unique, generator)]
    blocks: dict[int, list[Run]] = {}
    for run in unique:
        blocks.setdefault(run.number // trials.block, []).append(run)
    return [OrderedRun(block, run) for block in sorted(blocks) for run in _shuffled(blocks[block], generator)]


def _shuffled(runs: Iterable[Run], generator: random.Random) -> Sequence[Run]:
    """Return the runs sorted by random numbers: unlike `shuffle`, `random` gives the same numbers in every Python."""
    return [run for _, run in sorted(((generator.random(), run) for run in runs), key=lambda pair: pair[0])]


UNJUDGED = "nobody has judged it"
"""The reason why a trial without a verdict is not valid."""
NEXT = """
SELECT coalesce(max(position) + 1, 0)::BIGINT FROM trials JOIN executions USING (execution) WHERE batch = $batch
"""
STATE = "SELECT status, reason FROM executions WHERE execution = $execution"


class _State(NamedTuple):
    """The recorded state of an execution."""

    status: str
    reason: str | None


class Conduct:
    """The trials of one session."""

    def __init__(self, trials: Trials, supervisor: Supervisor, core: Core) -> None:
        self._core = core
        self._plan = core.plan
        self._store = core.store
        self._session = core.session
        self._supervisor = supervisor
        self._trials = trials
        self._order = ordered(core.plan.batch, trials)
        self._operator: str | None = None
        self._position = 0
        self._tries: dict[str, int] = {}
        self._ended = float("-inf")
        """The end of the last trial by the monotonic clock."""
        self._outcome = Outcome()

    def conduct(self, wanted: AbstractSet[str]) -> Outcome:
        """Execute these runs one after the other. Raises the errors of the runner, ConfigError and Missing."""
        turns = [turn for turn in self._order if turn.run.id in wanted]
        self._left = len(turns)
        self._done = 0
        try:
            self._position = _next_position(self._store, self._plan.batch.id)
            self._operator = self._supervisor.begin(self._left)
            for _, block in groupby(turns, key=lambda turn: turn.block):
                self._conduct_block(deque(block))
        except KeyboardInterrupt:
            self._outcome.interrupted = True
        return self._outcome

    def _conduct_block(self, pending: deque[OrderedRun]) -> None:
        """Execute a block; trials that are not valid are repeated at its end."""
        while pending and not self._outcome.interrupted and not self._core.is_enough():
            turn = pending.popleft()
            if not self._tried(turn):
                pending.append(turn)

    def _tried(self, turn: OrderedRun) -> bool:
        """Execute a trial, or leave it out; return False if it is to be repeated.

        If it cannot begin, for example because a robot is lost, the person decides. Raises Missing without a person.
        """
        while True:
            try:
                runner = self._core.runner()
                return self._try(turn.run, runner, *self._prepared(turn, runner))
            except Missing as error:
                execution = self._execution(turn.run)
                has_begun = bool(self._store.select(_State, STATE, execution=execution))
                decision = None if has_begun else self._supervisor.unready(str(error))
                if decision is None:
                    raise
                if decision is not Start.GO:
                    self._leave_out(turn.run, decision, interrupted=False)
                    return True

    def _execution(self, run: Run) -> str:
        """Return the id of the next execution of a run."""
        return commands.execution_id(self._session.id, run.id, self._tries.get(run.id, 0))

    def _prepared(self, turn: OrderedRun, runner: Runner) -> tuple[Trial, TrialRow]:
        """Return a trial as it is presented, and the row that is recorded with its execution. `runner` executes it."""
        run, trials, root = turn.run, self._trials, self._plan.project.root
        values = self._plan.batch.experiments[run.experiment].values
        placed = poses.of_run(self._plan, run, trials)
        files, printed = of_files(trials, root), of_commands(trials, root)
        trial = Trial(
            run.id,
            run.number,
            values,
            position=self._done + 1,
            total=self._done + self._left,
            block=turn.block,
            blocks=self._order[-1].block + 1,
            attempt=self._tries.get(run.id, 0),
            poses=placed,
            robots=self._robots(run, runner),
            facts=printed,
            wait_s=max(0.0, self._ended + trials.pause - time.monotonic()),
        )
        row = TrialRow(
            execution=self._execution(run),
            marked=datetime.now(UTC),
            valid=False,
            reason=UNJUDGED,
            operator=self._operator,
            block=turn.block,
            position=self._position,
            poses=poses.as_json(placed),
            arena=trials.arena,
            order_rule=trials.order,
            order_seed=order_seed(self._plan.batch),
            facts=json.dumps(printed) if printed else None,
            files=json.dumps(files) if files else None,
        )
        return trial, row

    def _robots(self, run: Run, runner: Runner) -> Mapping[int, str]:
        """Return the names of the robots that take part in a run, by place; nothing if the runner does not know them."""
        return runner.robot_names(members.places(self._plan.files(run))) if isinstance(runner, NamesRobots) else {}

    def _try(self, run: Run, runner: Runner, trial: Trial, row: TrialRow) -> bool:
        """Execute a trial unless the person decides otherwise, and record the verdict; return False if it is to be repeated."""
        with self._supervisor.attending(trial) as attendant:
            watched = WatchedRunner(runner, attendant, ends=self._trials.stop == "ends")
            followed = self._core.execute(run, trial.attempt, watched, _as_json(row))
        self._outcome.notes.update(dict.fromkeys(followed.notes))
        if watched.decision is not Start.GO:
            self._leave_out(run, watched.decision, interrupted=followed.interrupted)
            return True
        self._ended = time.monotonic()
        self._tries[run.id] = trial.attempt + 1
        recorded = self._store.select(_State, STATE, execution=row.execution)
        if recorded:
            self._position += 1
            self._done += 1
        if followed.interrupted or not recorded:
            self._outcome.interrupted = followed.interrupted
            return not watched.stopped  # the person stopped it before it began
        verdict = self._verdict(run, trial, _ended(recorded[0], watched), row._replace(stopped=watched.stopped))
        self._left -= verdict.valid
        if verdict.valid:  # only now it is compared with its siblings, because it did not count before
            now = context(self._plan, self._session.id, self._session.number)
            self._outcome.inconsistent |= find_inconsistent(self._store, self._session.paths, now)
        return verdict.valid

    def _leave_out(self, run: Run, decision: Start | None, *, interrupted: bool) -> None:
        """Note why a trial has not begun. Without a decision, the session was ended, or its code has changed."""
        self._outcome.interrupted = interrupted or decision is Start.ABORT
        if decision is Start.SKIP:
            self._outcome.skipped.add(run.id)
            self._left -= 1

    def _verdict(self, run: Run, trial: Trial, ended: Ended, row: TrialRow) -> Verdict:
        """Ask for the verdict on a trial, and record it; return it."""
        verdict = self._supervisor.verdict(trial, ended)
        self._record(row._replace(valid=verdict.valid, reason=verdict.reason, note=verdict.note))
        self._core.counter.ended(run.id, ended.status if verdict.valid else Status.INVALID)
        if not verdict.valid:
            self._core.counter.failed.discard(run.id)  # it is repeated
        return verdict

    def _record(self, row: TrialRow) -> None:
        """Add a verdict to the store. It is later than the row that was recorded with the execution."""
        now = context(self._plan, self._session.id, self._session.number)
        writer = self._store.writer(self._session.paths.segment, self._plan.batch.id)
        writer.records([row._replace(marked=datetime.now(UTC), lamport=now.lamport(1))])
        self._store.publish(writer)


def _ended(recorded: _State, runner: WatchedRunner) -> Ended:
    """Return how a trial has ended, from its record; there, a success is invalid as long as nobody has judged it."""
    if recorded.status == Status.INVALID:
        return Ended(Status.OK, None, runner.seconds, runner.stopped)
    return Ended(Status(recorded.status), recorded.reason, runner.seconds, runner.stopped)


def _next_position(store: Store, batch: str) -> int:
    """Return the position of the next trial in the order in which the trials of a batch are executed, from 0."""
    return store.values(int, NEXT, batch=batch)[0]


def _as_json(row: TrialRow) -> dict[str, JsonView]:
    """Return the columns of a row that is recorded with its execution; the recorder adds the others."""
    return {name: value for name, value in row._asdict().items() if name not in ("marked", "lamport")}
