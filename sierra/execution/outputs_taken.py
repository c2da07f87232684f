"""The outputs of a batch as they were read: its tables, and the files that became no table, with the reasons."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from sierra.config.output_tables import FILE_FORMAT, Key, Keys, Output, with_rotation
from sierra.errors import SierraError
from sierra.execution.unread_files import NUMBER, Alike, UnreadFiles, most_searched, unread_files
from sierra.ingest import open_names, robot_files, text_headers
from sierra.store.batch_data import ON_ROBOTS
from sierra.store.sql_names import column_names, identifier, stored_names
from sierra.store.sql_result import NUMBER as NUMBER_TYPE
from sierra.store.store import Snapshot, Store
from sierra.store.table_layout import TableLayout
from sierra.store.time_axis import names_time
from sierra.store.type_inference import DURATION
from sierra.util.lazy_definitions import dataclass, field, replace
from sierra.util.text import counted

OWN = ("run", "execution", "file")
ONLY_0_AND_1 = "min({column}) = 0 AND max({column}) = 1 AND coalesce(bool_and({column} IN (0, 1)), false)"
"""True if a column has only the numbers 0 and 1, and both of them."""
RATES = "SELECT {tests} FROM {table} WHERE execution IN (FROM mine)"


@dataclass(frozen=True, slots=True)
class TakenColumn:
    """One column of a table: its name and its type in SQL, and its unit if `sierra.toml` declares one.

    The name differs from that in the file if SQL or the store needs it for something else: `v` and `V` are `v_lower` and
    `V_upper`.
    """

    name: str
    type: str
    unit: str | None = None
    original: str | None = None
    """The name in the file, if it is another one."""


NO_COLUMN = TakenColumn("", "")


@dataclass(frozen=True, slots=True)
class TakenTable:
    """One table of a batch."""

    name: str
    file: str
    """The path of its file, or the declared pattern."""
    format: str
    columns: tuple[TakenColumn, ...]
    runs: int
    """The number of runs that wrote it."""
    least: int
    most: int
    """The smallest and the largest number of rows of a run."""
    time: str
    """The column that is the time axis by its declaration or its name; empty if there is none."""
    units_row: bool
    """True if a line with units follows the column names."""
    declared: bool
    rates: tuple[str, ...] = ()
    """The columns, as the file names them, that are 0 in some runs and 1 in others, if each run has one row."""
    keys: Keys = field(default_factory=dict)
    """The keys of `[outputs.NAME]` that read an undeclared file that is no plain CSV; empty for others."""

    @property
    def rows(self) -> str:
        """Return the number of rows of a run, in words."""
        return counted(self.most, "row") if self.least == self.most else f"{self.least} to {self.most} rows"


@dataclass(frozen=True, slots=True)
class TakenOutputs:
    """The tables of a batch, and the files that became no table."""

    batch: str
    runs: int
    """The number of runs with an effective execution."""
    tables: tuple[TakenTable, ...]
    unread: tuple[UnreadFiles, ...]
    target: str | None = None
    """The target that the batch was requested for."""
    all_failed: bool = False
    """True if no run was successful: then these are the runs whose tables could not be read."""


class _Layout(NamedTuple):
    output: str
    table_layout: str
    path: str


class _Unread(NamedTuple):
    path: str
    files: int
    most: int
    runs: int
    sha256: str
    size: int


class _Content(NamedTuple):
    output: str
    path: str
    sha256: str
    size: int


class _Rows(NamedTuple):
    output: str
    runs: int
    least: int
    most: int


MINE = "CREATE OR REPLACE TEMP TABLE mine AS SELECT DISTINCT judgement FROM effective WHERE batch = $batch"
OWN_FILES = "CREATE OR REPLACE TEMP TABLE own AS SELECT a.* FROM all_artifacts a JOIN mine m ON a.execution = m.judgement"
OWN_FILES_OF_ROBOTS = """
CREATE OR REPLACE TEMP TABLE own AS
SELECT * FROM (
    SELECT a.* REPLACE (regexp_replace(a.path, '^[1-9][0-9]*/', '') AS path)
    FROM all_artifacts a JOIN mine m ON a.execution = m.judgement
) QUALIFY kind = 'table' OR row_number() OVER (PARTITION BY execution, path) = 1
"""
"""The files with the names that they have in the folder of each robot, as `[outputs]` declares them; a file that several robots
wrote is there once, unless it is a part of a table. Those of the base station keep their folder.
"""
MINE_UNREAD = """
CREATE OR REPLACE TEMP TABLE mine AS SELECT arg_max(judgement, lamport) AS judgement FROM all_judgements
WHERE purpose = 'run' AND status = 'mismatch' AND run IN (SELECT run FROM batch_runs WHERE batch = $batch) GROUP BY run
"""
"""The executions whose tables could not be read, which are listed if no run was successful."""
COUNT = "SELECT count(*) FROM mine"
LAYOUTS = """
SELECT output, table_layout, arg_min(path, (starts_with(path, '0/'), path)) AS path
FROM own WHERE kind = 'table' GROUP BY ALL ORDER BY ALL
"""
ROWS = """
SELECT output, count(*) AS runs, min(rows)::BIGINT AS least, max(rows)::BIGINT AS most FROM (
    SELECT output, execution, sum(rows) AS rows FROM own WHERE kind = 'table' GROUP BY ALL
) GROUP BY output
"""
CONTENTS = """
SELECT output, min(path) AS path, arg_min(sha256, path) AS sha256, arg_min(size, path) AS size
FROM own WHERE kind = 'table' GROUP BY output
"""
UNREAD = """
SELECT min(path) AS path, sum(files)::BIGINT AS files, max(files) AS most, count(*) AS runs,
       arg_min(sha256, path) AS sha256, arg_min(size, path) AS size FROM (
    SELECT regexp_replace(path, '[0-9]+', '0', 'g') AS alike, execution, min(path) AS path, count(*) AS files,
           arg_min(sha256, path) AS sha256, arg_min(size, path) AS size
    FROM own WHERE kind = 'file' GROUP BY ALL
) GROUP BY alike ORDER BY path LIMIT 1000
"""
"""The files that became no table; those whose names differ only in numbers are counted together."""
VARYING = """
SELECT alike, place FROM (
    SELECT regexp_replace(path, '[0-9]+', '0', 'g') AS alike, unnest(regexp_extract_all(path, '[0-9]+')) AS number,
           generate_subscripts(regexp_extract_all(path, '[0-9]+'), 1) AS place
    FROM own WHERE kind = 'file'
) GROUP BY ALL HAVING count(DISTINCT number) > 1
"""
"""The places of the numbers that differ in the names of such files; the first place is 1."""
LAYOUTS_BY_SESSION = """
SELECT DISTINCT a.output, a.table_layout, '' AS path
FROM all_artifacts a JOIN all_judgements e ON e.judgement = a.execution AND e.purpose = 'run'
WHERE a.kind = 'table' AND (e.session = $session) = $own
"""
ENDINGS_BY_SESSION = """
SELECT DISTINCT regexp_extract(regexp_replace(a.path, '[0-9]+', '0', 'g'), '[^/]*$')
FROM all_artifacts a JOIN all_judgements e ON e.judgement = a.execution AND e.purpose = 'run'
WHERE a.kind = 'file' AND (e.session = $session) = $own
"""


def _format(output: Output) -> str:
    """Return the format of a table in one word."""
    return "lines" if output.lines else output.kind


def taken(store: Store, batch: str, outputs: Mapping[str, Output], *, inside: bool) -> TakenOutputs:
    """Return how the outputs of a batch's effective executions were read; `outputs` are the declared ones.

    `inside`: look into files of tables for keys that read them better.
    """
    with store.snapshot(batch) as snapshot:
        snapshot.views.make(("effective", "all_artifacts", "all_judgements", "batch_runs", "batches", "specs"))
        snapshot.run(MINE, {"batch": batch})
        if failed := not snapshot.values(int, COUNT)[0]:
            snapshot.run(MINE_UNREAD, {"batch": batch})
        on_robots = bool(snapshot.run(ON_ROBOTS, {"b": batch}))
        snapshot.run(OWN_FILES_OF_ROBOTS if on_robots else OWN_FILES)
        [runs] = snapshot.values(int, COUNT)
        layouts: dict[str, list[_Layout]] = {}
        for row in snapshot.select(_Layout, LAYOUTS) if not failed else ():
            layouts.setdefault(row.output, []).append(row)
        sizes = {row.output: row for row in snapshot.select(_Rows, ROWS)}
        tables = tuple(
            _table(snapshot, columns, sizes[name], outputs.get(name), _format(outputs.get(name) or _undeclared(columns)))
            for name, columns in sorted(layouts.items())
        )
        contents = {row.output: row for row in snapshot.select(_Content, CONTENTS)}
        rows = snapshot.select(_Unread, UNREAD)
        places: dict[str, set[int]] = {}
        for alike, position in snapshot.run(VARYING) if any(row.files > 1 for row in rows) else ():
            places.setdefault(alike, set()).add(position)
    tables = tuple(
        replace(table, keys=_keys(store, contents[table.name])) if inside and _is_undeclared_csv(table) else table
        for table in tables
    )
    kinds = [
        Alike(
            row.path,
            row.files,
            row.most,
            row.runs,
            places.get(NUMBER.sub("0", row.path), ()),
            partial(_content, store, row.sha256 if row.size <= most_searched(row.path) else None),
        )
        for row in rows
    ]
    unread = unread_files(kinds, outputs, [table.name for table in tables], runs)
    return TakenOutputs(batch, runs, tables, unread, all_failed=failed and runs > 0)


def _is_undeclared_csv(table: TakenTable) -> bool:
    return table.format == "csv" and not table.declared


def _keys(store: Store, row: _Content) -> Keys:
    """Return the keys that read a file that is no plain CSV, as one file shows."""
    content = _content(store, row.sha256 if row.size <= most_searched(row.path) else None)
    return text_headers.better_keys_of(content) if content else {}


def _content(store: Store, sha256: str | None) -> bytes | None:
    try:
        return store.object(sha256) if sha256 else None
    except SierraError:  # the store does not have it any more
        return None


def is_new(store: Store, session: str) -> bool:
    """Check if this session recorded a table, a column, a kind of values or a kind of file that no earlier session has."""
    with store.snapshot() as snapshot:
        mine = _signs(snapshot.select(_Layout, LAYOUTS_BY_SESSION, session=session, own=True))
        if mine and not mine <= _signs(snapshot.select(_Layout, LAYOUTS_BY_SESSION, session=session, own=False)):
            return True
        files = set(snapshot.values(str, ENDINGS_BY_SESSION, session=session, own=True))
        return bool(files) and not files <= set(snapshot.values(str, ENDINGS_BY_SESSION, session=session, own=False))


def _signs(layouts: Iterable[_Layout]) -> set[tuple[str, ...]]:
    """Return what these tables have: their names, and their columns with the kinds of values."""
    found: set[tuple[str, ...]] = set()
    for row in layouts:
        columns = TableLayout.load(row.table_layout).columns.items()
        found |= {(row.output,), *((row.output, name, kind) for name, kind in columns if kind != "empty")}
    return found


def _undeclared(layouts: Iterable[_Layout]) -> Output:
    return Output(file=next(iter(layouts)).path)


def _table(snapshot: Snapshot, layouts: list[_Layout], size: _Rows, declared: Output | None, kind: str) -> TakenTable:
    columns = list(_columns(snapshot, layouts, declared))
    several = TableLayout.load(layouts[0].table_layout).file is None  # its first column may be the place of a robot
    first, column = next((pair for pair in columns if not (several and pair[0] == robot_files.COLUMN)), ("", NO_COLUMN))
    named = first if names_time(first) and column.type != "VARCHAR" else ""
    time = (declared.time if declared else "") or named
    return TakenTable(
        name=size.output,
        file=declared.file if declared else layouts[0].path,
        format=kind,
        columns=tuple(column for _, column in columns),
        runs=size.runs,
        least=size.least,
        most=size.most,
        time=next((column.name for original, column in columns if original == time), time),
        units_row=bool(declared and declared.units_row),
        declared=declared is not None,
        rates=tuple(_rates(snapshot, size, columns)),
    )


def _rates(snapshot: Snapshot, size: _Rows, columns: Sequence[tuple[str, TakenColumn]]) -> Iterator[str]:
    """Yield the columns whose only numbers are 0 and 1, if each run has one row."""
    stored = stored_names([original for original, _ in columns])
    numbers = [
        (original, column.name)
        for (original, column), name in zip(columns, stored, strict=True)
        if original == name and re.fullmatch(NUMBER_TYPE, column.type)
    ]
    if size.runs < 2 or (size.least, size.most) != (1, 1) or not numbers:
        return
    tests = ", ".join(ONLY_0_AND_1.format(column=identifier(name)) for _, name in numbers)
    [are_rates] = snapshot.run(RATES.format(tests=tests, table=identifier(size.output)))
    yield from (original for (original, _), is_rate in zip(numbers, are_rates, strict=True) if is_rate)


def _columns(snapshot: Snapshot, layouts: Iterable[_Layout], declared: Output | None) -> Iterator[tuple[str, TakenColumn]]:
    """Yield the columns of a table with the names that they have in its file."""
    layouts = list(layouts)
    name = layouts[0].output
    names = dict.fromkeys(column for row in layouts for column in TableLayout.load(row.table_layout).columns)
    if not names:
        return  # SQL has no table without columns
    snapshot.views.make((name,))
    described = {row[0]: row[1] for row in snapshot.run(f"DESCRIBE {identifier(name)}")}
    own = {stored: sql for stored, sql in snapshot.views.sql_names.get(name.lower(), {}).items() if stored not in OWN}
    units = {**(declared.units if declared else {}), **{column: "ns" for row in layouts for column in _durations(row)}}
    originals: dict[str, str] = {}
    for naming in (column_names, stored_names):  # the first one for records of earlier versions
        for row in layouts:
            columns = list(TableLayout.load(row.table_layout).columns)
            originals |= zip(naming(columns), columns, strict=True)
    for stored, sql in own.items():
        original = originals.get(stored, stored)
        yield original, TakenColumn(sql, described.get(sql, ""), units.get(original), original if original != sql else None)


def _durations(row: _Layout) -> Iterator[str]:
    """Yield the columns of durations, which are recorded in nanoseconds."""
    yield from (name for name, kind in TableLayout.load(row.table_layout).columns.items() if kind == DURATION)


def proposed(outputs: TakenOutputs) -> dict[str, dict[str, Key]]:
    """Return the keys of `[outputs.NAME]` for each table that is not declared, and for files that they make tables of.

    The tables that exist stay the same, except those of files that are no plain CSV, and those of several files: if each run
    has a date in its file's name, or each robot has a file, these become one table. Tables of declarations that were removed
    are left out: their keys are not known.
    """
    tables: dict[str, dict[str, Key]] = {}
    for name, (file, same) in _undeclared_tables(outputs).items():
        rates = [column for column in same[0].rates if all(column in table.rates for table in same)]
        tables[name] = {"file": with_rotation(file, (unread_file.path for unread_file in outputs.unread))}
        tables[name] |= same[0].keys
        tables[name] |= {} if sum(table.runs for table in same) >= outputs.runs else {"required": False}
        tables[name] |= {"rates": rates} if rates else {}
    return tables | {unread_file.name: dict(unread_file.keys) for unread_file in outputs.unread if unread_file.keys}


def _undeclared_tables(outputs: TakenOutputs) -> dict[str, tuple[str, list[TakenTable]]]:
    """Return the tables that are not declared, by the name that they get: the file or its pattern, and what became tables."""
    names: dict[str, tuple[str, list[TakenTable]]] = {}
    taken = {table.name for table in outputs.tables}
    undeclared = [table for table in outputs.tables if not table.declared and table.format != FILE_FORMAT]
    of_robots = open_names.of_robots(
        {table.file: [column.original or column.name for column in table.columns] for table in undeclared}
    )
    for table in undeclared:
        pattern = of_robots.get(table.file) or open_names.with_date(table.file)
        name = open_names.name_of(pattern) if pattern else table.name
        if pattern and (name in taken or names.get(name, (pattern,))[0] != pattern):
            name, pattern = table.name, None
        names.setdefault(name, (pattern or table.file, []))[1].append(table)
    return names


def comments(found: TakenOutputs) -> dict[str, str]:
    """Return what is known about each of these outputs, in words."""
    tables = {
        name: f"{same[0].rows}; {', '.join(f'{column.name} {column.type}' for column in same[0].columns)}"
        for name, (_, same) in _undeclared_tables(found).items()
    }
    return tables | {
        one.name: f"{counted(one.files, 'file')} in {counted(found.runs, 'run')}" for one in found.unread if one.keys
    }
