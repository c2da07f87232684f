"""Compaction: new segments that replace old ones, merged or without some of their rows. Or new ones that are added at once.

New segments are written outside the store first. Then one rename replaces the old segments (see `sierra.store.segments`).
A process that is killed leaves the store in its state before or after that rename. After it, the old segments are
ignored. `tidy` removes them when nobody reads them, then or at any later time.

The rows that are kept do not change, and neither does their order. A file that keeps all rows and is not merged with others
is copied byte for byte, unless it is an output's and does not name its table in itself, as in former formats. When DuckDB
rewrites the rows of an output, the old and the new rows are compared afterwards.
"""

from __future__ import annotations

import contextlib
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from sierra.errors import Damaged, Missing
from sierra.store import index_files
from sierra.store.connections import connect, keep_order
from sierra.store.duckdb_file_io import copy, read_parquet
from sierra.store.duckdb_messages import check_shortage, first_line
from sierra.store.layout import StorePaths
from sierra.store.objects import GROUP, ROWS
from sierra.store.parquet_footer import rows_in
from sierra.store.parquet_row_counts import Written, rows_by_file
from sierra.store.read_lock import alone
from sierra.store.schema import RECORDED, arrow_schema, is_table
from sierra.store.segments import (
    AFTER,
    OUTPUT,
    REPLACES,
    Segment,
    Writer,
    disk_errors,
    is_first_part,
    on_disk,
    out_of_date,
    own_table,
    sync,
    table_of,
)
from sierra.store.sql_names import identifier
from sierra.store.store import Snapshot
from sierra.store.verified_files import verify

Drop = Mapping[str, Mapping[str, AbstractSet[str]]]
"""Rows to remove, by table (`output` stands for all outputs) and column: those whose value is in the set."""
Group = tuple[Segment, ...]
"""Segments of one batch that are merged into one. Files of the same name have the same columns in all of them."""
LINES = 65_536


def groups(segments: Iterable[Segment]) -> list[Group]:
    """Group the segments that can be merged: segments of one batch whose columns agree."""
    grouped: list[tuple[str, dict[str, pa.Schema], list[Segment]]] = []
    for segment in segments:
        schemas = {name: _written(name, path) for name, path in segment.files.items()}
        for batch, theirs, members in grouped:
            if batch == segment.batch and all(theirs.get(name, schema).equals(schema) for name, schema in schemas.items()):
                theirs.update(schemas)
                members.append(segment)
                break
        else:
            grouped.append((segment.batch, schemas, [segment]))
    return [tuple(members) for _, _, members in grouped]


def touched(snapshot: Snapshot, segments: Iterable[Segment], drop: Drop) -> list[Segment]:
    """Return the segments that have a row to remove."""
    for table, columns in drop.items():
        for column, values in columns.items():
            snapshot.add_table(f"going {table} {column}", value=sorted(values))

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
    """Return the key in a `Drop` for a file of a segment."""
    return "output" if name.startswith(OUTPUT) else name


def _written(name: str, path: str) -> pa.Schema:
    """Return the schema that a file will have after it is rewritten: for records, the schema of their table."""
    schema = _schema(path)
    return arrow_schema(name) if name in RECORDED and is_table(name, schema) else schema


def _schema(path: str) -> pa.Schema:
    """Return a file's column names and types. Nullability is left out, because DuckDB records it only sometimes."""
    with _readable(path):
        return pa.schema([(field.name, field.type) for field in pq.read_schema(path)])


class Compaction:
    """New segments that replace old ones: call `write` for each group, then `publish` to replace all at once."""

    def __init__(self, paths: StorePaths, folder: Path, name: str) -> None:
        """`folder`: a folder for the new segments, in the store's file system; `name`: a unique name for this compaction."""
        self._paths = paths
        self._folder = folder
        self._name = name
        self._writers: list[Writer] = []
        self._replaced: list[Segment] = []

    def write(self, group: Group, drop: Drop) -> None:
        """Write the kept rows of a group. Raises Missing if the disk is full, Damaged if an old file cannot be read."""
        self.add(group, drop)
        self._replaced += group

    def add(self, group: Group, drop: Drop) -> Writer:
        """Write the kept rows of a group of another store, which replaces nothing. Raises the same errors as `write`.

        Return the writer, for further records. A writer of nothing makes no segment.
        """
        writer = self.new(group[0].batch)
        write_kept(group, drop, writer)
        return writer

    def new(self, batch: str) -> Writer:
        """Return the writer of a new segment of a batch, which replaces nothing. A writer of nothing makes no segment."""
        writer = Writer(self._folder / str(len(self._writers)), batch)
        self._writers.append(writer)
        return writer

    def publish(self) -> None:
        """Add the segments that were written, and replace the old ones, at one moment."""
        writers = [writer for writer in self._writers if any(writer.folder.iterdir())]
        if not (writers or self._replaced):
            return
        names = {name for segment in self._replaced for name in (segment.name, *segment.replaces)}
        lines = [*sorted(names), f"by {self._name}"]
        if len(writers) == 1:
            writers[0].mark(REPLACES, lines)
            writers[0].publish(self._paths.segments)
            return
        last = Writer(self._folder / "last", (writers[0] if writers else self._replaced[0]).batch)
        last.mark(REPLACES, lines)
        name = last.seal()
        for writer in writers:
            writer.mark(AFTER, [name])
            writer.publish(self._paths.segments)
        last.publish(self._paths.segments)


def write_kept(group: Group, drop: Drop, writer: Writer) -> None:
    """Write the kept rows of a group into one new segment. Raises Missing if the disk is full, Damaged for unreadable files."""
    tables = _tables_of_staying(group, drop.get("output", {}))
    for name in sorted({name for segment in group for name in segment.files}):
        paths = [segment.files[name] for segment in group if name in segment.files]
        verify(paths)
        with disk_errors(writer.folder):
            _write(writer.path(name), name, paths, drop.get(_table(name), {}), tables)


def _tables_of_staying(group: Group, drop: Mapping[str, AbstractSet[str]]) -> AbstractSet[str] | None:
    """Return the tables, in lower case, to which executions that stay have written, perhaps no rows; None if all stay."""
    if not drop:
        return None
    paths = [segment.files["artifacts"] for segment in group if "artifacts" in segment.files]
    verify(paths)
    named = (output for part in _staying(paths, drop, (*drop, "output")) for output in part.column("output").to_pylist())
    return {output.lower() for output in named if output is not None}


def _write(
    target: Path, name: str, paths: Sequence[str], drop: Mapping[str, AbstractSet[str]], tables: AbstractSet[str] | None
) -> None:
    """Write the kept rows of several files into one file; write none if no row is kept.

    The file of an output without rows is kept for the executions that wrote it, see `_tables_of_staying`.
    """
    if name.startswith(OUTPUT):
        stays = tables is None or (table_of(name).lower() in tables and (is_first_part(name) or not any(map(rows_in, paths))))
        if len(paths) == 1 and (stays or rows_in(paths[0])) and not _any_dropped(paths[0], drop):
            write_whole_file(target, name, paths[0])
        else:
            _write_output(target, table_of(name), paths, drop.get("execution", frozenset()), even_empty=stays)
    elif len(paths) == 1 and not _any_dropped(paths[0], drop):
        write_whole_file(target, name, paths[0])
    elif name == "objects":
        _write_tables(target, _staying_objects(paths, drop.get("sha256", frozenset())), arrow_schema(name))
    else:
        schema = _schema(paths[0]) if name == "experiments" else arrow_schema(name)
        _write_tables(target, _staying(paths, drop), schema)


def write_whole_file(target: Path, name: str, path: str, copy_file: Callable[[str, str], object] = shutil.copyfile) -> None:
    """Copy a file of a segment. One of an output that does not name its table in itself is written again, so that it does."""
    if name.startswith(OUTPUT) and _own_table(path) != table_of(name):
        _write_output(target, table_of(name), [path], frozenset())
    else:
        copy_file(path, str(target))


def _own_table(path: str) -> str | None:
    with _readable(path):
        return own_table(pq.read_metadata(path))


def _any_dropped(path: str, drop: Mapping[str, AbstractSet[str]]) -> bool:
    if not drop:
        return False
    with _readable(path), pq.ParquetFile(path) as file:
        for batch in file.iter_batches(LINES, columns=list(drop)):
            for column, values in drop.items():
                if pc.any(_is_in(batch.column(column), values)).as_py():
                    return True
    return False


def _is_in(column: pa.Array, values: AbstractSet[str]) -> pa.BooleanArray:
    return pc.is_in(column, value_set=pa.array(sorted(values), pa.string()))


def _staying(
    paths: Sequence[str], drop: Mapping[str, AbstractSet[str]], columns: Sequence[str] | None = None
) -> Iterator[pa.Table]:
    """Yield the kept rows of tables of records, some rows at a time, with all columns or with these."""
    for path in paths:
        with _readable(path), pq.ParquetFile(path) as file:
            for batch in file.iter_batches(LINES, columns=columns):
                for column, values in drop.items():
                    batch = batch.filter(pc.invert(_is_in(batch.column(column), values)))
                if batch.num_rows:
                    yield pa.Table.from_batches([batch]).replace_schema_metadata(None)


def _staying_objects(paths: Sequence[str], drop: AbstractSet[str]) -> Iterator[pa.Table]:
    """Yield the kept objects, each once, in row groups of the usual size."""
    known: set[str] = set()
    held: list[pa.Table] = []
    for path in paths:
        mine: set[str] = set()
        with _readable(path), pq.ParquetFile(path) as file:
            for group in range(file.num_row_groups):
                table = file.read_row_group(group).cast(arrow_schema("objects"))
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


def _in_groups(table: pa.Table) -> Iterator[pa.Table]:
    """Yield the rows in row groups that are no larger than those of `sierra.store.objects`."""
    begin = held = 0
    for row, content in enumerate(table.column("content")):
        size = content.as_buffer().size
        if row > begin and (held + size > GROUP or row - begin >= ROWS):
            yield table.slice(begin, row - begin)
            begin, held = row, 0
        held += size
    yield table.slice(begin)


def _write_tables(target: Path, tables: Iterable[pa.Table], schema: pa.Schema) -> None:
    """Write tables; fill columns that they lack with NULL."""
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


def _write_output(
    target: Path, table: str, paths: Sequence[str], executions: AbstractSet[str], *, even_empty: bool = True
) -> None:
    """Write the kept rows of an output; if none is kept, write a file without rows if `even_empty`.

    DuckDB wrote them and rewrites them, because only DuckDB has all their types.
    """
    connection = connect()
    try:
        connection.register("gone", pa.table({"execution": pa.array(sorted(executions), pa.string())}))
        keep_order(connection)
        stays = f"SELECT o.* FROM {read_parquet(paths)} o ANTI JOIN gone g ON o.execution = g.execution"
        before = connection.execute(SUM.format(rows=stays)).fetchall()[0]
        kept = {written: rows for written, rows in _counted(paths).items() if written[0] not in executions}
        if before[0] or kept or even_empty:
            connection.execute(copy(stays, target, table))
            written = connection.execute(SUM.format(rows=f"SELECT * FROM {read_parquet([str(target)])}")).fetchall()[0]
            if written != before or _counted([str(target)]) != kept or not _schema(str(target)).equals(_schema(paths[0])):
                raise Damaged(f"{paths[0]}: its rows differ after they were written again; nothing was changed")
    except duckdb.IOException as error:
        raise Missing(f"cannot write {target}: {first_line(error)}") from error
    except duckdb.Error as error:
        check_shortage(error)
        raise Damaged(f"{paths[0]}: cannot be written again: {first_line(error)}") from error
    finally:
        connection.close()


def _counted(paths: Sequence[str]) -> Counter[Written]:
    """Return how many rows each execution, and each of its files, has in these Parquet files, counted without DuckDB."""
    return sum((rows_by_file(path) for path in paths), Counter[Written]())


SUM = "SELECT count(*), sum(hash(place, line))::VARCHAR FROM (SELECT row_number() OVER () AS place, t AS line FROM ({rows}) t)"
"""The query for a checksum over rows and their order."""


@contextlib.contextmanager
def _readable(path: str) -> Iterator[None]:
    """Turn pyarrow's errors about a damaged file into Damaged; raise write errors (OSError with an errno) unchanged."""
    try:
        yield
    except (pa.ArrowException, ValueError) as error:
        check_shortage(error)
        raise Damaged(f"{path}: cannot be read: {first_line(error)}; see sierra fsck") from error
    except OSError as error:
        if error.errno is None:
            check_shortage(error)
            raise Damaged(f"{path}: cannot be read: {first_line(error)}; see sierra fsck") from error
        raise


def out_of_use(paths: StorePaths) -> list[Segment]:
    """Return the segments that are ignored, and the segments that only replace segments which no longer exist.

    Call it only while no compaction is being published: within `sierra.execution.sessions.exclusively`.
    """
    unused = list(on_disk(paths.segments))
    hidden = out_of_date(unused)
    waited_for = {segment.after for segment in unused if segment.name not in hidden}
    return [
        segment
        for segment in unused
        if segment.name in hidden
        or (segment.replaces and not segment.files and segment.after is None and segment.name not in waited_for)
    ]


def tidy(paths: StorePaths, aside: Path) -> int:
    """Remove ignored segments if nobody reads; return how many. `aside` is a folder for them, in the same file system."""
    with alone(paths.reading) as nobody:
        if not nobody:
            return 0
        unused = out_of_use(paths)
        hidden = out_of_date(list(on_disk(paths.segments)))
        aside.mkdir(parents=True, exist_ok=True)
        if unused:  # first: whoever finds no such segment any more would leave their rows in an index
            index_files.remove_all(paths)
        for segment in sorted(unused, key=lambda segment: segment.name not in hidden):
            if segment.name not in hidden:  # replaced segments must be gone from the disk before this one
                sync(paths.segments)
            (paths.segments / segment.name).rename(aside / segment.name)
        if unused:
            sync(paths.segments)
    shutil.rmtree(aside, ignore_errors=True)
    return len(unused)
