"""Tables of data, which readers can see, and copy as CSV."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

from sierra.deliverables.html.escaping import Data
from sierra.util.arrow_columns import values_of
from sierra.util.html_elements import Markup, element, joined
from sierra.util.lazy_definitions import dataclass
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
    """A note on values that the table lacks."""

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


def table_element(table: Table, index: int) -> Markup:
    """Return a table with a button that copies it; `index` is its number in the section."""
    shown = f"the first {SHOWN} of {table.rows:,} rows are shown, the CSV has all" if table.rows > SHOWN else ""
    note = "; ".join(filter(None, (table.note, shown)))
    digits = [digits_apart(column[:SHOWN]) for column in table.columns]
    rows = (element("tr", *map(_cell_element, row, digits)) for row in zip(*(c[:SHOWN] for c in table.columns), strict=True))
    head = element("thead", element("tr", *map(_head_element, table.headers, table.columns)))
    inner = element("table", joined(("", head, element("tbody", joined(("", *rows, ""), "\n"))), "\n"))
    button = element("button", "Copy as CSV", type="button", data_csv=index)
    lines = (
        element("summary", f"Data: {table.name}" if table.name else "Data"),
        element("p", button, " ", element("span", role="status"), f" {note}"),
        element("div", inner, class_="scroll", tabindex=0, role="group", aria_label=f"Data {table.name}".strip()),
    )
    return element("details", joined(lines, "\n"))


def as_data(table: Table) -> Data:
    """Return the table as data for scripts."""
    return {"headers": table.headers, "columns": [list(map(exact, column)) for column in table.columns]}


def _head_element(header: str, column: Sequence[Cell]) -> Markup:
    kind = None if any(isinstance(value, str) for value in column[:SHOWN]) else "number"
    return element("th", header, scope="col", dir="auto", class_=kind)


def _cell_element(value: Cell, digits: int) -> Markup:
    if isinstance(value, str):
        return element("td", value, dir="auto")
    return element("td", _number(value, digits), class_="number")


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
