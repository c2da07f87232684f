"""The shipped ranges that have a name: `.Log8` and `.Linear100.C10`."""

from __future__ import annotations

from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.design.query.numbers import COUNT, whole
from sierra.errors import QueryError
from sierra.model import Linear, Log
from sierra.util.lazy_definitions import regex

LINEAR_COUNT = 10
"""Default number of values of `.Linear100`, without `.C`."""
_LOG = regex(r"[+-]?[0-9]+")
_LINEAR = regex(rf"([+-]?[0-9]+)(?:\.{COUNT})?")


class LogRange:
    """`.Log8`: 1, 2, 4, … up to a power of two."""

    contract = 1
    Options: ClassVar[type[Table]] = NoOptions
    example = "8"

    def __init__(self, options: Table) -> None:
        pass

    def scale(self, text: str) -> Log:
        if not _LOG.fullmatch(text):
            raise QueryError(f"{text!r} is not a whole number; use Log8")
        return Log(whole(text))


class LinearRange:
    """`.Linear100.C10`: equal whole steps up to a number."""

    contract = 1
    Options: ClassVar[type[Table]] = NoOptions
    example = "100.C10"

    def __init__(self, options: Table) -> None:
        pass

    def scale(self, text: str) -> Linear:
        if not (found := _LINEAR.fullmatch(text)):
            raise QueryError(f"{text!r} is not an end and a count; use Linear100.C10")
        return Linear(whole(found[1]), LINEAR_COUNT if found[2] is None else whole(found[2]))
