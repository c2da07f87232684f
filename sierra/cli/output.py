"""Output of commands: tables for people, JSON for programs.

The output may contain texts from a stranger's record: names, values, paths, the ends of logs, a scheduler's messages. `Safe` is
the one place that escapes the characters that control a terminal. JSON has its own escapes for them, and files keep every byte.
"""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields as fields_of
from dataclasses import is_dataclass
from datetime import datetime
from decimal import Decimal
from typing import Any, TextIO

from sierra.util.text import DIGITS, digits_apart, short_number, visible


def safe(text: str) -> str:
    """Return a text in which escapes replace characters that control a terminal or deceive its reader."""
    return visible(text).replace("\r", "\\r")


class Safe:
    """A stream to a person, with escapes for characters that control the terminal; `raw` is the original stream."""

    def __init__(self, raw: TextIO) -> None:
        self.raw = raw

    def write(self, text: str) -> int:
        self.raw.write(safe(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Make all output inside the context safe."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (Safe(stream) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def raw(stream: TextIO) -> TextIO:
    """Return the stream behind a safe one, for code that draws on the terminal itself."""
    return stream.raw if isinstance(stream, Safe) else stream


def print_json(value: object) -> None:
    """Print one JSON value, as `as_json` writes it."""
    print(as_json(value))


def as_json(value: object) -> str:
    """Return JSON that every reader accepts: times as ISO 8601, null for infinite floats and NaN.

    Dataclasses and named tuples become objects.
    """
    return json.dumps(_finite(value), indent=2, default=_plain, allow_nan=False)


def members(value: object) -> Mapping[str, object] | None:
    """Return the values by name of a mapping, a dataclass or a named tuple; None for any other value."""
    if isinstance(value, Mapping):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in fields_of(value)}
    return (
        dict(zip(names, value, strict=True)) if isinstance(value, tuple) and (names := getattr(value, "_fields", ())) else None
    )


def table(
    columns: Sequence[str], rows: Iterable[Sequence[object]], *, right: Iterable[str] = (), width: int | None = None
) -> None:
    """Print a table without lines. It is as wide as its content; on a terminal, long texts are cut so that it fits.

    `width` is the width of the terminal; 0 cuts nothing.
    """
    columns, rows = [cell(column) for column in columns], [list(row) for row in rows]
    texts = cells(rows)
    to_the_right = set(right)
    widths = [max([len(column), *(len(row[index]) for row in texts)]) for index, column in enumerate(columns)]
    cuttable = [index for index in range(len(columns)) if any(isinstance(row[index], str) for row in rows)]
    widths = _fitted(widths, cuttable, terminal_width() if width is None else width)
    texts = [[_cut(text, widths[index]) for index, text in enumerate(row)] for row in texts]
    for row in ([_cut(column, wide) for column, wide in zip(columns, widths, strict=True)], *texts):
        padded = [
            text.rjust(wide) if column in to_the_right else text.ljust(wide)
            for text, wide, column in zip(row, widths, columns, strict=True)
        ]
        print("  ".join(padded).rstrip())


def terminal_width() -> int:
    """Return the number of columns of the terminal; 0 if standard output is not a terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 0


NARROWEST = 12
"""The width below which no column is cut: an id of 10 digits fits."""


def _fitted(widths: list[int], cuttable: Sequence[int], room: int) -> list[int]:
    """Return the widths of columns; the widest of those that may be cut are cut to the room, as far as that is possible."""
    widths, excess = list(widths), sum(widths) + 2 * (len(widths) - 1) - room
    while room and excess > 0 and cuttable:
        widest = max(cuttable, key=lambda place: widths[place])
        if widths[widest] <= NARROWEST:
            break
        widths[widest] -= 1
        excess -= 1
    return widths


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 1]}…"


def cells(rows: Sequence[Sequence[object]]) -> list[list[str]]:
    """Return the texts of the rows of a table, with as many digits in each column as tell different values apart."""
    columns = [_column([row[place] for row in rows]) for place in range(len(rows[0]) if rows else 0)]
    return [list(row) for row in zip(*columns, strict=True)]


def _column(values: Sequence[object]) -> list[str]:
    digits = digits_apart(values)
    moments = {value for value in values if isinstance(value, datetime)}
    exact = len({cell(moment) for moment in moments}) < len(moments)
    return [str(one) if exact and isinstance(one, datetime) else cell(one, digits) for one in values]


def cell(value: object, digits: int = DIGITS) -> str:
    """Return a value as text for a table: short numbers, times to the second with their zone, one line."""
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "no"
        case float():
            return short_number(value, digits)
        case datetime():
            return str(value.replace(microsecond=0))
        case _:
            return safe(" ".join(str(value).split("\n")))


def short_id(value: object) -> object:
    """Return the prefix of an id that commands accept; return any other value unchanged."""
    from sierra.util.hashing import short

    return short(value) if isinstance(value, str) and len(value) == 64 and not value.strip("0123456789abcdef") else value


def fitting(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> int:
    """Return the number of columns of a table that fit the terminal, at least 1; all columns without a terminal."""
    if not sys.stdout.isatty():
        return len(columns)
    room = shutil.get_terminal_size().columns
    for place, column in enumerate(columns):
        room -= max([len(column), *map(len, _column([row[place] for row in rows]))]) + (2 if place else 0)
        if room < 0:
            return max(place, 1)
    return len(columns)


def readable(text: str) -> str:
    """Return a text from outside as one line, with escapes for characters that control a terminal or end a line."""
    return safe(text).replace("\n", "\\n").replace("\t", "\\t")


def fields(record: Mapping[str, object], indent: str = "", columns: int = 0) -> None:
    """Print names and values, a line each; on a terminal, long values are wrapped, and elsewhere if `columns` are given."""
    width = max((len(name) for name in record), default=0)
    for name, value in record.items():
        label = f"{indent}{name.ljust(width)}  "
        print(label + ("\n" + " " * len(label)).join(_lines(cell(value), len(label), columns)))


def _lines(text: str, indent: int, columns: int) -> list[str]:
    """Return a text as lines that fit the terminal, or as one line without a terminal.

    Words stay whole, so that users can copy them.
    """
    is_terminal = sys.stdout.isatty()
    if not is_terminal and not columns:
        return [text]
    room = max((shutil.get_terminal_size().columns if is_terminal else columns) - indent, 20)
    return textwrap.wrap(text, room, break_long_words=False, break_on_hyphens=False) or [""]


def note(message: str) -> None:
    """Print a note to standard error: information for the user that is not part of the result."""
    print(f"note: {message}", file=sys.stderr)


def _finite(value: object) -> object:
    """Return a value in which null replaces floats that JSON does not have, and numbers replace exact decimals.

    Sums of whole numbers are exact decimals.
    """
    match value:
        case float():
            return value if math.isfinite(value) else None
        case Decimal():
            return int(value) if value == value.to_integral_value() else float(value)
        case _ if (named := members(value)) is not None:
            return {str(name): _finite(inner) for name, inner in named.items()}
        case list() | tuple():
            return [_finite(inner) for inner in value]
        case _:
            return value


def _plain(value: object) -> str:
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value)
