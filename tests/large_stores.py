"""Stores with very many runs for tests: the records of one real run, many times, written directly."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

import sierra
from sierra.store.store import Store
from sierra.util.hashing import sha256

ROWS = 10_000
"""The number of runs that are in memory at a time."""


def grow(root: Path, batch: str, runs: int) -> str:
    """Add a batch with so many runs to a project that has executed `batch` with one run; return its id.

    Ids do not follow from the records, so that `sierra fsck` finds faults.
    """
    store = sierra.open(root).store
    other = sha256(batch.encode())
    [segment] = [one for one in store.segments() if "executions" in one.files]
    writer = store.writer(store.paths.work / "large", other)
    for name in ("batches", "experiments", "sessions"):
        [path] = [one.files[name] for one in store.segments() if name in one.files]
        table = _set(pq.read_table(path), batch=other)
        pq.write_table(_set(table, runs=runs) if name == "batches" else table, writer.path(name))
    [members] = [one.files["batch_runs"] for one in store.segments() if "batch_runs" in one.files]
    _repeat(Path(members), writer.path("batch_runs"), other, runs)
    for name, path in segment.files.items():
        if name in ("executions", "artifacts") or name.startswith("output."):
            _repeat(Path(path), writer.path(name), other, runs)
    store.publish(writer)
    assert isinstance(store, Store)
    return other


OF_BATCHES = frozenset(("batch", "experiment", "run", "execution", "judgement", "session"))
"""The columns with ids that are other ones in each copy of a batch."""


def multiply(root: Path, batch: str, count: int) -> None:
    """Add so many copies of a batch to a project, each with ids of its own, in as many segments.

    Ids do not follow from the records, so that `sierra fsck` finds faults.
    """
    store = sierra.open(root).store
    copied = [
        (one, {name: pq.read_table(path) for name, path in one.files.items()})
        for one in store.segments()
        if one.batch == batch[:12]
    ]
    tables = [table for _, files in copied for table in files.values()]
    ids = {
        value for table in tables for name in OF_BATCHES & {*table.column_names} for value in table[name].to_pylist() if value
    }
    for number in range(count):
        others = {one: sha256(f"{number} {one}".encode())[: len(one)] for one in ids}
        for _, files in copied:
            writer = store.writer(store.paths.work / "large", others[batch])
            for name, table in files.items():
                pq.write_table(_renamed(table, others), writer.path(name))
            store.publish(writer)


def _renamed(table: pa.Table, ids: Mapping[str, str]) -> pa.Table:
    for place, field in enumerate(table.schema):
        if pa.types.is_string(field.type):
            values = [ids.get(value, value) for value in table.column(place).to_pylist()]
            table = table.set_column(place, field, pa.array(values, field.type))
    return table


def _set(table: pa.Table, **values: object) -> pa.Table:
    for name, value in values.items():
        place = table.schema.get_field_index(name)
        field = table.schema.field(place)
        table = table.set_column(place, field, pa.array([value] * len(table), field.type))
    return table


def _repeat(source: Path, target: Path, batch: str, runs: int) -> None:
    """Write the rows of one run for each run, with its own ids."""
    rows = pq.read_table(source)
    rows = _set(rows, batch=batch) if "batch" in rows.column_names else rows
    with pq.ParquetWriter(target, rows.schema, compression="zstd") as file:
        for ids in _ids(runs):
            table = pa.concat_tables([rows] * len(ids))
            for name in {"run", "execution"} & set(table.column_names):
                mine = [sha256(f"{name} {one}".encode()) for one in ids for _ in range(len(rows))]
                table = table.set_column(table.schema.get_field_index(name), name, pa.array(mine))
            if "number" in table.column_names:
                numbers = pa.array([one for one in ids for _ in range(len(rows))], pa.int64())
                table = table.set_column(table.schema.get_field_index("number"), "number", numbers)
            file.write_table(table.cast(rows.schema))


def _ids(runs: int) -> Iterator[range]:
    for begin in range(0, runs, ROWS):
        yield range(begin, min(begin + ROWS, runs))
