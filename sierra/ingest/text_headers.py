"""The keys of `[outputs.NAME]` that read a text table that is no plain CSV, found from its first lines.

Programs write comments, units or a small table above the names of columns, or no names at all, or the names again and again.
Numbers may have a decimal comma. A proposal is made only if all lines below have as many cells, and each has a number.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise

from sierra.config.field_types import NAME
from sierra.ingest.delimiters import COMMA, DELIMITERS, PADDED, POINT, delimiter_of, reads_as_number, split
from sierra.store.sql_names import unmarked
from sierra.store.type_inference import as_float
from sierra.util.lazy_definitions import regex

BLANKS = "blanks"
READ = 1 << 16
"""The number of bytes at the beginning of a file that are looked at."""
RULES = ("---", "===")
"""The ends of the beginnings of rules."""
MARK = regex(r"\s*(#|@|%|//|!|[+| :]{0,3}(?:---|===)(?=[-=+|:\s]*$))")
"""The beginnings of comments, and of rules, such as `----+----`, `|---|` and `+===+`."""
UNIT = regex(
    r"\[.*\]|\(.*\)|[-%1]|([munpkMGc\u00b5\u03bc]?(s|m|g|W|J|V|A|N|Pa|Hz|B|bps)|min|h|d|K|C|F|deg|degC|\u00b0C|rad|mol)"
    r"([/*^.][-\w/*^.]*)?"
)
"""The units in a line below the names of columns."""
NAME_AND_UNIT = regex(r"([^\s\[(]+)(?:\s*[\[(]([^\[\]()]*)[\])])?")
"""A name, perhaps with its unit, as in `distance[m]`."""
MISSING = frozenset(["na", "n/a", "null", "none", "-", "--", "?"])
"""Texts of cells without a value."""
MOST = 200
"""The largest number of lines above the first row."""
GROUPED = regex(r"[-+]?[1-9][0-9]{0,2}(,[0-9]{3})+")
"""Numbers whose comma may be that of thousands."""
Key = str | bool | int | list[str] | dict[str, str]
CHANGING_NO_ROWS = frozenset(["decimal", "comment"])
Cells = Mapping[int, Sequence[str]]
"""The cells of lines, by the place of the line."""


def better_keys_of(content: bytes) -> Mapping[str, Key]:
    """Return the keys that read a table better that is read without them: only those that change neither rows nor names.

    A rule between rows is no row.
    """
    keys = keys_of(content) or {}
    return keys if keys.keys() <= CHANGING_NO_ROWS and str(keys.get("comment", RULES[0])).endswith(RULES) else {}


def keys_of(content: bytes) -> Mapping[str, Key] | None:
    """Return the keys that read a text table with this beginning; nothing if it needs none, None if it is no such table."""
    lines = _lines(content)
    for delimiter in (*DELIMITERS, BLANKS):
        keys = _keys_of_repeated_names(lines, delimiter)
        if keys is None:
            keys = _keys(lines, delimiter)
        if keys is not None:
            return keys
    return None


def _lines(content: bytes) -> list[str]:
    text = content[:READ].decode("utf-8-sig", "replace")
    lines = text.split("\n")
    if len(content) > READ or not lines[-1]:
        lines.pop()
    return [line.rstrip("\r") for line in lines]


def _cells(line: str, delimiter: str) -> tuple[str, ...]:
    if delimiter == PADDED and len(line) > 1 and line[0] == PADDED == line.rstrip()[-1]:
        line = line.rstrip()[1:-1]  # as in Markdown
    try:
        return tuple(line.split()) if delimiter == BLANKS else split(line, delimiter)
    except csv.Error:
        return ()


def _keys(lines: Sequence[str], delimiter: str) -> dict[str, Key] | None:
    """Return the keys for cells that this delimiter separates."""
    rows = {index: _cells(line, delimiter) for index, line in enumerate(lines) if line.strip() and not MARK.match(line)}
    is_number = _is_number(delimiter)
    first = _first_row(rows, is_number)
    if first is None or first > MOST or (len(rows[first]) < 2 and delimiter != DELIMITERS[0]):
        return None
    width = len(rows[first])
    above = [index for index in rows if index < first]
    numbers = [index for index in above if len(rows[index]) == width and all(map(is_number, rows[index]))]
    if numbers and not _is_small_table(rows, above, numbers, width):
        return None  # these are rows, too
    marks = {index: mark[1] for index, line in enumerate(lines) if (mark := MARK.match(line))}
    others = [line.lstrip() for index, line in enumerate(lines) if index not in marks]
    if any(line.startswith(tuple(marks.values())) for line in others):
        return None  # these begin like a rule
    within = [lines[index] for index in marks if index > (above[-1] if above else first)]
    if any(_may_be_row(line, _cells(line, delimiter), width) for line in within):
        return None  # these are rows, too
    body = [rows[index] for index in rows if index >= first]
    is_plain = _are_numbers(body, is_number)
    keys: dict[str, Key] = {"decimal": ","} if delimiter != DELIMITERS[0] and _has_decimal_commas(body) else {}
    if has_units := len(above) == 2 and _are_units(rows[above[1]]) and not _are_units(rows[above[0]]):
        above.pop()
    if above:
        head = above[-1]
        names = rows[head]
        skips = len(above) > 1 or (head > 0 and not marks)
        if skips and not is_plain:
            return None  # a row of texts is no header
        keys |= {"units_row": True} if has_units else {}
        keys |= {"skip": head} if skips else {}
        keys |= _comment(mark for index, mark in marks.items() if index > head or not skips)
    elif (head := first - 1) in marks and (names := _only_names(lines, marks, head, delimiter, width)):
        keys |= {"skip": head} if head else {}
    elif head in marks and (declared := _declared_names([lines[index] for index in marks if index < first], delimiter, width)):
        return {**keys, **_named_delimiter(delimiter), **_comment(marks.values()), "header": False, **declared}
    elif not is_plain:
        return None  # its first line may be a header with numbers in it
    else:
        blank = any(not line.strip() for line in lines[:first])  # without names, an empty line may be a row
        keys |= {"skip": first} if blank else {}
        keys |= _comment(mark for index, mark in marks.items() if index > first or not blank)
        return {**keys, **({"delimiter": delimiter} if delimiter == BLANKS else {}), "header": False}
    if not _are_names(names, width) or names in [rows[index] for index in above[:-1]]:
        return None  # with the same names above, a run has appended to its file
    if len(above) > 1 and _are_names(rows[above[-2]], width):
        return None  # are these two lines of names?
    if delimiter == BLANKS and any(other in lines[head] for other in DELIMITERS if other != "\t"):
        return None
    if delimiter == BLANKS or (width > 1 and delimiter_of(lines[head]) != delimiter):
        keys["delimiter"] = delimiter
    return keys


def _comment(marks: Iterable[str]) -> dict[str, Key]:
    """Return the key for lines that begin with these marks."""
    own = list(dict.fromkeys(marks))
    return {"comment": own[0] if len(own) == 1 else own} if own else {}


def _marked_names(line: str, delimiter: str, width: int) -> tuple[str, ...]:
    """Return the names in a line that is marked as a comment; nothing if there are other words."""
    bare = unmarked(line.strip())
    cells = _cells(bare, delimiter) if bare != line.strip() else ()
    return cells if _are_names(cells, width) else ()


def _only_names(lines: Sequence[str], marks: Mapping[int, str], head: int, delimiter: str, width: int) -> tuple[str, ...]:
    """Return the names in a comment, if no comment follows it; nothing if it has units, or other words."""
    names = _marked_names(lines[head], delimiter, width) if max(marks) == head else ()
    return () if _are_units(names) else names


def _declared_names(comments: Sequence[str], delimiter: str, width: int) -> dict[str, Key]:
    """Return the keys that declare the names, and the units, in comments above the first row; nothing if these are other words.

    The last comment has the names, perhaps with units behind them, or has the units of the one before.
    """
    below = _cells(unmarked(comments[-1].strip()), delimiter) if len(comments) > 1 else ()
    has_units = len(below) == width and _are_units(below)
    named = _marked_names(comments[-2 if has_units else -1], delimiter, width) if comments else ()
    parts = [NAME_AND_UNIT.fullmatch(name) for name in named]
    names = [part[1] for part in parts if part]
    if not names or len({name.lower() for name in names}) < width or not all(re.fullmatch(NAME, name) for name in names):
        return {}
    units = below if has_units else [part[2] or "" for part in parts if part]
    bare = {name: unit.strip("[]()") for name, unit in zip(names, units, strict=True)}
    of_columns = {name: unit for name, unit in bare.items() if unit not in ("", "-", "1")}
    return {"columns": names, **({"units": of_columns} if of_columns else {})}


def _keys_of_repeated_names(lines: Sequence[str], delimiter: str) -> dict[str, Key] | None:
    """Return the keys for a table whose first line is repeated; None for others, and if a run may have appended to its file.

    The rows of all parts are then one table: its first column goes ahead from part to part.
    """
    head = lines[0] if lines else ""
    names = _cells(head, delimiter)
    others = [line for line in lines if line != head]
    if len(others) + 1 == len(lines) or any(line.startswith(head) for line in others) or not _are_names(names, len(names)):
        return None
    if not all(re.fullmatch(NAME, name) for name in names):
        return None  # `columns` cannot declare them
    keys = _keys([head, *others], delimiter)
    if keys is None or keys.keys() - {"delimiter"}:
        return None
    times = [as_float(_cells(line, delimiter)[0]) or 0.0 for line in others if line.strip()]
    if any(later <= earlier for earlier, later in pairwise(times)):
        return None
    return {"comment": head, "header": False, "columns": list(names), **_named_delimiter(delimiter)}


def _named_delimiter(delimiter: str) -> dict[str, Key]:
    """Return the key for a delimiter that is not the usual one."""
    return {} if delimiter == DELIMITERS[0] else {"delimiter": delimiter}


def _is_small_table(rows: Cells, above: Sequence[int], numbers: Sequence[int], width: int) -> bool:
    """Return whether lines of numbers above the names are the only row of another table, with names of its own above it."""
    if len(numbers) > 1 or numbers[0] in (above[0], above[-1]):
        return False
    names = rows[above[above.index(numbers[0]) - 1]]
    return _are_names(names, width) and not set(names) & set(rows[above[-1]])


def _is_number(delimiter: str) -> Callable[[str], bool]:
    """Return the test for a number, which may have a decimal comma if cells are separated by something else."""
    return reads_as_number if delimiter == DELIMITERS[0] else _reads_with_comma


def _reads_with_comma(cell: str) -> bool:
    return reads_as_number(cell) or COMMA.fullmatch(cell) is not None


def _are_numbers(rows: Iterable[Iterable[str]], is_number: Callable[[str], bool]) -> bool:
    """Return whether all cells are numbers, or have no value."""
    return all(not cell or cell in MISSING or is_number(cell) for row in rows for cell in row)


def _has_decimal_commas(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether columns of numbers have a decimal comma, and none a decimal point; commas of thousands leave doubt."""
    cells = [cell for row in rows for cell in row]
    with_commas = [column for column in zip(*rows, strict=True) if any(map(COMMA.fullmatch, column))]
    commas = [cell for column in with_commas for cell in column if COMMA.fullmatch(cell)]
    are_numbers = _are_numbers(with_commas, _reads_with_comma)
    return are_numbers and not all(map(GROUPED.fullmatch, commas)) and not any(map(POINT.fullmatch, cells))


def _first_row(rows: Cells, is_number: Callable[[str], bool]) -> int | None:
    """Return the first line from which on all lines have the same number of cells, and a number in each."""
    first = width = None
    for place in reversed(list(rows)):
        cells = rows[place]
        width = width or len(cells)
        if len(cells) != width or not any(map(is_number, cells)):
            break
        first = place
    return first


def _may_be_row(line: str, cells: Sequence[str], width: int) -> bool:
    """Return whether a marked line may be a row of the table, such as `#ff0000,3`; `# total: 3` is none."""
    mark = MARK.match(line)
    is_apart = mark is not None and not line[mark.end() : mark.end() + 1].strip()
    return not is_apart and len(cells) == width and any(map(reads_as_number, cells))


def _are_units(cells: Sequence[str]) -> bool:
    return all(map(UNIT.fullmatch, cells)) and any(re.search(r"[^\W\d]|[\[(\u00b0]", cell) for cell in cells)


def _are_names(cells: Sequence[str], width: int) -> bool:
    unique = len({cell.lower() for cell in cells}) == len(cells)
    words = all(cell and cell.lower() not in MISSING and not reads_as_number(cell) for cell in cells)
    return len(cells) == width and unique and words
