"""Records written to Parquet files by DuckDB."""

from __future__ import annotations

import math
import os
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sierra.errors import Missing
from sierra.store.parquet_writer import AT_A_TIME, PYTHON_TYPES, write
from sierra.store.row_types import ROWS
from sierra.store.schema import is_table, sql_types

NOW = datetime(2026, 1, 2, 3, 4, 5, 678901, tzinfo=UTC)
VALUES: dict[str, list[object]] = {
    "VARCHAR": ["a\0b", "", "é😀'\"", None],
    "BIGINT": [2**63 - 1, -(2**63), 0, None],
    "DOUBLE": [0.1 + 0.2, math.inf, 5e-324, None],
    "BOOLEAN": [True, False, None, True],
    "TIMESTAMP WITH TIME ZONE": [NOW, NOW.astimezone(timezone(timedelta(hours=5))), None, NOW],
    "VARCHAR[]": [["a", ""], [], None, ["b"]],
    "BLOB": [b"\0\xff\\x41", b"", None, bytes(range(256))],
}


def test_values_of_every_type_are_kept_exactly(tmp_path: Path) -> None:
    assert VALUES.keys() == PYTHON_TYPES.keys()
    write(tmp_path / "x.parquet", {kind: kind for kind in VALUES}, zip(*VALUES.values(), strict=True))
    assert pq.read_table(tmp_path / "x.parquet").to_pydict() == VALUES


@pytest.mark.parametrize("count", [1, AT_A_TIME - 1, AT_A_TIME, 2 * AT_A_TIME + 1])
def test_all_rows_are_written_in_their_order(tmp_path: Path, count: int) -> None:
    for _ in range(2):
        write(tmp_path / "x.parquet", {"number": "BIGINT", "name": "VARCHAR"}, ((n, str(n)) for n in range(count)))
    table = pq.read_table(tmp_path / "x.parquet")
    assert table.to_pydict() == {"number": list(range(count)), "name": list(map(str, range(count)))}


def test_no_file_is_written_without_rows(tmp_path: Path) -> None:
    write(tmp_path / "x.parquet", {"number": "BIGINT"}, [])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("BIGINT", 1.5),
        ("BIGINT", "1"),
        ("BIGINT", True),
        ("BIGINT", 2**63),
        ("DOUBLE", "1.5"),
        ("BOOLEAN", 1),
        ("VARCHAR", 1),
        ("VARCHAR", "\udcff"),
        ("VARCHAR[]", "text"),
        ("BLOB", "text"),
        ("TIMESTAMP WITH TIME ZONE", datetime(2026, 1, 2)),  # noqa: DTZ001
        ("TIMESTAMP WITH TIME ZONE", "2026-01-02"),
    ],
)
def test_a_value_of_another_type_is_refused(tmp_path: Path, kind: str, value: object) -> None:
    with pytest.raises((TypeError, ValueError)):
        write(tmp_path / "x.parquet", {"column": kind}, [(None,), (value,)])
    write(tmp_path / "x.parquet", {"column": kind}, [(None,)])
    assert pq.read_table(tmp_path / "x.parquet").to_pydict() == {"column": [None]}


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    with pytest.raises(Missing, match=f"^cannot write to {tmp_path}/none: No such file or directory$"):
        write(tmp_path / "none" / "x.parquet", {"number": "BIGINT"}, [(1,)])


def test_a_forked_process_writes_too(tmp_path: Path) -> None:
    write(tmp_path / "parent.parquet", {"number": "BIGINT"}, [(1,)])
    if (child := os.fork()) == 0:
        try:
            write(tmp_path / "child.parquet", {"number": "BIGINT"}, [(2,)])
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    assert pq.read_table(tmp_path / "child.parquet").to_pydict() == {"number": [2]}


@pytest.mark.parametrize("name", ROWS)
def test_tables_are_recognized_whether_duckdb_or_pyarrow_wrote_them(tmp_path: Path, name: str) -> None:
    types = sql_types(name)
    write(tmp_path / "x.parquet", types, [[VALUES[kind][0] for kind in types.values()]])
    schema = pq.read_schema(tmp_path / "x.parquet")
    assert is_table(name, schema)
    large = [field.with_type(pa.large_binary()) if pa.types.is_binary(field.type) else field for field in schema]
    assert is_table(name, pa.schema(large))
    assert not is_table(name, pa.schema([field.with_type(pa.int32()) for field in schema]))
    assert not is_table(name, pa.schema(list(schema)[1:]))
