"""Rows of statements as instances of classes."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import pytest

from sierra.errors import Damaged
from sierra.store.row_mapper import of_fields
from sierra.store.row_types import ROWS, BlobRow, FindingRow
from sierra.store.store import Store

NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


class Row(NamedTuple):
    blob: str
    sha256: str | None


class Words(NamedTuple):
    words: list[str]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store.create(tmp_path / "store")
    writer = store.writer(tmp_path / "store/work/segment", "0" * 64)
    writer.records([BlobRow("b1", "s1"), BlobRow("b2", "s2")])
    writer.records([FindingRow("e", NOW, "failed", "a reason", 1)])
    writer.records([])
    store.publish(writer)
    return store


def test_records_are_read_as_they_were_written(store: Store) -> None:
    assert store.select(BlobRow, "SELECT * FROM blobs ORDER BY blob") == [BlobRow("b1", "s1"), BlobRow("b2", "s2")]
    [finding] = store.select(FindingRow, "SELECT * FROM findings")
    assert finding == FindingRow("e", NOW, "failed", "a reason", 1)
    assert finding.found_at.tzinfo is not None


@pytest.mark.integration
def test_each_table_can_be_read_as_its_class(store: Store) -> None:
    for table, row in ROWS.items():
        assert len(store.select(row, f"SELECT * FROM {table}")) == {"blobs": 2, "findings": 1}.get(table, 0)


def test_one_column_is_read_as_values(store: Store) -> None:
    assert store.values(str, "SELECT blob FROM blobs ORDER BY 1") == ["b1", "b2"]
    assert store.values(int, "SELECT count(*) FROM blobs WHERE blob = $b", b="b1") == [1]


def test_a_null_is_refused_unless_the_class_allows_it(store: Store) -> None:
    assert store.select(Row, "SELECT blob, NULL AS sha256 FROM blobs LIMIT 1") == [Row("b1", None)]
    with pytest.raises(Damaged, match="a record has no 'blob'"):
        store.select(Row, "SELECT NULL AS blob, sha256 FROM blobs LIMIT 1")
    with pytest.raises(Damaged, match="a record has no 'blob'"):
        store.values(str, "SELECT NULL::VARCHAR AS blob")
    with pytest.raises(Damaged, match="a record has no 'words'"):
        store.select(Words, "SELECT ['a', NULL] AS words")


def test_a_statement_that_does_not_fit_its_class_is_refused(store: Store) -> None:
    with pytest.raises(TypeError, match="Row has the fields"):
        store.select(Row, "SELECT blob FROM blobs")
    with pytest.raises(TypeError, match=r"Row\.blob is annotated str, but the result has INTEGER"):
        store.select(Row, "SELECT 1 AS blob, sha256 FROM blobs")
    with pytest.raises(TypeError, match="annotated int"):
        store.values(int, "SELECT blob FROM blobs")


def test_rows_are_made_from_exactly_their_fields() -> None:
    assert of_fields(Row, {"sha256": None, "blob": "b1"}) == Row("b1", None)
    for wrong in ({"blob": "b1"}, {"blob": "b1", "sha256": None, "other": 1}):
        with pytest.raises(TypeError, match="Row has the fields"):
            of_fields(Row, wrong)
