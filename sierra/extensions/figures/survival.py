"""The kind for times until an event: the part of the runs that have not reached a threshold, over time."""

from __future__ import annotations

from typing import ClassVar

from sierra.config.plugin_registry import NoOptions
from sierra.deliverables.figures.base import PLOT, DrawnBy, DrawnKind, Request
from sierra.errors import UsageError
from sierra.stats.needs import Needs
from sierra.store.sql_names import identifier


class Survival(DrawnKind[NoOptions]):
    """The Kaplan-Meier curve of each experiment; a run that never reaches the threshold is censored at its last time."""

    uses: ClassVar[frozenset[str]] = frozenset({"measure", "series", "facet"}) | PLOT - {"log_x", "log_y"}

    def needs(self, request: Request) -> Needs:
        from sierra.stats import survival

        if request.figure.threshold is None:
            raise UsageError('a survival figure needs measure = "time_to" and a threshold: the value that is the event')
        if len(request.columns) != 1:
            raise UsageError(f"a survival figure needs one column, not {len(request.columns)}")
        value = f"{identifier(request.columns[0])}::DOUBLE"
        samples = f'SELECT "# experiment" AS experiment, run, "# t" AS t, {value} AS value FROM data'
        times = survival.statement().replace("$threshold", repr(request.figure.threshold))
        counts = (
            "SELECT count(*) AS rows, count(*) FILTER (value IS NULL OR isnan(value)) AS missing, "
            f"count(DISTINCT (experiment, run)) AS runs FROM ({samples})"
        )
        shows = "Kaplan-Meier curves, 95 % CI at each time (log-log), | censored"
        return Needs(rows={"times": f"WITH samples AS ({samples})\n{times}", "counts": counts}, single=True, shows=shows)

    def drawn_by(self) -> DrawnBy:
        from sierra.extensions.figures.survival_drawing import notes, survival

        return DrawnBy(survival, (notes,))
