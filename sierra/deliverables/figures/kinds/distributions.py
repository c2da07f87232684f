"""Kinds that show how the runs of each experiment are distributed over a value."""

from __future__ import annotations

from functools import partial
from typing import ClassVar

from pydantic import Field

from sierra.config.field_types import Table
from sierra.deliverables.figures.base import PLOT, STATISTICAL, DrawnBy, DrawnKind, Request
from sierra.stats.needs import Needs


class EcdfOptions(Table):
    """Figures of kind `ecdf`."""

    interval: bool = Field(
        True, description="draw a band that contains the complete true distribution in 95 % of all cases (Massart 1990)"
    )


class Ecdf(DrawnKind[EcdfOptions]):
    """The part of the runs that is at most a value, as a step curve for each experiment."""

    Options: ClassVar[type[Table]] = EcdfOptions
    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT - {"log_y"}

    def needs(self, request: Request) -> Needs:
        shows = "part of the runs" + (", 95 % band of Dvoretzky, Kiefer and Wolfowitz" if self.options.interval else "")
        return Needs(("median",), runs=True, shows=shows)

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import distributions, sampled_runs

        draw = partial(distributions.ecdf, interval=self.options.interval)
        return DrawnBy(draw, (distributions.not_above_0, sampled_runs.notes))


class HistogramOptions(Table):
    """Figures of kind `histogram`."""

    bins: int = Field(0, ge=0, le=1000, description="number of bins, the same for all experiments; 0: by Freedman and Diaconis")
    density: bool = Field(False, description="show densities instead of numbers of runs")


class Histogram(DrawnKind[HistogramOptions]):
    """The number of runs in each of several ranges of a value, as an outline for each experiment."""

    Options: ClassVar[type[Table]] = HistogramOptions
    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT - {"log_x", "log_y"}

    def needs(self, request: Request) -> Needs:
        return Needs(("median",), runs=True, shows="histogram of the runs")

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import distributions

        bins = self.options.bins
        draw = partial(distributions.histogram, bins=bins, density=self.options.density)
        return DrawnBy(draw, (lambda drawing: [f"{len(distributions.edges(drawing, bins)) - 1} bins"],))
