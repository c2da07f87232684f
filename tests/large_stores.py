"""Stores with very many runs for tests: the records of one real run, many times, written directly."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

import sierra
from sierra.design.expand import exact, run_id
from sierra.store.segments import MANIFEST, OUTPUTS, SUFFIX
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
        table = _set(pq.read_table(path), batch=other, **({"session": other[:16]} if name == "sessions" else {}))
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
NUMBERS = ("seed", "lamport")
"""The columns with numbers that differ between copies."""
MARK = b"\xfa\xce\xfe\xed"
"""The upper half of the numbers that stand for these in a file before it is copied; the lower half tells them apart."""
A_SESSION = 1 << 40
"""The difference between the Lamport times of sessions with adjacent numbers."""


class _Original(NamedTuple):
    """A batch that is copied."""

    batch: str
    segments: Sequence[Mapping[str, Sequence[bytes]]]
    """The files of each segment, by name: a text, an id or a number that may be another in copies, a text, and so on."""
    runs: Sequence[Mapping[str, Any]]
    experiments: Mapping[str, tuple[Sequence[str], Mapping[str, Any]]]
    """The runs and the values of each experiment."""
    ids: Sequence[str]
    """The ids that follow from nothing."""
    numbers: Mapping[bytes, tuple[str, int]]
    """The columns and the values that stand in files as other numbers."""


def multiply(root: Path, batch: str, count: int, *, first: int = 1, segments: int | None = None) -> None:
    """Add so many copies of a batch to a project, each with other seeds, as if it had been executed so often.

    The batch should not be the first of its project, with which alone the store keeps the source.

    All ids follow from the records, as `sierra fsck` demands. `first`: the number of the first copy, for a project that has
    some. `segments`: the most segments to add, for a copy that looks unfinished.

    Parquet is written only once: copies differ in bytes of ids and numbers, whose columns are neither compressed nor have
    dictionaries or statistics. Nothing is synced.
    """
    store = sierra.open(root).store
    original = _original(store, batch)
    left = len(original.segments) * count if segments is None else segments
    for number in range(first, first + count):
        new = _new_values(original, number)
        for files in original.segments[:left]:
            copied = {name: b"".join(new.get(part, part) for part in parts) for name, parts in files.items()}
            _publish(store.paths.segments, new[batch.encode()].decode(), copied)
        left = max(left - len(original.segments), 0)


def _original(store: Store, batch: str) -> _Original:
    folders = [store.paths.segments / one.name for one in store.segments() if one.batch == batch[:12]]
    files = [file for folder in folders for file in folder.iterdir() if file.suffix == SUFFIX]
    tables = {file: pq.read_table(file) for file in files}
    ids = {
        value
        for table in tables.values()
        for name in {*NEW_IDS} & {*table.column_names}
        for value in table[name].to_pylist()
        if value
    }
    runs = store.rows(
        "SELECT ordinal, run, seed, spec, [input] || other_inputs AS inputs, files FROM batch_runs JOIN specs USING (spec) "
        "WHERE batch = $b ORDER BY ordinal, number",
        b=batch,
    )
    with store.snapshot() as snapshot:
        cells = snapshot.cells(batch)
        axes = snapshot.values(str, "SELECT unnest(axes) FROM batches WHERE batch = $b", b=batch)
    experiments: dict[str, tuple[list[str], dict[str, Any]]] = {}
    for ordinal in sorted(cells):
        members = [str(row["run"]) for row in runs if row["ordinal"] == ordinal]
        values = {"values": {axis: exact(value) for axis in axes if (value := cells[ordinal][axis]) is not None}}
        experiments[merkle("experiment", members, values)] = members, values
    assert merkle("batch", list(experiments)) == batch
    numbers: dict[bytes, tuple[str, int]] = {}
    changing = {batch, *ids, *experiments, *(row["run"] for row in runs)}
    segments = [
        {
            file.name: _parts(tables[file], changing, numbers) if file in tables else [file.read_bytes()]
            for file in sorted(folder.iterdir())
            if file in tables or file.name == OUTPUTS
        }
        for folder in folders
    ]
    return _Original(batch, segments, runs, experiments, sorted(ids), numbers)


def _parts(table: pa.Table, changing: AbstractSet[str], numbers: dict[bytes, tuple[str, int]]) -> list[bytes]:
    """Return the file of a table in parts, and add to `numbers` those that stand in it for others."""
    columns = [name for name in table.column_names if name in NUMBERS or not changing.isdisjoint(_texts(table[name]))]
    for name in {*NUMBERS} & {*columns}:
        marks = {
            value: struct.pack("<I", len(numbers) + place) + MARK
            for place, value in enumerate(table[name].unique().to_pylist())
        }
        numbers |= {mark: (name, value) for value, mark in marks.items()}
        values = [struct.unpack("<q", marks[value])[0] for value in table[name].to_pylist()]
        table = table.set_column(table.schema.get_field_index(name), name, pa.array(values, pa.int64()))
    plain = [name for name in _leaves(table.schema) if name not in columns]
    compression = {name: "ZSTD" if name in plain else "NONE" for name in _leaves(table.schema)}
    file = io.BytesIO()
    with pq.ParquetWriter(
        file, table.schema, compression=compression, use_dictionary=plain, write_statistics=plain, store_schema=False
    ) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata(table.schema.metadata or {})
    return _places(changing).split(file.getvalue())


def _texts(column: pa.ChunkedArray) -> list[str]:
    return column.unique().to_pylist() if pa.types.is_string(column.type) else []


def _leaves(schema: pa.Schema) -> list[str]:
    """Return the names of a table's columns in Parquet."""
    return [f"{field.name}.list.element" if pa.types.is_list(field.type) else field.name for field in schema]


def _places(changing: Iterable[str]) -> re.Pattern[bytes]:
    """Return the pattern of ids in plain columns, each after its length, and of numbers that stand for others."""
    lengths = sorted({len(one) for one in changing})
    ids = [b"(?<=" + re.escape(struct.pack("<I", length)) + b")[0-9a-f-]{%d}" % length for length in lengths]
    return re.compile(b"(" + b"|".join([*ids, b"[\\x00-\\xff]{4}" + re.escape(MARK)]) + b")")


def _new_values(original: _Original, number: int) -> dict[bytes, bytes]:
    """Return the ids and the numbers of a copy, as in its files, by those of the original."""
    ids = {one: sha256(f"{number} {one}".encode())[: len(one)] for one in original.ids}
    for row in original.runs:
        ids[row["run"]] = run_id(row["spec"], zip(row["files"], row["inputs"], strict=True), _seed(row["seed"], number))
    for experiment, (runs, values) in original.experiments.items():
        ids[experiment] = merkle("experiment", [ids[run] for run in runs], values)
    ids[original.batch] = merkle("batch", [ids[one] for one in original.experiments])
    numbers = {
        mark: struct.pack("<q", _seed(value, number) if name == "seed" else value + number * A_SESSION)
        for mark, (name, value) in original.numbers.items()
    }
    return {old.encode(): new.encode() for old, new in ids.items()} | numbers


def _seed(seed: int, number: int) -> int:
    return (seed + number * 7919) % (1 << 31)


def _publish(segments: Path, batch: str, files: Mapping[str, bytes]) -> None:
    """Write a segment as `Writer.publish` does, but sync nothing."""
    manifest = "".join(f"{sha256(content)}  {name}\n" for name, content in sorted(files.items())).encode()
    folder = segments / f"{batch[:12]}-{sha256(manifest)[:16]}"
    folder.mkdir()
    for name, content in {**files, MANIFEST: manifest}.items():
        (folder / name).write_bytes(content)


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
