"""Gather the data of a figure: what its kind needs, computed by SQL from a source."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from sierra.config.deliverable_tables import Figure
from sierra.deliverables.figures.base import Request, kind_of
from sierra.deliverables.figures.drawing import Drawing
from sierra.model import Axis, Value
from sierra.stats import aggregate as stats
from sierra.stats.needs import Needs

if TYPE_CHECKING:
    import pyarrow as pa


class Source(Protocol):
    """One output of one batch."""

    def check(self, columns: Sequence[str], *, numeric: bool) -> None:
        """Raise NotFound for a column that does not exist, UsageError for one that is not numeric but should be."""

    def samples(self, column: str) -> stats.Frame:
        """Return the frame of one column, for statistics."""

    def rows(self, statement: str) -> pa.Table:
        """Return the result of a statement on the relation `data`: see `Needs.rows`."""


@dataclass(frozen=True, slots=True)
class Batch:
    """What figures of one batch share."""

    axes: tuple[Axis, ...]
    cells: Mapping[int, Mapping[str, Value]]
    """By ordinal of the experiment: the value of each axis."""
    planned: Mapping[int, int]
    """The number of runs that each experiment should have."""
    id: str = ""


def gather(
    name: str,
    figure: Figure,
    columns: tuple[str, ...],
    batch: Batch,
    source: Source,
    seen: stats.Coverage,
    whole: Container[str] = (),
) -> Drawing:
    """Return the drawing of a figure, without units. Raises SierraError if there is nothing to draw.

    `seen` is the coverage of the output, `whole` has its columns of whole numbers.
    """
    needs = kind_of(figure).needs(Request(figure, batch.axes, len(seen.runs), seen.most, columns))
    source.check(columns, numeric=needs.numeric)
    computed = stats.Computed({}, None, "", "")
    if needs.statistics or needs.runs:
        frames = {column: source.samples(column) for column in columns}
        computed = stats.compute(figure, frames, needs, planned=batch.planned, known=seen, whole=whole)
    return Drawing(
        name=name,
        figure=figure if figure.columns == columns else figure.model_copy(update={"columns": columns}),
        axes=batch.axes,
        cells=batch.cells,
        tables=computed.tables,
        runs=computed.runs,
        rows={key: source.rows(statement) for key, statement in needs.rows.items()},
        note=computed.note or _note(needs, seen, batch.planned),
        sql="\n\n".join(filter(None, (computed.sql, *needs.rows.values()))),
        batch=batch.id,
    )


def _note(needs: Needs, seen: stats.Coverage, planned: Mapping[int, int]) -> str:
    """Return the small print of a figure that has no statistics: what it shows, n, and the runs that are not in it."""
    low, high = min(seen.runs.values()), max(seen.runs.values())
    runs = f"n = {low}–{high}" if low < high else f"n = {low}"
    return "; ".join([", ".join(filter(None, (needs.shows, runs))), *stats.left_out((), seen, planned)])
