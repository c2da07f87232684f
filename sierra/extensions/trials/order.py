"""Order in which supervised runs are executed: shuffled in blocks, because batteries, floors and operators drift.

A block has the same number of runs of each experiment, so that a drift is spread over all experiments alike (a randomised
complete block design). The order follows from the batch's id: on every machine, and if a batch is continued another day,
it is the same.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from sierra.extensions.trials.table import Trials
from sierra.model import Batch, Run


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
