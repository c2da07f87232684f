"""In-memory connections to DuckDB that never use the network; the last one is reused.

Opening a connection takes longer than most queries, because DuckDB enters thousands of functions into a catalogue. So the
last connection is kept for the next snapshot of the same store. A snapshot sees nothing of an earlier one: temporary and
registered objects are dropped with the query's cursor, its views are dropped, and its settings are reset. A connection
that failed, or whose query was so large that it wrote to the disk, is not kept.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from sierra.store.duckdb_file_io import steady
from sierra.util import open_files, signals

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

    from sierra.store.sql_result import RawRow

AT_A_TIME = 4096
"""The number of rows that are read at a time."""
INTERRUPTED = "Query interrupted"
"""The text of the RuntimeError that DuckDB raises in place of a KeyboardInterrupt."""
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
        self._key = (memory, attached, *self._folders)
        kept = _idle.pop(os.getpid(), None)
        if kept is not None and kept[0] != self._key:
            kept[1].close()
            kept = None
        self._database = _locked(self._folders, memory, attached) if kept is None else kept[1]
        self._settings: list[str] = []
        self.cursor = self._database.cursor()

    def note(self, statement: str) -> None:
        """Record a setting that a statement is about to change, so that it is reset at the end."""
        if setting := re.match(r"SET (\w+)", statement):
            self._settings.append(setting[1])

    def keep(self, views: Iterable[str]) -> None:
        """Drop these views, close the cursor, and keep the database for the next snapshot."""
        import duckdb

        try:
            for statement in (*(f"DROP VIEW {view}" for view in views), *map(reset, self._settings)):
                self.cursor.execute(statement)
            [(spilled,)] = self.cursor.execute("SELECT current_setting('temp_directory')").fetchall()
        except duckdb.Error:
            self.close()
            return
        self.cursor.close()
        absolute = all(Path(folder).is_absolute() for folder in self._folders)
        if absolute and not Path(spilled).exists() and os.getpid() not in _idle:
            _idle[os.getpid()] = (self._key, self._database)
        else:
            self._database.close()

    def close(self) -> None:
        self.cursor.close()
        self._database.close()


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


_idle: dict[int, tuple[tuple[int | str | None, ...], DuckDBPyConnection]] = {}
"""The kept databases with their limits on memory and the folders that they may read, by process id.

A forked process does not inherit DuckDB's threads."""


def _locked(folders: tuple[str, ...], memory: int | None, attached: str) -> DuckDBPyConnection:
    database = connect(memory)
    if attached:
        database.execute(attached)
    database.execute("SET allowed_directories = $folders", {"folders": list(folders)})
    database.execute("SET enable_external_access = false")
    return database


def connect(memory: int | None = None) -> DuckDBPyConnection:
    """Return an in-memory DuckDB connection that never uses the network, with as many threads as open files allow.

    `memory`: let a process with this limit, in bytes, execute the statements (see `sierra.store.statement_process`).
    """
    threads = open_files.threads()
    config: dict[str, str | bool | int | float | list[str]] = {
        "autoinstall_known_extensions": "false",
        "autoload_known_extensions": "false",
        # DuckDB allows reads there, so the folder has a random name; DuckDB makes and removes it as needed.
        "temp_directory": steady(str(Path(tempfile.gettempdir(), f"sierra-{os.urandom(8).hex()}"))),
        "python_enable_replacements": "false",
        **({} if threads is None else {"threads": str(threads)}),
    }
    if memory is not None:
        from sierra.store import statement_process

        return statement_process.connect(memory, config)
    return local(config)


def local(config: dict[str, str | bool | int | float | list[str]]) -> DuckDBPyConnection:
    """Return an in-memory DuckDB connection in this process, whose statements end with KeyboardInterrupt."""
    import duckdb

    made = duckdb.connect(":memory:", config=config)
    made.execute("SET enable_progress_bar = false")  # DuckDB draws it on standard output in notebooks and shells
    return cast("DuckDBPyConnection", Interruptible(made))


class Interruptible:
    """A connection to DuckDB or one of its relations, with all of its methods, which raise what the handler of a signal raises.

    DuckDB itself raises RuntimeError in place of KeyboardInterrupt: it would be taken for a fault of the statement, or of the
    data that it reads.
    """

    __slots__ = ("_connection", "_wrapped")

    def __init__(self, wrapped: Any, connection: Any = None) -> None:
        """`connection`: the one that executes the statements of a relation."""
        self._wrapped = wrapped
        self._connection = connection or wrapped

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._wrapped, name)
        return partial(self._call, found) if callable(found) else found

    def __enter__(self) -> Interruptible:
        return self

    def __exit__(self, *_: object) -> None:
        self._wrapped.close()

    def _call(self, method: Callable[..., object], *arguments: object, **named: object) -> object:
        import duckdb

        try:
            with _interrupted_by_signals(self._connection):
                result = method(*arguments, **named)
        except RuntimeError as error:
            if str(error) == INTERRUPTED:
                raise (_raised.pop() if _raised else KeyboardInterrupt()) from error
            raise
        if isinstance(result, duckdb.DuckDBPyRelation):
            return Interruptible(result, self._connection)
        return Interruptible(result) if isinstance(result, duckdb.DuckDBPyConnection) else result


_executing: list[DuckDBPyConnection] = []
"""The connections whose statements the main thread executes."""
_raised: list[BaseException] = []
"""The exception that the handler of a signal has raised within a statement, in whose place DuckDB raises another one."""


@contextlib.contextmanager
def _interrupted_by_signals(connection: DuckDBPyConnection) -> Iterator[None]:
    """Interrupt a connection if the handler of a signal raises an exception within the `with` block.

    The exception alone ends only DuckDB's thread that meets it, which then waits for the others: perhaps for hours. Programs
    that use `sierra` have Python's own handler of Ctrl-C, which interrupts nothing; it is replaced within the block.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    replaced = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    _raised.clear()
    _executing.append(connection)
    try:
        if replaced:
            signal.signal(signal.SIGINT, signals.interrupt)
        yield
    finally:
        _executing.pop()
        if replaced:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _interrupt_statements(error: BaseException) -> None:
    import duckdb

    _raised[:] = [error]
    for connection in _executing:
        with contextlib.suppress(duckdb.Error):  # it is closed
            connection.interrupt()


signals.before_raising(_interrupt_statements)
