"""The characters between the cells of a text table, the cells of its lines, and those that are numbers."""

from __future__ import annotations

import csv
import io
import re

from sierra.store.type_inference import as_float
from sierra.util.lazy_definitions import regex

PADDED = "|"
"""The delimiter whose cells lose the blanks around them: programs pad such columns to the same width."""
DELIMITERS = (",", "\t", ";", PADDED)
COMMA = regex(r"[-+]?([0-9]+,[0-9]*|,[0-9]+)([eE][-+]?[0-9]+)?")
POINT = regex(r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
"""Numbers with a decimal comma, and with a decimal point."""


def delimiter_of(head: str) -> str:
    """Return the delimiter that occurs most often in a header line, outside quotes; a comma if there is none."""
    bare = re.sub(r'"[^"]*"', "", head)
    return max(DELIMITERS, key=lambda d: (bare.count(d), d == ","))


def split(head: str, delimiter: str) -> tuple[str, ...]:
    """Return the fields of a header line."""
    if len(delimiter) != 1:
        return tuple(field.strip() for field in head.split(delimiter))
    reader = csv.reader(io.StringIO(head, newline=""), delimiter=delimiter, skipinitialspace=True)
    return tuple(field.strip() for field in next(reader, []))


def reads_as_number(field: str) -> bool:
    return as_float(field) is not None
