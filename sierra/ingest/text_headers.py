"""The keys of `[outputs.NAME]` that read a text table whose names are not in its first line, found from its first lines.

Programs write comments, units or a small table above the names of columns, or no names at all. A proposal is made only if all
lines below have the same number of cells, and each has a number.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence

from sierra.ingest.delimiters import DELIMITERS, delimiter_of, reads_as_number, split
from sierra.store.sql_names import unmarked
from sierra.util.lazy_definitions import regex

BLANKS = "blanks"
READ = 1 << 16
"""The number of bytes at the beginning of a file that are looked at."""
MARK = regex(r"\s*(#|@|%|//|!)")
"""The beginnings of comments."""
UNIT = regex(
    r"\[.*\]|\(.*\)|[-%1]|([munpkMGc\u00b5\u03bc]?(s|m|g|W|J|V|A|N|Pa|Hz|B|bps)|min|h|d|K|C|F|deg|degC|\u00b0C|rad|mol)"
    r"([/*^.][-\w/*^.]*)?"
)
"""The units in a line below the names of columns."""
MISSING = frozenset(["na", "n/a", "null", "none", "-", "--", "?"])
"""Texts of cells without a value."""
MOST = 200
"""The largest number of lines above the first row."""
Key = str | bool | int | list[str]


def keys_of(content: bytes) -> Mapping[str, Key] | None:
    """Return the keys that read a text table with this beginning; nothing if it needs none, None if it is no such table."""
    lines = _lines(content)
    return next((keys for one in (*DELIMITERS, BLANKS) if (keys := _keys(lines, one)) is not None), None)


def _lines(content: bytes) -> list[str]:
    text = content[:READ].decode("utf-8-sig", "replace")
    lines = text.split("\n")
    if len(content) > READ or not lines[-1]:
        lines.pop()
    return [line.rstrip("\r") for line in lines]


def _cells(line: str, delimiter: str) -> tuple[str, ...]:
    try:
        return tuple(line.split()) if delimiter == BLANKS else split(line, delimiter)
    except csv.Error:
        return ()


def _keys(lines: Sequence[str], delimiter: str) -> dict[str, Key] | None:
    """Return the keys for cells that this delimiter separates."""
    rows = {place: _cells(line, delimiter) for place, line in enumerate(lines) if line.strip() and not MARK.match(line)}
    first = _first_row(rows)
    if first is None or first > MOST or (len(rows[first]) < 2 and delimiter != DELIMITERS[0]):
        return None
    width = len(rows[first])
    above = [place for place in rows if place < first]
    if any(len(rows[place]) == width and all(map(reads_as_number, rows[place])) for place in above):
        return None  # these are rows, too
    marks = {place: mark[1] for place, line in enumerate(lines) if (mark := MARK.match(line))}
    keys: dict[str, Key] = {}
    below = (cell for place in rows if place >= first for cell in rows[place])
    is_plain = all(not cell or cell in MISSING or reads_as_number(cell) for cell in below)
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
        keys |= _comment(mark for place, mark in marks.items() if place > head or not skips)
    elif (head := first - 1) in marks and (names := _marked_names(lines[head], delimiter, width)):
        keys |= {"skip": head} if head else {}
        if max(marks) > head:  # comments within the table, of which its names could not be told
            return None
    elif not is_plain:
        return None  # its first line may be a header with numbers in it
    else:
        blank = any(not line.strip() for line in lines[:first])  # without names, an empty line may be a row
        keys |= {"skip": first} if blank else {}
        keys |= _comment(mark for place, mark in marks.items() if place > first or not blank)
        return {**keys, **({"delimiter": delimiter} if delimiter == BLANKS else {}), "header": False}
    if not _are_names(names, width) or names in [rows[place] for place in above[:-1]]:
        return None  # with the same names above, a run has appended to its file
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


def _first_row(rows: Mapping[int, Sequence[str]]) -> int | None:
    """Return the first line from which on all lines have the same number of cells, and a number in each."""
    first = width = None
    for place in reversed(list(rows)):
        cells = rows[place]
        width = width or len(cells)
        if len(cells) != width or not any(map(reads_as_number, cells)):
            break
        first = place
    return first


def _are_units(cells: Sequence[str]) -> bool:
    return all(map(UNIT.fullmatch, cells))


def _are_names(cells: Sequence[str], width: int) -> bool:
    unique = len({cell.lower() for cell in cells}) == len(cells)
    words = all(cell and cell.lower() not in MISSING and not reads_as_number(cell) for cell in cells)
    return len(cells) == width and unique and words
