"""The columns of a table for papers that has statistics, with a row for each experiment of each batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import TableForPaper
from sierra.config.project_file import LoadedProject
from sierra.deliverables import overlay, paper_tables
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.paper_tables import Cell, Estimates, Heads
from sierra.deliverables.run_statistics import output_and_columns, statistics
from sierra.deliverables.table_columns import Columns
from sierra.design.query import condition
from sierra.errors import UsageError
from sierra.execution import targets
from sierra.model import Value
from sierra.stats.rounding import rounded
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import pyarrow as pa

BATCH = "batch"
NOTHING = (None, None, None, 0)


@dataclass(frozen=True, slots=True)
class _Estimates:
    """The statistics of the columns of one batch."""

    axes: tuple[str, ...]
    rows: Mapping[int, Mapping[str, Value]]
    """The values of the variables, by the position of the experiment."""
    labelled: Mapping[int, Mapping[str, Value]]
    """The same, as a reader sees them: with the labels of controllers and scenarios."""
    values: Mapping[str, Estimates]
    """Value, low, high and n, by the name of the column in the table and the position of the experiment."""
    headers: Mapping[str, Heads]
    methods: Mapping[str, Sequence[str]]
    notes: tuple[str, ...]
    sql: tuple[str, ...]


def columns(
    project: LoadedProject, store: Store, declared: TableForPaper, batches: Mapping[str, str]
) -> tuple[Columns, pa.Table, str]:
    """Return the columns of statistics, the numbers behind them, and the SQL that computed these."""
    import pyarrow as pa

    by_label = {label: _estimates(project, store, declared, batch) for label, batch in batches.items()}
    first = next(iter(by_label.values()))
    for label, estimates in by_label.items():
        if (estimates.axes, estimates.headers) != (first.axes, first.headers):
            raise UsageError(f"batch {label!r} has other variables, columns or units than {next(iter(by_label))!r}")
    places = [(label, ordinal) for label, estimates in by_label.items() for ordinal in estimates.rows]
    keys: dict[str, list[Value | None]] = {BATCH: [label for label, _ in places]} if len(by_label) > 1 else {}
    shown = keys | {axis: [by_label[label].labelled[ordinal][axis] for label, ordinal in places] for axis in first.axes}
    keys |= {axis: [by_label[label].rows[ordinal][axis] for label, ordinal in places] for axis in first.axes}
    numbers = {
        column: [by_label[label].values[column].get(ordinal, NOTHING) for label, ordinal in places] for column in first.values
    }
    cells: dict[str, list[Cell]] = {
        column: [None if value is None else rounded(value, low, high) for value, low, high, _ in some]
        for column, some in numbers.items()
    }
    counts = {n for some in numbers.values() for *_, n in some}
    if len(counts) > 1:
        cells |= {f"n {column}" if len(numbers) > 1 else "n": [str(n) for *_, n in some] for column, some in numbers.items()}
    methods = {
        column: dict.fromkeys(m for estimates in by_label.values() for m in estimates.methods[column]) for column in numbers
    }
    n = f"n = {counts.pop()}" if len(counts) == 1 else ""
    note = "; ".join(filter(None, (n, paper_tables.intervals(methods), *overlay.together(_notes(by_label)))))
    parts = {
        f"{column} {part}": [estimate[k] for estimate in some]
        for column, some in numbers.items()
        for k, part in enumerate(PARTS)
    }
    data = pa.table({**{f"key {key}": pa.array(values) for key, values in keys.items()}, **parts})
    headers: dict[str, Heads] = {BATCH: (BATCH,), **first.headers} if len(by_label) > 1 else dict(first.headers)
    headers |= {column: (column.replace("_", " "),) for column in cells if column not in headers}
    sql = "\n\n".join(dict.fromkeys(text for estimates in by_label.values() for text in estimates.sql))
    return Columns(headers, shown, cells, note), data, sql


PARTS = ("value", "low", "high", "n")


def _notes(by_label: Mapping[str, _Estimates]) -> dict[str, str]:
    return {
        label: "; ".join(dict.fromkeys(part for text in estimates.notes for part in text.split("; ")))
        for label, estimates in by_label.items()
    }


def _estimates(project: LoadedProject, store: Store, declared: TableForPaper, batch: str) -> _Estimates:
    output, columns = output_and_columns(project, store, batch, declared.table, declared.columns)
    measure = declared.measure or "auto"

    def rows(gallery: Gallery) -> frozenset[int]:
        names = [axis.name for axis in gallery.axes]
        return condition.among(declared.experiments, names, gallery.frame.cells(), gallery.cells)

    by_column = {
        column: statistics(project, store, batch, output, column, measure, declared.threshold, None, declared.statistics, rows)
        for column in columns
    }
    config = targets.of_batch(project, store, batch).config
    first = next(iter(by_column.values()))
    cells = {ordinal: first.cells[ordinal] for ordinal in first.table.column("experiment").to_pylist()}
    chosen = condition.among(declared.experiments, first.axes, cells, first.labelled)
    axes = zip(first.axes, paper_tables.axis_headers(config, first), strict=True)
    headers: dict[str, Heads] = {axis: (header,) for axis, header in axes}
    values, methods = {}, {}
    for column, computed in by_column.items():
        for statistic, header in paper_tables.statistic_headers(config, computed).items():
            called = column if declared.statistics == paper_tables.PLAIN else f"{statistic} {column}"
            headers[called] = header
            values[called], methods[called] = paper_tables.estimates_of(computed, statistic, chosen)
    notes = tuple("; ".join(computed.notes) for computed in by_column.values())
    rows_shown = {ordinal: values for ordinal, values in cells.items() if ordinal in chosen}
    return _Estimates(
        first.axes,
        rows_shown,
        first.labelled,
        values,
        headers,
        methods,
        notes,
        tuple(computed.sql for computed in by_column.values()),
    )
