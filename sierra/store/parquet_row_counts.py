"""Row counts of Parquet files by pyarrow, independent of DuckDB, which writes and queries them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.errors import Damaged
from sierra.store.duckdb_messages import check_shortage, first_line

if TYPE_CHECKING:
    import pyarrow.parquet as pq

HELD = 256 << 20
"""The limit, in bytes, for the counted columns of one row group. Row groups that SIERRA writes are far smaller."""

Written = tuple[str, str | None]
"""An execution and, if it wrote several files of one output, the file."""


def rows_by_file(path: str | Path) -> Counter[Written]:
    """Return how many rows each execution, and each of its files, has in one Parquet file of an output.

    Raises Damaged if the file cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    counts: Counter[Written] = Counter()
    try:
        with pq.ParquetFile(path, pre_buffer=False) as file:
            columns = ["execution", *(["file"] if "file" in file.schema_arrow.names else [])]
            _check_size(file.metadata, columns)
            for batch in file.iter_batches(columns=columns):
                grouped = pa.Table.from_batches([batch]).group_by(columns, use_threads=False).aggregate([([], "count_all")])
                for row in grouped.to_pylist():
                    counts[row["execution"], row.get("file")] += row["count_all"]
    except (OSError, ValueError, LookupError, MemoryError, pa.ArrowException) as error:
        check_shortage(error)
        raise Damaged(f"{path}: cannot be read: {first_line(error) if str(error) else 'out of memory'}") from error
    return counts


def _check_size(described: pq.FileMetaData, columns: list[str]) -> None:
    for number in range(described.num_row_groups):
        group = described.row_group(number)
        chunks = (group.column(place) for place in range(group.num_columns))
        if sum(chunk.total_uncompressed_size for chunk in chunks if chunk.path_in_schema in columns) > HELD:
            raise ValueError("its row groups are larger than any that SIERRA writes")
