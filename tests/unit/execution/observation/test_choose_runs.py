"""Which runs are observed: the first of a session and of each experiment, and a sample that is the same on every machine."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sierra.execution.observation.choose_runs import ALWAYS, PART, SAMPLED, affordable, is_sampled
from tests import projects

AMPLE = 1e9


def batch_of(tmp_path: Path, settings: str) -> tuple[list[str], list[str], set[str], str]:
    """Execute 2 × 40 runs one after the other; return the runs, the first of each experiment, those observed, the batch."""
    config = projects.CONFIG.replace("python3 sim.py {input}", "touch out.txt").replace("runs = 2", f"runs = 40\n{settings}")
    root = projects.make(tmp_path / "project", config)
    done = projects.quick(root, "run", "population_size=1,2", "-j", "1", "--no-figures")
    assert done.returncode == 0, done.stderr
    executed = sql(root, "SELECT run, batch, ordinal FROM executions JOIN batch_runs USING (batch, run) ORDER BY lamport")
    seen = sql(root, "SELECT run FROM observations JOIN executions USING (execution)")
    begun: dict[int, str] = {}
    for one in executed:
        begun.setdefault(one["ordinal"], one["run"])
    return [one["run"] for one in executed], list(begun.values()), {one["run"] for one in seen}, executed[0]["batch"]


def sql(root: Path, statement: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(projects.quick(root, "sql", "--format", "json", statement).stdout)
    return found


def test_the_sample_has_the_expected_size_and_differs_between_batches() -> None:
    one, other = ({run for run in map(str, range(10_000)) if is_sampled(batch, run)} for batch in ("a", "b"))
    assert 0.9 * SAMPLED * 10_000 < len(one) < 1.1 * SAMPLED * 10_000
    assert one != other
    assert is_sampled("518b", "16") is False


@pytest.mark.integration
def test_the_first_run_of_each_experiment_and_the_whole_sample_are_observed_if_the_budget_is_ample(
    tmp_path: Path, require: Callable[..., str]
) -> None:
    require("strace")
    runs, first, seen, batch = batch_of(tmp_path, f"observe_budget = {AMPLE}")
    assert seen == {*first, *(run for run in runs if is_sampled(batch, run))}
    assert len(seen) > 2


@pytest.mark.nightly
def test_without_a_budget_the_first_run_of_each_experiment_is_observed(tmp_path: Path, require: Callable[..., str]) -> None:
    require("strace")
    _, first, seen, _ = batch_of(tmp_path, "observe_budget = 0")
    assert seen == set(first)


def test_a_few_experiments_are_observed_whatever_it_takes() -> None:
    assert affordable("a", range(ALWAYS), 10) == {}
    assert len(affordable("a", range(100), 100)) == 100 - ALWAYS


@pytest.mark.parametrize(
    ("experiments", "runs", "cost"), [(100, 100, 0.4), (100, 1000, 0.4), (40, 40, 0.05), (1000, 1000, 0.01)]
)
def test_as_many_experiments_are_observed_as_fit_into_the_runs_time(experiments: int, runs: int, cost: float) -> None:
    """`cost` is that of an observation, in units of the mean time of a run."""
    dear = sum(times < cost for times in affordable("a", range(experiments), runs).values())
    observed = experiments - dear
    assert observed == experiments or observed == max(ALWAYS, int(PART * runs / cost))


def test_the_batch_decides_which_experiments_come_first() -> None:
    """The order does not depend on which experiments a worker executes, or on their order."""
    one, other = (sorted(times, key=times.__getitem__) for times in (affordable(batch, range(50), 50) for batch in ("a", "b")))
    assert one != other
    assert affordable("a", range(49, -1, -1), 50) == affordable("a", range(50), 50)
    some = affordable("a", one[:20], 20)
    assert all(some[before] <= some[after] for before, after in itertools.pairwise(o for o in one if o in some))


def test_a_negative_budget_is_an_error(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("runs = 2", "observe_budget = -1"))
    done = projects.quick(root, "run", "population_size=1")
    assert done.returncode == 2
    assert "observe_budget" in done.stderr
