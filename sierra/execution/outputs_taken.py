"""The outputs of a batch as they were read: its tables, and the files that became no table, with the reasons."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import NamedTuple

from sierra.config.output_tables import FILE_FORMAT, Output
from sierra.config.plugin_registry import READERS
from sierra.ingest.match_outputs import AUTOMATIC_AT_MOST, automatic_format, table_name, unnamed_format
from sierra.store.samples import names_time
from sierra.store.sql_names import column_names, identifier
from sierra.store.store import Snapshot, Store
from sierra.store.table_layout import TableLayout
from sierra.util.text import counted

OWN = ("run", "execution", "file")
NAMED = {
    "json": 'format = "json"',
    "xml": 'format = "xml", rows = "//ELEMENT"',
    "graphml": 'format = "graphml", rows = "edges"',
    **dict.fromkeys(("npy", "npz"), 'format = "npy"'),
    **dict.fromkeys(("arrow", "feather"), 'format = "arrow"'),
    **dict.fromkeys(("sqlite", "sqlite3", "db"), 'format = "sqlite", rows = "TABLE"'),
    **dict.fromkeys(("h5", "hdf5", "hdf"), 'format = "hdf5", rows = "/DATASET"'),
    **dict.fromkeys(("nc", "nc4", "cdf"), 'format = "netcdf", rows = "VARIABLE"'),
    **dict.fromkeys(("dat", "txt", "out"), 'format = "csv" and, for columns between blanks, delimiter = "blanks"'),
}
"""The keys that make tables of files with these endings, which no reader takes by itself."""
COMPRESSED = ("gz", "zst")


@dataclass(frozen=True, slots=True)
class TakenColumn:
    """One column of a table: its name and its type in SQL, and its unit if `sierra.toml` declares one."""

    name: str
    type: str
    unit: str | None = None


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

    @property
    def rows(self) -> str:
        """Return the number of rows of a run, in words."""
        return counted(self.most, "row") if self.least == self.most else f"{self.least} to {self.most} rows"


@dataclass(frozen=True, slots=True)
class UnreadFiles:
    """Files of a batch that became no table: an example, their number in all runs, and the reason."""

    path: str
    files: int
    why: str
    noted: bool
    """True if `sierra run` prints a note about such files in each session."""


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


class _Layout(NamedTuple):
    output: str
    table_layout: str
    path: str


class _Rows(NamedTuple):
    output: str
    runs: int
    least: int
    most: int


class _Unread(NamedTuple):
    path: str
    last: str
    files: int
    most: int


MINE = "CREATE OR REPLACE TEMP TABLE mine AS SELECT DISTINCT judgement FROM effective WHERE batch = $batch"
OWN_FILES = "CREATE OR REPLACE TEMP TABLE own AS SELECT a.* FROM all_artifacts a JOIN mine m ON a.execution = m.judgement"
COUNT = "SELECT count(*) FROM mine"
LAYOUTS = "SELECT output, table_layout, min(path) AS path FROM own WHERE kind = 'table' GROUP BY ALL ORDER BY ALL"
ROWS = """
SELECT output, count(*) AS runs, min(rows)::BIGINT AS least, max(rows)::BIGINT AS most FROM (
    SELECT output, execution, sum(rows) AS rows FROM own WHERE kind = 'table' GROUP BY ALL
) GROUP BY output
"""
UNREAD = """
SELECT min(path) AS path, max(last) AS last, sum(files)::BIGINT AS files, max(files) AS most FROM (
    SELECT regexp_replace(path, '[0-9]+', '0', 'g') AS alike, execution, min(path) AS path, max(path) AS last, count(*) AS files
    FROM own WHERE kind = 'file' GROUP BY ALL
) GROUP BY alike ORDER BY path LIMIT 1000
"""
"""The files that became no table; those whose names differ only in numbers are counted together."""
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


def taken(store: Store, batch: str, outputs: Mapping[str, Output]) -> TakenOutputs:
    """Return how the outputs of a batch's effective executions were read; `outputs` are the declared ones."""
    with store.snapshot(batch) as snapshot:
        snapshot.views.make(("effective", "all_artifacts"))
        snapshot.run(MINE, {"batch": batch})
        snapshot.run(OWN_FILES)
        [runs] = snapshot.values(int, COUNT)
        layouts: dict[str, list[_Layout]] = {}
        for row in snapshot.select(_Layout, LAYOUTS):
            layouts.setdefault(row.output, []).append(row)
        sizes = {row.output: row for row in snapshot.select(_Rows, ROWS)}
        tables = tuple(
            _table(snapshot, found, sizes[name], outputs.get(name), (outputs.get(name) or _undeclared(found)).kind)
            for name, found in sorted(layouts.items())
        )
        rows = snapshot.select(_Unread, UNREAD)
    names = {table.name.lower() for table in tables}
    return TakenOutputs(batch, runs, tables, tuple(_unread(row, outputs, names) for row in rows))


def is_new(store: Store, session: str) -> bool:
    """Check if this session recorded a table, a column, a kind of values or a kind of file that no earlier session has."""
    with store.snapshot() as snapshot:
        snapshot.views.make(("all_artifacts", "all_judgements"))
        mine, others = (_signs(snapshot.select(_Layout, LAYOUTS_BY_SESSION, session=session, own=own)) for own in (True, False))
        if not mine <= others:
            return True
        files, known = (set(snapshot.values(str, ENDINGS_BY_SESSION, session=session, own=own)) for own in (True, False))
    return not files <= known


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
    columns = tuple(_columns(snapshot, layouts, declared))
    first = columns[0] if columns else None
    named = first.name if first and names_time(first.name) and first.type != "VARCHAR" else ""
    return TakenTable(
        name=size.output,
        file=declared.file if declared else layouts[0].path,
        format=kind,
        columns=columns,
        runs=size.runs,
        least=size.least,
        most=size.most,
        time=(declared.time if declared else "") or named,
        units_row=bool(declared and declared.units_row),
        declared=declared is not None,
    )


def _columns(snapshot: Snapshot, layouts: Iterable[_Layout], declared: Output | None) -> Iterator[TakenColumn]:
    """Yield the columns of a table with their types in SQL."""
    layouts = list(layouts)
    name = layouts[0].output
    names = dict.fromkeys(column for row in layouts for column in TableLayout.load(row.table_layout).columns)
    if not names:
        return  # SQL has no table without columns
    snapshot.views.make((name,))
    described = {row[0]: row[1] for row in snapshot.run(f"DESCRIBE {identifier(name)}")}
    own = {stored: sql for stored, sql in snapshot.views.sql_names.get(name.lower(), {}).items() if stored not in OWN}
    units: Mapping[str, str] = declared.units if declared else {}
    original = dict(zip(column_names(list(names)), names, strict=True))
    for stored, sql in own.items():
        yield TakenColumn(original.get(stored, stored), described.get(sql, ""), units.get(original.get(stored, stored)))


def _unread(row: _Unread, outputs: Mapping[str, Output], tables: set[str]) -> UnreadFiles:
    why, noted = _why(row, outputs, tables)
    return UnreadFiles(row.path, row.files, why, noted)


def _why(row: _Unread, outputs: Mapping[str, Output], tables: set[str]) -> tuple[str, bool]:
    """Return why files are no table and what would make one, and whether each session notes it."""
    declared = next((name for name, output in outputs.items() if output.matches(row.path)), None)
    if declared is not None:
        ending = unnamed_format(outputs[declared])
        if ending is None:
            return f'kept as a file, as declared (format = "{FILE_FORMAT}")', False
        return (
            f"declared without a format; set {NAMED.get(ending, f'format = {json.dumps(ending)}')} in [outputs.{declared}]",
            True,
        )
    place = f"[outputs.{_free(row.path, tables)}] file = {json.dumps(pattern(row), ensure_ascii=False)}"
    path = PurePosixPath(row.path)
    if automatic_format(row.path):
        if "/" in row.path:
            return f"in a subfolder; declare {place}", True
        many = row.most > AUTOMATIC_AT_MOST or table_name(row.path).lower() not in tables
        return (
            f"{'too many such files in a run' if many else 'another file makes the table of that name'}; declare {place}",
            True,
        )
    ending = path.suffix.lower().removeprefix(".")
    if ending in COMPRESSED:
        inner = PurePosixPath(path.stem).suffix.lower().removeprefix(".")
        plain = automatic_format(path.stem)
        keys = f'format = "{plain}"' if plain else NAMED.get(inner, "")
        return (f"compressed; to make a table of it, declare {place}, {keys}" if keys else "no reader takes it"), False
    if ending in READERS.added():
        return f"the installed reader {ending!r} takes declared files only; declare {place}", False
    if ending in NAMED:
        return f"this ending is read only if its format is named; declare {place}, {NAMED[ending]}", False
    return f"no reader takes {'files without an ending' if not ending else f'.{ending} files'}", False


def pattern(row: _Unread) -> str:
    """Return the value of `file` for these files: a path, or a pattern if a run has several."""
    if row.most < 2:
        return row.path
    first, last = (re.split("([0-9]+)", path) for path in (row.path, row.last))
    varying = [place for place, (one, other) in enumerate(zip(first, last, strict=True)) if one != other]
    stars = ("{tick}",) if len(varying) == 1 else tuple(f"{{tick{number}}}" for number in range(1, len(varying) + 1))
    for place, star in zip(varying, stars, strict=True):
        first[place] = star
    return "".join(first)


def _free(path: str, tables: set[str]) -> str:
    """Return a name for the table of a file that no other table has."""
    name = re.sub("_*[0-9]+$", "", table_name(path)) or table_name(path)
    return next(
        one for number in range(1, len(tables) + 3) if (one := name + f"_{number}" * (number > 1)).lower() not in tables
    )


def proposed(found: TakenOutputs) -> dict[str, dict[str, str | bool]]:
    """Return the keys of `[outputs.NAME]` for each table that is not declared. They give the same tables as without them."""
    return {
        table.name: {"file": table.file} | ({} if table.runs == found.runs else {"required": False})
        for table in found.tables
        if not table.declared
    }
