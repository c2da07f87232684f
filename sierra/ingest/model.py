"""The types of reading: files, how to read them, and the results."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import Any

from sierra.util.lazy_definitions import dataclass, field


@dataclass(frozen=True, slots=True)
class Written:
    """One file that an execution wrote, and that belongs to a table."""

    path: str
    run: str
    execution: str
    name: str
    """Its path in the output folder."""
    head: str
    lines: int
    ended: bool
    bytes: int
    quotes: int | None = None
    """Counts by a worker, as in `sierra.model.OutputFile`; None if it did not count."""
    blank: int | None = None
    alike: bool | None = None
    ticks: tuple[int, ...] = ()
    """The numbers in its name that become columns."""
    archive: str = ""
    """The path of the archive that it was in; its name begins with it."""


Found = Mapping[str, Mapping[str, str | None]]
"""The type that holds a column's values, by column and path; None if it has no values."""


@dataclass(frozen=True, slots=True)
class Part:
    """The files of an output that have the same columns."""

    names: tuple[str, ...]
    delimiter: str = ""


@dataclass(frozen=True, slots=True)
class Form:
    """The differences of a file from a plain one that shipped readers read; keys of the same names in `[outputs.NAME]`."""

    skip: int = 0
    comment: str | tuple[str, ...] = ""
    header_lines: int = 1
    units_row: bool = False
    decimal: str = "."
    na: tuple[str | float, ...] = ()
    widths: tuple[int, ...] = ()
    rows: str = ""
    unnest: str = ""
    lines: str = ""
    flatten: bool | None = None
    own: tuple[tuple[str, Any], ...] = ()
    """The keys that only outputs of this format have, with their values."""

    @property
    def comments(self) -> tuple[str, ...]:
        """The beginnings of lines that are not read."""
        return self.comment if isinstance(self.comment, tuple) else (self.comment,) if self.comment else ()


PLAIN = Form()


@dataclass(frozen=True, slots=True)
class Shape:
    """Instructions for reading the files of one output: as declared, and as found in earlier files."""

    format: str
    """The name of its reader."""
    delimiter: str = ""
    """The delimiter of a CSV; if it is empty, it is determined for each part."""
    header: bool = True
    names: tuple[str, ...] = ()
    """The declared columns of a CSV without header."""
    many: bool = False
    """True if a run writes several such files; the table then has the column `file`."""
    parts: tuple[Part, ...] = ()
    files: int = 0
    """The number of files that were read before."""
    ended: int = 0
    """The number of these files with a line feed at their end."""
    reader: str = ""
    """The package and the options of the reader, as JSON; empty for a shipped reader."""
    form: Form = PLAIN
    ticks: tuple[str, ...] = ()
    """The names of the columns for the numbers in the files' names."""
    lengths: tuple[str, ...] = ()
    """The columns that have only the number of the items of a list, as found in earlier files."""
    places: tuple[str, ...] = ()
    """The columns that say where a value was in a file, such as indices, as found in earlier files; `na` is not for these."""
    nans: tuple[str, ...] = ()
    """The columns of whole numbers in which nan is recorded as missing, as found in earlier files."""
    bare: int = 0
    """The number of elements around rows, in earlier files, that have no row within."""
    name: str = ""
    """The name of the table."""
    declared: bool = field(default=False, compare=False)
    """True if the project declares the output; it changes messages only."""
    time: str = ""
    """The declared time column; "" if none is declared."""
    any_order: bool = False
    """True if the time may go back within a file."""
    rotated: str = ""
    """The name of the newest part of a rotated file; "" if the files are not rotated."""
    packed: str = ""
    """The pattern of the files if they are in archives; else ""."""


Group = Hashable
"""An experiment, as a key."""
Votes = Mapping[tuple[Group, str], Mapping[str, int]]
"""The number of files by kind of their values, for each experiment and column."""


@dataclass(frozen=True, slots=True)
class Siblings:
    """Facts about files that were read before."""

    mixed: AbstractSet[str] = frozenset()
    """The columns in which some of these files have values that are not numbers."""
    ask: Callable[[Sequence[str]], tuple[Mapping[str, Group], Votes]] = lambda runs: ({}, {})
    """A function of runs. It returns each run's experiment, and the votes of the files that were read before."""
    texts_without: Callable[[str], AbstractSet[str]] = lambda mark: frozenset()
    """A function that returns the columns of text in layouts without a mark: those that an earlier version recorded."""
    names: Callable[[], AbstractSet[str]] = frozenset
    """A function that returns all names of columns with which the table was ever recorded."""
    example: Callable[[], tuple[bytes, int] | None] = lambda: None
    """A function that returns the content of one of these files, and the number of its rows that were recorded."""


@dataclass(frozen=True, slots=True)
class Reading:
    """The results of reading: row counts and kinds by execution and file, faults by execution, and the shape that was found.

    A column's kind is number, text, flag, empty, or another type; it is `number as text` if the siblings have text.
    """

    rows: Mapping[tuple[str, str], int]
    counted: Mapping[tuple[str, str], int]
    """Row counts of the files themselves, without the parser."""
    columns: Mapping[tuple[str, str], Mapping[str, str]]
    hints: Mapping[tuple[str, str], Mapping[str, str]]
    """By file and column: the place where text begins, in a column in which most siblings so far have numbers."""
    faults: Mapping[str, str]
    shape: Shape
    timed: AbstractSet[tuple[str, str]] = frozenset()
    """The files whose columns of text are no times."""
    padded: AbstractSet[tuple[str, str]] = frozenset()
    """The files between whose `|` texts kept the blanks around them, as an earlier version recorded them."""


class AtFaultError(Exception):
    """Files that are at fault, each with an error message; the other files must be read without them."""

    def __init__(self, faults: Sequence[tuple[Written, str]]) -> None:
        super().__init__("; ".join(f"{file.name}: {fault}" for file, fault in faults))
        self.faults = faults
