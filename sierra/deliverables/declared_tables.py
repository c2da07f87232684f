"""The tables for papers that `sierra.toml` declares: computed, written beside the figures, and recorded like these.

A table has statistics, with a row for each experiment, or the rows of an SQL statement. Several batches are side by side. Each
file of a format with comments names the batch, the hash of the data and the SQL (see `sierra.deliverables.record`).

Also: the columns of a table for papers that has the rows of an SQL statement.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Container, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sierra.config.deliverable_tables import TableForPaper
from sierra.config.project_file import LoadedProject
from sierra.config.validate import options
from sierra.deliverables import paper_tables, table_of_statistics
from sierra.deliverables.paper_tables import Cell, PaperTable
from sierra.deliverables.record import Deliverable, origin_of, parsing
from sierra.deliverables.table_columns import Columns, plain_table, side_by_side
from sierra.deliverables.table_of_statistics import BATCH
from sierra.errors import Missing, NotFound, SierraError
from sierra.stats.rounding import Rounded, fixed, rounded
from sierra.store.data_hash import data_hash
from sierra.store.row_types import DeliverableRow
from sierra.store.several_batches import joined
from sierra.store.store import Store
from sierra.util.arrow_columns import values_of
from sierra.util.fs import fitting, write_whole
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import like
from sierra.util.version import __version__

if TYPE_CHECKING:
    import pyarrow as pa


def columns_of_rows(store: Store, declared: TableForPaper, batches: Mapping[str, str]) -> tuple[Columns, pa.Table, str]:
    """Return the columns of the rows of a statement, these rows, and the statement."""
    answer = joined(store, batches, declared.sql, "sql")
    every = {column: values_of(answer.table.column(column)) for column in answer.table.column_names}
    numeric = _numeric(answer.table)
    intervals = {column: ends for column in every if (ends := _interval(column, numeric))}
    shown = [column for column in every if not any(column in ends for ends in intervals.values())]
    if isinstance(declared.digits, Mapping) and (unknown := [column for column in declared.digits if column not in shown]):
        raise NotFound(f"digits: the statement has no column {unknown[0]!r}; {like(unknown[0], shown)}")
    split = shown.index(declared.across) + 1 if declared.across in shown else 0
    cells: dict[str, list[Cell]] = {}
    for column in shown[split:]:
        digits = declared.digits if isinstance(declared.digits, int) else declared.digits.get(column)
        low, high = (every[end] for end in intervals[column]) if column in intervals else ([None] * answer.table.num_rows,) * 2
        cells[column] = [_cell(*values, digits) for values in zip(every[column], low, high, strict=True)]
    headers = {column: (column.replace("_", " "),) for column in shown}
    return Columns(headers, {column: every[column] for column in shown[:split]}, cells), answer.table, answer.sql


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


KIND = "table"
"""The kind of the records of tables, among deliverables."""
ENDINGS = {"latex": "tex", "markdown": "md", "html": "html", "csv": "csv"}


@dataclass(frozen=True, slots=True)
class ComputedTable:
    """A declared table with its numbers."""

    name: str
    declared: TableForPaper
    batches: Mapping[str, str]
    """The batches by label."""
    table: PaperTable
    data: pa.Table
    sql: str

    def content(self) -> Deliverable:
        """Return everything that the table's files depend on."""
        definition: dict[str, JsonView] = {
            "table": self.declared.model_dump(mode="json", exclude_unset=True, by_alias=True),
            "labels": list(self.batches),
            "headers": list(self.table.headers),
            "note": self.table.note,
        }
        made_by = (f"sierra-experiments=={__version__}",)
        return Deliverable(KIND, self.name, tuple(self.batches.values()), definition, self.sql, data_hash(self.data), made_by)

    def write(self, folder: Path) -> tuple[Path, ...]:
        """Write the table in its formats; return the files. Raises Missing if the folder cannot be written."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            return tuple(
                write_whole(folder / f"{fitting(self.name)}.{ENDINGS[format]}", self._text(format).encode())
                for format in self.declared.formats
            )
        except OSError as error:
            raise Missing(f"{folder}: cannot write table {self.name}: {error.strerror}") from error

    def _text(self, format: str) -> str:
        if format == "csv":
            return paper_tables.csv(self.table)
        first, *others = self.batches.values()
        lines = [origin_of(first, data_hash(self.data), *others), *self.sql.splitlines()]
        return f"{_comment(format, lines)}\n{paper_tables.FORMATS[format](self.table)}"


def _comment(format: str, lines: Sequence[str]) -> str:
    """Return lines as a comment, which two hyphens would end in HTML."""
    if format == "latex":
        return "".join(f"% {line}".rstrip() + "\n" for line in lines)
    return "\n".join(["<!--", *(re.sub("-(?=-)", "- ", line) for line in lines), "-->", ""])


def make(project: LoadedProject, store: Store, name: str, declared: TableForPaper, batches: Mapping[str, str]) -> ComputedTable:
    """Return a declared table of batches, by label. Raises SierraError if it cannot be made."""
    if declared.sql:
        columns, data, sql = columns_of_rows(store, declared, batches)
    else:
        columns, data, sql = table_of_statistics.columns(project, store, declared, batches)
    if not data.num_rows:
        raise SierraError("the table has no row")
    if unknown := [column for column in declared.headers if column not in columns.headers]:
        raise NotFound(f"headers: the table has no column {unknown[0]!r}; {like(unknown[0], list(columns.headers))}")
    headers = {name: (_given(header, declared),) for name, header in declared.headers.items()}
    columns = replace(columns, headers={**columns.headers, **headers})
    across = declared.across or (BATCH if len(batches) > 1 and not declared.sql else "")
    if across and across not in columns.keys:
        raise NotFound(f"across: the table has no variable {across!r}; {like(across, list(columns.keys))}")
    table = side_by_side(columns, across) if across else plain_table(columns)
    note = "; ".join(filter(None, (table.note, declared.footnote)))
    table = replace(table, note=note, caption=_given(declared.caption, declared), label=declared.label)
    return ComputedTable(name, declared, batches, table, data, sql)


def _given(text: str, declared: TableForPaper) -> str:
    """Return a text of `sierra.toml`, which may be LaTeX."""
    return paper_tables.Latex(text) if declared.latex else text


def content(project: LoadedProject, store: Store, row: DeliverableRow) -> Deliverable:
    """Return the content of a recorded table by its definition and the data that the store has now."""
    with parsing(row.name):
        recorded = json.loads(row.definition)
        declared = options(TableForPaper, recorded["table"], f"table {row.name}, as it was recorded")
        labelled = dict(zip(recorded["labels"], row.batches, strict=True))
    return make(project, store, row.name, declared, labelled).content()
