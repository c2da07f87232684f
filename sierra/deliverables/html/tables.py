"""Tables of data, which readers can see, and copy as CSV."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from sierra.deliverables.html.escaping import Data, text
from sierra.util.arrow_columns import values_of
from sierra.util.text import digits_apart, short_number

if TYPE_CHECKING:
    import pyarrow as pa

Cell: TypeAlias = "str | int | float | None"
SHOWN = 200
"""The largest number of rows that a page shows; the CSV has all rows of the table."""
EXACT = 2**53
"""The smallest whole number that scripts may confuse with the next one."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of values by column. All columns have the same length."""

    name: str
    headers: tuple[str, ...]
    columns: tuple[Sequence[Cell], ...]
    note: str = ""
    """What the table lacks."""

    @property
    def rows(self) -> int:
        return len(self.columns[0]) if self.columns else 0


def of_arrow(name: str, table: pa.Table, *, most: int, headers: Mapping[str, str] | None = None) -> Table:
    """Return the first `most` rows of a pyarrow table; `headers` has other headers for columns."""
    shown = table.slice(0, most)
    columns = tuple([_cell(value) for value in values_of(column)] for column in shown.columns)
    lacking = f"the first {most:,} of {table.num_rows:,} rows" if table.num_rows > most else ""
    return Table(name, tuple((headers or {}).get(name, name) for name in table.column_names), columns, lacking)


def _cell(value: object) -> Cell:
    return value if value is None or isinstance(value, str | int | float) else str(value)


def element(table: Table, place: int) -> str:
    """Return a table with a button that copies it, as an element of HTML; `place` is its number in the section."""
    return "\n".join(_lines(table, place))


def as_data(table: Table) -> Data:
    """Return the table as data for scripts."""
    return {"headers": table.headers, "columns": [list(map(exact, column)) for column in table.columns]}


def _lines(table: Table, place: int) -> Iterator[str]:
    shown = f"the first {SHOWN} of {table.rows:,} rows are shown, the CSV has all" if table.rows > SHOWN else ""
    note = "; ".join(filter(None, (table.note, shown)))
    yield "<details><summary>Data" + (f": {text(table.name)}" if table.name else "") + "</summary>"
    yield f'<p><button type="button" data-csv="{place}">Copy as CSV</button> <span role="status"></span> {text(note)}</p>'
    yield f'<div class="scroll" tabindex="0" role="region" aria-label="{text(f"Data {table.name}".strip())}"><table>'
    heads = zip(table.headers, table.columns, strict=True)
    yield f"<thead><tr>{''.join(_head_element(header, column) for header, column in heads)}</tr></thead>"
    yield "<tbody>"
    digits = [digits_apart(column[:SHOWN]) for column in table.columns]
    for row in zip(*(column[:SHOWN] for column in table.columns), strict=True):
        yield "<tr>" + "".join(map(_cell_element, row, digits)) + "</tr>"
    yield "</tbody></table></div></details>"


def _head_element(header: str, column: Sequence[Cell]) -> str:
    kind = "" if any(isinstance(value, str) for value in column[:SHOWN]) else ' class="number"'
    return f'<th scope="col" dir="auto"{kind}>{text(header)}</th>'


def _cell_element(value: Cell, digits: int) -> str:
    if isinstance(value, str):
        return f'<td dir="auto">{text(value)}</td>'
    return f'<td class="number">{_number(value, digits)}</td>'


def _number(value: int | float | None, digits: int) -> str:
    """Return a number with at most this many significant digits; whole numbers have all of theirs."""
    if value is None:
        return ""
    return (short_number(value, digits) if isinstance(value, float) else str(value)).replace("-", "−")


def exact(value: Cell) -> Cell:
    """Return a value that JSON and scripts can hold: NaN, infinity and very large whole numbers become text."""
    match value:
        case float() if not math.isfinite(value):
            return str(value)
        case int() if abs(value) > EXACT:
            return str(value)
        case _:
            return value
