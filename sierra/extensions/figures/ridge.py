"""The kind `ridge`: densities of runs, one above the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from sierra.deliverables.figures.base import STATISTICAL, PlainKind, Request
from sierra.stats.needs import Needs

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing


class Ridge(PlainKind):
    """The density of the runs of each experiment, one above the other."""

    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet", "xlim", "palette", "labels"})

    def needs(self, request: Request) -> Needs:
        return Needs(("median",), runs=True, shows="density of the runs, line: median, each tick a run")

    def notes(self, drawing: Drawing) -> Sequence[str]:
        from sierra.deliverables.figures import sampled_runs
        from sierra.extensions.figures.ridge_drawing import without_density

        return [*without_density(drawing), *sampled_runs.notes(drawing)]

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.extensions.figures.ridge_drawing import ridge

        return ridge(drawing)
