"""Conditions on the variables of a query: they select some of a batch's experiments.

    condition  = comparison {"and" comparison}
    comparison = name operator value {"," value}
    operator   = "=" | "!=" | "<" | "<=" | ">" | ">="

Values have the form of the values in a criterion: `0.5`, `1e-3`, `low`, `"levy (0.5)"`; a label of a controller or scenario,
which may have blanks, stands for its name: `random walk`, also in quotes. With `=`, a list means one of its values; with `!=`,
none of them; the other operators take one number. A value after `=` or `!=` must be a value of the variable, so that a mistyped
value is an error and not an empty selection.
"""

from __future__ import annotations

import difflib
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

from sierra.design.query import grammar
from sierra.errors import QueryError
from sierra.model import Axis, Batch, Value
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.quoted_values import QUOTE, split_off, unquoted
from sierra.util.text import few

if TYPE_CHECKING:
    from sierra.config.project_file import Project

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
_PLACE = regex(r'"([0-9]+)"')


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


Cells: TypeAlias = Mapping[int, Mapping[str, Value]]
"""The values of the variables, by the ordinal of the experiment."""
Labels: TypeAlias = Mapping[str, Mapping[Value, Value]]
"""The labels of values by the name of the variable and the value; a value without a label may be its own, or be left out."""


def select(text: str, batch: Batch, project: Project) -> Selection:
    """Return the experiments that a condition selects. The project has the labels of controllers and scenarios.

    Raises QueryError for an invalid condition, for an unknown variable or value, and if it selects nothing.
    """
    labels = {axis.name: project.labels(axis) for axis in batch.axes}
    ordinals = matching(text, batch.axes, {one.ordinal: one.values for one in batch.experiments}, "--only", labels)
    runs = frozenset(run.id for one in batch.experiments if one.ordinal in ordinals for run in one.runs)
    return Selection(text, ordinals, runs)


def matching(text: str, axes: Sequence[Axis], cells: Cells, origin: str, labels: Labels) -> frozenset[int]:
    """Return the ordinals of the experiments whose values fulfil a condition. Messages call it `origin`.

    Raises QueryError for an invalid condition, for an unknown variable or value, and if it selects nothing.
    """
    try:
        has_quotes = any(QUOTE in str(label) for of_values in labels.values() for label in of_values.values())
        outside, quotes = split_off(_with_names(text, labels) if has_quotes else text)
        parts = _AND.split(_BLANKS.sub(",", _with_names(outside, labels)))
        comparisons = [_comparison(part, quotes, axes, labels) for part in parts]
        for comparison in comparisons:
            _check(comparison, axes, labels)
    except QueryError as error:
        raise QueryError(f"{origin} {text!r}: {error}") from None
    chosen = frozenset(
        ordinal for ordinal, values in cells.items() if all(part.holds(values[part.name]) for part in comparisons)
    )
    if not chosen:
        raise QueryError(f"{origin} {text!r} selects no experiment; {'; '.join(_values(axis, labels) for axis in axes)}")
    return chosen


def among(text: str, names: Sequence[str], cells: Cells, labelled: Cells, origin: str = "experiments") -> frozenset[int]:
    """Return the ordinals of the experiments that the key `experiments` selects; all if it is empty. `names`: of the variables.

    `labelled` is as `cells`, with labels instead of names. Raises the errors of `matching`.
    """
    if not text:
        return frozenset(cells)
    axes = [Axis(name, tuple(dict.fromkeys(values[name] for values in cells.values()))) for name in names]
    labels = {name: {cells[ordinal][name]: labelled[ordinal][name] for ordinal in cells} for name in names}
    return matching(text, axes, cells, origin, labels)


def _with_names(text: str, labels: Labels) -> str:
    """Return a condition in which labels are replaced by names. A text that is both is a name."""
    for variable, of_values in labels.items():
        own = set(map(str, of_values))
        names = {str(label): str(value) for value, label in of_values.items() if str(label) not in own}
        if names:
            words = "|".join(re.escape(label) for label in sorted(names, key=len, reverse=True))
            item = rf"(?:(?:{words})(?=\s*(?:,|$)|\sand\s)|[^<>=!\s,]+)"
            compared = re.compile(rf"((?:^|\sand\s)\s*{re.escape(variable)}\s*!?=\s*)({item}(?:\s*,\s*{item})*)")
            text = compared.sub(partial(_named, item, names), text)
    return text


def _named(item: str, names: Mapping[str, str], comparison: re.Match[str]) -> str:
    return comparison[1] + ",".join(names.get(word, word) for word in re.findall(item, comparison[2]))


def _comparison(text: str, quotes: Sequence[str], axes: Sequence[Axis], labels: Labels) -> Comparison:
    """Return a comparison; `quotes` are the parts in quotes, which `"0"`, `"1"`, … stand for in its text."""

    def written(part: str) -> str:
        return _PLACE.sub(lambda mark: quotes[int(mark[1])], part)

    match = _COMPARISON.fullmatch(text)
    if match is None:
        raise QueryError(f"{written(text.strip())!r} is not a comparison; use, for example, {EXAMPLE!r}")
    axis = next((axis for axis in axes if axis.name == match["name"]), Axis(match["name"], ()))
    known = labels.get(axis.name, {})
    values = tuple(_value(written(word), axis, known) for word in match["values"].split(","))
    return Comparison(axis.name, match["operator"], values)


def _value(word: str, axis: Axis, labels: Mapping[Value, Value]) -> Value:
    """Return the value of an axis that a word means: its texts are also found if they look like numbers, and by label."""
    value = grammar.value(word)
    if axis.numeric:
        return value
    content = unquoted(word) or word
    names = {str(label): name for name, label in labels.items()} if word != content else {}
    return content if content in axis.values else names.get(content, value)


def _check(comparison: Comparison, axes: Sequence[Axis], labels: Labels) -> None:
    """Raise QueryError if the query has no such variable, or if the variable cannot have such values."""
    axis = next((axis for axis in axes if axis.name == comparison.name), None)
    if axis is None:
        names = [axis.name for axis in axes]
        close = difflib.get_close_matches(comparison.name, names, 1, cutoff=0.5)
        hint = f"did you mean {close[0]!r}?" if close else f"it varies {', '.join(names)}"
        raise QueryError(f"this query does not vary {comparison.name!r}; {hint}")
    if comparison.operator in ORDERED:
        if len(comparison.values) > 1:
            raise QueryError(f"{comparison.operator} takes one number; use = for a list of values")
        if not axis.numeric or isinstance(comparison.values[0], str):
            raise QueryError(f"{comparison.operator} compares numbers; {_values(axis, labels)}: use = or !=")
    elif unknown := [value for value in comparison.values if value not in axis.values]:
        raise QueryError(f"{comparison.name} is never {grammar.value_text(unknown[0])}; {_values(axis, labels)}")


def _values(axis: Axis, labels: Labels) -> str:
    """Return the values of a variable in words, with their labels."""
    known = labels.get(axis.name, {})
    texts = [
        f"{grammar.value_text(value)} ({known[value]})" if known.get(value, value) != value else grammar.value_text(value)
        for value in axis.values
    ]
    return f"{axis.name} is {few(texts, SHOWN)}"
