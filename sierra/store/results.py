"""The rows that one execution wrote, whether it counts or not."""

from __future__ import annotations

from typing import Any

from sierra.errors import Damaged
from sierra.store import Question
from sierra.store.files import holding
from sierra.store.views import read_parquet

OWN = ("run", "execution", "file", "filename", "file_row_number")


def rows_of(question: Question, execution: str, output: str, file: str | None) -> Any:
    """A table of one execution as a pyarrow.Table, rows in their order; of one file where it wrote several.

    Raises Damaged where there is none.
    """
    best = None
    for segment in holding(question, {execution}):
        for path in (path for name, path in segment.outputs() if name == output):
            found = _rows(question, path, execution, file)
            best = found if best is None or found.num_rows else best
    if best is not None:
        return best.drop_columns([column for column in OWN if column in best.column_names])
    raise Damaged(f"the rows of {output!r} that execution {execution[:10]} wrote are not in the store")


def _rows(question: Question, path: str, execution: str, file: str | None) -> Any:
    source = read_parquet([path], rows=True)
    only = "" if file is None else " AND file = $file"
    parameters = {"execution": execution} if file is None else {"execution": execution, "file": file}
    statement = f"SELECT * FROM {source} WHERE execution = $execution{only} ORDER BY file_row_number"
    return question.connection.sql(statement, params=parameters).to_arrow_table()
