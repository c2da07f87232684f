"""The kind `ridge`: densities of runs, one above the other."""

from __future__ import annotations

from typing import ClassVar

from sierra.config.plugin_registry import NoOptions
from sierra.deliverables.figures.base import STATISTICAL, DrawnBy, DrawnKind, Request
from sierra.stats.needs import Needs


class Ridge(DrawnKind[NoOptions]):
    """The density of the runs of each experiment, one above the other."""

    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet", "xlim", "palette", "labels"})

    def needs(self, request: Request) -> Needs:
        return Needs(("median",), runs=True, shows="density of the runs, line: median, each tick a run")

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import sampled_runs
        from sierra.extensions.figures.ridge_drawing import ridge, without_density

        return DrawnBy(ridge, (without_density, sampled_runs.notes))
