"""The result of one statement over the tables of several batches, each with a column `batch` that has the batch's label.

Each table that the statement reads is that of each batch, as in `sierra sql --batch`: its rows are those of the batch's own
runs, although batches may share runs. Derived tables are made for each batch. Then the rows of all batches are one table, in
the order of the batches, and the statement runs as that of a derived table does: with its limits, and with the same rows each
time.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING

from sierra.errors import SierraError, SqlError
from sierra.store import statement
from sierra.store.connections import connect
from sierra.store.derived_tables import Definition, Limits, explained, limited
from sierra.store.schema import TABLE_NAMES
from sierra.store.sql_names import identifier
from sierra.store.sql_result import few_rows
from sierra.store.statement_worker import PART
from sierra.store.store import Snapshot, Store
from sierra.util.lazy_definitions import dataclass, regex

if TYPE_CHECKING:
    import pyarrow as pa

BATCH = "batch"
OFFSET = 4
"""The bytes that Arrow needs for a text in addition to those of its characters."""
TELLING_NAN = frozenset(("isfinite", "isnan"))
"""Functions of a statement that considers NaN itself."""
STAR = regex(r"(?i)(?:\b(?:select|distinct)|[.,]|columns\s*\()\s*\*|\bcolumns\b|\bunpivot\b")
"""A part of a statement that uses columns without naming them."""


@dataclass(frozen=True, slots=True)
class Joined:
    """The rows of a statement, and its SQL with that of the derived tables that it reads."""

    table: pa.Table
    sql: str
    undefined: tuple[str, ...] = ()
    """The columns with NaN, as `table.column`, that the statement or a derived table that it reads names; empty unless wanted.

    Statements that call a function that tells NaN apart are left out."""


def joined(store: Store, batches: Mapping[str, str], text: str, origin: str, *, find_undefined: bool = False) -> Joined:
    """Return the rows of a statement over batches, by label. Messages call it `origin`. Raises SierraError."""
    limits = store.rules().limits
    with ExitStack() as opened:
        snapshots = {label: opened.enter_context(store.snapshot(batch, theirs=True)) for label, batch in batches.items()}
        first = next(iter(snapshots.values()))
        try:
            used = statement.used(first.connection, text)
            statement.check_repeatable(first.connection, used)
        except SqlError as error:
            raise SqlError(f"{origin}: {error}") from error
        tables = {}
        free = math.inf if store.memory is None else store.memory // PART
        for name in used.tables:
            parts = {}
            for label, snapshot in snapshots.items():
                parts[label] = part = _rows(snapshot, name, limits, origin)
                free -= part.nbytes + part.num_rows * (len(label.encode()) + OFFSET)
                if free < 0:
                    raise SierraError(
                        f"{origin}: out of memory: the tables of several batches have {limits.memory / PART / 1e9:g} GB; "
                        f"read fewer rows or columns, {limits.remedy.format('memory')}"
                    )
            tables[name] = _union(parts, name, origin)
        undefined = tuple(dict.fromkeys(_undefined(snapshots, text, tables, limits, origin))) if find_undefined else ()
        needed = [sql for name in used.tables if (sql := first.derived.statements(name))]
    with explained(origin, limits):
        database = connect(store.memory)
    try:
        with explained(origin, limits):
            database.execute("SET enable_external_access = false")
            for name, table in tables.items():
                database.register(f"# {name}", table)
                database.execute(f"CREATE VIEW {identifier(name)} AS SELECT * FROM {identifier(f'# {name}')}")
        rows = text.strip().rstrip(";")
        rows = rows if used.ordered else f"SELECT * FROM (\n{rows}\n) ORDER BY ALL"
        with limited(database, limits, origin) as connection:
            return Joined(few_rows(connection.sql(rows)), "\n\n".join([*needed, text.strip()]), undefined)
    finally:
        database.close()


def _rows(snapshot: Snapshot, name: str, limits: Limits, origin: str) -> pa.Table:
    """Return the rows of a table that belong to the runs of a snapshot's batch. Raises SierraError."""
    derived = snapshot.derived.definitions.get(name)
    if derived is not None and name not in TABLE_NAMES:
        snapshot.derived.make(name)
        return _read(snapshot, f"SELECT * FROM {identifier(name)}", limits, origin)
    empty = f"# columns of {name}"
    snapshot.derived.add(Definition(empty, f"SELECT * FROM {identifier(name)} LIMIT 0", origin))
    columns = [column.lower() for column in snapshot.derived.make(empty).columns]
    if "run" not in columns:
        raise SqlError(
            f"{origin}: table {name!r} has no column 'run', so its rows belong to no batch; read outputs, derived tables, or "
            "tables with a column run"
        )
    if name not in TABLE_NAMES and BATCH in columns:
        raise SqlError(f"{origin}: runs wrote a column 'batch' to {name!r}, which would hide that of the labels; rename it")
    snapshot.views.make(("batch_runs", name))
    return _read(snapshot, f"SELECT * FROM {identifier(name)} WHERE run IN (SELECT run FROM batch_runs)", limits, origin)


def _read(snapshot: Snapshot, text: str, limits: Limits, origin: str) -> pa.Table:
    """Return the rows in an order that is the same each time, because sums depend on it."""
    with limited(snapshot.connection, limits, origin) as connection:
        return connection.sql(text).to_arrow_table()


def _union(parts: Mapping[str, pa.Table], name: str, origin: str) -> pa.Table:
    """Return the rows of a table in all batches, with the labels first."""
    import pyarrow as pa

    labelled = []
    for label, part in parts.items():
        rest = part.drop_columns([column for column in part.column_names if column.lower() == BATCH])
        labelled.append(rest.add_column(0, BATCH, pa.array([label] * part.num_rows, pa.string())))
    try:
        return pa.concat_tables(labelled, promote_options="permissive")
    except pa.ArrowInvalid as error:
        raise SierraError(f"{origin}: the batches have columns of different types in {name!r}: {error}") from error


def _undefined(
    snapshots: Mapping[str, Snapshot], text: str, known: Mapping[str, pa.Table], limits: Limits, origin: str
) -> Iterator[str]:
    """Yield the columns with NaN that a statement names, and then those that the derived tables name which it reads."""
    first = next(iter(snapshots.values()))
    used = statement.used(first.connection, text)
    for name in used.tables:
        if not TELLING_NAN & {function for function, _ in used.calls}:
            parts = [known[name]] if name in known else (_rows(state, name, limits, origin) for state in snapshots.values())
            yield from (f"{name}.{column}" for part in parts for column in _with_nan(part, text))
        if name not in TABLE_NAMES and name in first.derived.definitions:
            yield from _undefined(snapshots, first.derived.definitions[name].sql, {}, limits, origin)


def _with_nan(rows: pa.Table, text: str) -> Iterator[str]:
    """Yield the columns of floats that have NaN, and whose name is a word of the statement, or all if it has a `*`."""
    import pyarrow as pa
    import pyarrow.compute as pc

    words = set(re.findall(r"\w+", text.lower()))
    for column in rows.column_names:
        named = words.issuperset(re.findall(r"\w+", column.lower())) or STAR.search(text)
        if named and pa.types.is_floating(rows.schema.field(column).type) and pc.any(pc.is_nan(rows.column(column))).as_py():
            yield column
