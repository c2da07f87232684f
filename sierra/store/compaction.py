"""Segments written anew, without some of their rows, in the place of others.

New segments are written beside the store first, then they take the place of the old ones at one moment (see
`sierra.store.segments`): whoever is killed leaves the store as it was before, or as it is after. Old segments do not count
from then on; `tidy` removes them once nobody reads them, then or at any later time.

What stays of a file is row for row what it was, in the same order: a file of which every row stays, and that is not merged
with others, is copied byte for byte; where DuckDB writes an output's rows again, both are compared afterwards.
"""

from __future__ import annotations

import contextlib
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sierra.errors import Damaged, Missing
from sierra.store.connections import connect
from sierra.store.counting import Written, rows_by_file
from sierra.store.errors import first_line
from sierra.store.layout import StorePaths
from sierra.store.names import identifier
from sierra.store.objects import GROUP, ROWS
from sierra.store.read_lock import alone
from sierra.store.scans import copy, read_parquet
from sierra.store.schema import LATER, arrow_schema, is_table
from sierra.store.segments import AFTER, MANIFEST, OUTPUT, REPLACES, Segment, Writer, disk_errors, on_disk, out_of_date, sync
from sierra.store.store import Snapshot

Drop = Mapping[str, Mapping[str, AbstractSet[str]]]
"""By table (`output`: all outputs) and column: a row goes where its value is one of these."""
LINES = 65_536


@dataclass(frozen=True, slots=True)
class Group:
    """Segments of one batch that become one; every file of a name has the same columns in all of them."""

    segments: tuple[Segment, ...]


def groups(segments: Iterable[Segment]) -> list[Group]:
    """Segments that can become one each: those of one batch, as far as their columns agree."""
    found: list[tuple[str, dict[str, Any], list[Segment]]] = []
    for segment in segments:
        schemas = {name: _written(name, path) for name, path in segment.files.items()}
        for batch, theirs, members in found:
            if batch == segment.batch and all(theirs.get(name, schema).equals(schema) for name, schema in schemas.items()):
                theirs.update(schemas)
                members.append(segment)
                break
        else:
            found.append((segment.batch, schemas, [segment]))
    return [Group(tuple(members)) for _, _, members in found]


def touched(snapshot: Snapshot, segments: Iterable[Segment], drop: Drop) -> list[Segment]:
    """Those segments that have a row which goes."""
    import pyarrow as pa

    for table, columns in drop.items():
        for column, values in columns.items():
            snapshot.register(f"going {table} {column}", pa.table({"value": pa.array(sorted(values), pa.string())}))

    def goes(path: str, table: str, column: str) -> bool:
        going = f"SELECT value FROM {identifier(f'going {table} {column}')}"
        return bool(snapshot.run(f"SELECT 1 FROM {read_parquet([path])} WHERE {column} IN ({going}) LIMIT 1"))

    return [
        segment
        for segment in segments
        if any(
            goes(path, table, column)
            for name, path in segment.files.items()
            for table in (_table(name),)
            for column in drop.get(table, ())
        )
    ]


def _table(name: str) -> str:
    """What a segment's file is called in a `Drop`."""
    return "output" if name.startswith(OUTPUT) else name


def _written(name: str, path: str) -> Any:
    """Return the schema that a file has once it is written again: later columns are added to older records."""
    schema = _schema(path)
    return arrow_schema(name) if name in LATER and is_table(name, schema) else schema


def _schema(path: str) -> Any:
    """Names and types. (Whether a column may lack values is no part of it: DuckDB notes that where it happens to know.)"""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with _readable(path):
        return pa.schema([(field.name, field.type) for field in pq.read_schema(path)])


class Compaction:
    """New segments in the place of old ones: `write` them, then `publish` at one moment."""

    def __init__(self, paths: StorePaths, folder: Path, name: str) -> None:
        """`folder`: where they are written, in the store's file system; `name`: what no other rewriting is called."""
        self._paths = paths
        self._folder = folder
        self._name = name
        self._writers: list[tuple[str, Writer]] = []
        self._replaced: list[Segment] = []

    def write(self, group: Group, drop: Drop) -> None:
        """Write what stays of a group. Raises Missing where the disk is full, Damaged where an old file cannot be read."""
        writer = Writer(self._folder / str(len(self._replaced)), group.segments[0].batch)
        for name in sorted({name for segment in group.segments for name in segment.files}):
            paths = [segment.files[name] for segment in group.segments if name in segment.files]
            with disk_errors(self._folder):
                _write(writer.path(name), name, paths, drop.get(_table(name), {}))
        self._replaced += group.segments
        if any(writer.folder.iterdir()):
            self._writers.append((group.segments[0].batch, writer))

    def publish(self) -> None:
        """Put all that was written in the place of what it replaces."""
        if not self._replaced:
            return
        names = {name for segment in self._replaced for name in (segment.name, *segment.replaces)}
        lines = [*sorted(names), f"by {self._name}"]
        if len(self._writers) == 1:
            writer = self._writers[0][1]
            writer.mark(REPLACES, lines)
            writer.publish(self._paths.segments)
            return
        last = Writer(self._folder / "last", self._replaced[0].batch)
        last.mark(REPLACES, lines)
        name = last.seal()
        for _, writer in self._writers:
            writer.mark(AFTER, [name])
            writer.publish(self._paths.segments)
        last.publish(self._paths.segments)


def _write(target: Path, name: str, paths: Sequence[str], drop: Mapping[str, AbstractSet[str]]) -> None:
    """One file of what stays of some; none where nothing does."""
    if len(paths) == 1 and not _any_dropped(paths[0], drop):
        shutil.copyfile(paths[0], target)
    elif name.startswith(OUTPUT):
        _write_output(target, paths, drop.get("execution", frozenset()))
    elif name == "objects":
        _write_tables(target, _staying_objects(paths, drop.get("sha256", frozenset())), arrow_schema(name))
    else:
        schema = _schema(paths[0]) if name == "experiments" else arrow_schema(name)
        _write_tables(target, _staying(paths, drop), schema)


def _any_dropped(path: str, drop: Mapping[str, AbstractSet[str]]) -> bool:
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    if not drop:
        return False
    with _readable(path), pq.ParquetFile(path) as file:
        for batch in file.iter_batches(LINES, columns=list(drop)):
            for column, values in drop.items():
                if pc.any(_is_in(batch.column(column), values)).as_py():
                    return True
    return False


def _is_in(column: Any, values: AbstractSet[str]) -> Any:
    import pyarrow as pa
    import pyarrow.compute as pc

    return pc.is_in(column, value_set=pa.array(sorted(values), pa.string()))


def _staying(paths: Sequence[str], drop: Mapping[str, AbstractSet[str]]) -> Iterator[Any]:
    """What stays of tables of records, some rows at a time."""
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    for path in paths:
        with _readable(path), pq.ParquetFile(path) as file:
            for batch in file.iter_batches(LINES):
                for column, values in drop.items():
                    batch = batch.filter(pc.invert(_is_in(batch.column(column), values)))
                if batch.num_rows:
                    yield pa.Table.from_batches([batch]).replace_schema_metadata(None)


def _staying_objects(paths: Sequence[str], drop: AbstractSet[str]) -> Iterator[Any]:
    """What stays of objects, each once, in row groups as they are written."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    known: set[str] = set()
    held: list[Any] = []
    for path in paths:
        mine: set[str] = set()
        with _readable(path), pq.ParquetFile(path) as file:
            for group in range(file.num_row_groups):
                table = file.read_row_group(group)
                digests = table.column("sha256").to_pylist()
                stays = [digest not in drop and digest not in known for digest in digests]
                mine.update(digests)
                if any(stays):
                    held.append(table.filter(pa.array(stays)))
                if sum(part.nbytes for part in held) >= GROUP // 2 or sum(part.num_rows for part in held) >= ROWS // 2:
                    yield from _in_groups(pa.concat_tables(held))
                    held = []
        known |= mine
    if held:
        yield from _in_groups(pa.concat_tables(held))


def _in_groups(table: Any) -> Iterator[Any]:
    """Row groups no larger than those that are written."""
    begin = held = 0
    for row, content in enumerate(table.column("content")):
        size = content.as_buffer().size
        if row > begin and (held + size > GROUP or row - begin >= ROWS):
            yield table.slice(begin, row - begin)
            begin, held = row, 0
        held += size
    yield table.slice(begin)


def _write_tables(target: Path, tables: Iterable[Any], schema: Any) -> None:
    """Write tables; columns that they do not have are NULL."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    writer = None
    try:
        for table in tables:
            writer = writer or pq.ParquetWriter(target, schema, compression="zstd")
            for field in schema:
                if field.name not in table.column_names:
                    table = table.append_column(field, pa.nulls(len(table), field.type))
            writer.write_table(table.cast(schema))
    finally:
        if writer is not None:
            writer.close()


def _write_output(target: Path, paths: Sequence[str], executions: AbstractSet[str]) -> None:
    """DuckDB wrote these rows, and writes those again that stay: it alone has all their types."""
    import duckdb
    import pyarrow as pa

    connection = connect()
    try:
        connection.register("gone", pa.table({"execution": pa.array(sorted(executions), pa.string())}))
        connection.execute("SET threads = 1")
        connection.execute("SET disabled_optimizers = 'join_order,build_side_probe_side'")  # rows keep their order
        stays = f"SELECT o.* FROM {read_parquet(paths)} o ANTI JOIN gone g ON o.execution = g.execution"
        before = connection.execute(SUM.format(rows=stays)).fetchall()[0]
        kept = {written: rows for written, rows in _counted(paths).items() if written[0] not in executions}
        if before[0] or kept:
            connection.execute(copy(stays, target))
            written = connection.execute(SUM.format(rows=f"SELECT * FROM {read_parquet([str(target)])}")).fetchall()[0]
            if written != before or _counted([str(target)]) != kept or not _schema(str(target)).equals(_schema(paths[0])):
                raise Damaged(f"{paths[0]}: its rows are not the same written again; nothing was changed")
    except duckdb.IOException as error:
        raise Missing(f"cannot write {target}: {first_line(error)}") from error
    except duckdb.Error as error:
        raise Damaged(f"{paths[0]}: cannot be written again: {first_line(error)}") from error
    finally:
        connection.close()


def _counted(paths: Sequence[str]) -> Counter[Written]:
    """Return how many rows each execution, and each of its files, has in these Parquet files, counted without DuckDB."""
    return sum((rows_by_file(path) for path in paths), Counter[Written]())


SUM = "SELECT count(*), sum(hash(place, line))::VARCHAR FROM (SELECT row_number() OVER () AS place, t AS line FROM ({rows}) t)"
"""A number for rows and their order."""


@contextlib.contextmanager
def _readable(path: str) -> Iterator[None]:
    """Turns what pyarrow says of a damaged file into Damaged. (An error in writing is an OSError, and has a number.)"""
    import pyarrow as pa

    try:
        yield
    except (pa.ArrowException, ValueError) as error:
        raise Damaged(f"{path}: cannot be read: {first_line(error)}; see sierra fsck") from error
    except OSError as error:
        if error.errno is None:
            raise Damaged(f"{path}: cannot be read: {first_line(error)}; see sierra fsck") from error
        raise


def out_of_use(paths: StorePaths) -> list[Segment]:
    """Segments that do not count, and those that said so of others which are not there any more.

    To be called where no rewriting is being published: within `sierra.execution.sessions.exclusively`.
    """
    found = list(on_disk(paths.segments))
    hidden = out_of_date(found)
    waited_for = {segment.after for segment in found if segment.name not in hidden}
    return [
        segment
        for segment in found
        if segment.name in hidden
        or (segment.replaces and not segment.files and segment.after is None and segment.name not in waited_for)
    ]


def tidy(paths: StorePaths, aside: Path) -> int:
    """Remove segments that do not count, if nobody reads; how many. `aside` is a folder for them, in the same file system."""
    with alone(paths.reading) as nobody:
        if not nobody:
            return 0
        unused = out_of_use(paths)
        hidden = out_of_date(list(on_disk(paths.segments)))
        aside.mkdir(parents=True, exist_ok=True)
        for segment in sorted(unused, key=lambda segment: segment.name not in hidden):
            if segment.name not in hidden:  # what it hides is gone for good before it goes itself
                sync(paths.segments)
            (paths.segments / segment.name).rename(aside / segment.name)
        if unused:
            sync(paths.segments)
    shutil.rmtree(aside, ignore_errors=True)
    return len(unused)


__all__ = ["MANIFEST", "Compaction", "Drop", "Group", "groups", "out_of_use", "tidy"]
