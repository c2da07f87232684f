"""Derived tables: each is made by one SQL statement from outputs, the store's tables and other derived tables.

A derived table gives the same rows, in the same order, each time that it is made from the same rows: its statement runs in one
thread, joins keep the order of the rows that they read, and rows of a statement without ORDER BY are sorted by all columns.
Functions of the time, of chance and of the connection are refused, as well as everything that is no table (see
`sierra.store.statement`). A time limit and a memory limit end statements that would never end.

Each table is made once for each snapshot, as a temporary table.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

from sierra.errors import SierraError, SqlError
from sierra.model import ACCEPTED
from sierra.store import statement
from sierra.store.connections import reset
from sierra.store.duckdb_messages import explain
from sierra.store.schema import TABLE_NAMES
from sierra.store.sql_names import identifier
from sierra.store.views import Views, tables_of
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import like

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

OWN_NAMES = frozenset(("samples", "wanted", "membership", "these"))
"""Names of temporary tables that statistics use."""
SETTINGS = ("threads", "disabled_optimizers", "memory_limit", "max_temp_directory_size", "TimeZone")
ON_DISK = 4
"""The default of `Limits.on_disk`."""
SHARE_OF_MEMORY = 0.8
"""The largest part of the machine's memory that a statement may use, whatever the limit is."""


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits on the time of one statement, in seconds, and on the memory of all tables of a snapshot, in bytes."""

    wall: float = 300.0
    memory: int = 4_000_000_000
    on_disk: int = ON_DISK
    """The largest amount written to the disk, as a multiple of the memory. Tables that were made before count too."""
    remedy: str = "or raise {} in [sql]"
    """The advice for somebody who needs more."""

    def within(self, most: Limits) -> Limits:
        """Return these limits, or those of `most` where they are smaller, with its advice if one is."""
        smaller = min(self.wall, most.wall), min(self.memory, most.memory), min(self.on_disk, most.on_disk)
        fits = smaller == (self.wall, self.memory, self.on_disk)
        return self if fits else Limits(*smaller, most.remedy)


@dataclass(frozen=True, slots=True)
class Definition:
    """A derived table: its name, its statement, and what messages call it."""

    name: str
    sql: str
    origin: str
    problem: str = ""
    """Why there is no statement: for example, its file does not exist."""
    implicit: bool = False
    """True if SIERRA adds it. An output of this name then counts instead."""
    empty: bool = False
    """True if it stands for the rows of accepted ends, and there are none. It is no part of recorded statements."""

    @property
    def text(self) -> str:
        """The statement without the semicolon at its end."""
        return self.sql.strip().rstrip(";")


@dataclass(frozen=True, slots=True)
class Rules:
    """The derived tables of a project, by name in lower case, and the limits on their statements."""

    tables: Mapping[str, Definition] = field(default_factory=dict)
    limits: Limits = Limits()


@dataclass(frozen=True, slots=True)
class BuiltTable:
    """A derived table that was made."""

    columns: Mapping[str, str]
    """The type of each column, in order."""
    rows: int
    ordered: bool
    """True if its statement orders the rows."""


class DerivedTables:
    """The derived tables of one snapshot."""

    def __init__(
        self,
        connection: Callable[[], DuckDBPyConnection],
        views: Views,
        rules: Callable[[], Rules],
        outputs: Iterable[str],
    ) -> None:
        """`rules` is called only if a statement names a table that is not SIERRA's own."""
        self._connection = connection
        self._views = views
        self._rules = rules
        self._outputs = {name.lower(): name for name in outputs}
        self.settings: tuple[str, ...] = ()
        """Statements that set up the connection again after a statement had limits of its own."""
        self._known: dict[str, Definition] | None = None
        self._made: dict[str, BuiltTable | SierraError] = {}
        self._making: list[Definition] = []
        self._listed: list[str] = []

    @property
    def definitions(self) -> dict[str, Definition]:
        """The definitions by name in lower case."""
        if self._known is None:
            tables = self._rules().tables
            self._known = {name: one for name, one in tables.items() if not (one.implicit and name in self._outputs)}
        return self._known

    def add(self, definition: Definition) -> None:
        """Add a table for this snapshot only: that of one figure, for example."""
        self.definitions[definition.name.lower()] = definition

    def statements(self, name: str) -> str:
        """Return the statement of a table after those of the tables that it needs, as SQL with comments; "" if it is none."""
        return "\n\n".join(dict.fromkeys(self._statements(name)))

    def _statements(self, name: str) -> Iterator[str]:
        """Yield the statements of the tables that a table needs, some several times, and then its own."""
        definition = self.definitions.get(name.lower())
        if definition is None or definition.empty:
            return
        for other in statement.used(self._connection(), definition.sql).tables:
            yield from self._statements(other)
        yield f"-- {definition.origin}\n{definition.sql.strip()}"

    def used_by(self, text: str) -> list[str]:
        """Return the derived tables that a statement names, in lower case; none if it cannot be parsed."""
        names = tables_of(text)
        if names is not None and names <= TABLE_NAMES:
            return []
        try:
            used = self._used_with_empty_tables(text)
        except SqlError:
            return []
        return [name for name in used.tables if name not in TABLE_NAMES and name in self.definitions]

    def _used_with_empty_tables(self, text: str) -> statement.Used:
        """Return what a statement uses. Add an empty table for each table of accepted ends in it that no run has written.

        Raises SqlError.
        """
        used = statement.used(self._connection(), text)
        for name in used.tables:
            output = self._outputs.get(name.removesuffix(ACCEPTED))
            if output is None:
                continue
            is_defined = name in {*self._outputs, *self.definitions}
            if not is_defined:
                self.add(Definition(name, f"SELECT * FROM {identifier(output)} LIMIT 0", f"the table {name}", empty=True))
        return used

    def list(self) -> list[str]:
        """Make views of all tables that are not made yet, so that they are listed; return notes on those that cannot be."""
        notes = []
        for name in [*self.definitions]:
            if name in self._made or name in self._listed:
                continue
            try:
                self._list(name, self.definitions[name])
            except SierraError as error:
                notes.append(str(error))
        return notes

    def make(self, name: str) -> BuiltTable:
        """Make a table and those that it needs. Raises SierraError; the error names the table that cannot be made."""
        name = name.lower()
        if name not in self._made:
            try:
                self._made[name] = self._make(self.definitions[name])
            except SierraError as error:
                self._made[name] = error
        table = self._made[name]
        if isinstance(table, SierraError):
            raise table
        return table

    def _make(self, definition: Definition) -> BuiltTable:
        ordered = self._prepare(definition, self.make)
        if definition.name.lower() in self._listed:
            self._connection().execute(f"DROP VIEW temp.{identifier(definition.name)}")
            self._listed.remove(definition.name.lower())
        text = definition.text
        rows = text if ordered else f"SELECT * FROM (\n{text}\n) ORDER BY ALL"
        table = identifier(definition.name)
        with self.limited(definition.origin) as connection:
            connection.execute(f"CREATE TEMP TABLE {table} AS {rows}")
        described = self._connection().execute(f"DESCRIBE {table}").fetchall()
        count = self._connection().execute(f"SELECT count(*) FROM {table}").fetchall()[0][0]
        return BuiltTable({row[0]: row[1] for row in described}, count, ordered)

    @contextlib.contextmanager
    def limited(self, origin: str) -> Iterator[DuckDBPyConnection]:
        """Yield the connection for one statement that SIERRA did not write, with the project's limits; see `limited`."""
        try:
            with limited(self._connection(), self._rules().limits, origin) as connection:
                yield connection
        finally:
            for setting in self.settings:
                self._connection().execute(setting)

    def _list(self, name: str, definition: Definition) -> None:
        if name in self._listed:
            return
        self._prepare(definition, lambda other: self._list(other, self.definitions[other]))
        with explained(definition.origin):
            text = definition.text
            self._connection().execute(f"CREATE TEMP VIEW {identifier(definition.name)} AS {text}")
        self._listed.append(name)

    def _prepare(self, definition: Definition, make: Callable[[str], object]) -> bool:
        """Check a definition and make what it needs; return whether its statement orders the rows. Raises SierraError."""
        if definition in self._making:
            names = [waiting.name for waiting in (*self._making[self._making.index(definition) :], definition)]
            raise SqlError(f"{definition.origin}: {' → '.join(names)}: a table cannot be made from itself")
        self._making.append(definition)
        try:
            used = self._checked(definition)
            for other in used.tables:
                if other in self.definitions:
                    make(other)
            self._views.make(used.tables)
        finally:
            self._making.pop()
        return used.ordered

    def _checked(self, definition: Definition) -> statement.Used:
        """Return what a table's statement uses, after checking that it may. Raises SqlError."""
        if problem := definition.problem or self._taken(definition):
            raise SqlError(f"{definition.origin}: {problem}")
        try:
            used = self._used_with_empty_tables(definition.sql)
            statement.check_repeatable(self._connection(), used)
        except SqlError as error:
            raise SqlError(f"{definition.origin}: {error}") from error
        if used.schemas:
            raise SqlError(f"{definition.origin}: write {used.schemas[0]!r} without a schema")
        known = [*self._outputs, *self.definitions, *TABLE_NAMES]
        for name, spelled in used.tables.items():
            if name not in known:
                names = [
                    *self._outputs.values(),
                    *(other.name for other in self.definitions.values() if not other.name.startswith("# ")),
                    *sorted(TABLE_NAMES),
                ]
                raise SqlError(f"{definition.origin}: there is no table {spelled!r}; {like(spelled, names, 'tables are')}")
        return used

    def _taken(self, definition: Definition) -> str:
        """Return a complaint if the name of a table has another meaning."""
        name = definition.name.lower()
        if name in self._outputs:
            return f"runs have written an output {self._outputs[name]!r}; use another name for the derived table"
        return "" if is_free(name) else f"SIERRA's own table {name!r} has this name; use another name"


def is_free(name: str) -> bool:
    """Check that a derived table may have this name: no table of the store has it; case is ignored."""
    return name.lower() not in TABLE_NAMES | OWN_NAMES


@contextlib.contextmanager
def limited(connection: DuckDBPyConnection, limits: Limits, origin: str) -> Iterator[DuckDBPyConnection]:
    """Yield the connection for one statement with limits, in one thread, which keeps the order of rows. Raises SierraError.

    Messages call the statement `origin`.
    """
    memory = min(limits.memory, int(SHARE_OF_MEMORY * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")))
    values = ("1", "'join_order,build_side_probe_side'", f"'{memory}B'", f"'{limits.on_disk * memory}B'", "'UTC'")
    try:
        for name, value in zip(SETTINGS, values, strict=True):
            connection.execute(f"SET {name} = {value}")
        with explained(origin, limits), _Timer(connection, limits, origin):
            yield connection
    finally:
        for name in SETTINGS:
            connection.execute(reset(name))


class _Timer:
    """A context manager that interrupts a connection's statement after some time, and then raises an error that says so."""

    def __init__(self, connection: DuckDBPyConnection, limits: Limits, origin: str) -> None:
        self._connection = connection
        self._limits = limits
        self._origin = origin
        self._lock = threading.Lock()
        self._ended = self._late = False
        self._timer = threading.Timer(limits.wall, self._interrupt)
        self._timer.daemon = True

    def __enter__(self) -> None:
        self._timer.start()

    def __exit__(self, *_: object) -> None:
        import duckdb

        with self._lock:
            self._ended = True
        self._timer.cancel()
        if self._late and isinstance(_[1], duckdb.InterruptException):
            wall, remedy = self._limits.wall, self._limits.remedy.format("wall")
            raise SierraError(f"{self._origin}: the statement did not end within {wall:g} s; correct it, {remedy}") from _[1]

    def _interrupt(self) -> None:
        with self._lock:
            if not self._ended:
                self._late = True
                self._connection.interrupt()


@contextlib.contextmanager
def explained(origin: str, limits: Limits | None = None) -> Iterator[None]:
    """Raise DuckDB's errors as errors of one line about `origin`."""
    import duckdb

    try:
        yield
    except duckdb.OutOfMemoryException as error:
        most, remedy = (f"{limits.memory / 1e9:g} GB", limits.remedy) if limits else ("the limit", Limits().remedy)
        raise SierraError(
            f"{origin}: out of memory: the statements of a command have {most}; "
            f"correct the statement, {remedy.format('memory')}"
        ) from error
    except duckdb.InterruptException:
        raise
    except duckdb.Error as error:
        raise SqlError(f"{origin}: {explain(error)}") from error
