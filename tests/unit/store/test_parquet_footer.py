"""The number of rows that a Parquet file's footer states: the same as pyarrow reads, and Damaged for all other files."""

from __future__ import annotations

import contextlib
import errno
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.errors import Damaged, Missing
from sierra.store.connections import connect
from sierra.store.parquet_footer import rows_in


@pytest.mark.parametrize("rows", [0, 1, 63, 64, 20_000])
@pytest.mark.parametrize("columns", [1, 14, 15, 200])
def test_files_of_pyarrow(tmp_path: Path, rows: int, columns: int) -> None:
    table = pa.table({f"c{number}": pa.array(range(rows), pa.int64()) for number in range(columns)})
    pq.write_table(table, tmp_path / "a.parquet", row_group_size=7000)
    assert rows_in(tmp_path / "a.parquet") == rows


def test_files_with_nested_and_logical_types(tmp_path: Path) -> None:
    table = pa.table(
        {
            "list": [[1, 2], [], None],
            "struct": [{"a": True, "b": [{"c": 1.5}]}] * 3,
            "time": pa.array([1, 2, 3], pa.timestamp("us", "UTC")),
            "decimal": pa.array([1, 2, 3]).cast(pa.decimal128(38, 2)),
            "map": pa.array([[("a", 1)]] * 3, pa.map_(pa.string(), pa.int64())),
        }
    ).replace_schema_metadata({"key": "value" * 100})
    pq.write_table(table, tmp_path / "a.parquet")
    assert rows_in(tmp_path / "a.parquet") == 3


@pytest.mark.parametrize("rows", [0, 1, 300_000])
def test_files_of_duckdb(tmp_path: Path, rows: int) -> None:
    connect().execute(f"COPY (SELECT range AS a, 'b' AS b FROM range({rows})) TO '{tmp_path}/a.parquet' (FORMAT parquet)")
    assert rows_in(tmp_path / "a.parquet") == rows == pq.read_metadata(tmp_path / "a.parquet").num_rows


@pytest.mark.parametrize("content", [b"", b"PAR1", b"PAR1\x00\x00\x00\x00PAR1", b"PAR1" + b"\xff" * 40 + b"\x28\0\0\0PAR1"])
def test_other_files_are_damaged(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.parquet").write_bytes(content)
    with pytest.raises(Damaged, match=r"a\.parquet: cannot be read"):
        rows_in(tmp_path / "a.parquet")
    with pytest.raises(Damaged):
        rows_in(tmp_path / "none.parquet")


@pytest.mark.parametrize("kind", [3, 7, 13])
def test_a_list_that_is_longer_than_the_footer_is_damaged_at_once(tmp_path: Path, kind: int) -> None:
    footer = bytes([0x19, 0xF0 | kind, *[0xFF] * 8, 0x3F, 0x00])
    (tmp_path / "a.parquet").write_bytes(b"PAR1" + footer + len(footer).to_bytes(4, "little") + b"PAR1")
    with pytest.raises(Damaged, match="cut off"):
        rows_in(tmp_path / "a.parquet")


def test_a_shortage_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pq.write_table(pa.table({"a": [1]}), tmp_path / "a.parquet")

    def short(*_: object, **__: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(Path, "open", short)
    with pytest.raises(Missing, match="Too many open files"):
        rows_in(tmp_path / "a.parquet")


@given(st.binary(max_size=60))
def test_any_footer_has_a_number_or_is_damaged(tmp_path_factory: pytest.TempPathFactory, footer: bytes) -> None:
    path = tmp_path_factory.mktemp("footer") / "a.parquet"
    path.write_bytes(b"PAR1" + footer + len(footer).to_bytes(4, "little") + b"PAR1")
    with contextlib.suppress(Damaged):
        assert isinstance(rows_in(path), int)
