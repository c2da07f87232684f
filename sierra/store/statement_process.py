"""DuckDB connections in a process of their own, for statements that somebody else wrote.

Nothing within a process can end each function of DuckDB, and DuckDB does not count all of its memory. So the statements of
packages, and those from the explorer's page, are executed by one other process for each command (see
`sierra.store.statement_worker`), whose memory the system limits. A statement that does not end when it is interrupted is
ended by killing the process. The next statement starts another process, in which the views and temporary tables that the
connections had are made again.

`Remote` has the methods of DuckDB's connections that the store uses.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

from sierra.store import statement_worker
from sierra.store.local_connection import local
from sierra.util.lazy_definitions import dataclass, regex

if TYPE_CHECKING:
    import pyarrow as pa
    from duckdb import DuckDBPyConnection

    from sierra.store.sql_result import RawRow

PATIENCE_S = 1.0
"""The time that an interrupted statement has to end, in s, before its process is killed."""
ENVIRONMENT = {"ARROW_DEFAULT_MEMORY_POOL": "system", "DUCKDB_JE_MALLOC_CONF": "retain:false"}
"""Settings of allocators, so that address space that is not used does not count."""
KEPT = ("ATTACH", "CREATE", "DROP", "RESET", "SET")
"""The first words of statements that another process must execute again."""
REPLACED = "the process that executed the statement was ended"
OF_SHORTAGE = (signal.SIGKILL, signal.SIGABRT)
"""The signals that end a process for which there is no memory: from the system, and from itself."""
OBJECT = 64
"""The memory of a Python object within a row, or of the row itself, in bytes."""
SETTING = regex(r"(?:SET|RESET)\s+(\w+)")
"""The beginning of a statement that changes a setting, with its name."""

Kept: TypeAlias = "tuple[int, dict[str, Any], pa.Table | None]"
_processes: dict[tuple[int, int], Process] = {}
"""The processes by the id of the process that they work for, and by their limit on memory."""


def connect(memory: int, config: Mapping[str, object]) -> DuckDBPyConnection:
    """Return a new database in the process with this limit on memory, in bytes."""
    key = os.getpid(), memory
    if key not in _processes:
        _processes[key] = Process(memory)
    process = _processes[key]
    made = Remote(process)
    process.ask(made.number, {"do": "connect", "made": made.number, "config": dict(config)}, keep=True)
    return cast("DuckDBPyConnection", made)


class Process:
    """A process that executes statements; it is started when it is needed, and again after it was killed."""

    def __init__(self, memory: int) -> None:
        self._memory = memory
        self._running: subprocess.Popen[bytes] | None = None
        self._kept: list[Kept] = []
        """The requests that have made what connections have now, by the number of the connection."""
        self._answering: Frames | None = None
        self._count = 0
        self._one = threading.Lock()
        """Held while a request is written, and while an answer begins or ends."""
        self._timer: threading.Timer | None = None

    def number(self) -> int:
        self._count += 1
        return self._count

    def ask(self, on: int, request: dict[str, Any], table: pa.Table | None = None, *, keep: bool = False) -> Frames:
        """Return the answer of a request for a connection. With `keep`, another process would execute it again, too."""
        self._settle()
        if not self._is_alive():
            self._start()
        answer = self._asked({"on": on, **request}, table)
        if keep:
            answer.finish()
            self._kept = _needed([*self._kept, (on, request, table)])
        return answer

    def forget(self, on: int) -> None:
        """Close a connection and its cursors, whose numbers are not used again."""
        gone = [on] if any(number == on for number, *_ in self._kept) else []
        for number, request, _ in self._kept:
            if request["do"] == "cursor" and request["on"] in gone:
                gone.append(number)
        self._kept = [kept for kept in self._kept if kept[0] not in gone]
        if gone:
            self._settle()
        for number in reversed(gone):
            if self._is_alive():
                self._asked({"do": "close", "on": number}).finish()

    def interrupt(self, on: int) -> None:
        """Interrupt the statement that another thread waits for; if it does not end, end the process."""
        with contextlib.suppress(OSError), self._one:
            running = self._running
            if running is None or self._answering is None:
                return
            if self._timer is None:
                self._timer = threading.Timer(PATIENCE_S, self._kill, (running, self._answering))
                self._timer.daemon = True
                self._timer.start()
            self._write(running, {"do": "interrupt", "on": on})

    def _kill(self, running: subprocess.Popen[bytes], answer: Frames) -> None:
        """End the process unless this answer has ended meanwhile: the next one has nothing to do with its interruption."""
        with self._one:
            if self._answering is answer:
                running.kill()

    def close(self) -> None:
        """End the process, if it runs."""
        self._answered()
        running, self._running = self._running, None
        if running is not None:
            running.kill()
            for pipe in (running.stdin, running.stdout):
                with contextlib.suppress(OSError):
                    pipe.close() if pipe else None
            running.wait()

    def _settle(self) -> None:
        """Read the rest of an answer that is still being read, because there is one answer at a time."""
        if self._answering is not None:
            self._answering.finish()

    def _answered(self) -> None:
        with self._one:
            self._answering = None
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None

    def _is_alive(self) -> bool:
        """Return whether the process runs; the next statement is not at fault if it has ended meanwhile."""
        if self._running is not None and self._running.poll() is not None:
            self.close()
        return self._running is not None

    def _start(self) -> None:
        argv = (sys.executable, "-P", "-B", statement_worker.__file__, str(self._memory), str(os.getpid()))
        self._running = subprocess.Popen(
            argv,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **ENVIRONMENT},
            start_new_session=True,  # Ctrl-C is for the command
        )
        import duckdb  # noqa: F401 - while the process imports it, too
        import pyarrow as pa  # noqa: F401

        try:
            for on, request, table in self._kept:
                self._asked({"on": on, **request}, table).finish()
        except BaseException:  # no statement may meet a process that has some of its connections
            self.close()
            raise

    def _asked(self, request: dict[str, Any], table: pa.Table | None = None) -> Frames:
        running = self._running
        if running is None:
            raise AssertionError
        try:
            with self._one:
                self._answering = answer = Frames(self, running, memory=self._memory)
                with contextlib.suppress(OSError):  # it has ended; its answer says so
                    self._write(running, request, table)
        except BaseException:
            self.close()
            raise
        answer.begin()
        return answer

    def _write(self, running: subprocess.Popen[bytes], request: dict[str, Any], table: pa.Table | None = None) -> None:
        import pyarrow as pa

        if running.stdin is None:
            raise AssertionError
        if table is not None:
            counted = pa.MockOutputStream()
            _write_table(counted, table)
            request = {**request, "table": counted.size()}
        running.stdin.write(json.dumps(request, default=_plain).encode() + b"\n")
        if table is not None:
            _write_table(running.stdin, table)
        running.stdin.flush()


def _write_table(target: Any, table: pa.Table) -> None:
    import pyarrow as pa

    with pa.ipc.new_stream(target, table.schema) as stream:
        stream.write_table(table)


class Frames:
    """The batches of rows of one answer, which are read as they come, and then its value."""

    def __init__(self, process: Process, running: subprocess.Popen[bytes], memory: int) -> None:
        self._process, self._running = process, running
        self._most = memory // statement_worker.PART
        self._read: list[pa.RecordBatch] = []
        """Batches that were read and not yet taken."""
        self._ended = False
        self.schema: pa.Schema | None = None
        self.value: Any = None

    def begin(self) -> None:
        """Wait for the first batch, or for the end. Raises DuckDB's errors."""
        if (batch := self._next()) is not None:
            self._read.append(batch)

    def finish(self) -> None:
        """Keep what has not been read yet in memory. Raises DuckDB's errors."""
        size = sum(batch.nbytes for batch in self._read)
        while (batch := self._next()) is not None:
            self._read.append(batch)
            size += batch.nbytes
            if size > self._most:
                import duckdb

                self._process.close()
                self._ended = True
                raise duckdb.OutOfMemoryException(f"the answer has more than {self._most / 1e9:g} GB")

    def batches(self) -> Iterator[pa.RecordBatch]:
        while self._read or not self._ended:
            batch = self._read.pop(0) if self._read else self._next()
            if batch is not None:
                yield batch

    def all(self, *, objects: bool = False) -> list[pa.RecordBatch]:
        """Return all batches that were not taken yet. With `objects`, they fit in memory as Python objects, too."""
        self.finish()
        rest, self._read = self._read, []
        if objects and sum(map(_size, rest)) > self._most:
            import duckdb

            raise duckdb.OutOfMemoryException(f"the answer has rows of more than {self._most / 1e9:g} GB")
        return rest

    def _next(self) -> pa.RecordBatch | None:
        import pyarrow as pa

        if self._ended:
            return None
        try:
            line = self._stream.readline()
            if line[:1].isdigit():
                stream = pa.ipc.open_stream(self._whole(int(line)))
                if self.schema is not None:
                    return stream.read_next_batch()
                self.schema = stream.schema
                return self._next()
            if not line:
                raise EOFError
        except EOFError:
            self._ended = True
            raise self._lost() from None
        except BaseException:  # Ctrl-C, for example: the rest of the answer would be taken for that of the next request
            self._ended = True
            self._process.close()
            raise
        self._process._answered()
        self._ended = True
        last = json.loads(line)
        if "error" in last:
            raise _error(last["error"], last["text"])
        self.value = last["value"]
        return None

    def _whole(self, size: int) -> bytes:
        content: bytes = self._stream.read(size)
        if len(content) < size:
            raise EOFError
        return content

    @property
    def _stream(self) -> Any:
        return self._running.stdout

    def _lost(self) -> Exception:
        """Return the error for a process that has ended: it was interrupted, or had no memory left, or got another signal."""
        interrupted = self._process._timer is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._running.wait(PATIENCE_S)
        ended = self._running.poll()
        self._process.close()
        if interrupted:
            return _error("InterruptException", REPLACED)
        if ended is None or ended >= 0 or -ended in OF_SHORTAGE:
            return _error("OutOfMemoryException", REPLACED)
        return _error("InternalException", f"{REPLACED} by signal {-ended} ({signal.strsignal(-ended)})")


@dataclass(frozen=True, slots=True)
class RemoteRelation:
    """A statement with rows, as DuckDB's relations are; each method that returns rows executes it."""

    process: Process
    request: dict[str, Any]
    columns: list[str]
    types: list[str]

    def limit(self, count: int) -> RemoteRelation:
        return self._then("limit", count)

    def project(self, columns: str) -> RemoteRelation:
        return self._then("project", columns)

    def fetchall(self) -> list[RawRow]:
        return rows_of(self._rows(lossless=True).all(objects=True))

    def to_few_rows(self) -> pa.Table:
        """Return the rows as an Arrow table, as long as Python objects of all of them fit in memory."""
        return self._table(objects=True)

    def to_arrow_table(self) -> pa.Table:
        return self._table()

    def to_arrow_reader(self, _: int) -> Iterator[pa.RecordBatch]:
        return self._rows(lossless=False).batches()

    def _then(self, method: str, argument: object) -> RemoteRelation:
        found = _described(self.process, {**self.request, "then": [*self.request["then"], (method, argument)]})
        if found is None:
            raise AssertionError
        return found

    def _table(self, *, objects: bool = False) -> pa.Table:
        import pyarrow as pa

        found = self._rows(lossless=False)
        return pa.Table.from_batches(found.all(objects=objects), found.schema)

    def _rows(self, *, lossless: bool) -> Frames:
        return self.process.ask(self.request["on"], {**self.request, "do": "rows", "lossless": lossless})


class RemoteResult:
    """The rows of an executed statement, as DuckDB's connections have them."""

    def __init__(self, frames: Frames) -> None:
        self._frames = frames
        self._batches = frames.batches()

    def fetchall(self) -> list[RawRow]:
        return rows_of(self._frames.all(objects=True))

    def fetchmany(self, _: int) -> list[RawRow]:
        """Return some of the next rows, none at the end."""
        return next((rows for batch in self._batches if (rows := rows_of([batch]))), [])

    def fetchone(self) -> RawRow | None:
        rows = self.fetchall()
        return rows[0] if rows else None


class Remote:
    """A connection to DuckDB in another process."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self.number = process.number()

    def cursor(self) -> Remote:
        made = Remote(self._process)
        self._process.ask(made.number, {"do": "cursor", "on": self.number, "made": made.number}, keep=True)
        return made

    def close(self) -> None:
        self._process.forget(self.number)

    def execute(self, text: str, parameters: object = None) -> RemoteResult:
        keep = text.lstrip().upper().startswith(KEPT)
        request = {"do": "execute", "text": text, "parameters": parameters or None}
        return RemoteResult(self._process.ask(self.number, request, keep=keep))

    def sql(self, text: str, *, params: Mapping[str, object] | None = None) -> RemoteRelation | None:
        request = {"on": self.number, "text": text, "parameters": params, "then": [], "lossless": False}
        return _described(self._process, request)

    def register(self, name: str, table: pa.Table) -> None:
        self._process.ask(self.number, {"do": "register", "name": name}, table, keep=True)

    def extract_statements(self, text: str) -> list[Statement]:
        return [Statement(Type(name)) for name in self._process.ask(self.number, {"do": "statements", "text": text}).value]

    def interrupt(self) -> None:
        self._process.interrupt(self.number)


class Type(NamedTuple):
    """The type of a statement."""

    name: str


class Statement(NamedTuple):
    """One statement of a text."""

    type: Type


def _needed(kept: Sequence[Kept]) -> list[Kept]:
    """Leave out each change of a setting that a later one undoes before anything else is executed."""
    needed: list[Kept] = []
    undone: set[tuple[int, str]] = set()
    for on, request, table in reversed(kept):
        setting = SETTING.match(request.get("text", ""))
        if setting is None:
            undone.clear()
        elif (on, setting[1]) in undone:
            continue
        else:
            undone.add((on, setting[1]))
        needed.append((on, request, table))
    return needed[::-1]


def _described(process: Process, request: dict[str, Any]) -> RemoteRelation | None:
    found = process.ask(request["on"], {**request, "do": "describe"}).value
    return None if found is None else RemoteRelation(process, request, *found)


def _size(batch: pa.RecordBatch) -> int:
    """Estimate the memory of a batch's rows as Python objects, in bytes."""
    return int(batch.nbytes + OBJECT * (batch.num_rows + sum(map(_count, batch.columns))))


def _count(values: pa.Array) -> int:
    """Count values and all that are within them."""
    import pyarrow as pa

    if isinstance(values, pa.ExtensionArray):
        return _count(values.storage)
    if isinstance(values, pa.StructArray):
        return len(values) + sum(map(_count, values.flatten()))
    if isinstance(values, pa.UnionArray):
        return len(values) + sum(_count(values.field(index)) for index in range(values.type.num_fields))
    if isinstance(values, pa.MapArray):
        return len(values) + _count(values.keys) + _count(values.items)
    if isinstance(values, pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        return len(values) + _count(values.flatten())
    return len(values)


def rows_of(batches: Sequence[pa.RecordBatch]) -> list[RawRow]:
    """Return rows as Python objects, as DuckDB makes them from the same types."""
    import pyarrow as pa

    full = [batch for batch in batches if batch.num_rows]
    if not full:
        return []
    with _converting:
        if not _converter:
            _converter.append(local({"enable_external_access": "false", "threads": "1"}))
        _converter[0].register("rows", pa.Table.from_batches(full))
        try:
            return _converter[0].sql("FROM rows").fetchall()
        finally:
            _converter[0].unregister("rows")


_converter: list[DuckDBPyConnection] = []
_converting = threading.Lock()


def _error(kind: str, text: str) -> Exception:
    """Return an error of DuckDB by the name of its class; for another error, one that has its name."""
    import duckdb

    if "MemoryError" in kind:
        kind = "OutOfMemoryException"
    found = getattr(duckdb, kind, None)
    if isinstance(found, type) and issubclass(found, duckdb.Error):
        return found(text)
    return duckdb.InvalidInputException(f"{kind}: {text}")


def _plain(value: Any) -> object:
    """Return a parameter that JSON does not have as one that it has: the numbers of NumPy."""
    return value.tolist()


@atexit.register
def _end() -> None:
    for (pid, _), process in _processes.items():
        if pid == os.getpid():
            process.close()
