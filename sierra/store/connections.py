"""In-memory connections to DuckDB that never use the network; the last one is reused.

Opening a connection takes longer than most queries, because DuckDB enters thousands of functions into a catalogue. So the
last connection is kept for the next snapshot of the same store. That sees nothing of an earlier one, except views if it asks
for them: temporary and registered objects are dropped with the query's cursor, and settings are reset. A connection that
failed, or whose query was so large that it wrote to the disk, is not kept.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from sierra.store.duckdb_file_io import steady
from sierra.store.duckdb_messages import duckdb_error, first_line
from sierra.store.local_connection import local
from sierra.store.rest_rows import RestRows
from sierra.util import open_files
from sierra.util.lazy_definitions import dataclass, field

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

    from sierra.store.sql_result import RawRow
    from sierra.store.views import Views

AT_A_TIME = 4096
"""The number of rows that are read at a time."""
Database: TypeAlias = "DuckDBPyConnection"
"""A connection to DuckDB, for packages that do not know DuckDB."""


def keep_order(connection: DuckDBPyConnection) -> None:
    """Set a connection so that joined rows keep the order in which they were read."""
    connection.execute("SET threads = 1")
    connection.execute("SET disabled_optimizers = 'join_order,build_side_probe_side'")


class Connection:
    """A cursor on a DuckDB database that may read only some folders; used by one snapshot at a time."""

    def __init__(self, *folders: Path, memory: int | None = None, attached: str = "") -> None:
        """`memory`: let a process with this limit, in bytes, execute the statements (see `sierra.store.statement_process`).

        `attached`: the statement that attaches an index (see `sierra.store.index_reader`). Raises duckdb.Error if it fails.
        """
        self._folders = tuple(steady(f"{folder}/") for folder in folders)
        key = (memory, attached, *self._folders)
        kept = _idle.pop(os.getpid(), None)
        if kept is not None and kept.key != key:
            kept.database.close()
            kept = None
        self._open = _locked(key, self._folders, memory, attached) if kept is None else kept
        self._settings: list[str] = []
        self.cursor = self._open.database.cursor()

    def note(self, statement: str) -> None:
        """Record a setting that a statement is about to change, so that it is reset at the end."""
        if setting := re.match(r"SET (\w+)", statement):
            self._settings.append(setting[1])

    @property
    def rest(self) -> RestRows:
        """The rows of segments that the database holds."""
        return self._open.rest

    def take_over(self, inherit: Callable[[Views], bool]) -> None:
        """Let the views that the last snapshot has left here be inherited; otherwise drop them."""
        views, self._open.views = self._open.views, None
        if views is not None and not inherit(views):
            self._drop(views.made)

    def keep(self, views: Views, *, drop: bool = False) -> None:
        """Close the cursor, and keep the database for the next snapshot, with these views unless they are to be dropped."""
        import duckdb

        try:
            if drop or views.depends_on_cursor:
                self._drop(views.made)
            else:
                self._drop(views.forget_contents())
                self._open.views = views
            for setting in self._settings:
                self.cursor.execute(reset(setting))
        except duckdb.Error:
            self.close()
            return
        self.cursor.close()
        absolute = all(Path(folder).is_absolute() for folder in self._folders)
        if absolute and not Path(self._open.spills).exists() and os.getpid() not in _idle:
            _idle[os.getpid()] = self._open
        else:
            self._open.database.close()

    def _drop(self, views: Iterable[str]) -> None:
        for view in views:
            self.cursor.execute(f"DROP VIEW {view}")

    def close(self) -> None:
        self.cursor.close()
        self._open.database.close()


def reset(setting: str) -> str:
    """Return the statement that gives a setting of a connection its first value."""
    threads = open_files.threads() if setting == "threads" else None
    return f"RESET {setting}" if threads is None else f"SET threads = {threads}"


class Rows:
    """The rows of a statement, with a few thousand of them in memory at a time.

    A connection has one result. If it is needed for another statement first, `finish` reads the rest of this one.
    """

    def __init__(self, result: DuckDBPyConnection) -> None:
        self._result = result
        self._rest: list[RawRow] | None = None

    def __iter__(self) -> Iterator[RawRow]:
        try:
            while rows := self._next():
                yield from rows
        finally:
            self._rest = []

    def _next(self) -> list[RawRow]:
        if self._rest is None:
            return self._result.fetchmany(AT_A_TIME)
        rows, self._rest = self._rest, []
        return rows

    def finish(self) -> None:
        if self._rest is None:
            self._rest = self._result.fetchall()


@dataclass(slots=True)
class _Open:
    """An open database."""

    database: DuckDBPyConnection
    key: tuple[int | str | None, ...]
    """The limit on its memory, the index that is attached, and the folders that it may read."""
    spills: str
    """The folder that exists when a query was too large for the memory."""
    rest: RestRows = field(default_factory=RestRows)
    """The rows that it holds."""
    views: Views | None = None
    """The views in it, if the next snapshot may use them."""


_idle: dict[int, _Open] = {}
"""The kept databases by process id. A forked process does not inherit DuckDB's threads."""


def _locked(key: tuple[int | str | None, ...], folders: tuple[str, ...], memory: int | None, attached: str) -> _Open:
    spills = _spills()
    database = connect(memory, spills=spills)
    if attached:
        database.execute(attached)
    database.execute("SET allowed_directories = $folders", {"folders": list(folders)})
    database.execute("SET enable_external_access = false")
    return _Open(database, key, spills)


def _spills() -> str:
    """Return a path of a folder that DuckDB makes and removes as needed. It allows reads there, so the name is random."""
    return steady(str(Path(tempfile.gettempdir(), f"sierra-{os.urandom(8).hex()}")))


def refused_by_re2(pattern: str) -> str:
    """Return why RE2, which matches regular expressions in DuckDB, does not take a pattern; "" if it does."""
    connection = connect()
    try:
        connection.execute("SELECT regexp_matches('', $pattern)", {"pattern": pattern}).fetchall()
    except duckdb_error() as error:
        return first_line(error).partition("Error: ")[2] or first_line(error)
    finally:
        connection.close()
    return ""


def connect(memory: int | None = None, *, spills: str | None = None) -> DuckDBPyConnection:
    """Return an in-memory DuckDB connection that never uses the network, with as many threads as open files allow.

    `memory`: let a process with this limit, in bytes, execute the statements (see `sierra.store.statement_process`). `spills`:
    the path of the folder for what does not fit into the memory.
    """
    threads = open_files.threads()
    config: dict[str, str | bool | int | float | list[str]] = {
        "autoinstall_known_extensions": "false",
        "autoload_known_extensions": "false",
        "temp_directory": spills or _spills(),
        "python_enable_replacements": "false",
        **({} if threads is None else {"threads": str(threads)}),
    }
    if memory is not None:
        from sierra.store import statement_process

        return statement_process.connect(memory, config)
    return local(config)
