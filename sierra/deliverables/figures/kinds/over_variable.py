"""Kinds over the independent variables: points with intervals, boxes, violins, and maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from sierra.config.plugin_registry import NoOptions
from sierra.deliverables.figures import bands
from sierra.deliverables.figures.base import CENTER, MODELS, PLOT, STATISTICAL, DrawnBy, DrawnKind, Request
from sierra.errors import UsageError
from sierra.stats.needs import Needs

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing
    from sierra.deliverables.html import Chart

NO_LOG_X = frozenset({"log_x", "xlim"})
"""The keys that have no effect where values of variables are side by side."""
SIDE_BY_SIDE = PLOT - NO_LOG_X - {"log_y"}
BOX = ("median", "whiskers")


class Summary(DrawnKind[NoOptions]):
    """Points with intervals over the first variable, with a series for each combination of the others."""

    uses: ClassVar[frozenset[str]] = CENTER | frozenset({"measure", "x", "series", "facet", MODELS}) | PLOT

    def needs(self, request: Request) -> Needs:
        return bands.needs(request.figure, some="hollow")

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import axis_limits, facets, summary

        return DrawnBy(summary.summary, (axis_limits.notes, partial(facets.unnamed, numbers=False)))

    def charts(self, drawing: Drawing) -> Sequence[Chart]:
        from sierra.deliverables.figures.interactive import over_variable

        return over_variable(drawing)


class Box(DrawnKind[NoOptions]):
    """Boxes over the first variable: median, quartiles, whiskers, and the runs beyond them."""

    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "x", "series", "facet", MODELS}) | PLOT - NO_LOG_X

    def needs(self, request: Request) -> Needs:
        return Needs(BOX, runs=True, shows="median, quartiles, whiskers to at most 1.5 IQR")

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import axis_limits, facets, sampled_runs, side_by_side

        return DrawnBy(side_by_side.box, (axis_limits.left_out_runs, sampled_runs.notes, facets.unnamed))


class Violin(Box):
    """Densities of the runs over the first variable, with a dot for each run."""

    def needs(self, request: Request) -> Needs:
        return Needs(BOX, runs=True, shows="median, quartiles, each dot a run")

    def notes(self, drawing: Drawing) -> Sequence[str]:
        return [*super().notes(drawing), *(["densities of the logarithms"] if drawing.figure.log_y else [])]

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures.side_by_side import violin

        return replace(super().drawn_by(), draw=violin)


class Strip(Box):
    """A dot for each run over the first variable, and a line at the median."""

    def needs(self, request: Request) -> Needs:
        return Needs(("median",), runs=True, shows="each mark a run, line: median")

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures.side_by_side import strip

        return replace(super().drawn_by(), draw=strip)


class Bar(DrawnKind[NoOptions]):
    """Bars over the first variable, with intervals; side by side for the values of the others."""

    uses: ClassVar[frozenset[str]] = CENTER | frozenset({"measure", "x", "series", "facet", MODELS}) | SIDE_BY_SIDE

    def needs(self, request: Request) -> Needs:
        return bands.needs(request.figure)

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import facets, summary

        return DrawnBy(summary.bar, (facets.unnamed,))


class Heatmap(DrawnKind[NoOptions]):
    """A map of colours over two variables."""

    uses: ClassVar[frozenset[str]] = frozenset({"measure", "center", "x", "series", "facet", "log_y", "labels", MODELS})

    def needs(self, request: Request) -> Needs:
        if (count := len(request.axes)) != (3 if request.figure.facet else 2):
            besides = " besides facet" if request.figure.facet else ""
            more = "" if request.figure.facet or count < 3 else ", or facet for the third"
            raise UsageError(
                f"a heatmap needs two independent variables{besides}, but this batch has {count}; use a summary{more}"
            )
        return bands.center_only(request.figure, none="hatched")

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import axis_limits, heatmap

        notes = (axis_limits.left_out_centers, heatmap.without_models, heatmap.unnamed)
        return DrawnBy(heatmap.heatmap, notes)
