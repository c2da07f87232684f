"""Equivalence of nondeterministic runs in a replay, by the project's declarations `[equivalence.NAME]`.

For each experiment, recorded and new values of the same runs are compared pair by pair with an equivalence test (see
`sierra.stats.equivalence`). If a run has a value in only one of the two, the metric cannot be compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any

from sierra.config.deliverable_tables import DerivedTable
from sierra.config.output_tables import Equivalence, Output
from sierra.errors import Damaged, Missing, NotFound, SierraError, UsageError
from sierra.stats import aggregate as stats
from sierra.stats import equivalence
from sierra.store.batch_data import BatchData, RecordedColumn
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import counted

Number = float | Fraction
"""A value of a run; a fraction if floats do not hold the digits of the column's numbers."""
Values = dict[str, dict[tuple[int, str], Number]]
"""By metric: the value of each run, by (experiment's place, run id)."""


@dataclass(frozen=True, slots=True)
class Metric:
    """Comparison of one metric in one experiment."""

    name: str
    declared: Equivalence
    recorded_mean: float | None
    """Recorded mean."""
    replayed_mean: float | None
    tested: equivalence.Tested | None
    reason: str
    """Explanation in one line."""

    @property
    def equivalent(self) -> bool:
        return self.tested is not None and self.tested.equivalent


def values(
    store: Store,
    batch: str,
    executions: Mapping[str, str],
    metrics: Mapping[str, Equivalence],
    declared: Mapping[str, Output | DerivedTable],
) -> Values:
    """Return the value of the given execution of each run, by metric. `declared`: outputs and derived tables.

    Raises NotFound for a table or a column that does not exist, for a derived table that cannot be made, or if runs have
    several values at one time.
    """
    by_metric: Values = {}
    with BatchData(store, batch, executions) as frame:
        for name, metric in metrics.items():
            table = declared.get(metric.table)
            column = RecordedColumn(frame, metric.table, metric.column, table.time if table else "")
            any_order = isinstance(table, Output) and table.time_order == "any"
            rows, offset = _reduced(column, metric, any_order=any_order)
            by_metric[name] = {
                (row["experiment"], row["run"]): Fraction(row["value"]) + offset if offset else row["value"] for row in rows
            }
    return by_metric


def _reduced(column: RecordedColumn, metric: Equivalence, *, any_order: bool) -> tuple[list[dict[str, Any]], int]:
    """Return the values of the runs, and the whole number that was subtracted from them. Raises NotFound."""
    try:
        _check_single(column, any_order=any_order)
        offset = 0 if metric.measure == "time_to" else column.data.offset(column.table, column.column)
        return stats.reduced(replace(column, offset=offset), metric.measure, metric.threshold).to_pylist(), offset
    except (NotFound, Missing, Damaged):
        raise
    except SierraError as error:
        raise NotFound(str(error)) from error


def _check_single(column: RecordedColumn, *, any_order: bool) -> None:
    """Check that no run has several rows at one time, and that no time goes back, except in `any_order`. Raises NotFound."""
    try:
        seen = stats.coverage(column, several=True)
        stats.check_times(replace(seen, backward=0) if any_order else seen)
    except NotFound:
        raise
    except UsageError as error:
        raise NotFound(f"output {column.table!r}: {error}") from error
    except SierraError:
        pass  # without rows, no run has a value


def compare(metrics: Mapping[str, Equivalence], was: Values, now: Values, ordinal: int, runs: list[str]) -> Iterator[Metric]:
    """Yield the comparison of each metric of one experiment (`ordinal` is its place in the batch), over these runs."""
    for name, metric in metrics.items():
        pairs = [(was[name].get((ordinal, run), math.nan), now[name].get((ordinal, run), math.nan)) for run in runs]
        yield _compare(name, metric, [pair for pair in pairs if not all(map(math.isnan, pair))])


def _compare(name: str, metric: Equivalence, pairs: list[tuple[Number, Number]]) -> Metric:
    alone = sum(any(map(math.isnan, pair)) for pair in pairs)
    if alone or len(pairs) < 2:
        why = (
            f"{alone} of {counted(len(pairs), 'run')} without a value in the record or in the replay"
            if alone
            else f"{counted(len(pairs), 'run')} with a value, but two are needed"
        )
        return Metric(name, metric, None, None, None, f"{name}: {why}")
    mean, now = (equivalence.mean_of(list(map(float, values))) for values in zip(*pairs, strict=True))
    differences = [float(new - old) for old, new in pairs]
    if not all(map(math.isfinite, differences)):
        return Metric(name, metric, mean, now, None, f"{name}: values differ by more than the largest possible number")
    margin = metric.margin or (metric.relative or 0.0) * abs(mean)
    if not margin > 0:
        return Metric(
            name, metric, mean, None, None, f"{name}: the recorded mean is 0, so 'relative' gives a margin of 0; use 'margin'"
        )
    tested = equivalence.test(differences, margin, metric.alpha)
    return Metric(name, metric, mean, now, tested, _as_text(name, tested))


def _as_text(name: str, tested: equivalence.Tested) -> str:
    level = f"{100 * (1 - 2 * tested.alpha):.3g} % CI {tested.low:.3g} … {tested.high:.3g}"
    within = "within" if tested.equivalent else "not within"
    return (
        f"{name}: mean difference {tested.difference:.3g} ({level}) is {within} ±{tested.margin:.3g}, "
        f"n = {tested.n}, p = {tested.p:.2g}, power {tested.power:.2f}"
    )
