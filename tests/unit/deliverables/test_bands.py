"""Centers and bands of figures have the numbers of NumPy and SciPy, and the small print names them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats

from sierra.deliverables.figures import bands, style
from sierra.deliverables.figures.drawing import Drawing, painted
from sierra.errors import UsageError
from sierra.stats import selection
from sierra.testing.figures import Row, Trial
from tests import plugins

VALUES = np.random.default_rng(5).exponential(10, 41)
QUARTILES = tuple(np.quantile(VALUES, (0.25, 0.75)))


def run(experiment: int, number: int, row: int) -> Row:
    return {"energy": float(VALUES[number]) + row - 7}


def drawing(kind: str = "summary", *, count: int = len(VALUES), **keys: Any) -> Drawing:
    return Trial(kind, keys, run, ()).drawing(runs=lambda experiment: count)


def shown(made: Drawing) -> list[float | None]:
    """Return the center and the ends of the interval of the last experiment, at its last time."""
    (table,) = made.tables.values()
    return [table.column(name).to_pylist()[-1] for name in bands.columns(made.figure)]


def around(center: float, half: float) -> tuple[float, float, float]:
    return center, center - half, center + half


SPREADS = [
    ({"band": "sd"}, around(VALUES.mean(), VALUES.std(ddof=1)), "mean, ± one standard deviation"),
    (
        {"center": "median", "band": "mad"},
        around(float(np.median(VALUES)), scipy.stats.median_abs_deviation(VALUES)),
        "median, ± one median absolute deviation",
    ),
    ({"center": "q90", "band": "iqr"}, (np.quantile(VALUES, 0.9), *QUARTILES), "90 % quantile, quartiles"),
    ({"band": "range"}, (VALUES.mean(), VALUES.min(), VALUES.max()), "mean, smallest to largest value"),
    (
        {"center": "median", "band": "quantiles", "quantiles": (0.05, 0.975)},
        (float(np.median(VALUES)), *np.quantile(VALUES, (0.05, 0.975))),
        "median, quantiles of 5 % and 97.5 %",
    ),
]


@pytest.mark.parametrize("kind", ["summary", "timeseries"])
@pytest.mark.parametrize(("keys", "expected", "words"), SPREADS)
def test_bands_show_the_spread_of_the_runs(kind: str, keys: dict[str, Any], expected: tuple[float, ...], words: str) -> None:
    made = drawing(kind, **keys)
    assert shown(made) == pytest.approx(expected, rel=1e-12)
    assert made.note == f"{words}, n = 41"


def trimmed_t() -> tuple[float, float, float]:
    """Return the interval of a trimmed mean by Tukey and McLaughlin (1963), with SciPy's winsorized values."""
    n, kept = len(VALUES), len(VALUES) - 2 * (len(VALUES) // 4)
    spread = np.asarray(scipy.stats.mstats.winsorize(VALUES, (0.25, 0.25))).std(ddof=1)
    half = scipy.stats.t.ppf(0.975, kept - 1) * spread * math.sqrt((n - 1) / (kept * (kept - 1)))
    return around(scipy.stats.trim_mean(VALUES, 0.25), half)


def order_statistics(p: float) -> tuple[float, float, float]:
    found = scipy.stats.quantile_test(VALUES, p=p).confidence_interval(0.95)
    return float(np.quantile(VALUES, p)), found.low, found.high


CENTERS = [
    ("mean", (VALUES.mean(), *scipy.stats.ttest_1samp(VALUES, 0).confidence_interval()), "mean, 95 % CI (Student's t)"),
    ("median", order_statistics(0.5), "median, 95 % CI (order statistics)"),
    ("q75", order_statistics(0.75), "75 % quantile, 95 % CI (order statistics)"),
    ("iqm", trimmed_t(), "interquartile mean, 95 % CI (t of a trimmed mean)"),
]


@pytest.mark.parametrize(("center", "expected", "words"), CENTERS)
def test_each_center_has_the_interval_of_its_statistic(center: str, expected: tuple[float, ...], words: str) -> None:
    made = drawing("bar", center=center, band="ci")
    assert shown(made) == pytest.approx(expected, rel=1e-9)
    assert made.note == f"{words}, n = 41"


def test_a_center_without_an_interval_says_so_and_one_with_too_few_runs_too() -> None:
    assert drawing(count=3, center="median", band="ci").note == "median, no interval, n = 3"
    unequal = Trial("summary", {"center": "median", "band": "ci"}, run)
    made = unequal.drawing(runs=lambda experiment: 8 - 5 * experiment)
    assert made.note == "median, 95 % CI (order statistics), n = 3–8; n too small for an interval at 1 of 2 points"


@pytest.mark.parametrize("kind", ["summary", "bar", "timeseries"])
def test_a_center_beyond_its_band_is_drawn(kind: str) -> None:
    def skewed(experiment: int, number: int, row: int) -> Row:
        return {"energy": 1000.0 if number == 0 else float(number)}

    made = Trial(kind, {"band": "iqr"}, skewed).drawing()
    center, _, high = shown(made)
    assert center is not None
    assert high is not None
    assert center > high
    with style.applied(made.figure):
        painted(made)


STATISTIC = """
from typing import ClassVar
from sierra.plugin import Estimate, Function, Table

class Keys(Table):
    reach: float = 1.0

class Middle:
    contract = 1
    Options: ClassVar[type[Table]] = Keys
    interval = "half way"

    def __init__(self, options):
        self._reach = options.reach

    def definition(self):
        return Function(self._estimate)

    def _estimate(self, values):
        if not values:
            return Estimate(None)
        middle = (values[0] + values[-1]) / 2
        return Estimate(middle, middle - self._reach, middle + self._reach)
"""


def test_a_statistic_of_another_package_is_a_center_with_its_interval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = plugins.write(tmp_path, "middling", {"sierra.statistics middle": "Middle"}, STATISTIC)
    monkeypatch.syspath_prepend(str(place))
    made = drawing(center="middle")
    middle = float(VALUES.min() + VALUES.max()) / 2
    assert shown(made) == pytest.approx(around(middle, 1.0))
    assert made.note == "middle, 95 % CI (half way), n = 41"


def test_a_bootstrap_names_its_seed_where_its_numbers_are_explained() -> None:
    made = drawing(center="mad")
    assert made.note == "median absolute deviation, 95 % CI (percentile bootstrap), n = 41"
    assert "-- mad: percentile bootstrap, resamples = 9999, seed = 1\n" in made.sql


def test_a_bootstrap_at_too_many_times_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection, "CALLS", 7)
    with pytest.raises(UsageError, match="mad would be computed for 8 experiments and times"):
        drawing("timeseries", center="mad")
