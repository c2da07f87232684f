"""Recording: what workers say becomes segments of the store, checked on the way.

An execution is judged here and nowhere else: by its exit status, the outputs and the marker that the project
asks for, and by the tables it wrote (see `sierra.store.reading`). What is only known once its siblings are
there too (other row counts than theirs, a table that it alone lacks) becomes a *finding*.

Recording may be repeated: what is in the store already is not recorded again, so a session that died is
finished by reading its journal once more.
"""

from __future__ import annotations

import fnmatch
import json
import shutil
import signal
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

from sierra.config import Output, Success
from sierra.hashing import digest, merkle
from sierra.model import OutputFile, Result, Status
from sierra.paths import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT, SessionPaths
from sierra.store import Store
from sierra.store.objects import Objects
from sierra.store.reading import Shape, Written, read
from sierra.store.segments import OUTPUT, Writer
from sierra.store.tables import check_name

LOG_KEPT = 1 << 20
"""Bytes of each log that are kept at most: its beginning and, thrice as much, its end."""
LOG_SHOWN = 2000
AUTOMATIC = {".csv": "csv", ".tsv": "csv", ".parquet": "parquet", ".jsonl": "jsonl", ".ndjson": "jsonl"}
AUTOMATIC_AT_MOST = 20
"""Undeclared tables of one run; beyond, its undeclared files are kept as files."""
PENDING_RUNS = 10_000
PENDING_BYTES = 256 << 20
SOON_S, LATE_S = 2.0, 600.0

STOPPED = {
    Status.TIMEOUT: "ran longer than its limit ([limits] wall)",
    Status.MEMORY: "took more memory than its limit ([limits] memory)",
    Status.CPU: "took more CPU time than its limit ([limits] cpu)",
    Status.OUTPUT: "wrote more bytes than its limit ([limits] output)",
    Status.INTERRUPTED: "was interrupted",
}


@dataclass(frozen=True, slots=True)
class Context:
    """All that recording needs to know of a session, so that another process can finish it."""

    session: str
    batch: str
    purpose: str
    environment: str
    programs: str
    outputs: Mapping[str, Output]
    success: Success

    @property
    def reading(self) -> str:
        """The hash of what decides whether an execution is good and what is kept of it."""
        outputs = {name: output.model_dump(mode="json", exclude={"mismatch", "units"}) for name, output in self.outputs.items()}
        return digest("reading", {"outputs": outputs, "success": self.success.model_dump(mode="json")})

    def save(self, path: Path) -> None:
        fields = {name: getattr(self, name) for name in ("session", "batch", "purpose", "environment", "programs")}
        fields["outputs"] = {name: output.model_dump(mode="json") for name, output in self.outputs.items()}
        fields["success"] = self.success.model_dump(mode="json")
        path.write_text(json.dumps(fields))

    @classmethod
    def load(cls, path: Path) -> Context:
        fields = json.loads(path.read_text())
        fields["outputs"] = {name: Output.model_validate(output) for name, output in fields["outputs"].items()}
        fields["success"] = Success.model_validate(fields["success"])
        return cls(**fields)


def judge(result: Result, outputs: Mapping[str, Output], success: Success) -> tuple[Status, str | None]:
    """Whether an execution is good by what is known at once, and why not."""
    if result.error is not None:
        return Status.FAILED, f"could not be started: {result.error}"
    if result.stopped is not None:
        return Status(result.stopped), STOPPED[Status(result.stopped)]
    if result.signal is not None:
        return Status.FAILED, f"ended by signal {result.signal} ({_signal_name(result.signal)})"
    if result.exit_code not in success.exit_status:
        return Status.FAILED, f"exit status {result.exit_code}"
    for name, output in outputs.items():
        if output.required and not any(matches(file.path, output.file) for file in result.outputs):
            return Status.FAILED, f"did not write {output.file!r} (output {name!r})"
    return _marked(result, success)


def _marked(result: Result, success: Success) -> tuple[Status, str | None]:
    if not success.marker:
        return Status.OK, None
    log = success.marker in (RUN_STDOUT, RUN_STDERR)
    marker = Path(result.directory, "" if log else RUN_OUTPUT, success.marker)
    if not marker.is_file():
        return Status.FAILED, f"did not write its marker {success.marker!r}"
    if success.contains and success.contains.encode() not in marker.read_bytes():
        return Status.FAILED, f"its marker {success.marker!r} does not contain {success.contains!r}"
    return Status.OK, None


def matches(path: str, pattern: str) -> bool:
    """Whether an output file is meant by a pattern; `*` matches slashes too."""
    return fnmatch.fnmatchcase(path, pattern.removeprefix("./"))


def table_name(path: str) -> str:
    """The table that an undeclared file becomes: by its name."""
    stem = "".join(c if c.isalnum() and c.isascii() else "_" for c in PurePosixPath(path).stem)
    name = ("_" if stem[:1].isdigit() else "") + stem or "_"
    return name if check_name(name) else name + "_"


@dataclass(frozen=True, slots=True)
class _Judged:
    result: Result
    status: Status
    reason: str | None


class Recorder:
    """Takes results, and writes them to the store now and then, and at the end."""

    def __init__(self, store: Store, session: SessionPaths, context: Context) -> None:
        self._store = store
        self._session = session
        self._context = context
        self._reading = context.reading
        self._pending: list[_Judged] = []
        self._bytes = 0
        self._began = self._flushed = time.monotonic()
        self._shapes: dict[str, Shape] = {}

    def add(self, result: Result) -> Status:
        """Take one result; how it is judged so far. One that was interrupted is not kept."""
        status, reason = judge(result, self._context.outputs, self._context.success)
        if status is Status.INTERRUPTED:
            discard(Path(result.directory))
        else:
            self._pending.append(_Judged(result, status, reason))
            self._bytes += sum(file.bytes for file in result.outputs)
        return status

    def due(self) -> bool:
        """Whether it is time to write: soon at first, then ever less often, so that segments stay few."""
        now = time.monotonic()
        patience = min(max(SOON_S, 0.5 * (now - self._began)), LATE_S)
        many = len(self._pending) >= PENDING_RUNS or self._bytes >= PENDING_BYTES
        return bool(self._pending) and (many or now - self._flushed >= patience)

    def flush(self) -> list[tuple[str, Status, str]]:
        """Write what is pending; the executions among it that are not good: run, status, reason.

        Raises Missing where the disk is full or may not be written; nothing is lost then.
        """
        self._flushed = time.monotonic()
        if not self._pending:
            return []
        writer = self._store.writer(self._session.segment, self._context.batch)
        judged = self._write(writer, self._pending)
        self._store.publish(writer)
        for one in judged:
            discard(Path(one.result.directory))
        self._pending, self._bytes = [], 0
        return [(one.result.run, one.status, one.reason or "") for one in judged if one.status is not Status.OK]

    def _write(self, writer: Writer, pending: Sequence[_Judged]) -> list[_Judged]:
        tables, rows, faults = self._tables(writer, pending)
        judged = [self._judge_again(one, tables, rows, faults) for one in pending]
        objects = Objects(writer.path("objects"))
        artifacts: list[dict[str, Any]] = []
        for one in judged:
            artifacts += self._artifacts(one, tables, rows, objects)
        objects.close()
        writer.rows("artifacts", artifacts)
        writer.rows("executions", (self._execution(one) for one in judged))
        return judged

    # ------------------------------------------------------------ tables

    def _tables(
        self, writer: Writer, pending: Sequence[_Judged]
    ) -> tuple[dict[tuple[str, str], str], dict[tuple[str, str, str], int], dict[str, str]]:
        """Read all tables of good executions: which file is which table's, rows of each, faults by execution."""
        from sierra.store import connect

        belongs: dict[tuple[str, str], str] = {}
        files: dict[str, list[Written]] = {}
        shapes: dict[str, Shape] = {}
        for one in pending:
            if one.status is Status.OK:
                for name, shape, file in self._assigned(one.result):
                    belongs[one.result.execution, file.path] = name
                    shapes.setdefault(name, shape)
                    files.setdefault(name, []).append(_written(one.result, file))
        rows: dict[tuple[str, str, str], int] = {}
        faults: dict[str, str] = {}
        if files:
            connection = connect()
            try:
                for name, written in files.items():
                    shape = self._shapes.get(name, shapes[name])
                    reading = read(connection, written, shape, writer.path(OUTPUT + name))
                    self._shapes[name] = reading.shape
                    rows |= {(name, execution, file): count for (execution, file), count in reading.rows.items()}
                    for execution, fault in reading.faults.items():
                        faults.setdefault(execution, fault)
            finally:
                connection.close()
        return belongs, rows, faults

    def _assigned(self, result: Result) -> Iterator[tuple[str, Shape, OutputFile]]:
        """The files of one execution that become tables: the declared ones, then what ends like a table."""
        automatic = []
        for file in result.outputs:
            if shown(file.path) != file.path:
                continue
            declared = next((n for n, o in self._context.outputs.items() if matches(file.path, o.file)), None)
            if declared is not None:
                output = self._context.outputs[declared]
                if output.kind != "file":
                    yield declared, _shape(output), file
            elif "/" not in file.path and PurePosixPath(file.path).suffix.lower() in AUTOMATIC:
                automatic.append(file)
        if len(automatic) <= AUTOMATIC_AT_MOST:
            taken: set[str] = set(self._context.outputs)
            for file in automatic:
                name = table_name(file.path)
                if name not in taken:
                    taken.add(name)
                    yield name, Shape(AUTOMATIC[PurePosixPath(file.path).suffix.lower()]), file  # type: ignore[arg-type]

    def _judge_again(
        self,
        one: _Judged,
        tables: Mapping[tuple[str, str], str],
        rows: Mapping[tuple[str, str, str], int],
        faults: Mapping[str, str],
    ) -> _Judged:
        """The same, knowing what its tables were like."""
        execution = one.result.execution
        if execution in faults:
            return _Judged(one.result, Status.MISMATCH, faults[execution])
        for name, output in self._context.outputs.items():
            if one.status is Status.OK and output.min_rows:
                for file in one.result.outputs:
                    count = rows.get((name, execution, file.path))
                    if count is not None and count < output.min_rows:
                        reason = f"{file.path}: {count} rows; [outputs.{name}] min_rows asks for {output.min_rows}"
                        return _Judged(one.result, Status.FAILED, reason)
        return one

    # ------------------------------------------------------------ records

    def _artifacts(
        self,
        one: _Judged,
        tables: Mapping[tuple[str, str], str],
        rows: Mapping[tuple[str, str, str], int],
        objects: Objects,
    ) -> Iterator[dict[str, Any]]:
        result = one.result
        mine = {"execution": result.execution, "run": result.run}
        for file in result.outputs:
            table = tables.get((result.execution, file.path))
            count = rows.get((table or "", result.execution, file.path))
            if count is None:
                objects.add_file(Path(result.directory, RUN_OUTPUT, file.path), file.sha256, file.bytes)
            yield {
                **mine,
                "path": shown(file.path),
                "kind": "file" if count is None else "table",
                "output": table,
                "size": file.bytes,
                "sha256": file.sha256,
                "rows": count,
            }
        for name in (RUN_STDOUT, RUN_STDERR):
            content, size = _log(Path(result.directory, name))
            if size:
                yield {**mine, "path": name, "kind": "log", "output": None, "size": size, "sha256": objects.add(content)}

    def _execution(self, one: _Judged) -> dict[str, Any]:
        result, context = one.result, self._context
        return {
            "execution": result.execution,
            "run": result.run,
            "session": context.session,
            "batch": context.batch,
            "started": _moment(result.started),
            "ended": _moment(result.ended),
            "status": str(one.status),
            "reason": one.reason,
            "exit_code": result.exit_code,
            "signal": result.signal,
            "wall": result.ended - result.started,
            "user": result.user_s,
            "system": result.system_s,
            "max_rss": result.max_rss_bytes,
            "host": result.host,
            "slot": result.slot,
            "result": result_hash(result.outputs),
            "log": None if one.status is Status.OK else _last_words(Path(result.directory)),
            "environment": context.environment,
            "programs": context.programs,
            "reading": self._reading,
            "purpose": context.purpose,
        }


def result_hash(outputs: Iterable[OutputFile]) -> str:
    """The Merkle hash of an execution's outputs: their names and digests, in the order of the names."""
    return merkle("result", (f"{file.sha256} {shown(file.path)}" for file in sorted(outputs, key=lambda file: file.path)))


def shown(path: str) -> str:
    """A file's name as text: bytes of it that are no UTF-8 as escapes."""
    return path.encode("utf-8", "backslashreplace").decode()


def find_odd(store: Store, session: SessionPaths, batch: str, outputs: Mapping[str, Output]) -> int:
    """Find executions whose tables have other row counts than their siblings', and record that; how many.

    Siblings are the good executions of one experiment. The row count that most of them have is right (of two
    that as many have, the greater); a declared output with `mismatch = "ragged"` is left alone.
    """
    ragged = {name for name, output in outputs.items() if output.mismatch == "ragged"}
    found = []
    for row in store.rows(ODD, batch=batch):
        if row["output"] not in ragged:
            has = f"has {row['rows']} rows" if row["rows"] is not None else "is not there"
            reason = (
                f"table {row['output']!r} {has} where {row['those']} of its {row['siblings']} siblings have {row['likely']} "
                f'(if that may be so: mismatch = "ragged" in [outputs.{row["output"]}])'
            )
            found.append({"execution": row["execution"], "found": datetime.now(UTC), "status": "mismatch", "reason": reason})
    writer = store.writer(session.segment, batch)
    writer.rows("findings", {row["execution"]: row for row in found}.values())
    store.publish(writer)
    return len({row["execution"] for row in found})


ODD = """
WITH good AS (
    SELECT m.ordinal, e.run, arg_max(e.execution, e.ended) AS execution
    FROM (SELECT DISTINCT ordinal, run FROM members WHERE batch = $batch) m
    JOIN executions e ON e.run = m.run AND e.status = 'ok' AND e.purpose = 'run'
    GROUP BY ALL
),
tables AS (
    SELECT g.ordinal, g.execution, a.output, sum(a.rows) AS rows
    FROM good g JOIN artifacts a ON a.execution = g.execution AND a.kind = 'table'
    GROUP BY ALL
),
expected AS (SELECT DISTINCT ordinal, output FROM tables),
counted AS (
    SELECT g.ordinal, g.execution, x.output, t.rows
    FROM good g JOIN expected x USING (ordinal) LEFT JOIN tables t USING (ordinal, execution, output)
),
frequent AS (
    SELECT ordinal, output, rows, count(*) AS those FROM counted GROUP BY ALL
),
likely AS (
    SELECT ordinal, output, arg_max(rows, (those, coalesce(rows, -1))) AS rows, max(those) AS those, sum(those) AS siblings
    FROM frequent GROUP BY ALL HAVING count(*) > 1
)
SELECT c.execution, c.output, c.rows::BIGINT AS rows, l.rows::BIGINT AS likely, l.those, l.siblings::BIGINT AS siblings
FROM counted c JOIN likely l USING (ordinal, output)
WHERE c.rows IS DISTINCT FROM l.rows AND l.rows IS NOT NULL
ORDER BY ALL
"""


def discard(folder: Path) -> None:
    """Remove a run's folder; what is recorded is not needed there any more."""
    shutil.rmtree(folder, ignore_errors=True)


def _shape(output: Output) -> Shape:
    many = any(c in output.file for c in "*?[")
    return Shape(output.kind, output.delimiter, output.header, output.columns, many)  # type: ignore[arg-type]


def _written(result: Result, file: OutputFile) -> Written:
    path = str(Path(result.directory, RUN_OUTPUT, file.path))
    return Written(path, result.run, result.execution, file.path, file.head, file.lines, file.ended, file.bytes)


def _log(path: Path) -> tuple[bytes, int]:
    """What is kept of a log, and how long it was."""
    try:
        size = path.stat().st_size
        if not size:
            return b"", 0
        with path.open("rb") as file:
            if size <= LOG_KEPT:
                return file.read(), size
            head = file.read(LOG_KEPT // 4)
            file.seek(-3 * LOG_KEPT // 4, 2)
            return head + b"\n[... %d bytes left out ...]\n" % (size - LOG_KEPT) + file.read(), size
    except FileNotFoundError:
        return b"", 0


def _last_words(folder: Path) -> str | None:
    for name in (RUN_STDERR, RUN_STDOUT):
        content, _ = _log(folder / name)
        if content.strip():
            return content[-LOG_SHOWN:].decode("utf-8", "replace").strip()
    return None


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return "unknown"
