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

    found = {label: _estimates(project, store, declared, batch) for label, batch in batches.items()}
    first = next(iter(found.values()))
    for label, one in found.items():
        if (one.axes, one.headers) != (first.axes, first.headers):
            raise UsageError(f"batch {label!r} has other variables, columns or units than {next(iter(found))!r}")
    places = [(label, ordinal) for label, one in found.items() for ordinal in one.rows]
    keys: dict[str, list[Value | None]] = {BATCH: [label for label, _ in places]} if len(found) > 1 else {}
    shown = keys | {axis: [found[label].labelled[ordinal][axis] for label, ordinal in places] for axis in first.axes}
    keys |= {axis: [found[label].rows[ordinal][axis] for label, ordinal in places] for axis in first.axes}
    numbers = {
        column: [found[label].values[column].get(ordinal, NOTHING) for label, ordinal in places] for column in first.values
    }
    cells: dict[str, list[Cell]] = {
        column: [None if value is None else rounded(value, low, high) for value, low, high, _ in some]
        for column, some in numbers.items()
    }
    counts = {n for some in numbers.values() for *_, n in some}
    if len(counts) > 1:
        cells |= {f"n {column}" if len(numbers) > 1 else "n": [str(n) for *_, n in some] for column, some in numbers.items()}
    methods = {column: dict.fromkeys(m for one in found.values() for m in one.methods[column]) for column in numbers}
    n = f"n = {counts.pop()}" if len(counts) == 1 else ""
    note = "; ".join(filter(None, (n, paper_tables.intervals(methods), *overlay.together(_notes(found)))))
    parts = {f"{column} {part}": [one[k] for one in some] for column, some in numbers.items() for k, part in enumerate(PARTS)}
    data = pa.table({**{f"key {key}": pa.array(values) for key, values in keys.items()}, **parts})
    headers: dict[str, Heads] = {BATCH: (BATCH,), **first.headers} if len(found) > 1 else dict(first.headers)
    headers |= {column: (column.replace("_", " "),) for column in cells if column not in headers}
    sql = "\n\n".join(dict.fromkeys(text for one in found.values() for text in one.sql))
    return Columns(headers, shown, cells, note), data, sql


PARTS = ("value", "low", "high", "n")


def _notes(found: Mapping[str, _Estimates]) -> dict[str, str]:
    return {
        label: "; ".join(dict.fromkeys(part for text in one.notes for part in text.split("; "))) for label, one in found.items()
    }


def _estimates(project: LoadedProject, store: Store, declared: TableForPaper, batch: str) -> _Estimates:
    output, columns = output_and_columns(project, store, batch, declared.table, declared.columns)
    measure = declared.measure or "auto"

    def rows(gallery: Gallery) -> frozenset[int]:
        names = [axis.name for axis in gallery.axes]
        return condition.among(declared.experiments, names, gallery.frame.cells(), gallery.cells)

    found = {
        column: statistics(project, store, batch, output, column, measure, declared.threshold, None, declared.statistics, rows)
        for column in columns
    }
    config = targets.of_batch(project, store, batch).config
    first = next(iter(found.values()))
    cells = {ordinal: first.cells[ordinal] for ordinal in first.table.column("experiment").to_pylist()}
    chosen = condition.among(declared.experiments, first.axes, cells, first.labelled)
    axes = zip(first.axes, paper_tables.axis_headers(config, first), strict=True)
    headers: dict[str, Heads] = {axis: (header,) for axis, header in axes}
    values, methods = {}, {}
    for column, one in found.items():
        for statistic, header in paper_tables.statistic_headers(config, one).items():
            called = column if declared.statistics == paper_tables.PLAIN else f"{statistic} {column}"
            headers[called] = header
            values[called], methods[called] = paper_tables.estimates_of(one, statistic, chosen)
    notes = tuple("; ".join(one.notes) for one in found.values())
    rows_shown = {ordinal: values for ordinal, values in cells.items() if ordinal in chosen}
    return _Estimates(
        first.axes, rows_shown, first.labelled, values, headers, methods, notes, tuple(one.sql for one in found.values())
    )
