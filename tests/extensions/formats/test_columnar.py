"""NumPy, Arrow, SQLite and GraphML files keep their types; what is damaged, hostile or not understood is an error."""

from __future__ import annotations

import io
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from sierra.config.output_tables import Output
from sierra.ingest import sqlite_file
from tests.readings import read_file
from tests.unit.ingest.test_column_types import ALL, parquet

COLUMNS = {"t": [1, 2, 3], "v": [0.5, None, 1.5], "name": ["a", "b", None], "on": [True, False, None]}
ROWS = [dict(zip(COLUMNS, values, strict=True)) for values in zip(*COLUMNS.values(), strict=True)]


def npy(array: Any, **keys: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, array, **keys)
    return file.getvalue()


def npz(*, zipped: bool = False, **arrays: Any) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if zipped else np.savez)(file, **arrays)
    return file.getvalue()


def arrow(columns: Any, *, stream: bool = False, chunk: int = 2, compression: str | None = None) -> bytes:
    file, table = io.BytesIO(), pa.table(columns)
    options = pa.ipc.IpcWriteOptions(compression=compression)
    with (pa.ipc.new_stream if stream else pa.ipc.new_file)(file, table.schema, options=options) as writer:
        writer.write_table(table, max_chunksize=chunk)
    return file.getvalue()


def sqlite(folder: Path, *statements: str) -> bytes:
    path = folder / "made.db"
    path.unlink(missing_ok=True)
    database = sqlite3.connect(path)
    for statement in statements:
        database.execute(statement)
    database.commit()
    database.close()
    return path.read_bytes()


def rows_of(folder: Path, content: bytes, kind: str, **keys: Any) -> list[dict[str, Any]]:
    reading, rows = read_file(folder, f"t.{kind}", content, format=kind, **keys)
    assert not reading.faults
    assert list(reading.counted.values()) == [len(rows)]
    return rows


def fault_of(folder: Path, content: bytes, kind: str, **keys: Any) -> str:
    reading, rows = read_file(folder, f"t.{kind}", content, format=kind, **keys)
    assert rows == []
    assert "\n" not in reading.faults["e0"]
    assert "failed: " not in reading.faults["e0"]
    return reading.faults["e0"].removeprefix(f"t.{kind}: ")


GRID = [{"i": 0, "j": 0, "value": 0}, {"i": 0, "j": 1, "value": 1}, {"i": 1, "j": 0, "value": 2}, {"i": 1, "j": 1, "value": 3}]
STRUCTURED = np.array([(1, b"x"), (2, b"y")], dtype=[("n", ">i2"), ("s", "S1")])


@pytest.mark.parametrize(
    ("content", "rows"),
    [
        (npy(np.arange(4).reshape(2, 2)), GRID),
        (npy(np.asfortranarray(np.arange(4).reshape(2, 2))), GRID),
        (npy(np.float16(0.5)), [{"value": 0.5}]),
        (npy(np.zeros((0, 3))), []),
        (npy(np.array(["ä", "b"])), [{"i": 0, "value": "ä"}, {"i": 1, "value": "b"}]),
        (npy(STRUCTURED), [{"i": 0, "n": 1, "s": "x"}, {"i": 1, "n": 2, "s": "y"}]),
        (npz(t=np.array([1, 2]), on=np.array([True, False])), [{"i": 0, "t": 1, "on": True}, {"i": 1, "t": 2, "on": False}]),
        (npz(zipped=True, t=np.array([1.5])), [{"i": 0, "t": 1.5}]),
    ],
)
def test_elements_of_arrays_become_rows(tmp_path: Path, content: bytes, rows: list[Any]) -> None:
    assert rows_of(tmp_path, content, "npy") == rows


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (npy(np.array([{}], dtype=object), allow_pickle=True), "the array 'value' has objects, which are pickles"),
        (npz(a=np.array([1]), b=np.array([None])), "the array 'b' has objects, which are pickles"),
        (npz(a=np.array([1]), b=np.array([1, 2])), "the array 'b' has the shape (2,), but 'a' has (1,)"),
        (npz(i=np.array([1])), "the array 'i' has the name of an index"),
        (npy(np.arange(9))[:-1], "the array 'value' is truncated"),
        (npy(np.arange(9)) + b"x", "the array 'value' has bytes after its end"),
        (npy(np.arange(9) * 1j), "the array 'value' has elements of type complex128"),
        (npz(a=np.arange(9))[:-30], "is truncated, or neither NPY nor NPZ"),
        (b"", "is truncated, or neither NPY nor NPZ"),
    ],
)
def test_array_that_is_hostile_or_damaged_is_an_error(tmp_path: Path, content: bytes, fault: str) -> None:
    assert fault_of(tmp_path, content, "npy").startswith(fault)


@pytest.mark.parametrize("stream", [False, True])
@pytest.mark.parametrize("compression", [None, "zstd"])
def test_arrow_tables_keep_their_types(tmp_path: Path, stream: bool, compression: str | None) -> None:
    content = arrow(COLUMNS, stream=stream, compression=compression)
    assert rows_of(tmp_path, content, "arrow") == ROWS
    assert rows_of(tmp_path, arrow({"a": pa.array([], pa.int64())}, stream=stream), "arrow") == []
    encoded = {"s": pa.array(["x", "y", "x"]).dictionary_encode()}
    assert rows_of(tmp_path, arrow(encoded, stream=stream), "arrow") == [{"s": "x"}, {"s": "y"}, {"s": "x"}]
    for damaged in (content[:-1], content[:-9], content[: len(content) // 2], content[:9], b""):
        assert fault_of(tmp_path, damaged, "arrow")


def test_sqlite_tables_and_statements_become_tables(tmp_path: Path) -> None:
    made = (
        'CREATE TABLE "my steps" (t INTEGER, v REAL, name TEXT)',
        "INSERT INTO \"my steps\" VALUES (1, 0.5, 'a'), (2, 1, NULL), (3, NULL, '007')",
    )
    rows = [{"t": 1, "v": 0.5, "name": "a"}, {"t": 2, "v": 1.0, "name": None}, {"t": 3, "v": None, "name": "007"}]
    for content in (sqlite(tmp_path, *made), sqlite(tmp_path, "PRAGMA journal_mode = wal", *made)):
        assert rows_of(tmp_path, content, "sqlite", rows="my steps") == rows
        statement = 'SELECT t * 2 AS u FROM "my steps" WHERE v > 0'
        assert rows_of(tmp_path, content, "sqlite", rows=statement) == [{"u": 2}, {"u": 4}]
        assert rows_of(tmp_path, content, "sqlite", rows='SELECT t FROM "my steps" WHERE false') == []


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        ("other", "SQLite cannot read it: no such table"),
        ("SELECT t, t FROM s", "the statement gives two columns of the same name"),
        ("mixed", "the column 'x' has values of several types: int and str"),
        ("SELECT load_extension('x')", "SQLite cannot read it: "),
        ("WITH x AS (SELECT 1) DELETE FROM s", "SQLite cannot read it: "),
        ("SELECT 1; DROP TABLE s", "SQLite cannot read it: "),
        ("big", "the column 'x' has fractions and whole numbers that DOUBLE cannot hold"),
    ],
)
def test_statement_that_is_not_a_query_is_an_error(tmp_path: Path, rows: str, fault: str) -> None:
    content = sqlite(
        tmp_path,
        "CREATE TABLE s (t)",
        "INSERT INTO s VALUES (1)",
        "CREATE TABLE mixed (x)",
        "INSERT INTO mixed VALUES (1), ('a')",
        "CREATE TABLE big (x)",
        "INSERT INTO big VALUES (0.5), (9007199254740993)",
    )
    assert fault_of(tmp_path, content, "sqlite", rows=rows).startswith(fault)


@pytest.mark.parametrize("limit", ["is_over", "authorize"])
def test_ctrl_c_within_a_statement_of_sqlite_is_no_fault_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sqlite_file._Limits, limit, interrupted)
    many = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 100000) SELECT max(i) AS i FROM n"
    content = sqlite(tmp_path, "CREATE TABLE s (t)")
    with pytest.raises(KeyboardInterrupt):
        rows_of(tmp_path, content, "sqlite", rows=many)


def test_damaged_or_unfinished_database_is_an_error(tmp_path: Path) -> None:
    content = sqlite(tmp_path, "CREATE TABLE s (t)", *(f"INSERT INTO s VALUES ('{'x' * 500}{n}')" for n in range(200)))
    for damaged in (content[:-4096], content[: len(content) // 2 + 7], b"", b"x" * 5000):
        assert fault_of(tmp_path, damaged, "sqlite", rows="s")
    (tmp_path / "t.sqlite-wal").write_bytes(b"x")
    assert fault_of(tmp_path, content, "sqlite", rows="s").startswith("has an unfinished journal")


GRAPH = b"""<?xml version="1.0"?>
<graphml xmlns="http://graphml.graphdrawing.org/xmlns">
  <key id="d0" for="node" attr.name="color" attr.type="string"><default>007</default></key>
  <key id="d1" for="edge" attr.name="weight" attr.type="double"/>
  <key id="d2" for="all" attr.name="on" attr.type="boolean"/>
  <graph id="G" edgedefault="undirected">
    <data key="d0">of the graph</data>
    <node id="n0"><data key="d0">red</data><graph><node id="n0::1"><data key="d2">true</data></node></graph></node>
    <edge source="n0" target="n0::1"><data key="d1">1</data></edge>
    <edge source="n0::1" target="n0"/>
  </graph>
</graphml>
"""


def test_nodes_and_edges_of_graphs_become_rows(tmp_path: Path) -> None:
    assert rows_of(tmp_path, GRAPH, "graphml", rows="nodes") == [
        {"id": "n0", "color": "red", "on": None},
        {"id": "n0::1", "color": "007", "on": True},
    ]
    assert rows_of(tmp_path, GRAPH, "graphml", rows="edges") == [
        {"source": "n0", "target": "n0::1", "weight": 1.0},
        {"source": "n0::1", "target": "n0", "weight": None},
    ]
    nothing = {"target": None, "weight": None, "on": None, "color": None}
    assert rows_of(tmp_path, GRAPH, "graphml", rows="graph") == [
        {**nothing, "source": "n0", "color": "red"},
        {**nothing, "source": "n0::1", "color": "007", "on": True},
        {**nothing, "source": "n0", "target": "n0::1", "weight": 1.0},
        {**nothing, "source": "n0::1", "target": "n0"},
    ]
    edgeless = GRAPH[: GRAPH.index(b"<edge")] + GRAPH[GRAPH.index(b"</graph>", GRAPH.index(b"<edge")) :]
    assert all(row.keys() == {"source", *nothing} for row in rows_of(tmp_path, edgeless, "graphml", rows="graph"))


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        (b"</graphml>", b"", "line 13: is truncated or not XML"),
        (b'<data key="d1">1', b'<data key="d1">one', "line 9: 'weight' is no double: 'one'"),
        (b'<data key="d1">1', b'<data key="d9">1', "line 9: the key 'd9' is not declared"),
        (b'"color"', b'"id"', "line 3: a value has the name of the attribute 'id'"),
        (b'<edge source="n0" ', b'<hyperedge/><edge source="n0" ', "line 9: has a hyperedge"),
        (b"<graphml ", b"<!DOCTYPE x><graphml ", "has a document type declaration"),
    ],
)
def test_graph_that_is_not_understood_is_an_error(tmp_path: Path, old: bytes, new: bytes, fault: str) -> None:
    assert fault_of(tmp_path, GRAPH.replace(old, new), "graphml", rows="nodes").startswith(fault)


@pytest.mark.parametrize(("kind", "rows"), [("sqlite", ""), ("graphml", ""), ("graphml", "node")])
def test_rows_must_be_named(kind: str, rows: str) -> None:
    with pytest.raises(ValueError, match=f'format = "{kind}" needs rows'):
        Output.model_validate({"file": "t.x", "format": kind, "rows": rows})


@pytest.mark.nightly
def test_arrow_files_have_the_same_values_as_parquet_files(tmp_path: Path) -> None:
    for name, (array, _, _) in ALL.items():
        (_, one), (_, other) = (
            read_file(tmp_path, "t.parquet", parquet(array)),
            read_file(tmp_path, "t.arrow", arrow({"v": array}), format="arrow"),
        )
        assert (name, one) == (name, other)


def test_intervals_of_months_are_a_fault(tmp_path: Path) -> None:
    content = arrow({"v": pa.array([pa.MonthDayNano((1, 2, 3))])})
    reading, _ = read_file(tmp_path, "t.arrow", content, format="arrow")
    assert "month_day_nano_interval" in reading.faults["e0"]
