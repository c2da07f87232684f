"""Statistics that are chosen by name: shipped ones, quantiles such as `q90`, and plug-ins; as columns of one statement.

A statistic NAME becomes the columns `NAME`, `NAME_low`, `NAME_high` and `NAME_interval`, the method of its interval. The
interval is NULL if there is none, for example because there are too few runs.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite
from typing import TYPE_CHECKING, cast

from sierra.config.field_types import RawTable
from sierra.config.plugin_registry import STATISTICS
from sierra.config.statistic_names import complaint, percent
from sierra.errors import PluginError, UsageError
from sierra.stats.base import LEVEL, Estimate, Formula, Function, Parameter, Statistic
from sierra.store.sql_names import quote
from sierra.util.text import counted

if TYPE_CHECKING:
    import pyarrow as pa

PARTS = ("", "_low", "_high", "_interval")
"""The ends of the names of a statistic's columns."""
CALLS = 5000
"""The largest number of calls of statistics in Python for one table; a bootstrap takes some hundredths of a second."""


def find(name: str, tables: Mapping[str, RawTable]) -> Statistic:
    """Return a statistic by its name; `tables` has the options of plug-ins. Raises UsageError for an unknown name."""
    from sierra.stats.shipped import Quantile

    if wrong := complaint(name):
        raise UsageError(wrong)
    of_quantile = percent(name)
    return cast(Statistic, STATISTICS.make(name, tables)) if of_quantile is None else Quantile(name, of_quantile / 100)


@dataclass(frozen=True)
class Selection:
    """The statistics that were chosen, by name."""

    statistics: Mapping[str, Statistic]
    level: float = LEVEL
    """The confidence of their intervals."""
    formulas: tuple[str, ...] = ()
    """Shipped formulas whose own columns are wanted too."""
    tables: Mapping[str, RawTable] = field(default_factory=dict)
    """The options of statistics."""

    @classmethod
    def of(
        cls, names: Iterable[str], tables: Mapping[str, RawTable], level: float = LEVEL, formulas: Iterable[str] = ()
    ) -> Selection:
        """Return the statistics of these names, each once, with intervals of a confidence. Raises UsageError."""
        return cls({name: find(name, tables) for name in dict.fromkeys(names)}, level, tuple(formulas), tables)

    @cached_property
    def definitions(self) -> Mapping[str, Formula | Function]:
        return {name: defined(name, statistic, self.level) for name, statistic in self.statistics.items()}

    @property
    def uses(self) -> tuple[str, ...]:
        """Return the shipped formulas that the statement has."""
        steps = (
            step for definition in self.definitions.values() if isinstance(definition, Formula) for step in definition.uses
        )
        return (*self.formulas, *steps)

    @property
    def functions(self) -> Mapping[str, Function]:
        return {name: definition for name, definition in self.definitions.items() if isinstance(definition, Function)}

    def columns(self) -> list[str]:
        """Return the columns of a statement: those of formulas, and the values for functions."""
        columns = []
        for name, definition in self.definitions.items():
            if isinstance(definition, Formula):
                texts = (definition.value, definition.low, definition.high, self._method(name, definition))
                columns += [f'{text} AS "{name}{part}"' for text, part in zip(texts, PARTS, strict=True)]
        return [*columns, *(["x"] if self.functions else [])]

    def _method(self, name: str, formula: Formula) -> str:
        return formula.method or f"CASE WHEN {formula.low} IS NOT NULL THEN {quote(self.statistics[name].interval)} END"

    def parameters(self, most: int) -> dict[str, Parameter]:
        """Return the parameters of the formulas. `most` is the largest number of runs of an experiment."""
        formulas = [formula for formula in self.definitions.values() if isinstance(formula, Formula)]
        return {name: value for formula in formulas for name, value in formula.parameters(most).items()}

    def documented(self) -> str:
        """Return comments on statistics: the options of those that Python functions compute, and the packages of plug-ins."""
        lines = []
        for name in self.statistics:
            words = [*self._computed(name), *(f"of {package}" for package in STATISTICS.recorded(name))]
            lines += [f"-- {name}: {', '.join(words)}\n"] if words else []
        return "".join(lines)

    def _computed(self, name: str) -> list[str]:
        """Return the interval and the options of a statistic that a Python function computes; no statement shows them."""
        if name not in self.functions:
            return []
        keys = (f"{key} = {value}" for key, value in STATISTICS.options(name, self.tables.get(name, {})))
        return [self.statistics[name].interval or "no interval", *keys]

    def complete(self, table: pa.Table) -> pa.Table:
        """Return the table of a statement with the columns of functions, and without the values for them."""
        if self.functions:
            self._check_calls(table.num_rows)
            values = [tuple(row) for row in table.column("x").to_pylist()]
            for name, function in self.functions.items():
                estimates = [_checked(name, function.estimate(x)) for x in values]
                table = with_estimates(table, name, estimates, self.statistics[name].interval)
            table = table.drop_columns("x")
        own = [f"{name}{part}" for name in self.statistics for part in PARTS]
        return table.select([name for name in table.column_names if name not in own] + own)

    def _check_calls(self, rows: int) -> None:
        if rows > CALLS:
            raise UsageError(
                f"{' and '.join(self.functions)} would be computed for {rows} experiments and times, which takes too long "
                f"(at most {CALLS}); choose a measure, or statistics with a formula in SQL"
            )

    def notes(self, table: pa.Table) -> list[str]:
        """Return notes on intervals that are missing because there are too few runs, and on bootstraps."""
        n = table.column("n").to_pylist()
        notes = []
        for name, statistic in self.statistics.items():
            low = table.column(f"{name}_low").to_pylist()
            lacking = sum(end is None and count > 0 for end, count in zip(low, n, strict=True))
            if not statistic.interval:
                notes.append(f"{name} has no interval")
            elif lacking:
                notes.append(f"n is too small for the {100 * self.level:.4g} % interval of {name} in {counted(lacking, 'row')}")
        return notes


def defined(name: str, statistic: Statistic, level: float) -> Formula | Function:
    """Return how a statistic is computed. Raises UsageError if it has intervals of another confidence only."""
    if level == LEVEL:
        return statistic.definition()
    if "level" not in inspect.signature(statistic.definition).parameters:
        raise UsageError(f"statistic {name!r} has intervals of 95 % only, and looks need others; see level in its contract")
    return statistic.definition(level)


def _checked(name: str, estimate: Estimate) -> Estimate:
    """Return an estimate of a function. Raises PluginError if its interval is none."""
    numbers = [number for number in (estimate.low, estimate.value, estimate.high) if number is not None]
    if len(numbers) == 2 or not all(map(isfinite, numbers)) or numbers != sorted(numbers):
        raise PluginError(
            f"statistic {name!r} returned {estimate}; an interval has two finite ends, and the value is between them"
        )
    return estimate


def with_estimates(table: pa.Table, name: str, estimates: Sequence[Estimate], method: str) -> pa.Table:
    """Return a table with the columns of one more statistic."""
    import pyarrow as pa

    columns = (
        pa.array([estimate.value for estimate in estimates], pa.float64()),
        pa.array([estimate.low for estimate in estimates], pa.float64()),
        pa.array([estimate.high for estimate in estimates], pa.float64()),
        pa.array([None if estimate.low is None else method for estimate in estimates], pa.string()),
    )
    for part, column in zip(PARTS, columns, strict=True):
        table = table.append_column(f"{name}{part}", column)
    return table
