"""Looks at growing data: the schedule, and intervals that hold although a study stops when they are narrow."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from sierra.errors import UsageError
from sierra.stats import looks
from sierra.stats.base import LEVEL
from sierra.stats.selection import Selection
from tests.samples import Memory, samples

STUDIES = 2000
WITHIN = 3 * (0.05 * 0.95 / STUDIES) ** 0.5
"""Three standard errors of a coverage of 95 % that is found by simulation."""


def test_the_schedule_grows_by_half_up_to_the_maximum() -> None:
    assert looks.schedule(10, 200) == (10, 15, 23, 35, 53, 80, 120, 180, 200)
    assert looks.schedule(2, 5) == (2, 3, 5)
    assert looks.schedule(7, 7) == (7,)
    for first, most in ((1, 9), (9, 8), (0, 0)):
        with pytest.raises(UsageError):
            looks.schedule(first, most)


def test_the_estimate_is_that_of_a_width_that_falls_with_the_root_of_n() -> None:
    assert looks.estimate(10, 2.0, 1.0) == 40
    assert looks.estimate(10, 1.0, 1.0) == 11
    assert looks.estimate(10, 1.0, 0.0) is None
    assert looks.estimate(10, 1.0, 5e-324) is None


def coverage_at_the_stop(
    values: npt.NDArray[np.float64], truth: float, statistic: str, width: float, level: float, *, rate: bool = False
) -> float:
    """Return how often the interval at the stop has the true value: a row of values for each study, a column for each run."""
    schedule = looks.schedule(5, values.shape[1])
    open_ones, covers = np.ones(len(values), dtype=bool), np.zeros(len(values), dtype=bool)
    for n in schedule:
        rows = [(study, run, 0.0, values[study, run]) for study in np.flatnonzero(open_ones).tolist() for run in range(n)]
        selection = Selection.of([statistic], {}, level)
        table, _ = samples(Memory(rows), rate=rate).by_experiment("final", selection)
        study, low, high = (
            table.column(name).to_numpy(zero_copy_only=False).astype(float)
            for name in ("experiment", f"{statistic}_low", f"{statistic}_high")
        )
        stops = (high - low) / 2 < width if n < schedule[-1] else np.ones(len(study), dtype=bool)
        covers[study[stops].astype(int)] = ((low <= truth) & (truth <= high))[stops]
        open_ones[study[stops].astype(int)] = False
        if not open_ones.any():
            break
    return float(covers.mean())


@pytest.mark.integration
@pytest.mark.parametrize(
    ("statistic", "width", "truth", "rate"),
    [("mean", 0.2, 0.3, True), ("mean", 0.6, 0.0, False), ("median", 0.8, 0.0, False)],
)
def test_the_interval_at_the_stop_has_its_confidence_only_if_it_is_corrected(
    statistic: str, width: float, truth: float, rate: bool
) -> None:
    random = np.random.default_rng(7)
    shape = STUDIES, 40
    values = (random.random(shape) < truth).astype(float) if rate else random.normal(size=shape)
    corrected = looks.level(0.05, len(looks.schedule(5, 40)))
    assert coverage_at_the_stop(values, truth, statistic, width, corrected, rate=rate) >= 0.95 - WITHIN
    if statistic == "mean" and not rate:  # others are wider than their level says, which hides what looking costs
        assert coverage_at_the_stop(values, truth, statistic, width, LEVEL) < 0.95 - WITHIN
