"""The output format `track`: the words `track 1`, the names of the columns, lines of numbers, and the word `end`."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from pydantic import Field

from sierra.plugin import Columns, Table, UnreadableError


class TrackOptions(Table):
    """The options of tracks."""

    scale: float = Field(1.0, gt=0, description="factor for all columns but the first: 100 gives centimetres for metres")


class Track:
    """The reader of tracks."""

    contract = 1
    Options: ClassVar[type[Table]] = TrackOptions

    def __init__(self, options: TrackOptions) -> None:
        self._scale = options.scale

    def read(self, path: Path) -> Columns:
        lines = path.read_text("utf-8", errors="replace").split("\n")
        if lines[0] != "track 1":
            raise UnreadableError("line 1: is not 'track 1'")
        if lines[-2:] != ["end", ""]:
            raise UnreadableError(f"line {len(lines)}: is cut short; the last line is not 'end'")
        names = lines[1].split()
        columns: dict[str, list[float]] = {name: [] for name in names}
        if not names or len(columns) < len(names):
            raise UnreadableError("line 2: names no columns, or one twice")
        for number, line in enumerate(lines[2:-2], 3):
            for name, value in zip(names, self._numbers(line, number, len(names)), strict=True):
                columns[name].append(value)
        return columns

    def _numbers(self, line: str, number: int, count: int) -> list[float]:
        try:
            first, *others = line.split()
            values = [int(first), *(float(word) * self._scale for word in others)]
        except ValueError as error:
            raise UnreadableError(f"line {number}: {error}") from error
        if len(values) != count:
            raise UnreadableError(f"line {number}: has {len(values)} numbers, not {count}")
        return values
