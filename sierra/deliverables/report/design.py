"""The section about the design: experiments, runs, seeds, and how the runs ended."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from sierra.deliverables.paper_tables import plain
from sierra.deliverables.report.batch_state import STATES, BatchState
from sierra.deliverables.report.parts import Section, details, note, sql, table
from sierra.util.html_elements import Markup, element, joined
from sierra.util.text import counted

SEEDS = """
SELECT number, min(seed) AS seed, count(DISTINCT seed) AS seeds FROM batch_runs WHERE batch = $b GROUP BY number ORDER BY number
"""
MEANINGS = {
    "ok": "succeeded, and counts in all numbers",
    "failed": "the program ended with an error, or its outputs were not as declared",
    "timeout": "cut off at the time limit",
    "memory": "cut off at the memory limit",
    "cpu": "cut off at the limit of CPU time",
    "output": "cut off at the limit of its output",
    "mismatch": "its image, program or input was not the planned one",
    "stopped": "stopped by the operator",
    "interrupted": "cut off before its end",
    "invalid": "declared invalid by a person",
    "not executed": "has no execution yet",
    "outdated": "executed, but does not count: code, programs or rules have changed since",
}
"""The meanings of the states of runs."""
ACCEPTED_END = "no success, but a result: its rows are in tables of their own, and count in no other number"
MOST = 1000
"""The largest number of experiments that are listed."""


class _Seed(NamedTuple):
    number: int
    seed: int
    seeds: int


def section(state: BatchState) -> Section:
    """Return the section about experiments, runs and seeds."""
    row = state.shown.row
    text = f"{counted(row.experiments, 'experiment')}, {counted(row.runs, 'run')}; base seed {row.base_seed}."
    return Section("design", "Design", joined((element("p", text), *_experiments(state), *_seeds(state))))


def _experiments(state: BatchState) -> Iterator[Markup]:
    experiments, axes = state.shown.experiments, state.shown.row.axes
    states = [name for name in dict.fromkeys((*MEANINGS, *state.counts)) if state.counts.get(name)]
    values = [plain([experiment.values.get(axis, "") for experiment in experiments]) for axis in axes]
    rows: list[Sequence[str | int]] = []
    for index, experiment in enumerate(experiments[:MOST]):
        counts = [state.states.get(experiment.ordinal, {}).get(name, 0) for name in states]
        rows.append((*([str(column[index]) for column in values] or [f"{experiment.ordinal}"]), experiment.runs, *counts))
    first = len(axes) or 1
    numbers = range(first, first + 1 + len(states))
    yield table((*(axes or ["experiment"]), "runs", *states), rows, "Runs of each experiment by their state", tuple(numbers))
    if len(experiments) > MOST:
        yield note(f"The first {MOST:,} of {len(experiments):,} experiments are listed.")
    meant = "; ".join(f"{name}: {MEANINGS.get(name, ACCEPTED_END)}" for name in states)
    yield note(f"States: {meant}.")
    yield sql(STATES, state.id)


def _seeds(state: BatchState) -> Iterator[Markup]:
    rows = state.store.select(_Seed, SEEDS, b=state.id)
    if not rows:
        return
    if all(row.seeds == 1 for row in rows):
        text = "Run i has the same seed in every experiment, so runs with the same number can be compared as pairs."
        shown = [f"{row.number}: {row.seed}" for row in rows[:MOST]]
        more = f" … and {len(rows) - MOST:,} more" if len(rows) > MOST else ""
        content = element("p", ", ".join(shown) + more, class_="seeds")
    else:
        text, content = "Runs with the same number have different seeds in different experiments.", None
    yield details("Seeds", element("p", text), content, sql(SEEDS, state.id))
