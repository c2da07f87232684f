"""The kind `pareto`: two columns of experiments against each other, with the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from sierra.config.field_types import Table
from sierra.deliverables.figures import bands
from sierra.deliverables.figures.base import CENTER, PLOT, Request
from sierra.stats.needs import Needs

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing

Better = Literal["high", "low"]


class ParetoOptions(Table):
    """Figures of kind `pareto`."""

    better: Annotated[tuple[Better, ...], Field(min_length=2, max_length=2)] = Field(
        ("high", "high"), description="whether `high` or `low` values are better, for each of the two columns"
    )


class Pareto:
    """Each experiment at its centers of two columns, with intervals, and the front that no other experiment dominates."""

    contract = 1
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

    def __init__(self, options: ParetoOptions) -> None:
        first, second = options.better
        self._better: tuple[Better, Better] = (first, second)

    def needs(self, request: Request) -> Needs:
        return bands.needs(request.figure, columns=2)

    def notes(self, drawing: Drawing) -> Sequence[str]:
        first, second = drawing.tables
        return [f"line: front of the experiments, where {self._better[0]} {first} and {self._better[1]} {second} are better"]

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.extensions.figures.pareto_drawing import pareto

        return pareto(drawing, self._better)
