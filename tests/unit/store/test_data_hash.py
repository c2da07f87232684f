"""The hash of a table's data: the same for the same rows in any order, and another one for any other value."""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime
from decimal import Decimal
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sierra.store.connections import connect
from sierra.store.data_hash import data_hash

ROWS: dict[str, list[Any]] = {
    "run": ["b", "a", None, "é"],
    "v": [1.5, math.nan, -0.0, None],
    "n": [3, -1, None, 2**60],
    "ok": [True, None, False, True],
    "at": [datetime(2026, 1, 2, tzinfo=UTC), None, datetime(2026, 1, 1, tzinfo=UTC), None],
    "pose": [{"x": 1.0, "y": [1, 2]}, None, {"x": math.nan, "y": []}, {"x": 0.1, "y": None}],
    "d": [Decimal("1.10"), None, Decimal("-2.00"), Decimal("0.00")],
}


def test_the_rule_stays_as_it_is() -> None:
    assert data_hash(pa.table(ROWS)) == "032b1a369a34ec88c5bec1edc3bc644eb6839143312aae0698dbaf0b79f60692"
    assert (
        data_hash(pa.table({"x": pa.array([], pa.float64())}))
        == "95cb35619c009d138a2edf9b866bd35c7f306ef2853b1027be88671a0224a1a6"
    )


@settings(max_examples=24)
@given(st.permutations(range(4)))
def test_the_order_of_rows_does_not_count(order: list[int]) -> None:
    table = pa.table(ROWS)
    assert data_hash(table.take(order)) == data_hash(table)


@pytest.mark.integration
@given(
    st.lists(st.tuples(st.none() | st.floats(), st.none() | st.sampled_from(["", "a", "b", "aa"]) | st.text())), st.randoms()
)
def test_tables_have_the_same_hash_if_and_only_if_they_have_the_same_rows(
    rows: list[tuple[float | None, str | None]], chance: Any
) -> None:
    def table(some: list[tuple[float | None, str | None]]) -> pa.Table:
        return pa.table({"v": pa.array([v for v, _ in some], pa.float64()), "s": pa.array([s for _, s in some], pa.string())})

    rows = [row for row in rows if row[1] is None or row[1].isprintable()]
    shuffled = chance.sample(rows, len(rows))
    assert data_hash(table(rows)) == data_hash(table(shuffled))
    for place in range(len(rows)):
        assert data_hash(table(rows[:place] + rows[place + 1 :])) != data_hash(table(rows))
        v, s = rows[place]
        changed = [*rows[:place], (v, (s or "") + "x"), *rows[place + 1 :]]
        assert data_hash(table(changed)) != data_hash(table(rows))


@pytest.mark.parametrize(
    "other",
    [
        {"v": [1.0, 2.0, 0.0]},
        {"v": [1.0, 2.0, None]},
        {"v": [1.0, 2.0, math.nan]},
        {"v": [1.0, math.nextafter(2.0, 3), -0.0]},
        {"v": [1, 2, 0]},
        {"v": ["1.0", "2.0", "-0.0"]},
        {"w": [1.0, 2.0, -0.0]},
        {"v": [1.0, 2.0, -0.0, -0.0]},
        {"v": [1.0, 2.0, -0.0], "w": [0.0, 0.0, 0.0]},
    ],
)
def test_another_value_type_name_or_number_of_rows_gives_another_hash(other: dict[str, list[Any]]) -> None:
    assert data_hash(pa.table(other)) != data_hash(pa.table({"v": [1.0, 2.0, -0.0]}))


def test_missing_and_empty_texts_differ_and_rows_are_not_mixed() -> None:
    tables = [{"a": [None, "x"]}, {"a": ["", "x"]}, {"a": ["", "x"], "b": ["1", "2"]}, {"a": ["", "x"], "b": ["2", "1"]}]
    assert len({data_hash(pa.table(one)) for one in tables}) == 4


def test_all_nan_are_alike_and_the_width_of_numbers_does_not_count() -> None:
    odd = struct.unpack("<d", struct.pack("<Q", 0xFFF8000000000123))[0]
    assert data_hash(pa.table({"v": [odd]})) == data_hash(pa.table({"v": [math.nan]}))
    for kinds in ((pa.int8(), pa.int64()), (pa.float32(), pa.float64()), (pa.string(), pa.large_string())):
        values = ["a"] if kinds[0] == pa.string() else [1]
        first, second = (data_hash(pa.table({"v": pa.array(values, kind)})) for kind in kinds)
        assert first == second


def test_a_table_has_the_same_hash_from_duckdb_and_from_arrow() -> None:
    made = connect().sql("SELECT unnest(['b', 'a', NULL]) AS s, unnest([1.5::DOUBLE, 'nan', NULL]) AS v").to_arrow_table()
    assert data_hash(made) == data_hash(pa.table({"s": ["a", None, "b"], "v": [math.nan, None, 1.5]}))


def test_tables_of_several_chunks_have_the_hash_of_one() -> None:
    table = pa.table(ROWS)
    assert data_hash(pa.concat_tables([table.slice(0, 1), table.slice(1)])) == data_hash(table)
