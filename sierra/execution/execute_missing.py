"""Executor of a plan: it executes the missing runs, also while other sessions execute the same ones."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from enum import StrEnum
from pathlib import Path

from sierra.errors import Missing
from sierra.execution import expected_durations, recover, sessions
from sierra.execution.expected_durations import Order
from sierra.execution.follow import Followed, attach
from sierra.execution.observer import ProgressCounter
from sierra.execution.plan import Plan, context, session_step
from sierra.execution.reuse import FileCheck, State, failed_twice, rules_changed, states
from sierra.execution.run_jobs import JobService, Setup
from sierra.execution.run_options import RunOptions
from sierra.execution.session_steps import Core, SessionStep
from sierra.execution.sessions import Session
from sierra.ingest import shared_use
from sierra.ingest.changed_files import Doubt
from sierra.ingest.consistency import find_inconsistent
from sierra.ingest.rejudge import reevaluate
from sierra.model import Batch, Run
from sierra.provenance.dependency_model import Programs
from sierra.runners.base import Runner
from sierra.store.layout import SessionPaths
from sierra.store.store import Store
from sierra.templates.base import Files
from sierra.util.hashing import short
from sierra.util.json_types import JsonView
from sierra.util.signals import noted
from sierra.util.text import counted, few

JOIN_S = 0.2
ENDING_S = 3.0
"""The seconds in which another session that has executed runs by a step must have ended."""
SECOND = (
    "{} is executed again and observed, because an observed run wrote and read a file elsewhere, or used a port: do others?"
)
FAILED = "{} is executed again and observed, because all observed runs of its experiment have failed: which files does it use?"
SHOWN = 2
"""Maximum number of named runs that are executed again."""
NOTED = 4
"""Maximum number of reported reasons why runs cannot be evaluated again."""


class RunState(StrEnum):
    """State of a run in this session. Runs without a state are untouched; the counter has the results of executed runs."""

    AWAITED = "awaited"
    """Another session was executing it, or had submitted it."""
    CLAIMED = "claimed"
    """This session evaluates its recorded executions again or executes it."""
    SKIPPED = "skipped"
    """A person has left it out of the supervised trials, or the runner has left it out."""
    REEVALUATED = "reevaluated"
    """Its recorded execution was evaluated again by changed rules."""
    REJECTED = "rejected"
    """It was evaluated again, and failed."""
    FAILED = "failed"
    """It failed in this session or in another one, and is not executed again."""
    GIVEN_UP = "given up"
    """It failed twice in the same way before, and is not executed again."""


class Executor:
    """State of one session while it executes."""

    def __init__(
        self,
        plan: Plan,
        store: Store,
        session: Session,
        runner: Callable[[], Runner],
        options: RunOptions,
        checked: FileCheck | None = None,
        recorded: tuple[AbstractSet[str], dict[str, State]] | None = None,
    ) -> None:
        """`checked`: the comparison of the files that recorded executions used, as the session has recorded it.

        `recorded`: the state of each run when the store had segments with these names.
        """
        self.plan = plan
        self.checked = checked
        self.store = store
        self.session = session
        self.interrupted = False
        self.only = options.only
        """The runs that the session is limited to; None for all."""
        self.notes: tuple[str, ...] = ()
        self.left: list[SessionPaths] = []
        """Sessions on a cluster that continue without this process."""
        self.rules_changed = rules_changed(plan, store)
        """True if the last session of the batch used other rules."""
        self._runner = runner
        self._options = options
        self._context = context(plan, session.id, session.number)
        total = len(self._selected({run.id for run in plan.batch.runs}))
        self._counter = ProgressCounter(options.observer, total, leave=True if options.detach else None)
        self._service: JobService | None = None
        self._recorded = recorded
        self._before: dict[str, int] | None = None
        """Number of executions at the beginning, of each run that has some and lacks a successful one."""
        self._run_states: dict[str, RunState] = {}
        self._has_failed = False  # of 100,000 runs, `failed` would look at all
        self._file_change: Doubt | None = None
        self._step = session_step(plan.project)

    @property
    def attempted(self) -> AbstractSet[str]:
        """Return the runs that this session has executed to their end."""
        return self._counter.statuses.keys()

    @property
    def reexecuted(self) -> AbstractSet[str]:
        """Return those of the attempted runs that had been executed before."""
        return self.attempted & (self._before or {}).keys()

    @property
    def failed(self) -> AbstractSet[str]:
        """Return the runs that have failed since the session began, or that are inconsistent with others."""
        return self._in(RunState.FAILED, RunState.REJECTED)

    @property
    def given_up(self) -> AbstractSet[str]:
        return self._in(RunState.GIVEN_UP)

    @property
    def awaited(self) -> AbstractSet[str]:
        return self._in(RunState.AWAITED)

    @property
    def reevaluated(self) -> AbstractSet[str]:
        """Return the runs that were evaluated again, with any result."""
        return self._in(RunState.REEVALUATED, RunState.REJECTED)

    def _in(self, *states: RunState) -> set[str]:
        return {run for run, state in self._run_states.items() if state in states}

    def _set(self, runs: Iterable[str], state: RunState) -> None:
        self._run_states.update(dict.fromkeys(runs, state))

    def fail(self, runs: AbstractSet[str]) -> None:
        """Note that runs have failed, in this session or in another one."""
        rejected = runs & self.reevaluated
        failed = runs - rejected - self.given_up
        self._set(rejected, RunState.REJECTED)
        self._set(failed, RunState.FAILED)
        self._has_failed |= bool(rejected or failed)

    def _selected(self, runs: set[str]) -> set[str]:
        """Return those of the runs that `only` does not leave out."""
        return runs if self.only is None else runs & self.only

    def answer(self) -> None:
        """Execute missing runs, wait for runs that other sessions execute, and take over runs that these leave.

        At the end, observe one more run of an experiment if nobody knows otherwise whether its runs share a file.
        """
        while not (self.interrupted or self.left):
            recorded = self.store.names()
            wanted = self._wanted()
            if not wanted or self._is_enough():
                break
            claimed = self.session.claim(wanted)
            if self.store.names() != recorded:
                continue  # claimed runs may have been executed since the store was read
            self._set((wanted - claimed) - self._run_states.keys(), RunState.AWAITED)
            if not claimed:
                if self._wait(wanted):
                    continue
                break
            rest = self._reevaluate(claimed)
            if len(rest) < len(claimed):
                continue
            inconsistent = self._execute_claimed(rest)
            unfinished = self._in(RunState.CLAIMED) - self.attempted
            if not self.left and rest <= unfinished and not self.interrupted:
                raise Missing(f"{self.session.paths.root}: the worker ended without reporting a result for any run")
            if len(rest) == len(wanted) and not unfinished and not inconsistent:
                break
        if not self.left:
            self._compare()

    def _compare(self) -> None:
        """Execute runs again, observed, if this tells whether runs share a file; those that most likely do have failed."""
        if (self.failed or self._counter.failed) and (unseen := shared_use.unseen(self.store, self._context)):
            self._observe(unseen, FAILED)
        undecided = shared_use.undecided(self.store, self._context)
        if undecided:
            self._observe(undecided, SECOND)
        if undecided or self.attempted:
            self.fail(shared_use.find(self.store, self.session.paths, self._context, final=True))

    def _observe(self, runs: set[str], why: str) -> None:
        """Execute runs again, observed, if that is possible here and now."""
        runner = self._runner()
        if self.interrupted or runner.remote or runner.stays:
            return
        self._options.observer.notice(why.format(few(["run " + short(run) for run in sorted(runs)], SHOWN)))
        service = self._prepared(self._code(), stays=False)
        work = (runner, self._context, self._inputs(runs), len(runs), self.plan.programs, self._counter)
        followed = service.execute_jobs(*work, doubt=self._find_change, attempt=1, observed=True)
        self.notes += tuple(note for note in followed.notes if note not in self.notes)
        self.interrupted = followed.interrupted
        self.fail(followed.inconsistent)

    def _wanted(self) -> set[str]:
        """Return the runs without a successful execution that no session has tried since this one began."""
        now = self._recorded_states()
        wanted = {run for run, state in now.items() if not state.succeeded}
        if self._before is None:
            self._before = {run: now[run].executions for run in wanted if now[run].executions}
            self._set(() if self._options.retry else failed_twice(self.plan, self.store, now), RunState.GIVEN_UP)
            self._counter.reused = self._counter.total - len(self._selected(wanted) - self.given_up)
        self.fail({run for run in wanted if now[run].executions > self._before.get(run, 0)})
        return self._selected(wanted) - self.failed - self.given_up - self.attempted - self._in(RunState.SKIPPED)

    def _recorded_states(self) -> dict[str, State]:
        """Return the recorded state of each run: at first as it was, if nothing has been recorded since."""
        known, self._recorded = self._recorded, None
        if known is not None and self.store.names() == known[0]:
            return known[1]
        return states(self.plan, self.store, self.checked)

    def _reevaluate(self, claimed: set[str]) -> set[str]:
        """Evaluate the recorded executions of these runs again, once each, if rules have changed.

        Returns the runs that must be executed.
        """
        fresh = claimed & (self._before or {}).keys() - self._in(RunState.CLAIMED)
        self._set(claimed, RunState.CLAIMED)
        if not fresh:
            return claimed
        self._context.save(self.session.paths.context)
        evaluated = reevaluate(self.store, self.session.paths, self._context, fresh, mismatched=self.rules_changed)
        for lack, count in Counter(evaluated.unread.values()).most_common(NOTED):
            self._options.observer.notice(
                f"executing {counted(count, 'run')} again; their records cannot be evaluated by the changed rules: {lack}"
            )
        if evaluated.judged:
            find_inconsistent(self.store, self.session.paths, self._context)
        self._set(evaluated.judged, RunState.REEVALUATED)
        self._counter.reused += len(evaluated.judged)
        self.notes += tuple(evaluated.notes)
        return claimed - evaluated.judged

    def _execute_claimed(self, wanted: AbstractSet[str]) -> set[str]:
        """Execute these runs; return those with an execution, new or old, that is inconsistent with other executions."""
        runner, plan = self._runner(), self.plan
        root, programs = self._snapshot() if runner.remote else (self._code(), plan.programs)
        service = self._prepared(root, stays=runner.stays)
        if self._step is not None:
            return self._by_step(self._step, wanted, service, programs)
        order, times = Order(plan.batch, {}), None
        if runner.stays:
            order, times = expected_durations.expected(plan, self.store, wanted, runner=self._options.runner)
        elif len(wanted) > (self._options.slots or 1):
            order = expected_durations.longest_first(plan, self.store, wanted)
        self._counter.expect(order.by_run(wanted))
        work = (runner, self._context, self._inputs(wanted, order.batch), len(wanted), programs, self._counter)
        followed = service.execute_jobs(
            *work,
            times=times,
            detach=self._options.detach,
            # other hosts execute a copy of the code, and a cluster's nodes check the programs
            doubt=self._find_change if not runner.remote else lambda: None,
            enough=self._is_enough,
            experiments={run.experiment for run in plan.batch.runs if run.id in wanted},
        )
        self.fail(self._counter.failed)
        self._set(followed.left_out, RunState.SKIPPED)
        self.notes += followed.notes
        self.left += [self.session.paths] if followed.left else []
        cancelled = self.session.paths.cancelled.exists() and not self._is_enough()
        self.interrupted = cancelled or followed.interrupted
        return followed.inconsistent

    def _by_step(self, step: SessionStep, wanted: AbstractSet[str], service: JobService, programs: Programs) -> set[str]:
        """Let a step execute these runs; return those with an inconsistent execution."""

        def execute(run: Run, attempt: int, runner: Runner, trial: Mapping[str, JsonView]) -> Followed:
            now, runs = replace(self._context, trial=trial), self._inputs({run.id})
            doubt, enough = self._find_change, self._is_enough
            return service.execute_jobs(
                runner, now, runs, 1, programs, self._counter, doubt=doubt, enough=enough, attempt=attempt
            )

        core = Core(self.plan, self.store, self.session, self._counter, self._runner, execute, self._is_enough)
        outcome = step.execute(wanted, core)
        self.fail(self._counter.failed)
        self.notes += tuple(outcome.notes)
        self._set(outcome.skipped, RunState.SKIPPED)
        self.interrupted = outcome.interrupted
        return outcome.inconsistent

    def _prepared(self, root: Path, *, stays: bool) -> JobService:
        """Return the service that executes the runs; its isolation is prepared at the first call."""
        if self._service is None:
            plan = self.plan
            setup = Setup(plan.project, plan.batch.spec, plan.engine, plan.image, plan.limits, root, plan.environment)
            self._service = JobService(setup, self.store, self.session, stays=stays)
            self.notes += self._service.isolation.notes
        return self._service

    def _find_change(self) -> Doubt | None:
        """Return the reason why results do not belong to the plan (files have changed, even if only for a while); else None."""
        if self._service is not None and (self._file_change is None or self._file_change.files is not None):
            self._file_change = self._service.doubt(self.plan.seen) or self._file_change
        return self._file_change

    def _is_enough(self) -> bool:
        """Check whether to execute no more runs. Runs go on while none is known to have used the files that have changed."""
        if self._counter.doubted or (self._file_change is not None and self._file_change.files is None):
            return True
        return self._options.fail_fast and (self._has_failed or bool(self._counter.failed))

    def _inputs(self, wanted: AbstractSet[str], batch: Batch | None = None) -> Iterator[tuple[Run, Files]]:
        """Yield these runs with their input files, each run once, in the order of this batch; default: that of the plan."""
        plan = self.plan
        unique = len(plan.batch.runs) == self._counter.total
        sent: set[str] = set()
        for run, files in plan.inputs.files(batch or plan.batch, lambda run: run.id in wanted):
            if unique or run.id not in sent:
                sent.update(() if unique else (run.id,))
                yield run, files

    def _code(self) -> Path:
        """Return the folder of the code that is executed."""
        if self.plan.checkout is None:
            return self.plan.project.root
        root = self.session.paths.source
        if not root.exists():
            self.plan.checkout.make(root)
        return root

    def _snapshot(self) -> tuple[Path, Programs]:
        """Return a folder with a copy of the current code, and the programs in it.

        The project may change while runs wait for a node. Files of the source have their recorded content. Raises Missing if
        other files or programs changed during the copy.
        """
        plan = self.plan
        checkout = plan.checkout or plan.snapshot(self.store.blob)
        root = self.session.paths.source
        is_new = not root.exists()
        if is_new:
            checkout.make(root)
        programs = checkout.programs_in(root)
        meanwhile = "while they were being copied for other hosts"
        if plan.checkout is None and plan.seen.changed_source() is None and (doubt := plan.seen.doubt(meanwhile)):
            raise Missing(f"{doubt}; run the command again")
        if programs.id != plan.programs.id:
            raise Missing(f"programs have changed {meanwhile}: {few(plan.programs.unlike(programs), 3)}; run the command again")
        if is_new and (left_out := checkout.left_out()):  # reported last: the callback may write to a file of the project
            what = "nodes get only those that the command, a variable or a template names"
            self._options.observer.notice(f"git ignores {left_out} in the project: {what}")
        return root, programs

    def _wait(self, wanted: AbstractSet[str]) -> bool:
        """Wait until one of the sessions that execute these runs ends or records something; return False to stop waiting.

        If such a session is on a cluster and no process follows it, follow it here.
        """
        session = self._adopted(wanted)
        if session is None and self._options.detach:
            self._options.observer.notice(
                f"other processes already execute {len(wanted)} runs; this command does not wait for them"
            )
            return False
        session = session or self._until_free(wanted)
        if session is not None:
            self._join(session, wanted)
        return True

    def _until_free(self, wanted: AbstractSet[str]) -> Session | None:
        """Wait until other sessions free or record some of these runs.

        Returns a session on a cluster that can be taken over because its follower has died; otherwise None. Raises Missing
        instead of waiting for runs of a step, because a person may decide how long they take.
        """
        known = self.store.names()
        give_up = time.monotonic() + (ENDING_S if self._step else math.inf)
        with noted() as signals:
            while not signals and sessions.others(self.session.store, self.session.id) & wanted:
                if self._step and time.monotonic() > give_up:
                    raise Missing(
                        f"{self._holders(wanted)} executes these {self._step.runs}; stop it, or wait until it has ended"
                    )
                self._counter.report(0, elsewhere=len(wanted))
                time.sleep(JOIN_S)
                recover.finish_dead(self.store, self._options.observer)
                if self.store.names() != known:
                    break
                if (session := self._adopted(wanted)) is not None:
                    return session
        self.interrupted = bool(signals)
        return None

    def _holders(self, wanted: AbstractSet[str]) -> str:
        """Return the processes that execute these runs, in words."""
        holders = [paths for paths in sessions.all_of(self.session.store) if sessions.claims(paths) & wanted]
        return few([f"{sessions.holder(paths)} (session {paths.root.name})" for paths in holders], NOTED) or "another session"

    def _adopted(self, wanted: AbstractSet[str]) -> Session | None:
        """Take over a session on a cluster that has claimed some of these runs and that no process follows.

        Returns the session, or None.
        """
        store = self.session.store
        submitted = (paths for paths in sessions.submitted(store) if sessions.claims(paths) & wanted)
        return next(filter(None, (Session.adopted(store, paths) for paths in submitted)), None)

    def _join(self, session: Session, wanted: AbstractSet[str]) -> None:
        """Follow runs that were submitted before."""
        mine = sessions.claims(session.paths) & wanted
        self._options.observer.notice(f"following {counted(len(mine), 'run')} submitted before (session {session.id})")
        attached = attach(self.store, session, _Joined(self._counter, mine), detach=self._options.detach)
        self.notes += attached.notes
        self.left += [session.paths] if attached.left else []
        self.interrupted = attached.interrupted


class _Joined(ProgressCounter):
    """The counter of another session that is followed here: it reports this session's progress, and the runs to come."""

    def __init__(self, own: ProgressCounter, runs: set[str]) -> None:
        super().__init__(own.observer, len(runs), leave=own.decision)
        self._own = own
        self._runs = runs

    def report(self, running: int, queued: int = 0, waits: str = "", elsewhere: int = 0) -> None:
        self._own.report(running, queued, waits, elsewhere=len(self._runs - self.statuses.keys()))
