"""The columns of a table for papers, and their layout: as they are, or with the values of one variable side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sierra.deliverables.paper_tables import Cell, Heads, PaperTable, flat, plain
from sierra.errors import UsageError
from sierra.model import Value
from sierra.util.lazy_definitions import dataclass


@dataclass(frozen=True, slots=True)
class Columns:
    """The columns of a table by name: those that say what a row is (`keys`), then those with numbers."""

    headers: Mapping[str, Heads]
    keys: Mapping[str, Sequence[Value | None]]
    cells: Mapping[str, Sequence[Cell]]
    note: str = ""


def plain_table(columns: Columns) -> PaperTable:
    """Return the table of these columns."""
    cells = {**{key: plain(values) for key, values in columns.keys.items()}, **columns.cells}
    heads = [columns.headers[name] for name in cells]
    return _table(columns, list(map(flat, heads)), heads, list(cells.values()))


def side_by_side(columns: Columns, across: str) -> PaperTable:
    """Return the table with the columns of numbers repeated for each value of one of the keys."""
    count = len(columns.keys[across])
    rest = {key: values for key, values in columns.keys.items() if key != across}
    keys = list(zip(*rest.values(), strict=True)) if rest else [()] * count
    rows = {key: row for row, key in enumerate(dict.fromkeys(keys))}
    heads = [columns.headers[key] for key in rest]
    headers = list(map(flat, heads))
    body: list[Sequence[Cell]] = [plain([key[index] for key in rows]) for index in range(len(rest))]
    groups = list(dict.fromkeys(columns.keys[across]))
    for group, shown in zip(groups, plain(groups), strict=True):
        above: Heads = (str(shown),) if isinstance(group, str) else (*columns.headers[across], str(shown))
        named = " = ".join(above)
        places = {rows[keys[k]]: k for k in range(count) if columns.keys[across][k] == group}
        if len(places) < sum(value == group for value in columns.keys[across]):
            raise UsageError(f"across: two rows have the same {across!r} and other values; leave it out, or group the rows")
        for name, cells in columns.cells.items():
            own = columns.headers[name]
            heads.append((*own, *above) if len(columns.cells) == 1 else (*above, *own))
            headers.append(f"{flat(own)} ({named})")
            body.append([cells[places[row]] if row in places else None for row in range(len(rows))])
    return _table(columns, headers, heads, body)


def _table(columns: Columns, headers: Sequence[str], heads: Sequence[Heads], cells: Sequence[Sequence[Cell]]) -> PaperTable:
    """Return the table; columns of texts that are no numbers are aligned to the left."""
    texts = frozenset(index for index, column in enumerate(cells) if any(map(_is_text, column)))
    return PaperTable(tuple(headers), tuple(zip(*cells, strict=True)), columns.note, texts=texts, heads=tuple(heads))


def _is_text(cell: Cell) -> bool:
    if not isinstance(cell, str):
        return False
    try:
        float(cell.replace("−", "-").replace("∞", "inf"))
    except ValueError:
        return True
    return False
