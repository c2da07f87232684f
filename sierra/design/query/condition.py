"""Conditions on the variables of a query: they select some of a batch's experiments.

    condition  = comparison {"and" comparison}
    comparison = name operator value {"," value}
    operator   = "=" | "!=" | "<" | "<=" | ">" | ">="

Values have the form of the values in a criterion: `0.5`, `1e-3`, `low`. With `=`, a list means one of its values; with `!=`,
none of them; the other operators take one number. A value after `=` or `!=` must be a value of the variable, so that a
mistyped value is an error and not an empty selection.
"""

from __future__ import annotations

import difflib
import operator
from collections.abc import Callable, Mapping, Sequence

from sierra.design.query import grammar
from sierra.errors import QueryError
from sierra.model import Axis, Batch, Value
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.text import few

EXAMPLE = "population_size<=4 and noise=0,0.5"
SHOWN = 10
ORDERED: Mapping[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_COMPARISON = regex(r"\s*(?P<name>[A-Za-z_][A-Za-z0-9_]*)\s*(?P<operator><=|>=|!=|=|<|>)\s*(?P<values>[^<>=!\s]+)\s*")
_AND = regex(r"\sand\s")
_BLANKS = regex(r"\s*,\s*")


@dataclass(frozen=True, slots=True)
class Comparison:
    """One comparison of a condition."""

    name: str
    operator: str
    values: tuple[Value, ...]

    def holds(self, value: Value) -> bool:
        """Return whether it holds for a value of its variable."""
        match self.operator:
            case "=":
                return value in self.values
            case "!=":
                return value not in self.values
            case _:
                [limit] = self.values
                return not isinstance(value, str) and not isinstance(limit, str) and ORDERED[self.operator](value, limit)


@dataclass(frozen=True, slots=True)
class Selection:
    """The experiments of a batch that a condition selects."""

    text: str
    """The condition."""
    experiments: frozenset[int]
    """Their ordinals."""
    runs: frozenset[str]
    """The ids of their runs."""


def select(text: str, batch: Batch) -> Selection:
    """Return the experiments that a condition selects.

    Raises QueryError for an invalid condition, for an unknown variable or value, and if it selects nothing.
    """
    ordinals = matching(text, batch.axes, {one.ordinal: one.values for one in batch.experiments}, "--only")
    runs = frozenset(run.id for one in batch.experiments if one.ordinal in ordinals for run in one.runs)
    return Selection(text, ordinals, runs)


def matching(text: str, axes: Sequence[Axis], cells: Mapping[int, Mapping[str, Value]], origin: str) -> frozenset[int]:
    """Return the ordinals of the experiments whose values fulfil a condition. Messages call it `origin`.

    Raises QueryError for an invalid condition, for an unknown variable or value, and if it selects nothing.
    """
    try:
        comparisons = [_comparison(part) for part in _AND.split(_BLANKS.sub(",", text))]
        for one in comparisons:
            _check(one, axes)
    except QueryError as error:
        raise QueryError(f"{origin} {text!r}: {error}") from None
    chosen = frozenset(
        ordinal for ordinal, values in cells.items() if all(part.holds(values[part.name]) for part in comparisons)
    )
    if not chosen:
        raise QueryError(f"{origin} {text!r} selects no experiment; {'; '.join(map(_values, axes))}")
    return chosen


def among(text: str, names: Sequence[str], cells: Mapping[int, Mapping[str, Value]]) -> frozenset[int]:
    """Return the ordinals of the experiments that the key `experiments` selects; all if it is empty. `names`: of the variables.

    Raises the errors of `matching`.
    """
    if not text:
        return frozenset(cells)
    axes = [Axis(name, tuple(dict.fromkeys(values[name] for values in cells.values()))) for name in names]
    return matching(text, axes, cells, "experiments")


def _comparison(text: str) -> Comparison:
    found = _COMPARISON.fullmatch(text)
    if found is None:
        raise QueryError(f"{text.strip()!r} is not a comparison; use, for example, {EXAMPLE!r}")
    values = tuple(grammar.value(word) for word in found["values"].split(","))
    return Comparison(found["name"], found["operator"], values)


def _check(one: Comparison, axes: Sequence[Axis]) -> None:
    """Raise QueryError if the query has no such variable, or if the variable cannot have such values."""
    axis = next((axis for axis in axes if axis.name == one.name), None)
    if axis is None:
        names = [axis.name for axis in axes]
        close = difflib.get_close_matches(one.name, names, 1, cutoff=0.5)
        hint = f"did you mean {close[0]!r}?" if close else f"it varies {', '.join(names)}"
        raise QueryError(f"this query does not vary {one.name!r}; {hint}")
    if one.operator in ORDERED:
        if len(one.values) > 1:
            raise QueryError(f"{one.operator} takes one number; use = for a list of values")
        if not axis.numeric or isinstance(one.values[0], str):
            raise QueryError(f"{one.operator} compares numbers; {_values(axis)}: use = or !=")
    elif unknown := [value for value in one.values if value not in axis.values]:
        raise QueryError(f"{one.name} is never {unknown[0]}; {_values(axis)}")


def _values(axis: Axis) -> str:
    """Return the values of a variable in words."""
    return f"{axis.name} is {few([str(value) for value in axis.values], SHOWN)}"
