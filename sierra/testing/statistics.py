"""Conformance suite for statistics, as functions that a plug-in's author calls in tests.

    from sierra.testing import statistics as conformance

    def test_it_is_a_statistic():
        conformance.check("midrange", {(1.0, 2.0, 9.0): 5.0})

The package must be installed, because statistics are found by their name. `known` maps values of runs to the right statistic.
Each claim is one function of a `Trial`, and can be called alone. A broken claim raises AssertionError with one line, even if
Python runs with `-O`.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sierra.config.field_types import RawTable
from sierra.config.plugin_registry import STATISTICS
from sierra.stats import aggregate
from sierra.stats.aggregate import ColumnStatistics
from sierra.stats.base import LEVEL, Estimate, Parameter, Statistic
from sierra.stats.selection import Selection
from sierra.testing.assertions import holds, says_what_its_options_are

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.store.connections import Database

Values = tuple[float, ...]
OTHERS: tuple[Values, ...] = (
    (),
    (3.0,),
    (3.0, 3.0, 3.0),
    (0.0, 1.0),
    (-1e300, 0.0, 1e300),
    tuple(math.sin(k) for k in range(50)),
)
"""Values of runs for which nothing but the contract is checked."""


@dataclass
class Trial:
    """A statistic to test, and what it should be for some values."""

    name: str
    known: Mapping[Values, float]
    options: RawTable = field(default_factory=dict)

    def estimates(self, groups: Sequence[Values], level: float = LEVEL) -> list[Estimate]:
        """Return the statistic of each group, computed as in `sierra stats`; the groups are experiments."""
        rows = [(e, run, value) for e, values in enumerate(groups) for run, value in enumerate(values or (math.nan,))]
        selection = Selection.of([self.name], {self.name: self.options}, level)
        with _connected() as connection:
            column = _Column(connection, rows)
            table, _ = ColumnStatistics(column, aggregate.coverage(column)).by_experiment("final", selection)
        parts = (table.column(f"{self.name}{part}").to_pylist() for part in ("", "_low", "_high"))
        return [Estimate(*row) for row in zip(*parts, strict=True)]


def _connected() -> Database:
    from sierra.store.connections import connect

    return connect()


class _Column:
    """A column of runs with one row each."""

    def __init__(self, connection: Database, rows: Sequence[tuple[int, int, float]]) -> None:
        self._connection = connection
        connection.execute(
            "CREATE TABLE samples (experiment INTEGER, run VARCHAR, number INTEGER, t DOUBLE, shared_t DOUBLE, value DOUBLE, "
            "file VARCHAR, place BIGINT)"
        )
        connection.executemany(
            "INSERT INTO samples VALUES (?, ?, ?, 0, 0, ?, NULL, NULL)",
            [(e, f"{e}-{run}", run, value) for e, run, value in rows],
        )

    def sql(self, text: str, /, **params: Parameter) -> pa.Table:
        return self._connection.sql(text, params=params).to_arrow_table()


def check(name: str, known: Mapping[Values, float], options: RawTable | None = None) -> None:
    """Check all claims about the statistic `name`. `options` are those of `[statistics.NAME]`."""
    trial = Trial(name, known, options or {})
    for claim in CLAIMS:
        claim(trial)


def declares_options(trial: Trial) -> None:
    """Check that its options are a table that refuses unknown options, and that it names the method of its interval."""
    found = STATISTICS.load(trial.name)
    says_what_its_options_are(found)
    holds(isinstance(found.interval, str), f"interval is {found.interval!r}, not a text")


def has_the_known_values(trial: Trial) -> None:
    """Check the statistic of each known group of values, and that their order has no effect."""
    for values, expected in trial.known.items():
        for ordered in (values, values[::-1]):
            (estimate,) = trial.estimates([ordered])
            holds(
                estimate.value is not None and math.isclose(estimate.value, expected, rel_tol=1e-9, abs_tol=1e-12),
                f"{trial.name} of {ordered} is {estimate.value}, not {expected}",
            )


def is_none_without_values(trial: Trial) -> None:
    """Check that an experiment without a value has no statistic and no interval."""
    (found,) = trial.estimates([()])
    holds(found == Estimate(None), f"{trial.name} of no values is {found}, not Estimate(None)")


def has_intervals_around_the_value(trial: Trial) -> None:
    """Check that an interval has both ends or none, and contains the value; and that one run has none."""
    groups = [*trial.known, *OTHERS]
    for values, estimate in zip(groups, trial.estimates(groups), strict=True):
        ends = (estimate.low, estimate.high)
        both_or_none = (estimate.low is None) == (estimate.high is None)
        holds(both_or_none, f"{trial.name} of {values[:5]} has one end of an interval: {ends}")
        holds(len(values) > 1 or estimate.low is None, f"{trial.name} of one value has an interval: {ends}")
        if estimate.low is not None and estimate.high is not None:
            inside = estimate.value is not None and estimate.low <= estimate.value <= estimate.high
            holds(inside, f"{trial.name} of {values[:5]} is {estimate.value}, outside its interval {ends}")
        numbers = [number for number in (estimate.value, *ends) if number is not None]
        holds(all(map(math.isfinite, numbers)), f"{trial.name} of {values[:5]} is not finite: {numbers}")


def is_repeatable(trial: Trial) -> None:
    """Check that the same values give the same result, whatever the other experiments are."""
    groups = [*trial.known, *OTHERS]
    together = trial.estimates(groups)
    holds(together == trial.estimates(groups), f"{trial.name} of the same values is another one the second time")
    for values, estimate in zip(groups, together, strict=True):
        (alone,) = trial.estimates([values])
        holds(alone == estimate, f"{trial.name} of {values[:5]} is {alone} alone, but {estimate} beside other experiments")


def has_wider_intervals_of_higher_confidence(trial: Trial) -> None:
    """Check that intervals of a higher confidence contain the others, if it has them: looks of a study need them."""
    statistic: Statistic = STATISTICS.make(trial.name, {trial.name: trial.options})
    if "level" not in inspect.signature(statistic.definition).parameters:
        return
    groups = [*trial.known, *OTHERS]
    for values, usual, wide in zip(groups, trial.estimates(groups), trial.estimates(groups, 0.99), strict=True):
        holds(usual.value == wide.value, f"{trial.name} of {values[:5]} depends on the confidence of its interval")
        if None not in (usual.low, usual.high, wide.low, wide.high):
            inside = wide.low <= usual.low and usual.high <= wide.high  # type: ignore[operator]
            holds(inside, f"the 99 % interval of {trial.name} of {values[:5]} does not contain that of 95 %")


CLAIMS: tuple[Callable[[Trial], None], ...] = (
    declares_options,
    has_the_known_values,
    is_none_without_values,
    has_intervals_around_the_value,
    is_repeatable,
    has_wider_intervals_of_higher_confidence,
)
