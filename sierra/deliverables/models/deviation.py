"""Deviations of a model from the data: the model's value minus the data's center, at each compared point.

A point is an experiment, or an experiment at one time. With the deviations d₁ … d_k of k points:

    bias      (d₁ + … + d_k) / k
    rmse      √((d₁² + … + d_k²) / k)
    largest   the deviation of the largest absolute value

(Willmott 1982, Bulletin of the American Meteorological Society 63, 1309–1313). Each point has the same weight. `inside` is the
number of points whose 95 % interval of the center contains the model. Such an interval says where the center is, and not where
runs are: a model that is right is in about 95 of 100 of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sierra.deliverables.models.predictions import CLOSE
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import pyarrow as pa

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Points:
    """The points that a model and the data have in common."""

    experiment: npt.NDArray[np.int64]
    time: Floats
    """NaN if the model predicts one number for each experiment."""
    n: npt.NDArray[np.int64]
    data: Floats
    predicted: Floats
    low: Floats
    high: Floats
    """The ends of the interval; NaN if there is none."""

    def of(self, ordinal: int) -> Points:
        """Return the points of one experiment."""
        rows = self.experiment == ordinal
        return Points(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True)
class Deviation:
    """The deviation of a model from the data over some points."""

    compared: int
    """The number of points."""
    bias: float
    rmse: float
    largest: float
    at: float
    """The time of the largest deviation; NaN without times."""
    inside: int
    intervals: int
    """The number of points with an interval."""


def points(predicted: pa.Table, data: pa.Table, center: str, ends: tuple[str, str] | None) -> Points:
    """Return the points of a model's table (`experiment`, perhaps `t`, `value`) at which the data has a finite center.

    Times that differ by no more than rounding are equal; nothing is interpolated.
    """
    columns = {name: numpy_of(predicted.column(name)) for name in predicted.column_names}
    keys = numpy_of(data.column("experiment"))
    timed = "t" in columns
    times = numpy_of(data.column("t")).astype(float) if timed else np.zeros(len(keys))
    own = columns["t"].astype(float) if timed else np.zeros(len(columns["experiment"]))
    places = np.full(len(keys), -1)
    for ordinal in np.unique(columns["experiment"]):
        mine, theirs = np.flatnonzero(columns["experiment"] == ordinal), np.flatnonzero(keys == ordinal)
        places[theirs] = _matching(times[theirs], own[mine], mine)
    centers = numpy_of(data.column(center)).astype(float)
    kept = (places >= 0) & np.isfinite(centers)
    nan = np.full(len(keys), np.nan)
    low, high = (numpy_of(data.column(end)).astype(float) for end in ends) if ends else (nan, nan)
    return Points(
        experiment=keys[kept].astype(np.int64),
        time=times[kept] if timed else nan[kept],
        n=numpy_of(data.column("n"))[kept].astype(np.int64),
        data=centers[kept],
        predicted=columns["value"][places[kept]].astype(float),
        low=low[kept],
        high=high[kept],
    )


def deviation(of: Points) -> Deviation | None:
    """Return the deviation over points; None if there is none."""
    if not len(of.data):
        return None
    d = of.predicted - of.data
    worst = int(np.argmax(np.abs(d) >= np.abs(d).max() * (1 - CLOSE)))  # the first, whatever the rounding
    known = np.isfinite(of.low) & np.isfinite(of.high)
    within = known & (of.low <= of.predicted) & (of.predicted <= of.high)
    scale = float(np.abs(d).max()) or 1.0  # so that squares of huge numbers do not overflow
    return Deviation(
        compared=len(d),
        bias=float(scale * np.mean(d / scale)),
        rmse=float(scale * np.sqrt(np.mean((d / scale) ** 2))),
        largest=float(d[worst]),
        at=float(of.time[worst]),
        inside=int(within.sum()),
        intervals=int(known.sum()),
    )


def _matching(times: Floats, own: Floats, places: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return for each time the place of the model's row at this time; −1 if it has none. `own` is in ascending order."""
    span = max(float(np.ptp(own)), float(np.ptp(times)) if len(times) else 0.0)
    after = np.clip(np.searchsorted(own, times), 0, len(own) - 1)
    before = np.maximum(after - 1, 0)
    near = np.where(np.abs(own[before] - times) < np.abs(own[after] - times), before, after)
    return np.where(np.abs(own[near] - times) <= CLOSE * span, places[near], -1)
