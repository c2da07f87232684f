"""Row counts of files, independent of the parser that reads them: a parser that stops early does not report it.

A worker counts lines and quotes while it hashes a file. If the file has no quotes and all lines end alike, the row count
follows from these counts. Otherwise, or if the result differs from the rows that were read, the file is read again: CSV by
Python's `csv` module in the same dialect, JSON lines by their lines. The row count of Parquet is in its footer.
"""

from __future__ import annotations

import contextlib
import csv
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.ingest.model import Written
from sierra.model import OutputFile
from sierra.util.lazy_definitions import regex
from sierra.worker.outputs import describe

if TYPE_CHECKING:
    import _csv

FILLED = regex(rb"^[ \t\r\f\v]*[^\s][^\n]*", re.MULTILINE)


def described(file: Written, path: Path) -> Written:
    """Return the file that a file became, at `path`, with the counts of its lines and quotes."""
    seen = OutputFile(**describe(str(path), file.name))
    counts = (seen.head, seen.lines, seen.ended, seen.bytes, seen.quotes, seen.blank, seen.alike)
    return Written(str(path), file.run, file.execution, file.name, *counts, file.ticks, file.archive)


def lines_of(file: Written, *, empty: bool = False) -> int | None:
    """Return the number of lines of a text, with `empty` also the empty ones; None if a worker has not counted them."""
    if not file.alike or file.blank is None:
        return None
    return file.lines + (not file.ended) - (0 if empty else file.blank)


def count_lines(file: Written) -> int:
    """Return the number of lines that are not blank."""
    with Path(file.path).open("rb") as lines:
        return sum(1 for line in lines if line.strip())


def count_filled(content: bytes) -> int:
    """Return the number of lines of a text that are not blank."""
    return len(FILLED.findall(content))


def count_records(file: Written, delimiter: str, *, empty: bool = False) -> int:
    """Return the number of records in a CSV, its header included. Raises csv.Error if its quotes are invalid."""
    with Path(file.path).open(encoding="utf-8-sig", errors="surrogateescape", newline="") as text, any_size():
        return sum(1 for record in csv_reader(text, delimiter) if record or empty)


def csv_reader(lines: Iterable[str], delimiter: str) -> _csv.Reader:
    """Return Python's reader for the dialect that SIERRA reads, in which blanks around quotes are ignored."""
    padded = delimiter != " "
    return csv.reader(
        _without_padding(lines, delimiter) if padded else lines, delimiter=delimiter, skipinitialspace=padded, strict=True
    )


def _without_padding(lines: Iterable[str], delimiter: str) -> Iterator[str]:
    """Yield the lines without blanks between a closing quote and the end of its field, which Python's reader would refuse."""
    padding = re.compile(rf'" +(?=[{re.escape(delimiter)}\r\n]|$)')
    for line in lines:
        yield padding.sub('"', line) if '" ' in line else line


@contextlib.contextmanager
def any_size() -> Iterator[None]:
    """Allow CSV fields of any size."""
    before = csv.field_size_limit(sys.maxsize)
    try:
        yield
    finally:
        csv.field_size_limit(before)
