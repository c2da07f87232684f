"""The kind that shows runs with many columns as points of a plane."""

from __future__ import annotations

from functools import partial
from typing import ClassVar, Literal

from pydantic import Field

from sierra.config.field_types import Positive, Table
from sierra.deliverables.figures.base import PLOT, DrawnBy, DrawnKind, Request
from sierra.errors import UsageError
from sierra.stats.needs import Needs


class EmbeddingOptions(Table):
    """Figures of kind `embedding`."""

    method: Literal["pca", "tsne"] = Field(
        "pca", description="`pca`: principal components; `tsne`: t-SNE, which needs the extra `embedding` (scikit-learn)"
    )
    perplexity: Positive = Field(
        30.0, description="for `tsne`: about how many neighbours each run has; at most a third of the number of other runs"
    )


class Embedding(DrawnKind[EmbeddingOptions]):
    """Each run as a mark in a plane, by several standardised columns: principal components or t-SNE."""

    Options: ClassVar[type[Table]] = EmbeddingOptions
    libraries: ClassVar[tuple[str, ...]] = ("scikit-learn",)
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT - {"log_x", "log_y"}

    def needs(self, request: Request) -> Needs:
        if len(request.columns) < 2:
            raise UsageError(f"an embedding needs two columns or more, not {len(request.columns)}")
        shows = "each mark a run, standardised columns"
        return Needs(("median",), runs=True, columns=None, shows=shows)

    def drawn_by(self) -> DrawnBy:
        from sierra.extensions.figures.embedding_drawing import embedding, notes

        return DrawnBy(partial(embedding, options=self.options), (partial(notes, options=self.options),))
