"""Statistics that are chosen by name have the values of numpy and right intervals, and plug-ins fulfil the contract."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pytest
import scipy.stats

import sierra
from sierra.errors import UsageError
from sierra.stats.base import Formula, Statistic
from sierra.stats.bootstrap import BootstrapOptions, estimate
from sierra.stats.order_statistics import ranks, smallest
from sierra.stats.selection import Selection
from tests.samples import Memory, samples

NAMES = ("mean", "median", "iqm", "sd", "iqr", "mad", "range", "q10", "q90", "q97.5")


def over_runs(values: Iterable[float], names: Sequence[str] = NAMES) -> dict[str, Any]:
    """Return the chosen statistics of one experiment whose runs ended with these values."""
    frame = Memory((0, number, 0.0, value) for number, value in enumerate(values))
    table, _ = samples(frame).by_experiment("final", Selection.of(names, {}))
    found: list[dict[str, Any]] = table.to_pylist()
    return found[0]


def ends(found: dict[str, Any], name: str) -> tuple[float | None, float | None]:
    return found[f"{name}_low"], found[f"{name}_high"]


@pytest.mark.parametrize("n", [1, 2, 5, 6, 36, 101])
def test_values_equal_those_of_numpy_and_scipy(n: int) -> None:
    x = np.random.default_rng(n).exponential(size=n)
    found = over_runs(x.tolist())
    expected = {
        "mean": x.mean(),
        "median": np.median(x),
        "iqm": scipy.stats.trim_mean(x, 0.25),
        "iqr": scipy.stats.iqr(x),
        "mad": scipy.stats.median_abs_deviation(x),
        "range": np.ptp(x),
        "q10": np.quantile(x, 0.1),
        "q90": np.quantile(x, 0.9),
        "q97.5": np.quantile(x, 0.975),
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-12, abs=1e-15)
    assert found["sd"] == (pytest.approx(x.std(ddof=1), rel=1e-12) if n > 1 else None)
    assert found["n"] == n


@pytest.mark.parametrize("percent", [1, 10, 25, 50, 80, 90, 97.5, 99.9])
def test_ranks_are_the_narrowest_that_the_binomial_distribution_allows(percent: float) -> None:
    p = percent / 100
    lower, upper = ranks(p, 400, 0.05)
    for n in range(1, 401):
        low, high = lower[n - 1], upper[n - 1]
        none = scipy.stats.binom.pmf(0, n, p) > 0.025 or scipy.stats.binom.pmf(n, n, p) > 0.025
        assert (low is None) == (high is None) == none
        if low is None or high is None:
            continue
        assert scipy.stats.binom.cdf(low - 1, n, p) <= 0.025 < scipy.stats.binom.cdf(low, n, p)
        assert scipy.stats.binom.sf(high - 1, n, p) <= 0.025 < scipy.stats.binom.sf(high - 2, n, p)


@pytest.mark.parametrize(("p", "n"), [(0.5, 6), (0.9, 36), (0.1, 36), (0.75, 13), (0.99, 368)])
def test_the_smallest_number_of_runs_for_an_interval_of_a_quantile(p: float, n: int) -> None:
    assert smallest(p, 0.05) == n
    assert [end is None for end in ranks(p, n, 0.05)[0][-2:]] == [True, False]


def test_the_interval_of_a_median_is_that_of_printed_tables() -> None:
    """From Conover (1999), table A3: for n = 10 the 2nd and 9th value, for n = 20 the 6th and 15th."""
    assert ends(over_runs(map(float, range(1, 11))), "median") == (2, 9)
    assert ends(over_runs(map(float, range(1, 21))), "median") == (6, 15)


@pytest.mark.parametrize(("p", "n"), [(0.5, 10), (0.25, 40), (0.9, 60)])
def test_the_interval_of_a_quantile_contains_that_of_scipy(p: float, n: int) -> None:
    x = np.sort(np.random.default_rng(2).normal(size=n))
    name = f"q{p * 100:g}"
    interval = scipy.stats.quantile_test(x, p=p).confidence_interval(0.95)
    found = over_runs(x.tolist(), [name])
    assert ends(found, name) == (interval.low, interval.high)
    assert found[f"{name}_interval"] == "order statistics"


def bonett(x: np.ndarray[Any, Any]) -> tuple[float, float]:
    """Compute Bonett's interval of a standard deviation independently."""
    n, z = len(x), scipy.stats.norm.ppf(0.975)
    trimmed = scipy.stats.trim_mean(x, 1 / (2 * math.sqrt(n - 4)))
    kurtosis = n * ((x - trimmed) ** 4).sum() / ((x - x.mean()) ** 2).sum() ** 2
    c = n / (n - z)
    error = c * math.sqrt((kurtosis - (n - 3) / n) / (n - 1))
    return math.sqrt(c * x.var(ddof=1) * math.exp(-z * error)), math.sqrt(c * x.var(ddof=1) * math.exp(z * error))


@pytest.mark.parametrize("n", [5, 6, 17, 100])
@pytest.mark.parametrize("scale", [1.0, 2.0**-1000, 2.0**900])
def test_the_interval_of_a_standard_deviation_equals_bonetts(n: int, scale: float) -> None:
    x = np.random.default_rng(n).exponential(size=n)
    low, high = ends(over_runs((x * scale).tolist(), ["sd"]), "sd")
    assert low is not None
    assert high is not None
    assert (low / scale, high / scale) == pytest.approx(bonett(x), rel=1e-10)


def test_a_bootstrap_equals_scipys_and_is_repeated_to_the_bit() -> None:
    x = np.sort(np.random.default_rng(3).normal(size=25))
    expected = scipy.stats.bootstrap(
        (x,), scipy.stats.iqr, n_resamples=9999, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    found = over_runs(x.tolist(), ["iqr"])
    assert ends(found, "iqr") == pytest.approx((expected.low, expected.high), rel=1e-12)
    assert over_runs(x.tolist(), ["iqr"]) == found
    assert found["iqr_interval"] == "percentile bootstrap"


@pytest.mark.parametrize(
    ("name", "n"), [("mean", 2), ("iqm", 2), ("sd", 5), ("median", 6), ("iqr", 10), ("mad", 10), ("q90", 36)]
)
def test_too_few_runs_have_a_value_but_no_interval_and_a_note(name: str, n: int) -> None:
    values = [float(k * k) for k in range(n)]
    assert None not in ends(over_runs(values, [name]), name)
    few = over_runs(values[:-1], [name])
    assert (*ends(few, name), few[f"{name}_interval"]) == (None, None, None)
    table = pa.Table.from_pylist([few])
    assert Selection.of([name], {}).notes(table) == [f"n is too small for the 95 % interval of {name} in 1 row"]


def test_no_values_have_no_statistics() -> None:
    frame = Memory([(0, 0, 0.0, None)])
    (row,) = samples(frame).by_experiment("final", Selection.of(NAMES, {}))[0].to_pylist()
    assert {name: row[name] for name in NAMES} == dict.fromkeys(NAMES)
    assert (row["n"], row["missing"]) == (0, 1)


def test_equal_values_have_that_value_as_interval() -> None:
    found = over_runs([3.5] * 40)
    for name in ("mean", "median", "iqm", "q10", "q90"):
        assert (found[name], *ends(found, name)) == (3.5, 3.5, 3.5), name
    for name in ("sd", "iqr", "mad"):
        assert (found[name], *ends(found, name)) == (0, 0, 0), name


def test_quantiles_of_huge_values_do_not_overflow() -> None:
    found = over_runs([-1.7e308, 1.7e308], ["q25", "range"])
    assert (found["q25"], found["range"]) == (pytest.approx(-0.85e308), None)


def test_statistics_over_time_have_a_row_for_each_time() -> None:
    frame = Memory((0, run, float(t), float(t * 100 + run)) for run in range(6) for t in range(3))
    table, text = samples(frame).by_time(Selection.of(["median", "iqr"], {}))
    assert table["median_low"].to_pylist() == [0, 100, 200]
    assert table["iqr"].to_pylist() == [2.5] * 3
    assert "-- $median_rank: rank of the lower end" in text


def test_a_bootstrap_does_not_depend_on_the_order_of_the_values() -> None:
    values = [3.0, 1.0, 9.0, 4.0, 8.0, 6.0, 2.0, 7.0, 5.0, 3.0]
    unsorted = estimate(np.median, values, BootstrapOptions())
    assert unsorted.low is not None
    assert unsorted.low < unsorted.value < unsorted.high


def test_a_bootstrap_for_too_many_times_is_refused() -> None:
    frame = Memory((0, 0, float(t), 1.0) for t in range(5001))
    with pytest.raises(UsageError, match="mad would be computed for 5001 experiments and times, which takes too long"):
        samples(frame).by_time(Selection.of(["mean", "mad"], {}))


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("meen", "unknown statistic 'meen'; known are mean, median, iqm, sd, iqr, mad, range, and quantiles such as q05"),
        ("q1", "'q1' is ambiguous; write q25 for the quartile, or q01 for the quantile of 1 %"),
        ("q5", "'q5' is ambiguous; write q05 for the quantile of 5 %"),
        ("q100", "must be between 0 and 100"),
        ("q00", "must be between 0 and 100"),
    ],
)
def test_wrong_names_are_refused(name: str, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        Selection.of([name], {})


RUNS = r"""
seed=$(sed 's/.* seed="\([0-9]*\)".*/\1/' "$1")
printf 't,v\n1,%s\n' $((seed % 7)) > swarm.csv
"""


@pytest.mark.integration
def test_the_stats_command_prints_the_chosen_statistics_only(simulate: Callable[..., Any]) -> None:
    project = simulate(RUNS)
    assert project.quick("run", "size=1", "--runs", "6", "--no-figures").returncode == 0
    asked = project.quick("stats", "swarm", "v", "--statistic", "median,q90", "-s", "range", "--json")
    (row,) = json.loads(asked.stdout)
    values = [one["v"] for one in json.loads(project.quick("sql", "SELECT v FROM swarm", "--format", "json").stdout)]
    parts = ("", "_low", "_high", "_interval")
    named = [f"{name}{part}" for name in ("median", "q90", "range") for part in parts]
    assert list(row) == ["experiment", "size", "n", "missing", "infinite", "never", *named]
    assert [row[name] for name in named[:4]] == [np.median(values), min(values), max(values), "order statistics"]
    assert [row[name] for name in named[4:8]] == [pytest.approx(np.quantile(values, 0.9)), None, None, None]
    assert [row[name] for name in named[8:]] == [max(values) - min(values), None, None, None]
    assert "n is too small for the 95 % interval of q90 in 1 row" in asked.stderr
    assert "range has no interval" in asked.stderr
    wrong = project.quick("stats", "swarm", "v", "--statistic", "median,,q90")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    (same,) = sierra.open(project.folder).statistics(None, "swarm", "v", statistics=["median", "q90", "range"]).to_pylist()
    assert same == row


NAMED = r"""
printf 't,first,name,together\n1,5,6,7\n2,8,9,1\n' > swarm.csv
"""


@pytest.mark.nightly
def test_columns_may_have_any_name(simulate: Callable[..., Any]) -> None:
    project = simulate(NAMED)
    assert project.quick("run", "size=1", "--runs", "2", "--no-figures").returncode == 0
    for column, last in (("first", 8), ("name", 9), ("together", 1)):
        (row,) = json.loads(project.quick("stats", "swarm", column, "--json").stdout)
        assert (row["n"], row["mean"]) == (2, last)


@pytest.mark.integration
@pytest.mark.parametrize("name", [name for name in NAMES if name != "range"])
def test_intervals_of_a_higher_confidence_are_those_of_scipy(name: str) -> None:
    x = np.random.default_rng(3).normal(size=300)
    frame = Memory((0, number, 0.0, value) for number, value in enumerate(x.tolist()))
    (wide,) = samples(frame).by_experiment("final", Selection.of([name], {}, 0.99))[0].to_pylist()
    usual = over_runs(x.tolist(), [name])
    assert wide[f"{name}_low"] < usual[f"{name}_low"] < wide[name] < usual[f"{name}_high"] < wide[f"{name}_high"]
    if name == "mean":
        assert ends(wide, name) == pytest.approx(scipy.stats.t.interval(0.99, 299, x.mean(), scipy.stats.sem(x)))
    if name == "median":
        found = scipy.stats.quantile_test(x).confidence_interval(0.99)
        assert ends(wide, name) == (found.low, found.high)


def test_a_statistic_with_intervals_of_95_percent_only_is_refused_for_looks() -> None:
    class Plain:
        contract, interval = 1, "t"
        formula = Formula("x[1]", "x[1]", "x[1]", uses=("n",))

        def definition(self) -> Formula:
            return self.formula

    plain = cast(Statistic, Plain())
    assert Selection({"plain": plain}).definitions["plain"] is Plain.formula
    with pytest.raises(UsageError, match="'plain' has intervals of 95 % only"):
        _ = Selection({"plain": plain}, 0.99).definitions
