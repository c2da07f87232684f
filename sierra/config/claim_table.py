"""Tables of `sierra.toml` about claims: what a paper says, and how the recorded runs decide it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from sierra.config.deliverable_tables import known_method
from sierra.config.field_types import (
    Alpha,
    Criteria,
    Finite,
    Line,
    ListOfWords,
    Measured,
    OfQuery,
    Positive,
)
from sierra.util.lazy_definitions import regex

DECISIONS = ("sql", "value", "order", "equivalence")
"""The ways to decide a claim."""
_PERCENT = regex(r"\s*(\d+(?:\.\d+)?)\s*%\s*")


def _margin(margin: float | str) -> float | str:
    found = _PERCENT.fullmatch(margin) if isinstance(margin, str) else None
    if not (float(found[1]) if found else 0.0 if isinstance(margin, str) else margin) > 0:
        raise ValueError(f"{margin!r} should be a number above 0, or a percentage such as 5 %")
    return margin


def _count(count: int | str) -> int | str:
    if not (_PERCENT.fullmatch(count) if isinstance(count, str) else count >= 0):
        raise ValueError(f"{count!r} should be a number of runs, or a percentage such as 5 %")
    return count


def _plan_n(command: str) -> str:
    words = command.split()
    if words and words[:2] != ["sierra", "plan-n"]:
        raise ValueError(f"{command!r} should be the command, as in: sierra plan-n 518b --difference 0.05")
    return " ".join(words)


Margin = Annotated[Finite | str, AfterValidator(_margin)]
"""A distance in the column's unit, or a percentage such as `5 %` of a value."""


def distance(margin: float | str, value: float) -> float:
    """Return a margin as a distance in the unit of `value`."""
    return float(margin.strip().rstrip("%")) / 100 * abs(value) if isinstance(margin, str) else margin


class ClaimedValue(Measured):
    """A value of one experiment: the claim holds if the whole 95 % interval is within the margin around it."""

    statistic: Annotated[str, Field(min_length=1)] = Field(
        "mean", description="statistic over the runs, as in `sierra stats --statistic`; the mean of flags is a rate"
    )
    expected: Finite = Field(description="the value that the paper says, in the column's unit")
    margin: Margin = Field(description="largest distance that agrees, in the column's unit, or as a percentage: `5 %`")
    better: Literal["higher", "lower"] | None = Field(None, description="the better values, for comparisons with a baseline")
    regression: Margin | None = Field(
        None,
        description="largest change for the worse since a baseline that does not matter, in the column's unit, or as a "
        "percentage of the baseline's value: `5 %`",
    )

    @model_validator(mode="after")
    def _decidable(self) -> ClaimedValue:
        from sierra.config.statistic_names import CENSORED, complaint

        if self.statistic in CENSORED and self.measure != "time_to":
            raise ValueError(f'statistic "{self.statistic}" needs measure = "time_to"')
        if self.statistic not in CENSORED and (wrong := complaint(self.statistic)):
            raise ValueError(f"statistic: {wrong}")
        if self.expected == 0 and isinstance(self.margin, str):
            raise ValueError("a percentage of 0 is 0; write the margin as a number in the column's unit")
        if (self.better is None) != (self.regression is None):
            raise ValueError('"better" and "regression" must be used together')
        return self


class Tested(Measured):
    """Groups of runs that a test compares."""

    groups: Annotated[ListOfWords, Field(min_length=2)] = Field(
        description="with `by`: values of the variable; without: labels of `batches`. An order has the group with the greatest "
        "values first"
    )
    by: str = Field("", description="the variable whose values are the groups: `controller`, `scenario` or another one")
    method: Annotated[str, Field(min_length=1), AfterValidator(known_method)] = Field(
        "auto", description="how groups are tested, as in `[comparisons.NAME]`; `auto`: what suits the data"
    )
    paired: bool | Literal["auto"] = Field(
        "auto", description="whether runs with the same seed are compared as pairs; `auto`: if their values are correlated"
    )
    alpha: Alpha = 0.05

    @model_validator(mode="after")
    def _different(self) -> Tested:
        if len(set(self.groups)) < len(self.groups):
            raise ValueError(f"a group is named twice: {', '.join(self.groups)}")
        return self


class ClaimedOrder(Tested):
    """An order of groups: each has greater values than the next one, in all experiments that count."""


class ClaimedEquivalence(Tested):
    """The equivalence of two groups, by two one-sided tests, in all experiments that count."""

    groups: Annotated[ListOfWords, Field(min_length=2, max_length=2)] = Field(
        description="the two groups: with `by`, values of the variable; without, labels of `batches`"
    )
    margin: Positive = Field(description="the largest difference that does not matter, in the column's unit")


class Claim(OfQuery):
    """One claim of a paper, decided by exactly one of `sql`, `value`, `order` and `equivalence`."""

    says: Line = Field(description="the sentence of the paper")
    figure: str = Field("", description="name of the figure in `figures` that shows it")
    table: str = Field("", description="name of the table in `paper_tables` that shows it")
    paper: str = Field("", description="place in the paper, such as `Fig. 3`")
    query: Criteria = Field(
        (), description="the query whose batch decides, as for `sierra run`; or the name of one in `queries`"
    )
    plan_n: Annotated[str, AfterValidator(_plan_n)] = Field(
        "", description="the `sierra plan-n` command that the number of runs came from; it is registered with the claim"
    )
    batches: ListOfWords = Field(
        (),
        description="the batches that decide, instead of `query`: each the prefix of an id or the name of a query in "
        "`queries`, also as `LABEL=` and one of these",
    )
    lost: Annotated[int | str, AfterValidator(_count)] = Field(
        0,
        description="largest number of runs without a value, or percentage such as `5 %`: because they failed, are missing, "
        "were cut off, or wrote no finite value; with more, the claim cannot be decided",
    )
    sql: str = Field(
        "",
        description="a SELECT statement with one row, whose first column says whether the claim holds; further columns are "
        "numbers to report. Each table has a column `batch`, with the label of the batch",
    )
    value: ClaimedValue | None = Field(None, description="a value with a margin")
    order: ClaimedOrder | None = Field(None, description="an order of groups")
    equivalence: ClaimedEquivalence | None = Field(None, description="the equivalence of two groups")

    @property
    def tested(self) -> ClaimedOrder | ClaimedEquivalence | None:
        """Return what tests decide; None for a claim that is decided otherwise."""
        return self.order or self.equivalence

    @model_validator(mode="after")
    def _fitting(self) -> Claim:
        given = [name for name in DECISIONS if getattr(self, name)]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {', '.join(DECISIONS)}{'; not ' + ' and '.join(given) if given else ''}")
        if bool(self.query) == bool(self.batches):
            raise ValueError('give either "query" or "batches"')
        if self.batches and (wrong := [name for name in ("runs", "controller", "scenario", "target") if getattr(self, name)]):
            raise ValueError(f'"{wrong[0]}" needs "query"; a batch has its own')
        if not (self.figure or self.table or self.paper):
            raise ValueError('say where the paper shows it: give "figure", "table" or "paper"')
        if self.tested and not self.tested.by and len(self.batches) < 2:
            raise ValueError('"by" is missing: the variable whose values are the groups; or give two batches or more')
        if (self.value or (self.tested and self.tested.by)) and len(self.batches) > 1:
            raise ValueError("this is decided within one batch; give one")
        return self

    def allowed(self, runs: int) -> int:
        """Return how many of these runs may be without a value."""
        return self.lost if isinstance(self.lost, int) else int(distance(self.lost, runs) + 1e-9)
