"""A process that executes SQL statements for `sierra.store.statement_process`; it is a program of its own.

No statement can take more memory than the system allows this process, and another process can end it at any time, whatever
function DuckDB is in. It needs only duckdb and pyarrow. A request on standard input is a line of JSON, followed by the table
to register, if there is one. The answer on standard output has frames if there are rows: the first with the columns, then one
for each batch of rows. A line of JSON ends it. A frame is a line with its length in bytes, and an Arrow stream.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import sys
import threading
import time
import warnings
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, BinaryIO

SLACK = 512 << 20
"""Memory beyond the limit, in bytes: DuckDB's own, and that of a result."""
PART = 4
"""An answer may take this part of the memory."""
ROWS = 100_000
"""The largest number of rows in a frame."""
THREADS = 8
"""The largest number of DuckDB's threads: the system counts the whole stack of each."""
PARENT_S = 0.5
"""The time between two looks whether the parent still exists, in s."""
WRAPPED = {
    "INTERRUPT Error:": "InterruptException",
    "Out of Memory Error:": "OutOfMemoryException",
    "IO Error:": "IOException",
}
"""DuckDB's classes of errors by the beginning of their text."""

Request = dict[str, Any]


class Worker:
    """The connections of this process by number, and the requests on them."""

    def __init__(self, answers: BinaryIO, memory: int) -> None:
        self._answers = answers
        self._memory = memory
        self._largest = memory // PART
        self._threads = THREADS
        self._connections: dict[int, Any] = {}
        self._lossless: dict[int, bool] = {}

    def answer(self, request: Request, table: object) -> None:
        """Execute a request and write its answer, or the class and the text of an error."""
        try:
            do: Callable[..., Any] = getattr(self, request["do"])
            last = {"value": do(request) if table is None else do(request, table)}
        except BaseException as error:
            last = {"error": kind_of(error), "text": str(error)}
        self._say(last)

    def connect(self, request: Request) -> None:
        import duckdb

        given = request["config"]
        self._threads = min(THREADS, int(given.get("threads", os.cpu_count() or 1)))
        config = {**given, "threads": self._threads, "memory_limit": f"{self._memory}B"}
        self._connections[request["made"]] = duckdb.connect(":memory:", config=config)

    def cursor(self, request: Request) -> None:
        self._connections[request["made"]] = self._of(request).cursor()

    def close(self, request: Request) -> None:
        self._connections.pop(request["on"]).close()
        self._lossless.pop(request["on"], None)

    def register(self, request: Request, table: object) -> None:
        self._of(request).register(request["name"], table)

    def statements(self, request: Request) -> list[str]:
        """Return the names of the types of the statements in a text."""
        return [kind(one) for one in self._of(request).extract_statements(request["text"])]

    def execute(self, request: Request) -> None:
        connection = self._of(request)
        self._convert(request["on"], lossless=True)
        connection.execute(self._within(request["text"]), request["parameters"])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a relation would bind the statement twice
            self._send(connection.to_arrow_reader(ROWS))

    def _within(self, text: str) -> str:
        """Return a statement that does not reset a setting to DuckDB's own limit, but to that of this process."""
        if text == "RESET memory_limit":  # what is larger must be written to the disk
            return f"SET memory_limit = '{self._memory}B'"
        if text == "RESET threads" or (text.startswith("SET threads = ") and int(text.split()[-1]) > self._threads):
            return f"SET threads = {self._threads}"
        return text

    def describe(self, request: Request) -> tuple[list[str], list[str]] | None:
        """Return the names and types of the columns of a relation; None if the statement has no rows."""
        relation = self._relation(request)
        return None if relation is None else (relation.columns, [str(kind) for kind in relation.types])

    def rows(self, request: Request) -> None:
        self._send(self._relation(request).to_arrow_reader(ROWS))

    def interrupt(self, request: Request) -> None:
        self._of(request).interrupt()

    def _convert(self, on: int, *, lossless: bool) -> None:
        """Convert types that Arrow does not have to extension types, or to others, as DuckDB does if it is not told."""
        if self._lossless.get(on) is not lossless:
            self._connections[on].execute(f"SET arrow_lossless_conversion = {str(lossless).lower()}").fetchall()
            self._lossless[on] = lossless

    def _of(self, request: Request) -> Any:
        return self._connections[request["on"]]

    def _relation(self, request: Request) -> Any:
        connection, parameters = self._of(request), request["parameters"]
        self._convert(request["on"], lossless=request["lossless"])
        relation = connection.sql(request["text"], params=parameters) if parameters else connection.sql(request["text"])
        for method, argument in request["then"] if relation is not None else ():
            relation = getattr(relation, method)(argument)
        return relation

    def _send(self, reader: Any) -> None:
        self._frame(reader.schema)
        for batch in reader:
            if batch.nbytes > self._largest:
                raise MemoryError(f"the answer has more than {self._largest / 1e9:g} GB")
            self._frame(reader.schema, batch)

    def _frame(self, schema: Any, *batches: Any) -> None:
        import pyarrow as pa

        frame = pa.BufferOutputStream()
        with pa.ipc.new_stream(frame, schema) as stream:
            for batch in batches:
                stream.write_batch(batch)
        content = frame.getvalue()
        self._answers.write(b"%d\n" % content.size)
        self._answers.write(content)

    def _say(self, last: object) -> None:
        self._answers.write(json.dumps(last).encode() + b"\n")
        self._answers.flush()


def kind_of(error: BaseException) -> str:
    """Return the name of DuckDB's class of an error; pyarrow raises those within an answer as errors of its own."""
    if isinstance(error, MemoryError):
        return "OutOfMemoryException"
    if isinstance(error, OSError) and error.errno is None:
        return next((name for start, name in WRAPPED.items() if str(error).startswith(start)), "InvalidInputException")
    return type(error).__name__


def kind(statement: Any) -> str:
    """Return the name of the type of a statement; its first word, if DuckDB's own module does not know the type."""
    try:
        return str(statement.type.name)
    except ValueError:
        return str(statement.query.split()[0].upper())


def _limit(memory: int) -> None:
    """Let the system refuse memory beyond that in use now, the limit, and the slack; some systems cannot."""
    with contextlib.suppress(OSError, ValueError):
        pages = int(_first_line("/proc/self/statm").split()[5])
        most = pages * os.sysconf("SC_PAGE_SIZE") + memory + SLACK
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))


def _first_line(path: str) -> str:
    with open(path) as file:  # noqa: PTH123 - as little as possible is imported
        return file.readline()


def _end_with(parent: int) -> None:
    """End this process when its parent has ended: another process may hold the other end of standard input."""
    while os.getppid() == parent:
        time.sleep(PARENT_S)
    os._exit(0)


def _main() -> None:
    """Answer the requests on standard input one after the other, but interrupt a statement at once; end when it ends."""
    memory, parent = map(int, sys.argv[1:])
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.modules["pandas"] = None  # type: ignore[assignment]  # pyarrow would load it
    import duckdb  # noqa: F401 - before the limit
    import pyarrow as pa

    _limit(memory)
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # nothing else can be written among the answers
    worker = Worker(answers, memory)
    waiting: SimpleQueue[tuple[Request, object]] = SimpleQueue()

    def work() -> None:
        while True:
            worker.answer(*waiting.get())

    threading.Thread(target=work, daemon=True).start()
    while line := requests.readline():
        request = json.loads(line)
        if request["do"] == "interrupt":
            with contextlib.suppress(Exception):
                worker.interrupt(request)
        else:
            size = request.get("table")
            waiting.put((request, None if size is None else pa.ipc.open_stream(requests.read(size)).read_all()))
    os._exit(0)


if __name__ == "__main__":
    _main()
