"""The kind `scatter`: two columns of runs against each other, with fitted lines."""

from __future__ import annotations

from functools import partial
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from sierra.config.field_types import Table
from sierra.deliverables.figures.base import PLOT, ROWS, STATISTICAL, DrawnBy, DrawnKind, Request
from sierra.deliverables.figures.kinds.distributions import of_rows
from sierra.stats.needs import Needs


class ScatterOptions(Table):
    """Figures of kind `scatter`."""

    fit: Literal["none", "linear", "quadratic", "cubic", "log", "exp", "power"] = Field(
        "none",
        description="curve through the runs of each series by least squares; `log`: y over log x; `exp`, `power`: a line "
        "through log y over x, or over log x",
    )
    rows: Annotated[bool, ROWS] = False


class Scatter(DrawnKind[ScatterOptions]):
    """Each run as a mark at its values of two columns, with fitted curves and their 95 % intervals."""

    Options: ClassVar[type[Table]] = ScatterOptions
    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT

    def needs(self, request: Request) -> Needs:
        fit = self.options.fit
        if self.options.rows:
            shows = "each mark a row" + (f", {fit} fit" if fit != "none" else "")
            return Needs(rows=of_rows(request, 2), sample="rows", columns=2, shows=shows)
        shows = "each mark a run" + (f", {fit} fit with the 95 % interval of its mean" if fit != "none" else "")
        return Needs(("median",), runs=True, columns=2, shows=shows)

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import pairs, sampled_runs

        drawn = DrawnBy(partial(pairs.scatter, fit=self.options.fit), (partial(pairs.notes, fit=self.options.fit),))
        return sampled_runs.of_rows(drawn) if self.options.rows else drawn
