"""Rules that end a sequential study: how narrow intervals must be.

    rule      = condition {"and" condition}
    condition = "ci(" (column | statistic "(" column ")") ")" "<" number ["%"]
    column    = [table "."] name

`ci(coverage) < 0.02` means that the 95 % interval of the mean of `coverage` is at most 0.02 wide to either side: half of its
width is below 0.02, in the column's unit. With `%`, the limit is relative to the statistic's absolute value. Names with other
characters than letters, digits, `_` and `-` are written in double quotes.
"""

from __future__ import annotations

from math import isfinite

from sierra.errors import QueryError
from sierra.util.lazy_definitions import dataclass, regex

EXAMPLE = "ci(coverage) < 0.02"
MEAN = "mean"
_NAME = r'(?:"[^"]+"|[\w-]+)'
_CONDITION = regex(
    rf"\s*ci\s*\(\s*(?:(?P<statistic>[\w.]+)\s*\(\s*)?(?:(?P<table>{_NAME})\s*\.\s*)?(?P<column>{_NAME})\s*(?P<closed>\)\s*)?\)"
    r"\s*(?P<operator><=?|>=?|=)\s*(?P<limit>[^\s%]+)\s*(?P<percent>%?)\s*"
)
_AND = regex(r"\sand\s(?=\s*ci\b)")
_PLAIN = regex(r"[\w-]+")


@dataclass(frozen=True, slots=True)
class Condition:
    """An upper limit on half of the width of one interval."""

    statistic: str
    table: str
    """The output or derived table; empty: the only one with this column."""
    column: str
    limit: float
    relative: bool
    """True if the limit is a part of the statistic's absolute value."""

    def __str__(self) -> str:
        column = ".".join(map(_written, filter(None, (self.table, self.column))))
        inner = column if self.statistic == MEAN else f"{self.statistic}({column})"
        return f"ci({inner}) < {f'{100 * self.limit:.12g}%' if self.relative else f'{self.limit:.12g}'}"

    def wanted(self, value: float) -> float:
        """Return the half-width below which the condition holds, if the statistic has this value."""
        return self.limit * abs(value) if self.relative else self.limit


@dataclass(frozen=True, slots=True)
class Rule:
    """Conditions that must all hold, in every experiment."""

    conditions: tuple[Condition, ...]

    def __str__(self) -> str:
        return " and ".join(map(str, self.conditions))


def parse(text: str) -> Rule:
    """Return the rule that a text describes. Raises QueryError with a one-line message that has an example."""
    conditions = tuple(map(_condition, _AND.split(text)))
    if twice := next((one for one in conditions if conditions.count(one) > 1), None):
        raise QueryError(f"--until {text!r}: the condition {str(twice)!r} occurs twice")
    return Rule(conditions)


def _condition(text: str) -> Condition:
    match = _CONDITION.fullmatch(text)
    if match is None or bool(match["statistic"]) != bool(match["closed"]):
        raise QueryError(
            f"--until: {text.strip()!r} is not a condition; use, for example, {EXAMPLE!r}, 'ci(swarm.coverage) < 5%' or "
            "'ci(median(coverage)) < 0.02'"
        )
    if match["operator"] != "<":
        raise QueryError(
            f"--until: {text.strip()!r} has the operator {match['operator']}; an interval must be narrow, so use <"
        )
    limit = _number(match["limit"], text) / (100 if match["percent"] else 1)
    return Condition(
        match["statistic"] or MEAN, _read(match["table"] or ""), _read(match["column"]), limit, relative=bool(match["percent"])
    )


def _number(text: str, condition: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not isfinite(value) or value <= 0:
        raise QueryError(f"--until: {condition.strip()!r} has the limit {text!r}; use a number above 0, as in {EXAMPLE!r}")
    return value


def _read(name: str) -> str:
    return name.strip('"')


def _written(name: str) -> str:
    return name if _PLAIN.fullmatch(name) else f'"{name}"'
