"""The order of supervised runs: blocks with the same number of runs of each experiment, shuffled by the batch's id."""

from __future__ import annotations

from collections import Counter

import pytest

from sierra.extensions.trials.conduct import OrderedRun, ordered
from sierra.extensions.trials.table import Trials
from sierra.model import Batch, Experiment, Run, RunSpec


def batch(experiments: int, runs: int, first: str = "0") -> Batch:
    """Return a batch whose id begins with `first`."""

    def run(experiment: int, number: int) -> Run:
        return Run(f"{experiment}-{number}", experiment, number, seed=7, names=("input.xml",), digests=bytes(32))

    made = (Experiment(f"{at}", at, {"size": at}, tuple(run(at, n) for n in range(runs))) for at in range(experiments))
    return Batch(first.ljust(64, "0"), (), tuple(made), RunSpec("command", (), {}, None), "")


def names(turns: list[OrderedRun]) -> list[str]:
    return [turn.run.id for turn in turns]


@pytest.mark.parametrize("block", [1, 2, 5])
def test_each_block_has_the_same_number_of_runs_of_each_experiment(block: int) -> None:
    turns = ordered(batch(4, 5), Trials(block=block))
    assert [turn.block for turn in turns] == sorted(turn.block for turn in turns)
    for number in {turn.block for turn in turns}:
        counts = Counter(turn.run.experiment for turn in turns if turn.block == number)
        assert set(counts.values()) == {min(block, 5 - number * block)}
        assert len(counts) == 4
    assert sorted(names(turns)) == sorted(f"{at}-{n}" for at in range(4) for n in range(5))


def test_the_order_follows_from_the_batch_alone() -> None:
    assert names(ordered(batch(2, 3), Trials())) == names(ordered(batch(2, 3), Trials()))
    assert names(ordered(batch(3, 6), Trials())) != names(ordered(batch(3, 6, "1"), Trials()))
    golden = ["1-0", "0-0", "0-1", "1-1", "1-2", "0-2"]  # another order would mix up batches that were begun before
    assert names(ordered(batch(2, 3), Trials())) == golden


def test_every_place_in_a_block_is_equally_likely() -> None:
    first = Counter(ordered(batch(4, 1, f"{number:08x}"), Trials())[0].run.experiment for number in range(800))
    assert all(150 < count < 250 for count in first.values()), "four standard deviations are 49"


def test_other_orders_have_one_block() -> None:
    designed = ordered(batch(2, 3), Trials(order="as-designed"))
    assert names(designed) == ["0-0", "0-1", "0-2", "1-0", "1-1", "1-2"]
    shuffled = ordered(batch(4, 8), Trials(order="random"))
    assert {turn.block for turn in (*designed, *shuffled)} == {0}
    assert len({turn.run.experiment for turn in shuffled[:8]}) > 1
