"""The result of a SQL statement, for users of SIERRA from Python."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

from sierra.errors import Missing
from sierra.util.arrow_columns import rows_of

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

EXTRA = "pip install 'sierra-experiments[figures]'"


class Result:
    """The rows of a result: an Arrow table that a notebook shows, and that other libraries can read.

    It has all methods and properties of `pyarrow.Table`, such as `num_rows`, `column_names`, `column("v")` and `to_pylist()`.
    DuckDB, polars and pandas accept it where they accept an Arrow table; `arrow` is the table itself. `schema.metadata` may
    have `sierra:note` and `sierra:sql`.
    """

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, arrow: pa.Table) -> None:
        self.arrow = arrow

    def frame(self) -> pd.DataFrame:
        """Return the rows as a pandas data frame, a column for each column. Raises Missing if pandas is not installed."""
        if importlib.util.find_spec("pandas") is None:
            raise Missing(f"pandas is not installed; {EXTRA}")
        return self.arrow.to_pandas()

    def to_pylist(self) -> list[dict[str, Any]]:
        """Return the rows as Python objects; times with nanoseconds, and intervals, are texts."""
        return rows_of(self.arrow)

    def __getattr__(self, name: str) -> Any:
        if name == "arrow":  # not there yet while it is copied
            raise AttributeError(name)
        return getattr(self.arrow, name)

    def __getitem__(self, key: int | str | slice) -> pa.ChunkedArray | pa.Table:
        return self.arrow[key]

    def __len__(self) -> int:
        return int(self.arrow.num_rows)

    def __eq__(self, other: object) -> bool:
        return bool(self.arrow == (other.arrow if isinstance(other, Result) else other))

    def equals(self, other: object) -> bool:
        """Return True if the other result, or Arrow table, has the same columns and rows."""
        return self == other

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        return self.arrow.__arrow_c_stream__(requested_schema)

    def __repr__(self) -> str:
        return f"Result of {self.arrow.num_rows} rows: {', '.join(self.arrow.column_names)}"

    def _repr_html_(self) -> str:
        from sierra.util import html

        rows = (tuple(row.values()) for row in rows_of(self.arrow.slice(0, html.ROWS)))
        count = "1 row" if len(self) == 1 else f"{len(self)} rows"
        return html.page(count, self.arrow.column_names, rows, total=len(self))
