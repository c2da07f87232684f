"""Execution of a plan, step by step: query → design → inputs → execute → record → analyse → deliver.

`sierra.execution.resolve_plan` turns a query into inputs; `run` continues from there and reads as that list. Each step turns
values into values and knows nothing about the other steps; their results are in the store. Everything is idempotent: a repeated
query executes only the runs without a successful execution.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING

from sierra.config import extensions
from sierra.errors import Missing
from sierra.execution import members, recover, session_records
from sierra.execution.observation import reusable_executions, stale_sessions
from sierra.execution.plan import Plan, context, session_step, versioned
from sierra.execution.reasons import FAILED
from sierra.execution.reuse import FileCheck, State, is_answered, states
from sierra.execution.run_options import RunOptions
from sierra.execution.sessions import Session
from sierra.execution.sum_up import of_session, unobserved_services, with_outcomes
from sierra.execution.summary import Summary
from sierra.store import index_builder
from sierra.store.store import Store
from sierra.util.lazy_logger import Log
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.execution.execute_missing import Executor
    from sierra.execution.observer import Observer
    from sierra.runners.base import Runner
    from sierra.store.row_types import SessionRow

log = Log(__name__)


def run(plan: Plan, store: Store, options: RunOptions) -> Summary:
    """Execute and record the runs without a successful execution; return a summary.

    When it is interrupted, it ends the runs, or leaves them running if they do not need this process. Finished runs are kept.
    """
    recover.finish_dead(store, options.observer)
    began = datetime.now(UTC)
    if is_answered(plan, store):
        return _reused(plan, store, options)
    from sierra import runners  # not needed if all runs are reused

    check_packages(plan)
    plan = versioned(plan)
    if session_step(plan.project):
        options = replace(options, slots=1)
    make = partial(runners.find(options.runner, plan.project.config.runners), options.slots)
    members.check_fleet(make(), options.runner, plan)
    session = Session(store.paths, None if make().stays else plan.project.config.store.place())
    try:
        executor, begun = _begin(plan, store, session, make, options, began)
        executor.answer()
        return _end(executor, begun)
    except Exception:
        session_records.withdraw(store, session)
        raise
    finally:
        session.close()


def _reused(plan: Plan, store: Store, options: RunOptions) -> Summary:
    """Return the summary of a plan whose runs all have a successful execution."""
    notes = (*unobserved_services(plan, store), *_member_notes(plan, store))
    summary = of_session(plan, store, len({run.id for run in plan.batch.runs}), only=options.only, notes=notes)
    return with_outcomes(plan, store, summary)


def _begin(
    plan: Plan, store: Store, session: Session, make: Callable[[], Runner], options: RunOptions, began: datetime
) -> tuple[Executor, SessionRow]:
    """Record a session before anything executes; return its executor, and its record without a result."""
    from sierra.execution.execute_missing import Executor
    from sierra.ingest.consistency import find_inconsistent

    session.take_number()
    log.info("query %s: batch %s on %s with %s", plan.text, plan.batch.id, options.runner, plan.engine.name)
    session_records.keep(plan, store, session)
    session_records.keep_variants(plan, store, session)
    seen = store.names()
    checked, recorded = session_records.keep_check(plan, store, session)
    _report(checked, recorded, store, session, options.observer)
    stays = make().stays
    slots = None if stays else options.slots
    begun = session_records.begun(plan, session, started=began, runner=options.runner, slots=slots)
    if stays:
        left_out = len(_unselected(plan, store, checked, options)) if options.only is not None else None
        session_records.prepare(plan, store, session, begun, left_out)
    inconsistent = find_inconsistent(store, session.paths, context(plan, session.id, session.number))
    executor = Executor(plan, store, session, make, options, checked, (seen, recorded))
    if executor.rules_changed:
        executor.fail(inconsistent)
    return executor, begun


def _report(checked: FileCheck, recorded: Mapping[str, State], store: Store, session: Session, observer: Observer) -> None:
    """Report the recorded executions that do not count, or count although source or programs differ."""
    known = stale_sessions.certain(checked.stale) if checked.unobserved else checked.stale
    if known and not all(state.succeeded for state in recorded.values()):
        observer.notice(stale_sessions.reason(known))
    if checked.unobserved:
        observer.notice(stale_sessions.unobserved_reason(len(checked.unobserved), checked.stale))
    if checked.reusable:
        observer.notice(reusable_executions.reason(store, session.id, len(checked.reusable)))


def _end(executor: Executor, begun: SessionRow) -> Summary:
    """Record the result of a session, unless it continues on a cluster; return the summary."""
    plan, store, session = executor.plan, executor.store, executor.session
    summary = replace(_sum_up(executor), sessions=(session.id,))
    log.info("%d runs: %d executed, %d failed, %d missing", summary.runs, summary.executed, summary.failed, summary.missing)
    if session.paths not in executor.left:
        session_records.close(plan, store, session, summary, begun)
        index_builder.keep_up(store.paths)
    return with_outcomes(plan, store, summary)


def _unselected(plan: Plan, store: Store, checked: FileCheck, options: RunOptions) -> set[str]:
    """Return the runs without a successful execution that the session leaves out."""
    only = options.only or frozenset()
    return {run for run, state in states(plan, store, checked).items() if not state.succeeded and run not in only}


def check_packages(plan: Plan) -> None:
    """Raise Missing if the runs need a program or Python packages that are not installed."""
    from sierra.provenance import required_packages

    plan.check_programs()
    if plan.batch.spec.robots is not None:  # their own Pythons execute the runs
        return
    if absent := required_packages.missing(plan.project.config, contained=plan.engine.name != "none"):
        raise Missing(
            f"runs need Python packages that are not installed ({', '.join(absent)}): {required_packages.remedy(absent)}"
        )


def _member_notes(plan: Plan, store: Store) -> Iterator[str]:
    """Yield what extensions note about the members of a batch's runs."""
    if plan.batch.spec.robots is not None:
        yield from itertools.chain(*extensions.called("member_notes", store, plan.batch.id))


def _sum_up(executor: Executor) -> Summary:
    """Return the summary of an execution, counted from the store's current state."""
    plan, store = executor.plan, executor.store
    recorded = states(plan, store, executor.checked)
    unsuccessful = {run: state for run, state in recorded.items() if not state.succeeded}
    missing = unsuccessful.keys()
    only = executor.only
    failed = missing & (executor.attempted | executor.failed | executor.given_up)
    failed = failed if only is None else failed & only
    reused = unobserved_services(plan, store) if len(recorded) > len(executor.attempted | missing) else ()
    given_up = len(executor.given_up & missing)
    twice = f"{counted(given_up, 'run')} failed twice in the same way, and only --retry executes them again"
    return of_session(
        plan,
        store,
        len(recorded),
        executed=executor.attempted,
        reexecuted=executor.reexecuted,
        awaited=executor.awaited - executor.attempted - missing,
        reevaluated=executor.reevaluated - executor.attempted,
        failed=failed,
        missing=missing - failed if failed else missing,
        tried={run for run, state in unsuccessful.items() if state.usefulness == FAILED} | failed,
        interrupted=executor.interrupted,
        detached=tuple(paths.root.name for paths in executor.left),
        notes=(*executor.notes, *([twice] if given_up else ()), *reused, *_member_notes(plan, store)),
        only=only,
    )
