"""Kinds over time: lines with bands, and stacked areas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from sierra.config.plugin_registry import NoOptions
from sierra.deliverables.figures import bands
from sierra.deliverables.figures.base import CENTER, MODELS, PLOT, DrawnBy, DrawnKind, Request
from sierra.stats.needs import Needs

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing
    from sierra.deliverables.html import Chart

MOST_PANELS = 9
"""The largest number of experiments that stacked areas over time have a panel each for."""


class Timeseries(DrawnKind[NoOptions]):
    """Lines over time, each with its band."""

    uses: ClassVar[frozenset[str]] = CENTER | frozenset({"times", "series", "facet", MODELS}) | PLOT

    def needs(self, request: Request) -> Needs:
        return bands.needs(request.figure, over="time")

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import axis_limits, thinning, timeseries

        return DrawnBy(timeseries.timeseries, (axis_limits.notes, thinning.notes))

    def charts(self, drawing: Drawing) -> Sequence[Chart]:
        from sierra.deliverables.figures.interactive import over_time

        return over_time(drawing)


class Stacked(DrawnKind[NoOptions]):
    """Stacked areas of several columns: over time in a panel for each experiment, else over the first variable."""

    uses: ClassVar[frozenset[str]] = frozenset({"times", "measure", "center", "x", "facet"}) | PLOT - {"log_y"}

    def needs(self, request: Request) -> Needs:
        timed = request.rows > 1 and (request.experiments <= MOST_PANELS or not request.axes)
        return bands.center_only(request.figure, over="time" if timed else "experiments", columns=None)

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import thinning, timeseries

        return DrawnBy(timeseries.stacked, (thinning.notes,))
