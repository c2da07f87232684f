"""The kind `pareto`: two columns of experiments against each other, with the Pareto front."""

from __future__ import annotations

from functools import partial
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from sierra.config.field_types import Table
from sierra.deliverables.figures import bands
from sierra.deliverables.figures.base import CENTER, PLOT, DrawnBy, DrawnKind, Request
from sierra.stats.needs import Needs

Better = Literal["high", "low"]


class ParetoOptions(Table):
    """Figures of kind `pareto`."""

    better: Annotated[tuple[Better, ...], Field(min_length=2, max_length=2)] = Field(
        ("high", "high"), description="whether `high` or `low` values are better, for each of the two columns"
    )


class Pareto(DrawnKind[ParetoOptions]):
    """Each experiment at its centers of two columns, with intervals, and the front that no other experiment dominates."""

    Options: ClassVar[type[Table]] = ParetoOptions
    uses: ClassVar[frozenset[str]] = (
        CENTER
        | frozenset({"measure", "series", "facet"})
        | PLOT
        - {
            "log_x",
            "log_y",
        }
    )

    def needs(self, request: Request) -> Needs:
        return bands.needs(request.figure, columns=2)

    def drawn_by(self) -> DrawnBy:
        from sierra.extensions.figures.pareto_drawing import notes, pareto

        return DrawnBy(partial(pareto, better=self.options.better), (partial(notes, better=self.options.better),))
