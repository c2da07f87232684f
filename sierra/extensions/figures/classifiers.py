"""Kinds for classifiers and detectors: each run is one sample, so that intervals are over runs and not over rows."""

from __future__ import annotations

from functools import partial
from typing import ClassVar

from pydantic import Field, model_validator

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.deliverables.figures.base import STATISTICAL, DrawnBy, DrawnKind, Request
from sierra.errors import UsageError
from sierra.stats.needs import Needs
from sierra.store.sql_names import identifier, quote
from sierra.util.text import counted

CURVE = frozenset({"series", "facet", "palette", "labels", "xlim", "ylim"})


class Confusion(DrawnKind[NoOptions]):
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

    def drawn_by(self) -> DrawnBy:
        from sierra.extensions.figures.classifiers_drawing import confusion, notes_on_confusion

        return DrawnBy(confusion, (notes_on_confusion,))


class CurveOptions(Table):
    """Figures of kinds `roc` and `pr`."""

    positive: str | None = Field(
        None, description="value of the first column, as text, that makes a row positive; by default `1` or `true`"
    )
    classes: tuple[str, ...] = Field(
        (),
        description="values of the first column, as text, whose scores the further columns have, in this order: a curve for "
        "each class against the others, of all their decisions together (micro), and of the mean over the classes (macro)",
    )

    @model_validator(mode="after")
    def _fitting(self) -> CurveOptions:
        if self.classes and self.positive is not None:
            raise ValueError('"positive" is for two classes; "classes" names several')
        if len(set(self.classes)) < len(self.classes) or len(self.classes) == 1:
            raise ValueError('"classes" should name two classes or more, each once')
        return self


class Roc(DrawnKind[CurveOptions]):
    """True-positive rate over false-positive rate, from two columns, the truth and the score, or from a score of each class."""

    Options: ClassVar[type[Table]] = CurveOptions
    uses: ClassVar[frozenset[str]] = CURVE
    draws: ClassVar[str] = "roc"

    def needs(self, request: Request) -> Needs:
        shows = "mean of the curves of the runs, 95 % CI of the mean at each place"
        if self.options.classes:
            if request.figure.series:
                raise UsageError("classes have a line each, so that series has no effect; use facet, or leave it out")
            rows, columns = _scores_of_classes(request, self.options.classes), request.columns
            return Needs(rows=rows, sample="scores", columns=len(columns), numeric=False, numbers=columns[1:], shows=shows)
        truth, score = _two(request, "the truth and the score")
        positive = ("1", "true") if self.options.positive is None else (self.options.positive,)
        is_positive = f"{identifier(truth)}::VARCHAR IN ({', '.join(map(quote, positive))})"
        return Needs(rows=_scores(is_positive, score), columns=2, numeric=False, numbers=(score,), shows=shows)

    def drawn_by(self) -> DrawnBy:
        from sierra.extensions.figures import classifiers_drawing as drawn

        draw, classes = getattr(drawn, self.draws), self.options.classes
        if classes:
            return DrawnBy(partial(draw, classes=classes), (partial(drawn.notes_on_classes, classes=classes),))
        return DrawnBy(draw, (drawn.notes_on_curves,))


class Pr(Roc):
    """Precision over recall, from two columns, the truth and the score, or from a score of each class."""

    draws: ClassVar[str] = "precision_recall"


class RiskCoverage(DrawnKind[NoOptions]):
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

    def drawn_by(self) -> DrawnBy:
        from sierra.extensions.figures.classifiers_drawing import left_out_rows, risk_coverage

        return DrawnBy(risk_coverage, (partial(left_out_rows, table="scores"),))


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


def _scores_of_classes(request: Request, classes: tuple[str, ...]) -> dict[str, str]:
    """Return the statements of the rows of each class against the others, and of all these decisions together.

    Rows without a truth, or without a score of each class, do not count. Raises UsageError unless each class has a column.
    """
    truth, *scores = request.columns
    if len(scores) != len(classes):
        counts = f"{len(classes)} classes, but {counted(len(scores), 'column')} after the truth"
        raise UsageError(f"a {request.figure.kind} figure of classes needs a column with the score of each; there are {counts}")
    actual = f"{identifier(truth)}::VARCHAR"
    numbers = [f"{identifier(name)}::DOUBLE" for name in scores]
    whole = " AND ".join([f"{actual} IS NOT NULL", *(f"isfinite({number})" for number in numbers)])
    decided = " UNION ALL ".join(
        f'SELECT "# experiment" AS experiment, run, {index} AS class, {number} AS score, {actual} = {quote(name)} AS positive '
        f"FROM data WHERE {whole}"
        for index, (name, number) in enumerate(zip(classes, numbers, strict=True))
    )
    sums = "count(*) AS count, count(*) FILTER (positive) AS positive"
    return {
        "scores": f"SELECT experiment, run, class, score, {sums} FROM ({decided}) GROUP BY ALL "
        "ORDER BY experiment, run, class, score DESC",
        "micro": f"SELECT experiment, run, score, {sums} FROM ({decided}) GROUP BY ALL ORDER BY experiment, run, score DESC",
        "truths": f"SELECT {actual} AS truth, count(*) FILTER ({whole}) AS count FROM data GROUP BY ALL ORDER BY ALL",
        "all": ALL,
    }
