"""Building an index: the records of segments, copied into one DuckDB file (see `sierra.store.index_files`).

    segments(seg, name, ignored, replaces, after)   the segments, by number; those that are ignored have no rows
    replaced(name)                                  the segments that these replace
    TABLE(seg, …)                                   the rows of a table of records; of `objects`, all columns but the contents
    TABLE(file_number, …)                           the same for tables of which many segments have equal files, once for each
    equal_files(file_number, sha256), equal_file_of(seg, file_number)   these files, and the segments that have them
    stored_<name>                                   results of the rows above: `effective`, `points`, `runs`, `counted`
    experiments_<n>(…), experiment_sets              the rows of `experiments` with equal columns, and these columns
    outputs(seg, output, file, columns)             the files of outputs
    column_sets(number, columns)                    the types of their columns
    answers(seg, output, file, question, value)     values of SQL expressions over files whose columns differ from others'

Each file is verified before it is read, so that an index never has rows of a damaged one: a segment with such a file stays out
of the index, and whoever reads it finds the damage. An index is built by adding the new segments to a copy of the last one, or
from nothing when it has become twice as large since it was, or names a segment that is gone.

A builder holds the lock of readers from the moment when it lists the segments until its index has its name, and whoever
removes segments takes that lock alone and removes each index. So no index has rows that have been removed.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import partial
from pathlib import Path

import duckdb

from sierra.errors import Damaged, SierraError
from sierra.store import index_files
from sierra.store.connections import connect
from sierra.store.duckdb_file_io import read_parquet, steady
from sierra.store.duckdb_messages import first_line
from sierra.store.index_reader import DATABASE, EQUAL, EXPERIMENTS, OWN, STORED, Index, read_facts
from sierra.store.layout import StorePaths
from sierra.store.listing import Listing
from sierra.store.read_lock import Shared
from sierra.store.schema import RECORDED
from sierra.store.segments import Segment, marked, names_in, out_of_date
from sierra.store.sql_names import identifier, quote
from sierra.store.sql_result import RawRow
from sierra.store.union_files import read_columns, relation
from sierra.store.verified_files import are_sound, recorded_hashes
from sierra.store.views import Views, records, segment_of
from sierra.util.scratch import scratch

WORTH = 30
"""The number of segments that are not in an index from which a process that has recorded some builds one."""
TIMES = 10
"""The same for a large index, as a multiple."""
LONG = 1000
"""The number of segments from which a user who waits is told what for."""
KEPT = 2
"""The number of indexes that are kept: readers may be about to open the last one."""
MEMORY = "1GB"
"""The memory that DuckDB may use before it writes to the disk."""
FILES = 100
"""The number of files whose rows are in memory at a time."""
STORAGE = "v1.5.0"
"""The version of DuckDB's file format. By default, DuckDB writes one that no other version reads."""
BLOCK = 16_384
"""The size of blocks, the smallest that DuckDB has: each of some 400 columns takes part of one."""
TABLES = {
    "segments": "seg INTEGER, name VARCHAR, ignored BOOLEAN, replaces BOOLEAN, after VARCHAR",
    "replaced": "name VARCHAR",
    "outputs": "seg INTEGER, output VARCHAR, file VARCHAR, columns INTEGER",
    "column_sets": "number INTEGER, columns VARCHAR",
    "answers": "seg INTEGER, output VARCHAR, file VARCHAR, question VARCHAR, value INTEGER",
    "equal_files": "file_number INTEGER, sha256 VARCHAR",
    "equal_file_of": "seg INTEGER, file_number INTEGER",
    "experiment_sets": "number INTEGER, columns VARCHAR",
    "base": "segments INTEGER",
}


def keep_up(paths: StorePaths, worth: int | None = None) -> None:
    """Build an index if so many segments are in none (by default, `WORTH`), and if the store is this user's and has executed
    something.

    A large index, which takes longer to build, waits for more segments. For lack of something, such as space on the disk, do
    nothing: whoever calls this has done its work.
    """
    worth = WORTH if worth is None else worth
    with contextlib.suppress(OSError, MemoryError, SierraError):
        if paths.identity.exists() and paths.root.stat().st_uid == os.geteuid() and os.access(paths.root, os.W_OK):
            best = index_files.best(paths)
            large = best is not None and best.path.stat().st_size > index_files.IN_MEMORY
            try:
                build(paths, worth * TIMES if large else worth)
            except duckdb.Error as error:
                if index_files.announce:
                    index_files.announce(f"no index could be built, so commands look at each segment: {first_line(error)}")


def build(paths: StorePaths, worth: int = 1) -> Path | None:
    """Build an index if at least so many segments are in none, and return it. Raises OSError and duckdb.Error."""
    shared = Shared(paths.reading)
    try:
        best = index_files.best(paths)
        present, indexed = len(names_in(paths.segments)), index_files.segments_of(best.path) if best else 0
        new = present - (indexed if indexed <= present else 0)
        if new < worth:
            return None
        if new >= LONG and index_files.announce:
            index_files.announce(f"building an index of {new} segments, so that commands need not look at each of them again")
        with (
            scratch(Path(tempfile.gettempdir()), index_files.PREFIX) as folder,
            _Building(paths, folder / "index", best) as building,
        ):
            if not building.add(worth):
                return None
            path = index_files.publish(paths, len(building.names), building.finish())
            if best is not None and not building.goes_on:
                index_files.remove(best.path)  # it may have rows of segments that are gone
            if not building.names <= set(names_in(paths.segments)):  # without locks, somebody may have removed some meanwhile
                index_files.remove(path)
                return None
        for old in index_files.published(paths.index)[KEPT:]:
            index_files.remove(old)
        return path
    finally:
        shared.close()


class _Building:
    """A context manager for an index that is being built."""

    def __init__(self, paths: StorePaths, path: Path, best: index_files.IndexFile | None) -> None:
        self._folder = paths.segments
        self._path = path
        self._connection = connect()
        self._connection.execute("SET threads = 1")  # with more, small files take up to twice the time of the processor
        self._connection.execute(f"SET memory_limit = '{MEMORY}'")
        names = names_in(self._folder)
        self.goes_on = best is not None and self._goes_on(best, set(names))
        if not self.goes_on:
            self._begin(len(names))
        self.names: set[str] = set()
        """The segments that the index names."""

    def __enter__(self) -> _Building:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def _fetch(self, statement: str) -> list[RawRow]:
        return self._connection.execute(statement).fetchall()

    def _named(self) -> dict[str, int]:
        return dict(self._fetch(f"SELECT name, seg FROM {DATABASE}.segments"))

    def _attach(self, path: Path, options: str = "") -> None:
        file = quote(steady(str(path)))
        self._connection.execute(f"ATTACH {file} AS {DATABASE} (TYPE duckdb, STORAGE_VERSION '{STORAGE}'{options})")

    def _goes_on(self, best: index_files.IndexFile, names: AbstractSet[str]) -> bool:
        """Begin with a copy of an index, if all its segments exist and it is not too old: a copy keeps freed bytes."""
        shutil.copyfile(best.readable, self._path)
        self._attach(self._path)
        [(base,)] = self._fetch(f"SELECT segments FROM {DATABASE}.base")
        facts = read_facts(self._fetch)
        if len(names) < 2 * base and facts.numbers.keys() <= names and facts.are_sure(names):
            return True
        self._connection.execute(f"DETACH {DATABASE}")
        self._path.unlink()
        return False

    def _begin(self, segments: int) -> None:
        """Begin an index without segments."""
        self._attach(self._path, f", BLOCK_SIZE {BLOCK}")
        for table, columns in TABLES.items():
            self._connection.execute(f"CREATE TABLE {DATABASE}.{table} ({columns})")
        for table, recorded in RECORDED.items():
            if table != EXPERIMENTS:
                kept = [column for column in recorded.columns if column.type != "BLOB"]
                columns = ", ".join(f"{identifier(column.name)} {column.type}" for column in kept)
                key = "file_number" if table in EQUAL else "seg"
                self._connection.execute(f"CREATE TABLE {DATABASE}.{table} ({key} INTEGER NOT NULL, {columns})")
        self._connection.execute(f"INSERT INTO {DATABASE}.base VALUES ({segments})")

    def add(self, worth: int) -> bool:
        """Add the segments that the index does not name. Return False if there are not so many.

        One that is not sound, or that only such a one replaces, is not added: whoever reads the index looks at it.
        """
        known = self._named()
        names = names_in(self._folder)
        new = [name for name in names if name not in known]
        if len(new) < worth:
            return False
        files = [file for file in marked(self._folder, new) if not file.missing and (file.after is None or file.after in names)]
        whole = [file for file in files if _is_sound(file)]
        sure = known.keys() | {file.name for file in whole}
        whole = [file for file in whole if file.after is None or file.after in sure]
        hidden = out_of_date(whole, set(names).difference(new))
        replaced = {name for file in whole if file.name not in hidden for name in file.replaces}
        ignored = hidden | replaced | {name for (name,) in self._fetch(f"SELECT name FROM {DATABASE}.replaced")}
        sound = {file.name for file in whole}
        added = [*whole, *(file for file in files if file.name in ignored - sound)]
        self._connection.execute("BEGIN")
        self._drop([known[name] for name in known.keys() & ignored])
        first = max(known.values(), default=0) + 1
        numbers = {file.name: first + number for number, file in enumerate(added)}
        self._insert(
            "segments",
            ((numbers[file.name], file.name, file.name in ignored, bool(file.replaces), file.after) for file in added),
        )
        self._insert("replaced", ((name,) for name in sorted(replaced)))
        self._add_rows([file for file in added if file.name not in ignored], numbers)
        self._connection.execute("COMMIT")
        self._store_results()
        self._store_answers()
        self.names = {*known, *numbers}
        return bool(added)

    def _index(self) -> tuple[Listing, Index]:
        """Return the index as a reader finds it, but without stored results, and without segments beside it."""
        listing = Listing([self._folder], segments=[])
        return listing, Index(self._fetch, listing, read_facts(self._fetch)._replace(stored=frozenset()))

    def _store_results(self) -> None:
        """Compute which executions are effective, and what else takes long in a store with very many runs."""
        listing, index = self._index()
        for name, query in Views(lambda: self._connection, listing, index=index).results():
            self._connection.execute(f"CREATE OR REPLACE TABLE {DATABASE}.{STORED}{name} AS {query}")

    def _store_answers(self) -> None:
        """Store what a reader asks of outputs whose columns differ between files, so that it need not look into these."""
        _, index = self._index()
        for name in {name.lower() for name in index.spellings()}:
            columns = {file.path: file.columns for file in index.outputs(name)}
            if len({tuple(each.items()) for each in columns.values()}) > 1:
                with contextlib.suppress(Damaged):  # whoever reads this output is told
                    relation(self._fetch, list(columns), known=columns, answers=partial(self._answers, index, name))

    def _answers(self, index: Index, output: str, files: Sequence[str], question: str) -> Mapping[str, int]:
        """Return the values of an SQL expression over some of these files; store those that the index does not have yet.

        Files with rows of another segment's executions are left out.
        """
        known = index.answers(output, question)
        new = [file for file in files if file not in known]
        if new:
            source = read_parquet(new, union=True, filename=True, check=False)
            own = f"bool_and((split_part(filename, '/', -2), execution) IN (FROM ({index.judgements()})))"
            fetched = self._fetch(
                f"SELECT filename, coalesce({question}, 0)::INTEGER FROM {source} GROUP BY filename HAVING {own}"
            )
            known |= dict(fetched)
            numbers = self._named()
            rows = ((numbers[segment_of(file)], output, Path(file).name, question, value) for file, value in fetched)
            self._insert("answers", rows)
        return {file: known[file] for file in files if file in known}

    def _drop(self, ignored: Sequence[int]) -> None:
        """Remove the rows of segments that have been replaced since they were added."""
        if not ignored:
            return
        numbers = ", ".join(map(str, ignored))
        tables = self._fetch(
            f"SELECT table_name, column_name FROM duckdb_columns() WHERE database_name = '{DATABASE}' AND column_index = 1"
        )
        for table, key in tables:
            if table != "segments" and identifier(key) in (identifier("seg"), OWN):
                self._connection.execute(f"DELETE FROM {DATABASE}.{table} WHERE {identifier(key)} IN ({numbers})")
        self._connection.execute(f"UPDATE {DATABASE}.segments SET ignored = true WHERE seg IN ({numbers})")
        for table in ("equal_files", *EQUAL):
            used = f"SELECT file_number FROM {DATABASE}.equal_file_of"
            self._connection.execute(f"DELETE FROM {DATABASE}.{table} WHERE file_number NOT IN ({used})")

    def _insert(self, table: str, rows: Iterable[tuple[object, ...]]) -> None:
        columns = [list(column) for column in zip(*rows, strict=True)]
        if columns:
            values = ", ".join("unnest(?)" for _ in columns)
            self._connection.execute(f"INSERT INTO {DATABASE}.{table} SELECT {values}", columns)

    def _add_rows(self, segments: Sequence[Segment], numbers: Mapping[str, int]) -> None:
        files: dict[str, list[str]] = {}
        for segment in segments:
            for name, path in segment.files.items():
                files.setdefault(name, []).append(path)
        new = self._add_equal([path for name in EQUAL for path in files.get(name, ())], numbers)
        for name in EQUAL:
            if theirs := {path: new[path] for path in files.pop(name, ()) if path in new}:
                self._copy_rows(name, theirs)
        for name, paths in files.items():
            own = {path: numbers[segment_of(path)] for path in paths}
            if name == EXPERIMENTS:
                self._add_experiments(own)
            elif name in RECORDED:
                self._copy_rows(name, own)
        self._add_outputs(segments, numbers)

    def _add_equal(self, paths: Sequence[str], numbers: Mapping[str, int]) -> dict[str, int]:
        """Note which segments have equal files. Return the files whose rows the index does not have yet, with their numbers."""
        known = {digest: number for number, digest in self._fetch(f"FROM {DATABASE}.equal_files")}
        hashes = {segment: recorded_hashes(self._folder / segment) for segment in {*map(segment_of, paths)}}
        first = max(known.values(), default=0) + 1
        new: dict[str, int] = {}
        links: list[tuple[object, ...]] = []
        for path in paths:
            digest = hashes[segment_of(path)][Path(path).name]
            if digest not in known:
                known[digest] = new[path] = first + len(new)
            links.append((numbers[segment_of(path)], known[digest]))
        self._insert("equal_files", [(number, digest) for digest, number in known.items() if number >= first])
        self._insert("equal_file_of", links)
        return new

    def _copy_rows(self, table: str, numbers: Mapping[str, int]) -> None:
        """Add the rows of files of a table, each with the number of its file."""
        kept = ", ".join(f"f.{identifier(column.name)}" for column in RECORDED[table].columns if column.type != "BLOB")
        files = list(numbers)
        for begin in range(0, len(files), FILES):
            part = files[begin : begin + FILES]
            rows = self._numbered(records(table, part, filename=True, check=False), {file: numbers[file] for file in part})
            self._connection.execute(f"INSERT INTO {DATABASE}.{table} SELECT n.number, {kept} FROM {rows}")

    def _numbered(self, source: str, numbers: Mapping[str, int]) -> str:
        """Return the relation of the rows of files with the numbers of these, n.number, in this order.

        A row whose file has no number would be lost; it is refused, because tables have no rows without a number.
        """
        self._connection.execute("CREATE OR REPLACE TEMP TABLE numbers (file VARCHAR, number INTEGER)")
        self._connection.execute("INSERT INTO numbers SELECT unnest(?), unnest(?)", [list(numbers), list(numbers.values())])
        return f"{source} f LEFT JOIN numbers n ON n.file = f.filename ORDER BY n.number"

    def _add_experiments(self, numbers: Mapping[str, int]) -> None:
        """Add the rows of `experiments`, those with equal columns to one table."""
        sets = {columns: number for number, columns in self._fetch(f"FROM {DATABASE}.experiment_sets")}
        for files, types in read_columns(self._fetch, list(numbers)):
            columns = json.dumps(list(types.items()))
            if columns not in sets:
                sets[columns] = len(sets) + 1
                self._insert("experiment_sets", [(sets[columns], columns)])
            table = f"{DATABASE}.{EXPERIMENTS}_{sets[columns]}"
            if "filename" in map(str.lower, types):  # an axis, beside which DuckDB adds no paths of files
                every = [f"SELECT {numbers[file]} AS {OWN}, * FROM {read_parquet([file], check=False)}" for file in files]
            else:
                source = read_parquet(files, filename=True, check=False)
                numbered = self._numbered(source, {file: numbers[file] for file in files})
                every = [f"SELECT n.number AS {OWN}, f.* EXCLUDE filename FROM {numbered}"]
            self._connection.execute(f"CREATE TABLE IF NOT EXISTS {table} AS {every[0]} LIMIT 0")
            self._connection.execute(f"ALTER TABLE {table} ALTER COLUMN {OWN} SET NOT NULL")
            for rows in every:
                self._connection.execute(f"INSERT INTO {table} {rows}")

    def _add_outputs(self, segments: Iterable[Segment], numbers: Mapping[str, int]) -> None:
        sets = {columns: number for number, columns in self._fetch(f"FROM {DATABASE}.column_sets")}
        known = len(sets)
        found = {path: (numbers[one.name], output) for one in segments for output, path in one.outputs()}
        rows: list[tuple[object, ...]] = []
        for files, types in read_columns(self._fetch, list(found)):
            number = sets.setdefault(json.dumps(list(types.items())), len(sets) + 1)
            rows += ((*found[path], Path(path).name, number) for path in files)
        self._insert("column_sets", [(number, columns) for columns, number in sets.items() if number > known])
        self._insert("outputs", rows)

    def finish(self) -> Path:
        """Write the index to its file, and return this."""
        self._connection.execute(f"DETACH {DATABASE}")
        return self._path


def _is_sound(segment: Segment) -> bool:
    """Check each file of a segment against what was recorded."""
    return are_sound([*segment.files.values(), *segment.marks])
