"""DuckDB connections in this process, whose statements end when the handler of a signal raises an exception."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from sierra.util import signals

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

INTERRUPTED = "Query interrupted"
"""The text of the RuntimeError that DuckDB raises in place of a KeyboardInterrupt."""


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
