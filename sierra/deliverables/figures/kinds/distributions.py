"""Kinds that show how the runs of each experiment are distributed over a value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from sierra.config.field_types import Table
from sierra.deliverables.figures.base import PLOT, STATISTICAL, Request
from sierra.stats.needs import Needs

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing


class EcdfOptions(Table):
    """Figures of kind `ecdf`."""

    interval: bool = Field(
        True, description="draw a band that contains the complete true distribution in 95 % of all cases (Massart 1990)"
    )


class Ecdf:
    """The part of the runs that is at most a value, as a step curve for each experiment."""

    contract = 1
    Options: ClassVar[type[Table]] = EcdfOptions
    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT - {"log_y"}

    def __init__(self, options: EcdfOptions) -> None:
        self._interval = options.interval

    def needs(self, request: Request) -> Needs:
        shows = "part of the runs" + (", 95 % band of Dvoretzky, Kiefer and Wolfowitz" if self._interval else "")
        return Needs(("median",), runs=True, shows=shows)

    def notes(self, drawing: Drawing) -> Sequence[str]:
        from sierra.deliverables.figures import distributions, sampled_runs

        return [*distributions.not_above_0(drawing), *sampled_runs.notes(drawing)]

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.deliverables.figures.distributions import ecdf

        return ecdf(drawing, interval=self._interval)


class HistogramOptions(Table):
    """Figures of kind `histogram`."""

    bins: int = Field(0, ge=0, le=1000, description="number of bins, the same for all experiments; 0: by Freedman and Diaconis")
    density: bool = Field(False, description="show densities instead of numbers of runs")


class Histogram:
    """The number of runs in each of several ranges of a value, as an outline for each experiment."""

    contract = 1
    Options: ClassVar[type[Table]] = HistogramOptions
    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT - {"log_x", "log_y"}

    def __init__(self, options: HistogramOptions) -> None:
        self._options = options

    def needs(self, request: Request) -> Needs:
        return Needs(("median",), runs=True, shows="histogram of the runs")

    def notes(self, drawing: Drawing) -> Sequence[str]:
        from sierra.deliverables.figures import distributions

        return [f"{len(distributions.edges(drawing, self._options.bins)) - 1} bins"]

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.deliverables.figures.distributions import histogram

        return histogram(drawing, self._options.bins, density=self._options.density)
