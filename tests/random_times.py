"""Claims about random times of runs, and about the means over them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import strategies as st

from sierra.store.rounded_times import PART, same
from tests.properties import Property
from tests.samples import Memory, samples


def shown(*runs: list[float]) -> list[list[float]]:
    """Return the times of runs as statistics show them."""
    steps: dict[float, float] = {}
    for run in runs:
        smallest = min(np.diff(run), default=np.nan)
        for time in run:
            steps[time] = float(np.fmin(steps.get(time, np.nan), smallest))
    times = sorted(steps)
    one = dict(same(np.array(times), np.array([steps[time] for time in times])))
    return [[one.get(time, time) for time in run] for run in runs]


def stay_apart(runs: list[list[float]]) -> None:
    """Check that no two times of a run become one, and that none moves far."""
    for run, seen in zip(runs, shown(*runs), strict=True):
        assert len(set(seen)) == len(run)
        assert seen == sorted(seen)
        step = min(np.diff(run), default=np.inf)
        assert all(abs(time - was) <= PART * step for time, was in zip(seen, run, strict=True))


def come_together(seed: int) -> None:
    """Check that shared times with small random errors become one."""
    chance = np.random.default_rng(seed)
    step, count = float(chance.choice([0.02, 0.1, 1.0, 60.0])), int(chance.integers(2, 60))
    nominal = np.arange(count) * step
    runs = [(nominal + chance.uniform(-PART / 3, PART / 3, count) * step).tolist() for _ in range(3)]
    first, *others = shown(*runs)
    assert all(other == first for other in others)


def mean_of(values: list[float], times: list[float], measure: str = "time_mean") -> float | None:
    """Return a mean of one run with these values at these times."""
    frame = Memory((0, 0, t, value) for t, value in zip(times, values, strict=True))
    table, _ = samples(frame).by_experiment(measure, ["mean"])
    found: float | None = table.column("mean")[0].as_py()
    return found


def is_the_integral(values: list[float], seed: int) -> None:
    """Check the mean over time against NumPy's integral."""
    times = np.cumsum(np.random.default_rng(seed).uniform(0.01, 10, len(values)))
    expected = np.trapezoid(np.array(values) / (times[-1] - times[0]), times)
    found = mean_of(values, times.tolist())
    assert found is not None
    assert found == pytest.approx(expected, rel=1e-9, abs=max(1e-300, 1e-9 * max(map(abs, values))))
    assert min(values) <= found <= max(values)


TIMES = st.lists(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=8, unique=True).map(sorted), min_size=1, max_size=5)
APART = Property("times of one run stay apart", (TIMES,), stay_apart)
TOGETHER = Property("times that differ by rounding are one", (st.integers(0, 2**32),), come_together)
VALUES = st.lists(st.floats(-1e300, 1e300), min_size=2, max_size=30)
INTEGRAL = Property("the mean over time is an integral", (VALUES, st.integers(0, 2**32)), is_the_integral)
PROPERTIES = (APART, TOGETHER, INTEGRAL)
