"""Kinds for classifiers and detectors: each run is one sample, so that intervals are over runs and not over rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from sierra.config.field_types import Table
from sierra.deliverables.figures.base import STATISTICAL, PlainKind, Request
from sierra.errors import UsageError
from sierra.stats.needs import Needs
from sierra.store.sql_names import identifier, quote

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing

CURVE = frozenset({"series", "facet", "palette", "labels", "xlim", "ylim"})


class Confusion(PlainKind):
    """The share of each true category that was predicted as each category, from two columns: the truth and the prediction."""

    libraries: ClassVar[tuple[str, ...]] = STATISTICAL
    uses: ClassVar[frozenset[str]] = frozenset({"facet", "labels"})

    def needs(self, request: Request) -> Needs:
        truth, predicted = (f"{identifier(name)}::VARCHAR" for name in _two(request, "the truth and the prediction"))
        statement = (
            f'SELECT "# experiment" AS experiment, run, {truth} AS truth, {predicted} AS predicted, count(*) AS count '
            f"FROM data WHERE {truth} IS NOT NULL AND {predicted} IS NOT NULL GROUP BY ALL ORDER BY ALL"
        )
        shows = "mean over runs of each run's part of a row, ± half of its 95 % CI"
        return Needs(rows={"counts": statement, "all": ALL}, columns=2, numeric=False, shows=shows)

    def notes(self, drawing: Drawing) -> Sequence[str]:
        from sierra.extensions.figures import classifiers_drawing

        return classifiers_drawing.notes_on_confusion(drawing)

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.extensions.figures.classifiers_drawing import confusion

        return confusion(drawing)


class CurveOptions(Table):
    """Figures of kinds `roc` and `pr`."""

    positive: str | None = Field(
        None, description="value of the first column, as text, that makes a row positive; by default `1` or `true`"
    )


class Roc:
    """True-positive rate over false-positive rate, from two columns: the truth and the score."""

    contract = 1
    Options: ClassVar[type[Table]] = CurveOptions
    uses: ClassVar[frozenset[str]] = CURVE

    def __init__(self, options: CurveOptions) -> None:
        self._positive = (options.positive,) if options.positive is not None else ("1", "true")

    def needs(self, request: Request) -> Needs:
        truth, score = _two(request, "the truth and the score")
        return Needs(
            rows=_scores(f"{identifier(truth)}::VARCHAR IN ({', '.join(map(quote, self._positive))})", score),
            columns=2,
            numeric=False,
            shows="mean of the curves of the runs, 95 % CI of the mean at each place",
        )

    def notes(self, drawing: Drawing) -> Sequence[str]:
        from sierra.extensions.figures import classifiers_drawing

        return classifiers_drawing.notes_on_curves(drawing)

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.extensions.figures.classifiers_drawing import roc

        return roc(drawing)


class Pr(Roc):
    """Precision over recall, from two columns: the truth and the score."""

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.extensions.figures.classifiers_drawing import precision_recall

        return precision_recall(drawing)


class RiskCoverage(PlainKind):
    """The mean loss of the part of the rows with the highest confidence, from two columns: the loss and the confidence."""

    uses: ClassVar[frozenset[str]] = CURVE

    def needs(self, request: Request) -> Needs:
        loss, confidence = (f"{identifier(name)}::DOUBLE" for name in _two(request, "the loss and the confidence"))
        statement = (
            f'SELECT "# experiment" AS experiment, run, {confidence} AS score, count(*) AS count, '
            f"list_sum(list_sort(list({loss}))) AS loss FROM data WHERE isfinite({loss}) AND isfinite({confidence}) "
            "GROUP BY ALL ORDER BY experiment, run, score DESC"
        )
        shows = "mean of the curves of the runs, 95 % CI of the mean at each place"
        return Needs(rows={"scores": statement, "all": ALL}, columns=2, shows=shows)

    def notes(self, drawing: Drawing) -> Sequence[str]:
        from sierra.extensions.figures import classifiers_drawing

        return classifiers_drawing.left_out_rows(drawing, drawing.rows["scores"])

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        from sierra.extensions.figures.classifiers_drawing import risk_coverage

        return risk_coverage(drawing)


ALL = "SELECT count(*) AS count FROM data"


def _two(request: Request, what: str) -> tuple[str, str]:
    if len(request.columns) != 2:
        raise UsageError(f"a {request.figure.kind} figure needs two columns, {what}, not {len(request.columns)}")
    first, second = request.columns
    return first, second


def _scores(positive: str, score: str) -> dict[str, str]:
    """Return the statement of the positive and negative rows of each run at each score, from the highest score on."""
    number = f"{identifier(score)}::DOUBLE"
    statement = (
        f'SELECT "# experiment" AS experiment, run, {number} AS score, count(*) AS count, '
        f"count(*) FILTER ({positive}) AS positive FROM data "
        f"WHERE isfinite({number}) AND ({positive}) IS NOT NULL GROUP BY ALL ORDER BY experiment, run, score DESC"
    )
    return {"scores": statement, "all": ALL}
