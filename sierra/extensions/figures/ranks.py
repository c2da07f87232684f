"""The kind for mean ranks of several groups over blocks: the critical-difference diagram (Demšar 2006)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from sierra.config.field_types import Table
from sierra.deliverables.figures.base import Request
from sierra.errors import UsageError
from sierra.model import Axis
from sierra.stats import words
from sierra.stats.needs import Needs

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing
    from sierra.extensions.figures.block_ranks import Ranking


class CriticalDifferenceOptions(Table):
    """Figures of kind `critical_difference`."""

    better: Literal["high", "low"] = Field("high", description="whether `high` or `low` values are better; the best has rank 1")
    blocks: Literal["auto", "experiments", "seeds"] = Field(
        "auto",
        description="what groups are ranked within: `experiments`: each combination of the other variables, by the centers of "
        "its runs; `seeds`: each seed in each of these combinations; `auto`: `experiments` if there are other variables",
    )
    test: Literal["nemenyi", "wilcoxon"] = Field(
        "nemenyi",
        description="test of each two groups: `nemenyi`: by the critical difference of mean ranks; "
        "`wilcoxon`: by the signed-rank test, corrected by Holm; two groups are always compared by `wilcoxon`",
    )
    alpha: Annotated[float, Field(gt=0, lt=0.5)] = Field(0.05, description="significance level")


class CriticalDifference:
    """The mean ranks of groups, which are the values of one variable; bars join groups that were not shown to differ."""

    contract = 1
    Options: ClassVar[type[Table]] = CriticalDifferenceOptions
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "center", "x", "labels"})

    def __init__(self, options: CriticalDifferenceOptions) -> None:
        self._options = options

    def needs(self, request: Request) -> Needs:
        if not request.axes or len(request.axes[0].values) < 2:
            raise UsageError("a critical_difference figure needs a variable (x) with two values or more: its groups")
        if self._options.blocks == "experiments" and len(request.axes) < 2:
            raise UsageError('blocks = "experiments" needs a second variable, but this batch has one; use blocks = "seeds"')
        center = request.figure.center
        of = f"the {words.named(center)} of the runs" if self.within(request.axes) == "experiments" else "runs"
        return Needs(chosen=(center,), runs=True, seeds=True, shows=f"mean ranks of {of}")

    def within(self, axes: Sequence[Axis]) -> Literal["experiments", "seeds"]:
        """Return what groups are ranked within."""
        if self._options.blocks != "auto":
            return self._options.blocks
        return "experiments" if len(axes) > 1 else "seeds"

    def notes(self, drawing: Drawing) -> Sequence[str]:
        from sierra.extensions.figures import ranks_drawing

        return ranks_drawing.notes(self._ranked(drawing))

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.extensions.figures import ranks_drawing

        return ranks_drawing.diagram(self._ranked(drawing), drawing)

    def _ranked(self, drawing: Drawing) -> Ranking:
        from sierra.extensions.figures import ranks_drawing

        options = self._options
        blocks = ranks_drawing.blocks(drawing, self.within(drawing.axes))
        return ranks_drawing.ranked(drawing, blocks, options.test, options.alpha, best_is_high=options.better == "high")
