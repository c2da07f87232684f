"""Ranges of criteria for this project."""

from typing import ClassVar

from sierra.plugin import Computed, NoOptions, QueryError, Table


class Squares:
    """The first square numbers."""

    contract = 1
    Options: ClassVar[type[Table]] = NoOptions
    example = "3"

    def __init__(self, options: NoOptions) -> None:
        pass

    def scale(self, text: str) -> Computed:
        if not text.isdecimal() or not 1 <= int(text) <= 100:
            raise QueryError(f"Squares needs a number from 1 to 100, not {text!r}; use Squares3")
        return Computed.of(*(n * n for n in range(1, int(text) + 1)))
