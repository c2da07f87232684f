"""Determinism probe: execute one run of a batch twice before the others, to see if it gives the same bytes.

The first execution belongs to the batch. The second one is a replay of it and is recorded as a replay.
"""

from __future__ import annotations

from dataclasses import replace as replaced

from sierra.errors import Missing
from sierra.execution import execute
from sierra.execution.observer import Observer
from sierra.execution.plan import Plan
from sierra.execution.reuse import states
from sierra.execution.run_options import RunOptions
from sierra.replay import replay
from sierra.replay.compare_values import Verdict
from sierra.replay.options import ReplayOptions
from sierra.replay.same_files import GPU_ADVICE
from sierra.replay.verdicts import Compared
from sierra.store.store import Store
from sierra.util.hashing import short


class _Progress(Observer):
    """Passes on the progress alone: the notes of the replay are in the result of the probe."""

    def __init__(self, observer: Observer) -> None:
        self.progress = observer.progress  # type: ignore[method-assign]


def probe(plan: Plan, store: Store, options: RunOptions) -> tuple[str, ...]:
    """Execute the first run without a successful execution twice; return the result as notes.

    Returns nothing if there is no such run, or if it fails. Raises KeyboardInterrupt when it is interrupted.
    """
    known = states(plan, store)
    wanted = (run.id for run in plan.batch.runs if options.only is None or run.id in options.only)
    run = next((run for run in wanted if not known[run].succeeded), None)
    if run is None:
        return ()
    first = execute.run(plan, store, replaced(options, slots=1, only={run}, detach=False))
    if first.interrupted:
        raise KeyboardInterrupt
    if not first.executed or not states(plan, store)[run].succeeded:
        return ()
    try:
        answer = replay.replay(
            plan.project, store, run, ReplayOptions(slots=1, runner=options.runner), _Progress(options.observer)
        )
    except Missing as error:
        return (f"run {short(run)} could not be executed a second time: {error}",)
    if answer.interrupted:
        raise KeyboardInterrupt
    return (*(_as_note(compared) for compared in answer.runs), *((GPU_ADVICE,) if answer.used_gpu else ()))


def _as_note(run: Compared) -> str:
    executed = f"run {short(run.taken.run)} was executed twice:"
    if run.verdict is Verdict.IDENTICAL:
        return f"{executed} both executions wrote the same bytes"
    worst = next((path, one) for path, one in run.outputs.items() if one.verdict is run.verdict)
    message = f"{executed} the second execution is {run.verdict}: {f'{worst[0]}: ' if worst[0] else ''}{worst[1].reason}"
    return message if run.verdict.fine else f"{message}; runs with the same seed are not deterministic"
