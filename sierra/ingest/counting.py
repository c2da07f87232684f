"""Rows of files, counted without the parser that reads them: a parser that stops early says nothing.

A worker counts lines and quotes while it hashes. Where a file has no quotes and its lines end alike, its rows follow from
these counts. Where they do not, or where they differ from what was read, the file is read again: CSV by Python's `csv`
module in the same dialect, JSON lines by their lines. Rows of Parquet are in its footer.
"""

from __future__ import annotations

import contextlib
import csv
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from sierra.ingest.model import Written


def lines_of(file: Written, *, empty: bool = False) -> int | None:
    """Return the lines of a text, the empty ones too if asked for; None where a worker has not counted them."""
    if not file.alike or file.blank is None:
        return None
    return file.lines + (not file.ended) - (0 if empty else file.blank)


def count_lines(file: Written) -> int:
    """Return how many lines of a file have more than blanks in them."""
    with Path(file.path).open("rb") as lines:
        return sum(1 for line in lines if line.strip())


def count_records(file: Written, delimiter: str, *, empty: bool = False) -> int:
    """Return how many records a CSV has, its header included. Raises csv.Error where its quotes are not a CSV's."""
    with Path(file.path).open(encoding="utf-8-sig", errors="surrogateescape", newline="") as text, any_size():
        return sum(1 for record in csv_reader(text, delimiter) if record or empty)


def csv_reader(lines: Iterable[str], delimiter: str) -> Any:
    """Return Python's reader of the dialect that SIERRA reads: blanks around quotes do not count."""
    padded = delimiter != " "
    return csv.reader(
        _without_padding(lines, delimiter) if padded else lines, delimiter=delimiter, skipinitialspace=padded, strict=True
    )


def _without_padding(lines: Iterable[str], delimiter: str) -> Iterator[str]:
    """Yield the lines without blanks between a quote and the end of its field, which Python's reader would refuse."""
    padding = re.compile(rf'" +(?=[{re.escape(delimiter)}\r\n]|$)')
    for line in lines:
        yield padding.sub('"', line) if '" ' in line else line


@contextlib.contextmanager
def any_size() -> Iterator[None]:
    """Let fields of a CSV be of any size."""
    before = csv.field_size_limit(sys.maxsize)
    try:
        yield
    finally:
        csv.field_size_limit(before)
