"""The reader of SQLite databases: `rows` is the name of a table or view, or a SELECT statement.

The rows are counted a second time by SQLite's `count(*)`. `sierra.ingest.sqlite_file` opens the file.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sierra.extensions.formats.columnar import Columnar, column_of
from sierra.ingest.base import UnreadableError
from sierra.ingest.missing_values import MissingValues
from sierra.ingest.rewriting import OriginalFile
from sierra.ingest.sqlite_file import opened
from sierra.store.sql_names import identifier
from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    import pyarrow as pa

STATEMENT = regex(r"\s*(select|with)\b", re.IGNORECASE)


class SqliteTables(Columnar):
    """The reader of SQLite databases."""

    def table(self, source: OriginalFile) -> pa.Table:
        import pyarrow as pa

        with opened(source) as database:
            cursor = database.execute(self._statement)
            names = [name for name, *_ in cursor.description]
            rows: Sequence[Sequence[object]] = cursor.fetchall()
        if missing := MissingValues(self.shape.form.na):
            rows = [[None if missing.has_value(value) else value for value in row] for row in rows]
        if len(set(names)) < len(names):
            raise UnreadableError("the statement gives two columns of the same name")
        columns = zip(*rows, strict=True) if rows else ((),) * len(names)
        return pa.table({name: column_of(name, list(values)) for name, values in zip(names, columns, strict=True)})

    def count(self, source: OriginalFile, written: int) -> int:
        with opened(source) as database:
            [[rows]] = database.execute(f"SELECT count(*) FROM ({self._statement})").fetchall()
        return int(rows)

    @property
    def _statement(self) -> str:
        rows = self.shape.form.rows
        return rows if STATEMENT.match(rows) else f"SELECT * FROM {identifier(rows)}"
