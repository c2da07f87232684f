"""Censored times: curves, medians and restricted means equal those of SciPy and of published data, and no run is dropped."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import scipy.stats

from sierra.stats import survival
from sierra.stats.base import Estimate
from sierra.stats.survival import Time
from tests.samples import Memory

FREIREICH = (
    [Time(t, reached=True) for t in (6, 6, 6, 7, 10, 13, 16, 22, 23)],
    [Time(t, reached=False) for t in (6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35)],
)
"""Weeks of remission with 6-mercaptopurine, of which many are censored (Freireich et al. 1963, Blood 21: 699-716)."""
TREATED = [*FREIREICH[0], *FREIREICH[1]]
CONTROL = [Time(t, reached=True) for t in (1, 1, 2, 2, 3, 4, 4, 5, 5, 8, 8, 8, 8, 11, 11, 12, 12, 15, 17, 22, 23)]


def some_times(seed: int, n: int) -> list[Time]:
    rng = np.random.default_rng(seed)
    late, ends = np.ceil(rng.exponential(10, n)), np.ceil(rng.exponential(15, n))
    return [Time(float(min(a, b)), reached=bool(a <= b)) for a, b in zip(late, ends, strict=True)]


@pytest.mark.parametrize("runs", [TREATED, CONTROL, *(some_times(seed, 5 + 15 * seed) for seed in range(5))])
def test_the_curve_and_its_interval_equal_those_of_scipy(runs: Sequence[Time]) -> None:
    data = scipy.stats.CensoredData(
        uncensored=[run.time for run in runs if run.reached], right=[run.time for run in runs if not run.reached]
    )
    expected = scipy.stats.ecdf(data).sf
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # SciPy's for curves that end at 0
        interval = expected.confidence_interval(method="log-log")
    for step in survival.curve(runs):
        assert step.remaining == pytest.approx(float(expected.evaluate(step.time)), rel=1e-12)
        if step.low is not None and step.high is not None:
            ends = (float(interval.low.evaluate(step.time)), float(interval.high.evaluate(step.time)))
            assert (step.low, step.high) == pytest.approx(ends, rel=1e-10)
        else:
            assert step.remaining in (0, 1)


def test_published_values_of_the_leukaemia_trial() -> None:
    """From Freireich's data in Klein and Moeschberger (2003), example 4.1: S(6) = 0.857, S(10) = 0.753, S(23) = 0.448."""
    curve = {step.time: step for step in survival.curve(TREATED)}
    assert [round(curve[t].remaining, 3) for t in (6, 7, 10, 13, 16, 22, 23)] == [
        0.857,
        0.807,
        0.753,
        0.69,
        0.627,
        0.538,
        0.448,
    ]
    assert [curve[t].at_risk for t in (6, 7, 10, 13, 16, 22, 23)] == [21, 17, 15, 12, 11, 7, 6]
    found = survival.median(survival.curve(TREATED))
    assert (found.value, found.low, found.high) == (23, 13, None)
    assert survival.median(survival.curve(CONTROL)) == Estimate(8, 4, 11)
    assert survival.restricted_mean(survival.curve(TREATED), 35).value == pytest.approx(23.287, abs=5e-4)
    assert survival.restricted_mean(survival.curve(CONTROL), 23).value == pytest.approx(8.667, abs=5e-4)


@pytest.mark.parametrize("n", [2, 3, 10, 11])
def test_without_censored_times_the_median_is_the_ordinary_one(n: int) -> None:
    times = np.random.default_rng(n).exponential(size=n)
    found = survival.median(survival.curve(Time(t, reached=True) for t in times.tolist()))
    assert found.value == pytest.approx(float(np.median(times)))


@pytest.mark.parametrize("end", [4.0, 12.0, 1e9])
def test_the_restricted_mean_of_runs_that_end_together_is_the_mean_with_students_interval(end: float) -> None:
    drawn = np.random.default_rng(5).exponential(8, 25)
    runs = [Time(min(t, end), reached=t < end) for t in drawn.tolist()]
    x = np.minimum(drawn, end)
    interval = scipy.stats.ttest_1samp(x, 0).confidence_interval(0.95)
    found = survival.restricted_mean(survival.curve(runs), max(run.time for run in runs))
    assert (found.value, found.low) == pytest.approx((x.mean(), interval.low), rel=1e-10)
    assert found.high == pytest.approx(min(interval.high, end), rel=1e-10)


def test_a_median_that_half_of_the_runs_never_reach_is_unknown() -> None:
    runs = [Time(3.0, reached=True), *[Time(9.0, reached=False)] * 3]
    assert survival.median(survival.curve(runs)) == Estimate(None)
    never = survival.curve([Time(9.0, reached=False)] * 3)
    assert survival.median(never) == Estimate(None)
    assert survival.restricted_mean(never, 9.0) == Estimate(9.0)


def test_all_curves_are_known_up_to_the_horizon() -> None:
    done = survival.curve([Time(1.0, reached=True), Time(2.0, reached=True)])
    open_ended = survival.curve([Time(1.0, reached=True), Time(7.0, reached=False)])
    longer = survival.curve([Time(9.0, reached=False)])
    assert survival.horizon([done, open_ended, longer]) == 7
    assert survival.horizon([done]) == 2


def test_times_of_runs_are_censored_at_their_last_known_value() -> None:
    rows = [(0, 0, 0.0, 0.0), (0, 0, 1.0, 5.0), (0, 0, 2.0, 1.0), (0, 1, 0.0, 0.0), (0, 1, 3.0, 4.0), (0, 1, 4.0, None)]
    found = survival.times(Memory([*rows, (1, 0, 0.0, None)]), 5.0)
    assert found == {0: (Time(1.0, reached=True), Time(3.0, reached=False))}


RUNS = r"""
size=$(sed 's/.* size="\([0-9]*\)".*/\1/' "$1")
echo t,v > swarm.csv
for t in 0 1 2 3; do echo "$t,$((t * size))" >> swarm.csv; done
"""


@pytest.mark.integration
def test_the_stats_command_counts_runs_that_never_reach_the_threshold(simulate: Callable[..., Any]) -> None:
    project = simulate(RUNS)
    assert project.quick("run", "size=1,2,9", "--runs", "2", "--no-figures").returncode == 0
    asked = project.quick("stats", "swarm", "v", "--measure", "time_to", "--threshold", "4", "--json")
    found = [
        (row["n"], row["never"], row["mean"], row["km_median"], row["restricted_mean"]) for row in json.loads(asked.stdout)
    ]
    assert found == [(0, 2, None, None, 3), (2, 0, 2, 2, 2), (2, 0, 1, 1, 1)]
    assert (
        "mean, median and all others except km_median and restricted_mean are those of the runs that reached it" in asked.stderr
    )
    assert "restricted_mean is the mean time up to 3" in asked.stderr
    words = ("--measure", "time_to", "--threshold", "4", "--times", "own", "--json")
    curve = json.loads(project.quick("stats", "swarm", "v", *words).stdout)
    assert [(row["size"], row["t"], row["at_risk"], row["reached"], row["censored"], row["remaining"]) for row in curve] == [
        (1, 3, 2, 0, 2, 1),
        (2, 2, 2, 2, 0, 0),
        (9, 1, 2, 2, 0, 0),
    ]
    words = ("--measure", "time_to", "--threshold", "4", "--statistic", "km_median,mean", "--json")
    assert [(row["km_median"], row["mean"]) for row in json.loads(project.quick("stats", "swarm", "v", *words).stdout)] == [
        (None, None),
        (2, 2),
        (1, 1),
    ]
