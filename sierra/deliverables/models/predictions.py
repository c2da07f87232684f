"""Predictions of one model for the experiments of one batch: the values of an expression, or the rows of a table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

from sierra.errors import ConfigError, SierraError, UsageError
from sierra.model import Value
from sierra.templates import arithmetic
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import counted, like

Cells = Mapping[int, Mapping[str, Value]]
"""The values of the variables of each experiment, by its position in the batch."""
TIME = "t"
"""The name of the time in expressions and tables; the name of the output's time column is another one."""
EXPERIMENT = "experiment"
"""The column of tables with the place of an experiment in the batch."""
CLOSE = 1e-9
"""The largest difference of numbers that are taken to be equal, as a part of the larger one, or of the span of times."""


class NoValue(SierraError):
    """A model has no value for an experiment, or for a time; the message is the reason."""


class NotVaried(SierraError):
    """A model needs a variable that the batch does not vary."""


class Prediction(Protocol):
    """The predictions of one model for one batch."""

    @property
    def over_time(self) -> bool:
        """True if it predicts values over time; False: one number for each experiment."""

    @property
    def text(self) -> str:
        """Its statement, expression or command, as SQL or as a comment of SQL."""

    @property
    def facts(self) -> Mapping[str, JsonView]:
        """The facts about its origin, for the record of figures."""

    def times(self, ordinal: int, known: Sequence[float]) -> Sequence[float]:
        """Return the times of its values for an experiment; `known` has those of the data."""

    def value(self, ordinal: int, time: float | None) -> float:
        """Return its value for an experiment, at a time if it has times. Raises NoValue."""


@dataclass(frozen=True, slots=True)
class Formula:
    """An expression in the variables and the time."""

    expression: str
    cells: Cells
    clock: frozenset[str]
    """The names that stand for the time, and for no variable."""
    used: frozenset[str]
    """The names in the expression."""

    @property
    def over_time(self) -> bool:
        return bool(self.clock & self.used)

    @property
    def text(self) -> str:
        return f"-- expression: {' '.join(self.expression.split())}"

    @property
    def facts(self) -> Mapping[str, JsonView]:
        return {"expression": self.expression}

    def times(self, ordinal: int, known: Sequence[float]) -> Sequence[float]:
        return known

    def value(self, ordinal: int, time: float | None) -> float:
        values = dict(self.cells[ordinal])
        if time is not None:
            values |= dict.fromkeys(self.clock, time)
        try:
            return float(arithmetic.number(self.expression, values))
        except (ConfigError, OverflowError) as error:
            raise NoValue(str(error)) from error


def formula(expression: str, cells: Cells, time: str, declared: Iterable[str]) -> Formula:
    """Return the prediction of an expression. Raises ConfigError for one that is invalid, or that has an unknown name.

    `time` is the name of the time column, `declared` has the names of all variables of the project. Raises NotVaried for one
    of these that the batch does not vary.
    """
    axes = _axes(cells)
    declared = frozenset(declared)
    clock = frozenset({TIME, time} - axes.keys() - declared - {""})
    used = arithmetic.names_in(expression)
    known = [*axes, *sorted(clock)]
    _check_varied(used - {*known}, declared)
    if unknown := sorted(used - {*known}):
        raise ConfigError(f"unknown name {unknown[0]!r} in {expression!r}; {like(unknown[0], known, 'known are')}")
    if texts := [name for name, values in axes.items() if name in used and any(isinstance(v, str) for v in values)]:
        raise ConfigError(f"{texts[0]!r} in {expression!r} has texts as values, with which there is no arithmetic; use sql")
    return Formula(expression, cells, clock, used)


@dataclass(frozen=True, slots=True)
class Listed:
    """The rows of a table: a value for each experiment, or for each experiment and time."""

    rows: Mapping[int, Mapping[float | None, float]]
    """By experiment: the value at each time, in ascending order; or one under None. A value may be NaN or infinite."""
    over_time: bool
    text: str = ""
    facts: Mapping[str, JsonView] = field(default_factory=dict)

    def times(self, ordinal: int, known: Sequence[float]) -> Sequence[float]:
        return [time for time in self.rows.get(ordinal, ()) if time is not None]

    def value(self, ordinal: int, time: float | None) -> float:
        rows = self.rows.get(ordinal, {})
        if time not in rows and time is not None:
            time = next((known for known in rows if known is not None and math.isclose(known, time, rel_tol=CLOSE)), time)
        if time not in rows:
            raise NoValue("no row" if time is None or not rows else "no row at the time at which runs end")
        if not math.isfinite(rows[time]):
            raise NoValue("not a number" if math.isnan(rows[time]) else "infinite")
        return rows[time]


def listed(
    table: Mapping[str, Sequence[object]], column: str, cells: Cells, time: str, declared: Iterable[str]
) -> tuple[Mapping[int, Mapping[float | None, float]], bool, list[str]]:
    """Return the rows of a table by experiment, whether they have times, and notes.

    Each column of the table is a variable, the time, the place of the experiment, or the predicted `column`. A variable that
    has no column does not matter to the prediction. Raises UsageError for other columns, values that are no numbers, and more
    than one row for an experiment and a time. Raises NotVaried like `formula`.
    """
    if EXPERIMENT in table:
        cells = {ordinal: {**cell, EXPERIMENT: ordinal} for ordinal, cell in cells.items()}
    axes = _axes(cells)
    declared = frozenset(declared)
    clock = [name for name in table if name in {TIME, time} - axes.keys() - declared - {column}]
    _check_columns(table, column, axes, clock, declared)
    keys = [name for name in table if name in axes]
    values = [_floats(table, name) for name in (column, *clock)]
    experiments: dict[tuple[Value | None, ...], list[int]] = {}
    for ordinal, cell in cells.items():
        experiments.setdefault(tuple(cell[name] for name in keys), []).append(ordinal)
    points = zip(*(_matched(table[name], axes[name]) for name in keys), strict=True) if keys else [()] * len(values[0])
    if clock and not all(map(math.isfinite, values[1])):
        raise UsageError(f"it has a row without a time in {clock[0]!r}")
    rows: dict[int, dict[float | None, float]] = {}
    strangers = 0
    for point, value, *times in zip(points, *values, strict=True):
        strangers += point not in experiments
        for ordinal in experiments.get(point, ()):
            at = times[0] if times else None
            if at in rows.setdefault(ordinal, {}):
                raise UsageError(f"it has more than one row for {_named(cells[ordinal], at)}; use one, as GROUP BY gives")
            rows[ordinal][at] = value
    notes = [f"{counted(strangers, 'row')} of other experiments"] if strangers else []
    return {k: dict(sorted(at.items(), key=lambda row: row[0] or 0.0)) for k, at in rows.items()}, bool(clock), notes


def _axes(cells: Cells) -> dict[str, list[Value]]:
    """Return the values of each variable."""
    first = next(iter(cells.values()), {})
    return {name: list(dict.fromkeys(cell[name] for cell in cells.values())) for name in first}


def _check_columns(
    table: Mapping[str, Sequence[object]], column: str, axes: Iterable[str], clock: Sequence[str], declared: Iterable[str]
) -> None:
    if column not in table:
        raise UsageError(f"it has no column {column!r}, which it should predict; it has {', '.join(table) or 'none'}")
    others = [name for name in table if name not in (column, *axes, *clock)]
    _check_varied(others, declared)
    if others:
        known = [*axes, TIME, column]
        hint = like(others[0], known, "known are")
        raise UsageError(f"its column {others[0]!r} is no variable of the batch and no time; {hint}")
    if len(clock) > 1:
        raise UsageError(f"its columns {clock[0]!r} and {clock[1]!r} are both the time; leave one out")


def _check_varied(names: Iterable[str], declared: Iterable[str]) -> None:
    if fixed := sorted({*names} & {*declared}):
        raise NotVaried(f"the batch does not vary {', '.join(fixed)}")


def _floats(table: Mapping[str, Sequence[object]], name: str) -> list[float]:
    """Return a column as numbers; a missing value is NaN. Raises UsageError for a text that is no number."""
    numbers = []
    for value in table[name]:
        try:
            numbers.append(math.nan if value is None or value == "" else float(value))  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            raise UsageError(f"its column {name!r} has {str(value)[:40]!r}, which is no number") from None
    return numbers


def _matched(column: Sequence[object], values: Sequence[Value]) -> list[Value | None]:
    """Return for each entry of a column the value of the variable that it stands for; None if it is none of them."""
    known: dict[object, Value | None] = {}
    entries = [str(entry) if isinstance(entry, list | dict) else entry for entry in column]
    for entry in entries:
        if entry not in known:
            known[entry] = next((value for value in values if _same(entry, value)), None)
    return [known[entry] for entry in entries]


def _same(entry: object, value: Value) -> bool:
    if isinstance(value, str):
        return str(entry) == value
    try:
        return math.isclose(float(entry), value, rel_tol=CLOSE)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return False


def _named(cell: Mapping[str, Value], time: float | None) -> str:
    at = [*cell.items(), *([("time", f"{time:g}")] if time is not None else [])]
    return ", ".join(f"{name} = {value}" for name, value in at) or "the experiment"
