"""The columns of a table for papers that has the rows of an SQL statement."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from decimal import Decimal
from typing import TYPE_CHECKING, Any

from sierra.config.deliverable_tables import TableForPaper
from sierra.deliverables.paper_tables import Cell
from sierra.deliverables.table_columns import Columns
from sierra.errors import NotFound
from sierra.stats.rounding import Rounded, fixed, rounded
from sierra.store.several_batches import joined
from sierra.store.store import Store
from sierra.util.arrow_columns import values_of
from sierra.util.text import like

if TYPE_CHECKING:
    import pyarrow as pa


def columns(store: Store, declared: TableForPaper, batches: Mapping[str, str]) -> tuple[Columns, pa.Table, str]:
    """Return the columns of the rows of a statement, these rows, and the statement."""
    found = joined(store, batches, declared.sql, "sql")
    every = {column: values_of(found.table.column(column)) for column in found.table.column_names}
    numeric = _numeric(found.table)
    intervals = {column: ends for column in every if (ends := _interval(column, numeric))}
    shown = [column for column in every if not any(column in ends for ends in intervals.values())]
    if isinstance(declared.digits, Mapping) and (unknown := [one for one in declared.digits if one not in shown]):
        raise NotFound(f"digits: the statement has no column {unknown[0]!r}; {like(unknown[0], shown)}")
    split = shown.index(declared.across) + 1 if declared.across in shown else 0
    cells: dict[str, list[Cell]] = {}
    for column in shown[split:]:
        digits = declared.digits if isinstance(declared.digits, int) else declared.digits.get(column)
        low, high = (every[end] for end in intervals[column]) if column in intervals else ([None] * found.table.num_rows,) * 2
        cells[column] = [_cell(*values, digits) for values in zip(every[column], low, high, strict=True)]
    headers = {column: (column.replace("_", " "),) for column in shown}
    return Columns(headers, {column: every[column] for column in shown[:split]}, cells), found.table, found.sql


def _interval(column: str, numeric: Container[str]) -> tuple[str, str] | None:
    """Return the columns with the ends of the interval of a column; None if it has none."""
    low, high = f"{column}_low", f"{column}_high"
    return (low, high) if all(name in numeric for name in (column, low, high)) else None


def _numeric(table: pa.Table) -> set[str]:
    from pyarrow import types

    kinds = (types.is_integer, types.is_floating, types.is_decimal)
    return {field.name for field in table.schema if any(is_kind(field.type) for is_kind in kinds)}


def _cell(value: Any, low: Any, high: Any, digits: int | None) -> Cell:
    """Return one value of a statement as it is printed."""
    if value is None:
        return None
    if isinstance(value, Decimal):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value).lower() if isinstance(value, bool) else str(value)
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else "∞" if value > 0 else "−∞"
    if digits is not None:
        return fixed(value, digits)
    ends = [float(end) if end is not None and math.isfinite(end) else None for end in (low, high)]
    if ends != [None, None]:
        return rounded(float(value), *ends)
    return Rounded(str(value).replace("-", "−")) if isinstance(value, int) else rounded(value)
