"""The kind `scatter`: two columns of runs against each other, with fitted lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from sierra.config.field_types import Table
from sierra.deliverables.figures.base import PLOT, STATISTICAL, Request
from sierra.stats.needs import Needs

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing


class ScatterOptions(Table):
    """Figures of kind `scatter`."""

    fit: Literal["none", "linear", "quadratic", "cubic", "log", "exp", "power"] = Field(
        "none",
        description="curve through the runs of each series by least squares; `log`: y over log x; `exp`, `power`: a line "
        "through log y over x, or over log x",
    )


class Scatter:
    """Each run as a mark at its values of two columns, with fitted curves and their 95 % intervals."""

    contract = 1
    Options: ClassVar[type[Table]] = ScatterOptions
    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT

    def __init__(self, options: ScatterOptions) -> None:
        self._fit = options.fit

    def needs(self, request: Request) -> Needs:
        shows = "each mark a run" + (f", {self._fit} fit with the 95 % interval of its mean" if self._fit != "none" else "")
        return Needs(("median",), runs=True, columns=2, shows=shows)

    def notes(self, drawing: Drawing) -> Sequence[str]:
        from sierra.deliverables.figures import pairs

        return pairs.notes(drawing, self._fit)

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.deliverables.figures.pairs import scatter

        return scatter(drawing, self._fit)
