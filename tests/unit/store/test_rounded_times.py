"""Times of runs that differ by rounding only are one time in statistics and figures, and stay as written in SQL."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sierra.store.rounded_times import PART
from tests import random_times
from tests.projects import CONFIG, SIMULATOR, make, quick, sql
from tests.random_times import shown


def summed(step: float, count: int) -> list[float]:
    return list(itertools.accumulate([step] * (count - 1), initial=0.0))


@pytest.mark.parametrize(
    "written",
    [
        lambda step, count: summed(step, count),
        lambda step, count: [float(np.float32(k * step)) for k in range(count)],
        lambda step, count: [k / (1 / step) for k in range(count)],
        lambda step, count: [float(f"{k * step:.5f}") for k in range(count)],
    ],
    ids=["running sum", "float32", "division", "five decimals"],
)
@pytest.mark.parametrize("step", [0.1, 0.01, 0.05, 1 / 3, 2.5])
def test_times_that_differ_by_rounding_are_one_time(written: Any, step: float) -> None:
    exact = [k * step for k in range(300)]
    first, second = shown(exact, written(step, 300))
    assert first == second
    assert len(set(first)) == 300
    assert all(len(repr(time)) <= len(repr(was)) for time, was in zip(first, exact, strict=True))


def test_times_apart_by_more_than_a_part_of_the_step_stay_apart() -> None:
    runs = [0.0, 1.0, 2.0], [0.0, 1.0 + 2 * PART, 2.0 - 2 * PART]
    assert shown(*runs) == list(runs)


def test_runs_of_a_single_time_have_no_step_and_stay_as_they_are() -> None:
    assert shown([12.5], [12.5000001]) == [[12.5], [12.5000001]]
    assert shown([0.3], [0.1 + 0.2]) == [[0.3], [0.3]]


test_no_two_times_of_a_run_become_one_and_none_moves_far = random_times.APART.tests()
test_shared_times_with_random_errors_of_rounding_become_one = random_times.TOGETHER.tests()


ADDS = SIMULATOR.replace(
    "for tick in range(5):",
    "for tick in (__import__('itertools').accumulate([0.1] * 9, initial=0.0) if seed % 2 else [k * 0.1 for k in range(10)]):",
).replace("tick,coverage", "time,coverage")


@pytest.mark.nightly
def test_runs_that_add_and_runs_that_multiply_share_their_times(tmp_path: Path) -> None:
    root = make(tmp_path / "p", simulator=ADDS)
    assert quick(root, "run", "population_size=1,2", "--runs", "6").returncode == 0
    done = quick(root, "stats", "swarm", "coverage", "--times", "own", "--json")
    rows = json.loads(done.stdout)
    assert {row["n"] for row in rows} == {6}
    assert sorted({row["t"] for row in rows}) == pytest.approx([k * 0.1 for k in range(10)])
    assert "fewer runs" not in done.stderr
    assert len(sql(root, "SELECT DISTINCT time FROM swarm")) > 10
    [caption] = [path.read_text() for path in root.glob("figures/*/swarm_coverage_timeseries.txt")]
    assert "n = 6." in caption


FIGURE = """\
[scenarios.a]
[scenarios.b]
[figures.one]
kind = "timeseries"
table = "swarm"
column = "coverage"
where = "agent = 0"
"""


@pytest.mark.integration
def test_rounded_times_are_shared_by_runs_of_two_experiments_and_of_several_rows_at_one_time(tmp_path: Path) -> None:
    agents = ADDS.replace("        print(tick,", "        for agent in (0, 1):\n            print(tick,")
    agents = agents.replace("sep=", "agent, sep=").replace("time,coverage", "time,coverage,agent")
    config = CONFIG + FIGURE
    root = make(tmp_path / "p", config, simulator=agents)
    done = quick(root, "run", "scenario=a,b", "population_size=1", "--runs", "6")
    assert done.returncode == 0, done.stderr
    [caption] = [path.read_text() for path in root.glob("figures/*/one.txt")]
    assert "n = 6" in caption
    assert "fewer runs" not in caption
