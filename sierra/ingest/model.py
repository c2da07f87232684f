"""What is read, how it is to be read, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Literal


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
    """What a worker has counted, as in `sierra.model.OutputFile`; None where it has not."""
    blank: int | None = None
    alike: bool | None = None


@dataclass(frozen=True, slots=True)
class Part:
    """Those files of an output that have the same columns."""

    names: tuple[str, ...]
    delimiter: str = ""


@dataclass(frozen=True, slots=True)
class Shape:
    """How the files of one output are to be read: as declared, and as earlier files were found to be."""

    format: Literal["csv", "parquet", "jsonl"]
    delimiter: str = ""
    """Of a CSV; found out, for each part, where it is empty."""
    header: bool = True
    names: tuple[str, ...] = ()
    """The columns of a CSV without header, where they are declared."""
    many: bool = False
    """Whether a run writes several such files; the table then has the column `file`."""
    parts: tuple[Part, ...] = ()
    files: int = 0
    """How many files were read before."""
    ended: int = 0
    """How many of them had a line feed at their end."""


Group = Hashable
"""An experiment, as a key."""


def _nobody(runs: Sequence[str]) -> tuple[Mapping[str, Group], Mapping[tuple[Group, str], Mapping[str, int]]]:
    return {}, {}


@dataclass(frozen=True, slots=True)
class Siblings:
    """What is known of files that were read before."""

    mixed: AbstractSet[str] = frozenset()
    """Columns in which some of them have something else than numbers."""
    ask: Callable[[Sequence[str]], tuple[Mapping[str, Group], Mapping[tuple[Group, str], Mapping[str, int]]]] = _nobody
    """Of runs: the experiment that each belongs to, and how many of its files have which kind in which column."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What came of it: rows and what columns hold, by execution and file; faults by execution; the shape that was found.

    What a column holds is number, text, flag, empty, or another type, and `number as text` where its siblings have text.
    """

    rows: Mapping[tuple[str, str], int]
    counted: Mapping[tuple[str, str], int]
    """Rows by a count of the file itself, without the parser."""
    columns: Mapping[tuple[str, str], Mapping[str, str]]
    hints: Mapping[tuple[str, str], Mapping[str, str]]
    """By file and column, where text begins that most siblings read so far do not have."""
    faults: Mapping[str, str]
    shape: Shape


class AtFaultError(Exception):
    """Files that are at fault, each with a sentence: the others are to be read without them."""

    def __init__(self, faults: Sequence[tuple[Written, str]]) -> None:
        super().__init__("; ".join(f"{file.name}: {fault}" for file, fault in faults))
        self.faults = faults
