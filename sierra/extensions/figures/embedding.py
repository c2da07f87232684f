"""The kind that shows runs with many columns as points of a plane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from sierra.config.field_types import Positive, Table
from sierra.deliverables.figures.base import PLOT, Request
from sierra.errors import UsageError
from sierra.stats.needs import Needs

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing


class EmbeddingOptions(Table):
    """Figures of kind `embedding`."""

    method: Literal["pca", "tsne"] = Field(
        "pca", description="`pca`: principal components; `tsne`: t-SNE, which needs the extra `embedding` (scikit-learn)"
    )
    perplexity: Positive = Field(
        30.0, description="for `tsne`: about how many neighbours each run has; at most a third of the number of other runs"
    )


class Embedding:
    """Each run as a mark in a plane, by several standardised columns: principal components or t-SNE."""

    contract = 1
    Options: ClassVar[type[Table]] = EmbeddingOptions
    libraries: ClassVar[tuple[str, ...]] = ("scikit-learn",)
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT - {"log_x", "log_y"}

    def __init__(self, options: EmbeddingOptions) -> None:
        self._options = options

    def needs(self, request: Request) -> Needs:
        if len(request.columns) < 2:
            raise UsageError(f"an embedding needs two columns or more, not {len(request.columns)}")
        shows = "each mark a run, standardised columns"
        return Needs(("median",), runs=True, columns=None, shows=shows)

    def notes(self, drawing: Drawing) -> Sequence[str]:
        from sierra.extensions.figures import embedding_drawing

        return embedding_drawing.notes(drawing, self._perplexity(drawing))

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.extensions.figures.embedding_drawing import embedding

        return embedding(drawing, self._perplexity(drawing))

    def _perplexity(self, drawing: Drawing) -> float | None:
        """Return the perplexity of t-SNE for this number of runs; None for principal components."""
        if self._options.method == "pca" or drawing.runs is None:
            return None
        others: int = drawing.runs.num_rows - 1
        return min(self._options.perplexity, max(1.0, others / 3))
