"""The choice of runs for a limited time, from their recorded durations.

The first choice is the shortest run of each experiment that a claim rests on, claim by claim in turn, then that of each other
experiment. The rest of the time is filled with the other runs, in the order of their numbers. With several slots, as many runs
execute at the same time; the sum of the durations of the chosen runs is at most the budget times the slots.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, zip_longest

from sierra.errors import UsageError
from sierra.execution.progress_display import duration
from sierra.packages.reproduction.planned import RecordedRun


def choose(runs: Sequence[RecordedRun], claims: Mapping[str, Sequence[str]], budget: float, slots: int) -> set[RecordedRun]:
    """Return the runs to execute within `budget` seconds on `slots` slots. `claims`: the batches of each claim.

    Raises UsageError if there is no time for any run.
    """
    chosen: set[RecordedRun] = set()
    left = budget * slots
    for run in _ordered(runs, claims):
        if run not in chosen and run.seconds <= min(left, budget):
            chosen.add(run)
            left -= run.seconds
    if runs and not chosen:
        least = min(run.seconds for run in runs)
        raise UsageError(f"--budget: the shortest run took {duration(least)}, more than {duration(budget)}")
    return chosen


def _ordered(runs: Sequence[RecordedRun], claims: Mapping[str, Sequence[str]]) -> Iterator[RecordedRun]:
    """Yield all runs in the order in which they are chosen; some are repeated."""
    shortest: dict[tuple[str, int], RecordedRun] = {}
    for run in sorted(runs, key=lambda run: (run.seconds, run.number)):
        shortest.setdefault((run.batch, run.ordinal), run)
    each = ([run for run in shortest.values() if run.batch in batches] for batches in claims.values())
    yield from _in_turn(each)
    yield from shortest.values()
    yield from sorted(runs, key=lambda run: (run.number, run.seconds))


def _in_turn(lists: Iterable[Sequence[RecordedRun]]) -> Iterator[RecordedRun]:
    return (run for run in chain.from_iterable(zip_longest(*lists)) if run is not None)


def untouched(runs: Sequence[RecordedRun], chosen: set[RecordedRun], batches: Sequence[str]) -> int:
    """Return the number of experiments of these batches without any chosen run."""
    return len(
        {(run.batch, run.ordinal) for run in runs if run.batch in batches} - {(run.batch, run.ordinal) for run in chosen}
    )
