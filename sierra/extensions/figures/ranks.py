"""The kind for mean ranks of several groups over blocks: the critical-difference diagram (Demšar 2006)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar, Literal

from pydantic import Field

from sierra.config.field_types import Alpha, Table
from sierra.deliverables.figures.base import DrawnBy, DrawnKind, Request
from sierra.errors import UsageError
from sierra.model import Axis
from sierra.stats import words
from sierra.stats.needs import Needs


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
    alpha: Alpha = 0.05

    def within(self, axes: Sequence[Axis]) -> Literal["experiments", "seeds"]:
        """Return what groups are ranked within."""
        if self.blocks != "auto":
            return self.blocks
        return "experiments" if len(axes) > 1 else "seeds"


class CriticalDifference(DrawnKind[CriticalDifferenceOptions]):
    """The mean ranks of groups, which are the values of one variable; bars join groups that were not shown to differ."""

    Options: ClassVar[type[Table]] = CriticalDifferenceOptions
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "center", "x", "labels"})

    def needs(self, request: Request) -> Needs:
        if not request.axes or len(request.axes[0].values) < 2:
            raise UsageError("a critical_difference figure needs a variable (x) with two values or more: its groups")
        if self.options.blocks == "experiments" and len(request.axes) < 2:
            raise UsageError('blocks = "experiments" needs a second variable, but this batch has one; use blocks = "seeds"')
        center = request.figure.center
        of = f"the {words.named(center)} of the runs" if self.options.within(request.axes) == "experiments" else "runs"
        return Needs(chosen=(center,), runs=True, seeds=True, shows=f"mean ranks of {of}")

    def drawn_by(self) -> DrawnBy:
        from sierra.extensions.figures.ranks_drawing import diagram, notes

        return DrawnBy(partial(diagram, options=self.options), (partial(notes, options=self.options),))
