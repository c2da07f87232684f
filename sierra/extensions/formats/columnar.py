"""The readers of formats that have types of their own: NumPy arrays, Arrow files, SQLite databases and GraphML.

Each file is written as Parquet, which keeps its types, and read by the reader of that format. Each reader counts its rows a
second time by other means than it reads them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, BinaryIO

from sierra.ingest.base import UnreadableError
from sierra.ingest.model import PLAIN, Shape
from sierra.ingest.parquet import Parquet, write_parquet
from sierra.ingest.rewriting import OriginalFile, Rewriter
from sierra.ingest.shipped_reader_base import TableReader
from sierra.store.type_inference import as_float

if TYPE_CHECKING:
    import pyarrow as pa


class Columnar(Rewriter):
    """The base class of these readers."""

    @classmethod
    def reader(cls) -> type[TableReader]:
        return Parquet

    def plain(self) -> Shape:
        return replace(self.shape, format="parquet", form=replace(PLAIN, na=self.shape.form.na))

    def rewrite(self, source: OriginalFile, target: BinaryIO) -> int:
        import pyarrow as pa

        table = self.table(source)
        try:
            write_parquet(table, target)
        except (pa.ArrowException, ValueError) as error:
            raise UnreadableError(f"a table cannot hold it ({error})") from error
        return int(table.num_rows)

    def table(self, source: OriginalFile) -> pa.Table:
        """Return the table in a file. Raises UnreadableError."""
        raise NotImplementedError


def _unbounded(text: str) -> object:
    """Return infinity or nan for a text that says so, as programs write them among numbers; any other text stays."""
    number = as_float(text)
    return text if number is None or math.isfinite(number) else number


def column_of(name: str, values: list[object]) -> pa.Array:
    """Return a column of Python values, which must be of one kind. Raises UnreadableError."""
    import pyarrow as pa

    kinds = {type(value) for value in values} - {type(None)}
    if str in kinds and kinds & {int, float}:
        values = [_unbounded(value) if isinstance(value, str) else value for value in values]
        kinds = {type(value) for value in values} - {type(None)}
    if kinds == {int, float}:
        if any(isinstance(value, int) and int(float(value)) != value for value in values):
            raise UnreadableError(f"the column {name!r} has fractions and whole numbers that DOUBLE cannot hold")
        values, kinds = [None if value is None else float(value) for value in values], {float}  # type: ignore[arg-type]
    if len(kinds) > 1:
        named = " and ".join(sorted(kind.__name__ for kind in kinds))
        raise UnreadableError(f"the column {name!r} has values of several types: {named}")
    try:
        return pa.array(values)
    except (pa.ArrowException, OverflowError) as error:
        raise UnreadableError(f"the column {name!r} cannot be stored: {' '.join(str(error).split())}") from error
