"""Kinds that show how the runs of each experiment are distributed over a value."""

from __future__ import annotations

from functools import partial
from typing import Annotated, ClassVar

from pydantic import Field

from sierra.config.field_types import Table
from sierra.deliverables.figures.base import PLOT, ROWS, STATISTICAL, DrawnBy, DrawnKind, Request
from sierra.errors import UsageError
from sierra.stats.needs import Needs
from sierra.store.sql_names import identifier
from sierra.util.text import counted


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
    rows: Annotated[bool, ROWS] = False


class Histogram(DrawnKind[HistogramOptions]):
    """The number of runs in each of several ranges of a value, as an outline for each experiment."""

    Options: ClassVar[type[Table]] = HistogramOptions
    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT - {"log_x", "log_y"}

    def needs(self, request: Request) -> Needs:
        if self.options.rows:
            return Needs(rows=of_rows(request, 1), sample="rows", shows="histogram of the rows")
        return Needs(("median",), runs=True, shows="histogram of the runs")

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import distributions, sampled_runs

        bins = self.options.bins
        draw = partial(distributions.histogram, bins=bins, density=self.options.density)
        drawn = DrawnBy(draw, (lambda drawing: [f"{len(distributions.edges(drawing, bins)) - 1} bins"],))
        return sampled_runs.of_rows(drawn) if self.options.rows else drawn


def of_rows(request: Request, count: int) -> dict[str, str]:
    """Return the statements of the rows with finite values of the columns, and of the number of all rows.

    Raises UsageError for a key that reduces the rows of a run to one value, and for another number of columns.
    """
    if chosen := {"measure", "threshold"} & request.figure.model_fields_set:
        raise UsageError(f"{min(chosen)} reduces the rows of a run to one value, but rows = true shows all rows")
    if len(request.columns) != count:
        raise UsageError(f"a {request.figure.kind} of rows needs {counted(count, 'column')}, not {len(request.columns)}")
    numbers = [f"{identifier(name)}::DOUBLE" for name in request.columns]
    values = ", ".join(f"{number} AS {name}" for number, name in zip(numbers, ("value", "value_2"), strict=False))
    finite = " AND ".join(f"isfinite({number})" for number in numbers)
    return {
        "rows": f'SELECT "# experiment" AS experiment, run, {values} FROM data WHERE {finite} '
        'ORDER BY experiment, run, "# place"',
        "all": "SELECT count(*) AS count FROM data",
    }
