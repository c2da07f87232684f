"""Recording: what workers say becomes segments of the store, checked on the way.

An execution is judged here and nowhere else: by its exit status, the outputs and the marker that the project
asks for, and by the tables it wrote (see `sierra.store.reading`). What is only known once its siblings are
there too (other row counts or columns than theirs, a table that it alone lacks or has) becomes a *finding*.

Recording may be repeated: what is in the store already is not recorded again, so a session that died is
finished by reading its journal once more.
"""

from __future__ import annotations

import fnmatch
import json
import os
import signal
import stat
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

from sierra import worker
from sierra.config import Output, Success
from sierra.hashing import digest, merkle
from sierra.model import OutputFile, Result, Status
from sierra.paths import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT, SessionPaths, write_whole
from sierra.store import Store
from sierra.store.objects import Objects
from sierra.store.reading import Reading, Shape, Written, difference, kinds, read, shown
from sierra.store.segments import OUTPUT, Writer, disk_errors
from sierra.store.tables import check_name

LOG_KEPT = 1 << 20
"""Bytes of each log that are kept at most: its beginning and, thrice as much, its end."""
LOG_SHOWN = 2000
AUTOMATIC = {".csv": "csv", ".tsv": "csv", ".parquet": "parquet", ".jsonl": "jsonl", ".ndjson": "jsonl"}
AUTOMATIC_AT_MOST = 20
"""Undeclared tables of one run; beyond, its undeclared files are kept as files."""
PENDING_RUNS = 4_000
PENDING_BYTES = 256 << 20
SOON_S, LATE_S = 2.0, 600.0

STOPPED = {
    Status.TIMEOUT: "ran longer than its limit ([limits] wall)",
    Status.MEMORY: "took more memory than its limit ([limits] memory)",
    Status.CPU: "took more CPU time than its limit ([limits] cpu)",
    Status.OUTPUT: "wrote more bytes than its limit ([limits] output; standard output and error: 256 MiB each)",
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
        return self._declared({"mismatch", "units", "time"})

    @property
    def rules(self) -> str:
        """The hash of the same, and of what may differ between siblings."""
        return self._declared({"units", "time"})

    def _declared(self, without: set[str]) -> str:
        outputs = {name: output.model_dump(mode="json", exclude=without) for name, output in self.outputs.items()}
        return digest("reading", {"outputs": outputs, "success": self.success.model_dump(mode="json")})

    def save(self, path: Path) -> None:
        fields = {name: getattr(self, name) for name in ("session", "batch", "purpose", "environment", "programs")}
        fields["outputs"] = {name: output.model_dump(mode="json") for name, output in self.outputs.items()}
        fields["success"] = self.success.model_dump(mode="json")
        with disk_errors(path.parent):
            write_whole(path, json.dumps(fields).encode())

    @classmethod
    def load(cls, path: Path) -> Context:
        fields = json.loads(path.read_text())
        fields["outputs"] = {name: Output.model_validate(output) for name, output in fields["outputs"].items()}
        fields["success"] = Success.model_validate(fields["success"])
        return cls(**fields)


def judge(result: Result, outputs: Mapping[str, Output], success: Success) -> tuple[Status, str | None]:
    """Whether an execution is good by what is known at once, and why not."""
    if result.error is not None:
        return Status.FAILED, result.error
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
    if marker.is_symlink() or not marker.is_file():
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
        self._heads: dict[str, list[str]] = {}

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
        tables, readings, faults = self._tables(writer, pending)
        judged = [self._judge_again(one, tables, readings, faults) for one in pending]
        objects = Objects(writer.path("objects"))
        artifacts: list[dict[str, Any]] = []
        for one in judged:
            artifacts += self._artifacts(one, tables, readings, objects)
        objects.close()
        writer.rows("artifacts", artifacts)
        writer.rows("executions", (self._execution(one) for one in judged))
        return judged

    # ------------------------------------------------------------ tables

    def _tables(
        self, writer: Writer, pending: Sequence[_Judged]
    ) -> tuple[dict[tuple[str, str], str], dict[str, Reading], dict[str, str]]:
        """Read all tables of good executions: which file is which table's, what was read, faults by execution."""
        from sierra.store import connect

        belongs: dict[tuple[str, str], str] = {}
        files: dict[str, list[Written]] = {}
        shapes: dict[str, Shape] = {}
        for one in pending:
            if one.status is Status.OK:
                for name, shape, file in self._assigned(one.result):
                    part = self._part(name, shape, file)
                    belongs[one.result.execution, file.path] = part
                    shapes.setdefault(part, shape)
                    files.setdefault(part, []).append(_written(one.result, file))
        readings: dict[str, Reading] = {}
        faults: dict[str, str] = {}
        if files:
            connection = connect()
            try:
                for name, written in files.items():
                    shape = self._shapes.get(name, shapes[name])
                    reading = read(connection, written, shape, writer.path(OUTPUT + name))
                    self._shapes[name] = reading.shape
                    readings[name] = reading
                    for execution, fault in reading.faults.items():
                        faults.setdefault(execution, fault)
            finally:
                connection.close()
        return belongs, readings, faults

    def _part(self, name: str, shape: Shape, file: OutputFile) -> str:
        """Which file of a segment a table's rows go to: where columns may differ, one for each set of columns."""
        declared = self._context.outputs.get(name)
        if declared is None or declared.mismatch == "strict" or shape.format != "csv" or not shape.header:
            return name
        heads = self._heads.setdefault(name, [])
        if file.head not in heads:
            heads.append(file.head)
        place = heads.index(file.head) + 1
        return name if place == 1 else f"{name}~{place}"

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
            taken = {name.lower() for name in self._context.outputs}
            for file in automatic:
                name = table_name(file.path)
                if name.lower() not in taken:
                    taken.add(name.lower())
                    yield name, Shape(AUTOMATIC[PurePosixPath(file.path).suffix.lower()]), file  # type: ignore[arg-type]

    def _judge_again(
        self,
        one: _Judged,
        tables: Mapping[tuple[str, str], str],
        readings: Mapping[str, Reading],
        faults: Mapping[str, str],
    ) -> _Judged:
        """The same, knowing what its tables were like."""
        execution = one.result.execution
        if execution in faults:
            return _Judged(one.result, Status.MISMATCH, faults[execution])
        for file in one.result.outputs if one.status is Status.OK else ():
            part = tables.get((execution, file.path), "")
            output = self._context.outputs.get(_table_of(part))
            count = readings[part].rows.get((execution, file.path)) if part else None
            if output and count is not None and count < output.min_rows:
                reason = f"{file.path}: {count} rows; [outputs.{_table_of(part)}] min_rows asks for {output.min_rows}"
                return _Judged(one.result, Status.FAILED, reason)
        return one

    # ------------------------------------------------------------ records

    def _artifacts(
        self,
        one: _Judged,
        tables: Mapping[tuple[str, str], str],
        readings: Mapping[str, Reading],
        objects: Objects,
    ) -> Iterator[dict[str, Any]]:
        result = one.result
        mine = {"execution": result.execution, "run": result.run}
        for file in result.outputs:
            table = tables.get((result.execution, file.path))
            reading = readings.get(table or "")
            count = reading.rows.get((result.execution, file.path)) if reading else None
            if count is None:
                objects.add_file(Path(result.directory, RUN_OUTPUT, file.path), file.sha256, file.bytes)
            yield {
                **mine,
                "path": shown(file.path),
                "kind": "file" if count is None else "table",
                "output": _table_of(table) if table else None,
                "size": file.bytes,
                "sha256": file.sha256,
                "rows": count,
                "form": _form(reading, file) if reading and count is not None else None,
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


def _table_of(part: str) -> str:
    """The table whose rows a file of a segment holds."""
    return part.partition("~")[0]


def result_hash(outputs: Iterable[OutputFile]) -> str:
    """The Merkle hash of an execution's outputs: their names and digests, in the order of the names."""
    return merkle("result", (f"{file.sha256} {shown(file.path)}" for file in sorted(outputs, key=lambda file: file.path)))


def find_odd(store: Store, session: SessionPaths, context: Context) -> int:
    """Find executions whose tables are not like their siblings', and record that; how many.

    Siblings are the good executions of one experiment with the same programs, whenever they were recorded. What most
    of them have is right (of two that as many have, the more). Row counts and columns of an output with
    `mismatch = "ragged"` may differ, and one that is not required may be absent.
    """
    if not store.rows("SELECT 1 FROM artifacts WHERE kind = 'table' LIMIT 1"):
        return 0
    tables: dict[tuple[int, str], list[dict[str, Any]]] = {}
    for row in store.rows(ODD, batch=context.batch, programs=context.programs, reading=context.reading):
        tables.setdefault((row["ordinal"], row["output"]), []).append(row)
    found: dict[str, dict[str, Any]] = {}
    for (_, name), siblings in sorted(tables.items()):
        for execution, reason in _odd(siblings, name, context.outputs.get(name)):
            now = datetime.now(UTC)
            found.setdefault(execution, {"execution": execution, "found": now, "status": "mismatch", "reason": reason})
    writer = store.writer(session.segment, context.batch)
    writer.rows("findings", found.values())
    store.publish(writer)
    return len(found)


def _odd(siblings: Sequence[Mapping[str, Any]], name: str, declared: Output | None) -> Iterator[tuple[str, str]]:
    """The executions among siblings whose table `name` differs, and how."""
    having = [row for row in siblings if row["rows"] is not None]
    lacking = [row for row in siblings if row["rows"] is None]
    count = len(siblings)
    ragged = declared is not None and declared.mismatch == "ragged"
    if declared is None or declared.required:
        if len(having) < len(lacking):
            for row in having:
                yield row["execution"], f"there is a table {name!r}, which {len(lacking)} of its {count} siblings do not have"
            return
        for row in lacking:
            yield row["execution"], f"table {name!r} is not there; {len(having)} of its {count} siblings have it"
    forms = Counter(form for row in having for form in row["forms"])
    likely = json.loads(max(forms, key=lambda form: (forms[form], *_fullness(json.loads(form)))))
    for row in having:
        for form in row["forms"]:
            if reason := _unlike(json.loads(form), likely, ragged=ragged):
                yield row["execution"], f"table {name!r} {reason}"
    if not ragged:
        rows = Counter(row["rows"] for row in having)
        most = max(rows, key=lambda number: (rows[number], number))
        allow = f'(if that may be so: mismatch = "ragged" in [outputs.{name}])'
        for row in having:
            if row["rows"] != most:
                told = f"has {row['rows']} rows where {rows[most]} of its {count} siblings have {most}"
                yield row["execution"], f"table {name!r} {told} {allow}"


def _fullness(form: Mapping[str, Any]) -> tuple[bool, int, int]:
    return form["ended"], len(form["columns"]), list(form["columns"].values()).count("number")


def _unlike(form: Mapping[str, Any], likely: Mapping[str, Any], *, ragged: bool) -> str | None:
    """What makes a table unlike its siblings', beside its rows."""
    if form["file"] != likely["file"]:
        return f"comes from {form['file']!r} where its siblings' come from {likely['file']!r}"
    columns, others = form["columns"], likely["columns"]
    if columns.keys() != others.keys() and columns and not ragged:
        return difference(tuple(columns), tuple(others))
    for name, kind in columns.items():
        if kind not in ("number", others.get(name)) and others.get(name) == "number":
            return f"has {kind} in the column {name!r} where its siblings have numbers"
    if likely["ended"] and not form["ended"]:
        return "is cut short: its last line has no line feed at its end"
    return None


ODD = """
WITH good AS (
    SELECT m.ordinal, e.run, arg_max(e.execution, e.ended) AS execution
    FROM (SELECT DISTINCT ordinal, run FROM members WHERE batch = $batch) m
    JOIN executions e ON e.run = m.run AND e.status = 'ok' AND e.purpose = 'run'
        AND e.programs = $programs AND e.reading = $reading
    GROUP BY ALL
),
tables AS (
    SELECT g.ordinal, g.execution, a.output, sum(a.rows)::BIGINT AS rows, list_sort(list(DISTINCT a.form)) AS forms
    FROM good g JOIN artifacts a ON a.execution = g.execution AND a.kind = 'table'
    GROUP BY ALL
),
counted AS (
    SELECT g.ordinal, g.execution, x.output, t.rows, t.forms
    FROM good g JOIN (SELECT DISTINCT ordinal, output FROM tables) x USING (ordinal)
    LEFT JOIN tables t USING (ordinal, execution, output)
),
differing AS (
    SELECT ordinal, output FROM counted GROUP BY ALL
    HAVING count(rows) < count(*) OR min(rows) < max(rows) OR min(forms) < max(forms)
)
SELECT c.* FROM counted c JOIN differing USING (ordinal, output) ORDER BY execution
"""


def discard(folder: Path) -> None:
    """Remove a run's folder; what is recorded is not needed there any more."""
    worker.remove(str(folder))


def _form(reading: Reading, file: OutputFile) -> str:
    """What a table looks like, for a comparison with its siblings'."""
    shape = reading.shape
    whole = file.ended or shape.format != "csv"
    return json.dumps({"file": None if shape.many else shown(file.path), "columns": kinds(shape), "ended": whole})


def _shape(output: Output) -> Shape:
    many = any(c in output.file for c in "*?[")
    return Shape(output.kind, output.delimiter, output.header, output.columns, many)  # type: ignore[arg-type]


def _written(result: Result, file: OutputFile) -> Written:
    path = str(Path(result.directory, RUN_OUTPUT, file.path))
    return Written(path, result.run, result.execution, file.path, file.head, file.lines, file.ended, file.bytes)


def _log(path: Path) -> tuple[bytes, int]:
    """What is kept of a log, and how long it was. A link that a run put in its place is not followed."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return b"", 0
    with os.fdopen(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or path.parent.is_symlink():
            return b"", 0
        size = found.st_size
        if size <= LOG_KEPT:
            return file.read(), size
        head = file.read(LOG_KEPT // 4)
        file.seek(-3 * LOG_KEPT // 4, 2)
        return head + b"\n[... %d bytes left out ...]\n" % (size - LOG_KEPT) + file.read(), size


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
