"""The reader for formats of other packages: their tables become Parquet files, which are read and checked as such."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from sierra.ingest import base
from sierra.ingest.base import Columns, OutputReader, UnreadableError
from sierra.ingest.model import Reading, Shape, Siblings, Written
from sierra.ingest.parquet import Parquet
from sierra.store.connections import Database
from sierra.store.segments import disk_errors


class Converted(Parquet):
    """A reader that converts each file by a reader of another package."""

    def __init__(self, connection: Database, shape: Shape, target: Path, siblings: Siblings) -> None:
        super().__init__(connection, shape, target, siblings)
        self._reader: OutputReader = base.make(shape.format, shape.reader)

    def read(self, files: Sequence[Written]) -> Reading:
        with tempfile.TemporaryDirectory(prefix="sierra-") as folder, disk_errors(Path(folder)):
            return super().read(list(self._converted(files, Path(folder))))

    def _converted(self, files: Sequence[Written], folder: Path) -> Iterator[Written]:
        """Yield the files as Parquet files; note the faults of others."""
        for number, file in enumerate(files):
            target = folder / f"{number}.parquet"
            try:
                _write(self._reader.read(Path(file.path)), target)
            except UnreadableError as error:
                self.fault(file, _one_line(str(error) or "cannot be read"))
            except OSError:
                raise
            except Exception as error:
                message = f"the reader {self.shape.format!r} failed: {type(error).__name__}: {error}"
                self.fault(file, _one_line(message))
            else:
                yield replace(file, path=str(target))


def _write(columns: Columns, target: Path) -> None:
    """Write a table as Parquet. A column without any value is BOOLEAN, which every other type can hold."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = columns if isinstance(columns, pa.Table) else pa.table(dict(columns))
    for place, field in enumerate(table.schema):
        if pa.types.is_null(field.type):
            empty = pa.nulls(len(table), pa.bool_())
            table = table.set_column(place, field.name, empty)
    pq.write_table(table, target)


def _one_line(text: str) -> str:
    return " ".join(text.split())
