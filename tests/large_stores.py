"""Stores with very many runs for tests: the records of one real run, many times, written directly."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

import sierra
from sierra.design.expand import exact, run_id
from sierra.store.store import Store
from sierra.util.hashing import merkle, sha256

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


NEW_IDS = ("execution", "session")
"""The columns with ids that follow from nothing; all others follow from seeds."""
A_SESSION = 1 << 40
"""The difference between the Lamport times of sessions with adjacent numbers."""


class _Copied(NamedTuple):
    """A batch that is copied: the tables of each of its segments, and what its ids follow from."""

    segments: Sequence[Mapping[str, pa.Table]]
    runs: Sequence[Mapping[str, Any]]
    values: Sequence[Mapping[str, Any]]
    """The values of the axes of each experiment."""
    ids: frozenset[str]
    """The ids that follow from nothing."""


def multiply(root: Path, batch: str, count: int) -> None:
    """Add so many copies of a batch to a project, each with other seeds, as if it had been executed so often.

    All ids follow from the records, as `sierra fsck` demands.
    """
    store = sierra.open(root).store
    copied = _copied(store, batch)
    for number in range(1, count + 1):
        ids = {one: sha256(f"{number} {one}".encode())[: len(one)] for one in copied.ids} | _ids_of_copy(copied, batch, number)
        for tables in copied.segments:
            writer = store.writer(store.paths.work / "large", ids[batch])
            for name, table in tables.items():
                pq.write_table(_copy(table, ids, number), writer.path(name))
            store.publish(writer)


def _copied(store: Store, batch: str) -> _Copied:
    segments = [
        {name: pq.read_table(path) for name, path in one.files.items()} for one in store.segments() if one.batch == batch[:12]
    ]
    tables = [table for files in segments for table in files.values()]
    ids = {
        value for table in tables for name in {*NEW_IDS} & {*table.column_names} for value in table[name].to_pylist() if value
    }
    runs = store.rows(
        "SELECT ordinal, run, seed, spec, [input] || other_inputs AS inputs, files FROM batch_runs JOIN specs USING (spec) "
        "WHERE batch = $b ORDER BY ordinal, number",
        b=batch,
    )
    with store.snapshot() as snapshot:
        cells = snapshot.cells(batch)
        [axes] = snapshot.values(list, "SELECT axes FROM batches WHERE batch = $b", b=batch)
    values = [{axis: exact(cells[ordinal][axis]) for axis in axes} for ordinal in sorted(cells)]
    return _Copied(segments, runs, values, frozenset(ids))


def _ids_of_copy(copied: _Copied, batch: str, number: int) -> dict[str, str]:
    """Return the ids of a copy's runs, experiments and batch, by those of the original."""
    found, experiments = {}, {}
    for row in copied.runs:
        inputs = zip(row["files"], row["inputs"], strict=True)
        found[row["run"]] = run_id(row["spec"], inputs, _seed(row["seed"], number))
        experiments.setdefault(row["ordinal"], []).append(row["run"])
    for ordinal, runs in experiments.items():
        values = {"values": copied.values[ordinal]}
        found[merkle("experiment", runs, values)] = merkle("experiment", [found[run] for run in runs], values)
    originals = [merkle("experiment", runs, {"values": copied.values[ordinal]}) for ordinal, runs in experiments.items()]
    assert merkle("batch", originals) == batch
    return found | {batch: merkle("batch", [found[one] for one in originals])}


def _seed(seed: int, number: int) -> int:
    return (seed + number * 7919) % (1 << 31)


def _copy(table: pa.Table, ids: Mapping[str, str], number: int) -> pa.Table:
    """Return a table with the ids, the seeds and the Lamport times of a copy."""
    for place, field in enumerate(table.schema):
        values = table.column(place).to_pylist()
        if field.name == "seed":
            values = [_seed(value, number) for value in values]
        elif field.name == "lamport":
            values = [value + number * A_SESSION for value in values]
        elif pa.types.is_string(field.type):
            values = [ids.get(value, value) for value in values]
        else:
            continue
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
