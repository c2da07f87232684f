"""Recording: what workers say becomes segments of the store, checked on the way.

An execution is judged here and nowhere else: by its exit status, the outputs and the marker that the project
asks for, and by the tables it wrote (see `sierra.store.reading`). What is only known once its siblings, the other
runs of its experiment, are there too (other row counts or columns than theirs, a table that it alone lacks or has)
becomes a *finding*, and so does a column that holds something else than theirs (see `_kind`).

Recording may be repeated: what is in the store already is not recorded again, so a session that died is
finished by reading its journal once more.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import stat
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

from sierra import engines, worker
from sierra.config import Output, Success
from sierra.hashing import digest, merkle, short
from sierra.model import OutputFile, Result, Status
from sierra.paths import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT, SessionPaths, write_whole
from sierra.store import Question, Store
from sierra.store.objects import Objects
from sierra.store.reading import (
    AS_TEXT,
    Reading,
    Shape,
    Siblings,
    Written,
    column_names,
    difference,
    identifier,
    own_kind,
    read,
    right_kind,
    shown,
)
from sierra.store.segments import OUTPUT, Writer, disk_errors
from sierra.store.tables import check_name

LOG_KEPT = 1 << 20
"""Bytes of each log that are kept at most: its beginning and, thrice as much, its end."""
LOG_SHOWN = 2000
AUTOMATIC = {".csv": "csv", ".tsv": "csv", ".parquet": "parquet", ".jsonl": "jsonl", ".ndjson": "jsonl"}
AUTOMATIC_AT_MOST = 20
"""Undeclared tables of one run; beyond, its undeclared files are kept as files."""
NOTED_AT_MOST = 1000
IN_FOLDERS = 'undeclared, in a subfolder ([outputs.NAME] file = "{glob}" makes a table of them)'
TOO_MANY = f'undeclared, and of more than {AUTOMATIC_AT_MOST} in a run ([outputs.NAME] file = "{{glob}}" makes a table of them)'
TAKEN = 'undeclared, and another has the table of that name already ([outputs.NAME] file = "{file}" makes it a table)'
NOT_UTF8 = "with a name that is no UTF-8"
"""Why files that look like tables are kept as files."""
UNREAD = {"units", "time", "tolerance", "ordered", "volatile"}
"""Of an output, what makes no difference to how it is recorded."""
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


SAVED = ("session", "batch", "purpose", "environment", "programs", "engine", "isolation", "shared", "enforced")


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
    engine: str = "none"
    isolation: Mapping[str, Any] | None = None
    """How the runs were contained, as a row of `isolations`; None where they were not."""
    shared: bool = False
    enforced: tuple[str, ...] = ()
    """The limits that the engine enforces."""

    @property
    def reading(self) -> str:
        """The hash of what decides whether an execution is good and what is kept of it."""
        return self._declared({"mismatch", *UNREAD})

    @property
    def rules(self) -> str:
        """The hash of the same, and of what may differ between siblings."""
        return self._declared(UNREAD)

    @property
    def declared(self) -> str:
        """What the project declares of outputs and success, as JSON."""
        return json.dumps(self._tables())

    def _tables(self) -> dict[str, Any]:
        outputs = {name: output.model_dump(mode="json") for name, output in self.outputs.items()}
        return {"outputs": outputs, "success": self.success.model_dump(mode="json")}

    def _declared(self, without: set[str]) -> str:
        outputs = {name: output.model_dump(mode="json", exclude=without) for name, output in self.outputs.items()}
        return digest("reading", {"outputs": outputs, "success": self.success.model_dump(mode="json")})

    def save(self, path: Path) -> None:
        fields = {name: getattr(self, name) for name in SAVED}
        fields |= self._tables()
        with disk_errors(path.parent):
            write_whole(path, json.dumps(fields).encode())

    @classmethod
    def load(cls, path: Path) -> Context:
        fields = json.loads(path.read_text())
        fields["outputs"], fields["success"] = rules_of(fields)
        return cls(**fields)


def rules_of(declared: Mapping[str, Any]) -> tuple[dict[str, Output], Success]:
    """What a project declared of outputs and success, as `Context.declared` keeps it."""
    outputs = {name: Output.model_validate(output) for name, output in declared["outputs"].items()}
    return outputs, Success.model_validate(declared["success"])


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
        if output.required and not any(output.matches(file.path) for file in result.outputs):
            return Status.FAILED, f"did not write {output.file!r} (output {name!r})"
    return _marked(result, success)


def _marked(result: Result, success: Success) -> tuple[Status, str | None]:
    if not success.marker:
        return Status.OK, None
    log = success.marker in (RUN_STDOUT, RUN_STDERR)
    marker = Path(result.directory, "" if log else RUN_OUTPUT, success.marker)
    there = not marker.is_symlink() and marker.is_file()
    if not there and not log:  # a log that is not there is empty
        return Status.FAILED, f"did not write its marker {success.marker!r}"
    if success.contains and not (there and success.contains.encode() in marker.read_bytes()):
        return Status.FAILED, f"its marker {success.marker!r} does not contain {success.contains!r}"
    return Status.OK, None


def table_name(path: str) -> str:
    """The table that an undeclared file becomes: by its name."""
    stem = "".join(c if c.isalnum() and c.isascii() else "_" for c in PurePosixPath(path).stem)
    name = ("_" if stem[:1].isdigit() else "") + stem or "_"
    return name if check_name(name) else name + "_"


def _automatic(path: str) -> str | None:
    """The format of what is a table by its ending."""
    return AUTOMATIC.get(PurePosixPath(path).suffix.lower())


@dataclass(frozen=True, slots=True)
class _Judged:
    result: Result
    status: Status
    reason: str | None


def _doubted(one: _Judged, doubt: str) -> _Judged:
    return _Judged(one.result, Status.FAILED, doubt) if one.status is Status.OK else one


class Recorder:
    """Takes results, and writes them to the store now and then, and at the end."""

    def __init__(
        self,
        store: Store,
        session: SessionPaths,
        context: Context,
        kept: Path | None = None,
        doubt: Callable[[], str | None] = lambda: None,
    ) -> None:
        """`kept`: the folder that the runs' folders are moved to once they are recorded; without, they are removed.

        `doubt` says, before anything is written, why none of what has ended since can be good.
        """
        self._folder = kept
        self._doubt = doubt
        self._store = store
        self._session = session
        self._context = context
        self._reading = context.reading
        self._pending: list[_Judged] = []
        self._beside: dict[str, list[Mapping[str, Any]]] = {}
        self._around: set[str] = set()
        """Environments that are recorded, or will be: mostly one for all elements."""
        self._ruled = 0
        """In how many segments what all executions have in common is recorded."""
        self._copies: list[Result] = []
        self._copied = self._unlike = 0
        self._bytes = 0
        self._began = self._flushed = time.monotonic()
        self._shapes: dict[str, Shape] = {}
        self._kept: dict[str, dict[str, None]] = {}
        """Files that look like tables and become none: why, and which."""

    def add(self, result: Result) -> Status:
        """Take one result; how it is judged so far. One that was interrupted is not kept."""
        result = self._ended(result)
        status, reason = judge(result, self._context.outputs, self._context.success)
        if status is Status.INTERRUPTED:
            discard(Path(result.directory))
        else:
            self._pending.append(_Judged(result, status, reason))
            self._bytes += sum(file.bytes for file in result.outputs)
        return status

    def _ended(self, result: Result) -> Result:
        """The result, where an engine's client stood between the program and the worker."""
        if self._context.isolation is None or self._context.shared or result.exit_code == 0:
            return result
        said = _log(f"{result.directory}/{RUN_STDERR}")[0][-LOG_SHOWN:].decode("utf-8", "replace")
        return engines.find(self._context.engine).classify(result, said, frozenset(self._context.enforced))

    def beside(self, rows: Iterable[tuple[str, Mapping[str, Any]]], copies: Iterable[Result]) -> None:
        """Take what else is to be recorded: rows by their table, and runs that were executed once more than was asked."""
        for table, row in rows:
            if table == "environments":
                if row["environment"] in self._around:
                    continue
                self._around.add(row["environment"])
            self._beside.setdefault(table, []).append(row)
        self._copies += copies

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
        if not (self._pending or self._beside or self._copies):
            return []
        writer = self._store.writer(self._session.segment, self._context.batch)
        for table, rows in self._beside.items():
            writer.rows(table, rows)
        writer.rows("copies", self._compared())
        if (doubt := self._doubt()) is not None:
            self._pending = [_doubted(one, doubt) for one in self._pending]
        judged = self._write(writer, self._pending)
        self._store.publish(writer)
        self._ruled += 1
        for one in judged:
            self._put_away(one.result)
        self._pending, self._bytes = [], 0
        self._beside, self._copies = {}, []
        return [(one.result.run, one.status, one.reason or "") for one in judged if one.status is not Status.OK]

    def _compared(self) -> Iterator[dict[str, Any]]:
        """The copies that are not recorded yet, each compared with what is recorded of its execution."""
        if not self._copies:
            return
        recorded = {one.result.execution: result_hash(one.result.outputs) for one in self._pending}
        rows = self._store.rows("SELECT execution, result FROM executions WHERE session = $s", s=self._context.session)
        recorded |= {row["execution"]: row["result"] for row in rows}
        told = self._store.rows(COPIES, s=self._context.session)
        known = {(row["execution"], row["attempt"]) for row in told}
        for copy in (one for one in self._copies if (one.execution, one.attempt) not in known):
            result = result_hash(copy.outputs)
            same = recorded.get(copy.execution) == result
            self._copied, self._unlike = self._copied + 1, self._unlike + (not same)
            yield {"execution": copy.execution, "run": copy.run, "attempt": copy.attempt, "result": result, "same": same}

    def _put_away(self, result: Result) -> None:
        folder = Path(result.directory)
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):
                shutil.move(folder, self._folder / short(result.run))
        discard(folder)

    def notes(self) -> list[str]:
        """What of the tables that were recorded is allowed, and yet hardly meant; a line each.

        Asks the store, so it is to be called once, when all is recorded and `find_odd` has looked at it.
        """
        forms = self._store.rows(GOOD + FORMS, **_asked(self._context)) if self._shapes else []
        return [*self._twice(), *self._kept_as_files(), *self._alone(forms), *self._renamed(), *self._of_kinds(forms)]

    def _twice(self) -> Iterator[str]:
        """Runs that two attempts executed at a time."""
        if self._copied:
            told = f"{self._copied} runs were executed twice, because copies of their elements lived at a time"
            unlike = f"; {self._unlike} of them came out differently: they are not deterministic" if self._unlike else ""
            yield f"{told}{unlike}; the table copies has them"

    def _kept_as_files(self) -> Iterator[str]:
        for why, files in self._kept.items():
            first = PurePosixPath(next(iter(files)))
            told = why.replace("{glob}", str(first.with_name("*" + first.suffix))).replace("{file}", str(first))
            some = "or more " if len(files) == NOTED_AT_MOST else ""
            these = f"{str(first)!r} and {len(files) - 1} {some}others are" if len(files) > 1 else f"{str(first)!r} is"
            yield f"{these} kept as {'files' if len(files) > 1 else 'a file'}: {told}"

    def _alone(self, forms: Sequence[Mapping[str, Any]]) -> Iterator[str]:
        """Columns that one run alone has in its whole batch, as it may be where there is one run per experiment."""
        sets: dict[str, Counter[tuple[str, ...]]] = {}
        for row in forms:
            sets.setdefault(row["output"], Counter())[tuple(json.loads(row["form"])["columns"])] += row["executions"]
        for name, counts in sets.items():
            declared = self._context.outputs.get(name)
            alone = sum(number == 1 for number in counts.values())
            if name in self._shapes and len(counts) > 1 and alone and (declared is None or declared.mismatch == "strict"):
                whose = "one run has columns" if alone == 1 else f"{alone} runs have columns, each its own,"
                yield f"output {name!r}: {whose} that no other run has; none of its experiment shows whether that is right"

    def _renamed(self) -> Iterator[str]:
        """Columns that SQL knows by another name, because an axis has theirs, and not their values."""
        if not self._shapes:
            return
        with self._store.ask(self._context.batch) as question:
            for name in self._shapes:
                for axis, column, called in _hidden(question, name):
                    told = f"the column {column!r} of output {name!r} is called {called!r} in SQL"
                    yield f"{told}: {axis!r} there is the independent variable, and its values are others"

    def _of_kinds(self, forms: Sequence[Mapping[str, Any]]) -> Iterator[str]:
        """Columns that hold one thing in some runs and another in others, and texts that were hardly meant as such."""
        kinds: dict[tuple[str, str], Counter[str]] = {}
        for row in forms:
            for name, kind in json.loads(row["form"])["columns"].items():
                if kind != "empty" and row["output"] in self._shapes:
                    kinds.setdefault((row["output"], name), Counter())[kind] += row["executions"]
        for (output, name), counts in kinds.items():
            stored = {"text" if kind.endswith(AS_TEXT) else kind for kind in counts}
            if len(stored) > 1:
                held = ", ".join(f"{_many(kind)} in {count}" for kind, count in sorted(counts.items()))
                as_text = "all as text, and a number's text need not be the file's (1e5 is 100000.0)"
                seen = as_text if "text" in stored else "true as 1"
                yield f"column {name!r} of output {output!r} holds {held} runs; SQL shows {seen}"
        texts = [key for key, counts in kinds.items() if counts["text"]]
        for output, name in texts:
            if self._shapes[output].format == "csv" and len(name.split()) > 1 and _only_column(kinds, output, name):
                told = f'delimiter = " " in [outputs.{output}]?'
                yield f"output {output!r} is one column {name!r} of texts: {told}"
        alone = [key for key in texts if all(kind == "text" or kind.endswith(AS_TEXT) for kind in kinds[key])]
        yield from self._numeric_texts([key for key in alone if len(key[1].split()) == 1], kinds)

    def _numeric_texts(self, texts: Sequence[tuple[str, str]], kinds: Mapping[tuple[str, str], Counter[str]]) -> Iterator[str]:
        """Columns of texts most of which are numbers, by the first rows that are there."""
        if not texts:
            return
        with self._store.ask(self._context.batch) as question:
            for output, name in texts[:NOTED_AT_MOST]:
                question.views.make((output,))
                named = {row[0].lower(): row[0] for row in question.run(f"DESCRIBE {identifier(output)}")}
                column = next((named[n] for n in (name.lower() + "_", name.lower()) if n in named), None)
                if column is None:
                    continue
                statement = NUMERIC.format(column=identifier(column), table=identifier(output))
                [(cells, numbers)] = question.run(statement)
                if numbers * 2 > cells:
                    counts = kinds[output, name]
                    runs = f"{counts['text']} of {counts.total()} runs"
                    told = "most of its cells are numbers: decimal commas? NA?"
                    yield f"column {name!r} of output {output!r} is text in {runs}; {told}"

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
        if self._ruled < 2:  # twice, as where one segment is damaged no others are to be lost
            writer.rows("readings", [{"reading": self._reading, "declared": self._context.declared}])
            writer.rows("isolations", [self._context.isolation] if self._context.isolation else [])
        return judged

    # ------------------------------------------------------------ tables

    def _tables(
        self, writer: Writer, pending: Sequence[_Judged]
    ) -> tuple[dict[tuple[str, str], str], dict[str, Reading], dict[str, str]]:
        """Read all tables of good executions: which file is which table's, what was read, faults by execution."""
        from sierra.store.connections import connect

        belongs: dict[tuple[str, str], str] = {}
        files: dict[str, list[Written]] = {}
        for one in pending:
            if one.status is Status.OK:
                for name, shape, file in self._assigned(one.result):
                    belongs[one.result.execution, file.path] = name
                    self._shapes.setdefault(name, shape)
                    files.setdefault(name, []).append(_written(one.result, file))
        readings: dict[str, Reading] = {}
        faults: dict[str, str] = {}
        if files:
            connection = connect()
            try:
                for name, written in files.items():
                    reading = read(connection, written, self._shapes[name], writer.path(OUTPUT + name), self._siblings(name))
                    self._shapes[name] = reading.shape
                    readings[name] = reading
                    for execution, fault in reading.faults.items():
                        faults.setdefault(execution, fault)
            finally:
                connection.close()
        return belongs, readings, faults

    def _siblings(self, name: str) -> Siblings:
        """What the store has of the table `name` in the experiments of this batch, whoever asked for them."""
        asked = {**_asked(self._context), "output": name}
        with self._store.ask() as question:
            if not question.sql(ANY_TABLE).num_rows:
                return Siblings()
            forms = question.sql(SIBLINGS + SIBLINGS_FORMS, **asked).to_pylist()
        mixed = {
            column
            for row in forms
            for column, kind in json.loads(row["form"])["columns"].items()
            if kind not in ("number", "empty")
        }

        def ask(runs: Sequence[str]) -> tuple[dict[str, Any], dict[tuple[Any, str], Counter[str]]]:
            places = self._store.rows(PLACES, batch=self._context.batch)
            votes: dict[tuple[Any, str], Counter[str]] = {}
            for row in self._store.rows(SIBLINGS + SIBLINGS_VOTES, **asked):
                for column, kind in json.loads(row["form"])["columns"].items():
                    if kind != "empty":
                        votes.setdefault((row["ordinal"], column), Counter())[own_kind(kind)] += row["executions"]
            wanted = set(runs)
            return {row["run"]: row["ordinal"] for row in places if row["run"] in wanted}, votes

        return Siblings(frozenset(mixed), ask)

    def _assigned(self, result: Result) -> Iterator[tuple[str, Shape, OutputFile]]:
        """The files of one execution that become tables: the declared ones, then what ends like a table."""
        automatic = []
        for file in result.outputs:
            declared = next((n for n, o in self._context.outputs.items() if o.matches(file.path)), None)
            kind = self._context.outputs[declared].kind if declared else _automatic(file.path)
            if kind in (None, "file"):
                continue
            if shown(file.path) != file.path:
                self._keep(NOT_UTF8, file)
            elif declared is not None:
                yield declared, _shape(self._context.outputs[declared]), file
            elif "/" in file.path:
                self._keep(IN_FOLDERS, file)
            else:
                automatic.append(file)
        if len(automatic) > AUTOMATIC_AT_MOST:
            for file in automatic:
                self._keep(TOO_MANY, file)
            return
        taken = {name.lower() for name in self._context.outputs}
        for file in automatic:
            name = table_name(file.path)
            if name.lower() in taken:
                self._keep(TAKEN, file)
            else:
                taken.add(name.lower())
                yield name, Shape(_automatic(file.path)), file  # type: ignore[arg-type]

    def _keep(self, why: str, file: OutputFile) -> None:
        """Note that a file is kept as it is, though it looks like a table."""
        kept = self._kept.setdefault(why, {})
        if len(kept) < NOTED_AT_MOST:
            kept[shown(file.path)] = None

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
            name = tables.get((execution, file.path), "")
            output = self._context.outputs.get(name)
            count = readings[name].rows.get((execution, file.path)) if name else None
            if output and count is not None and count < output.min_rows:
                reason = f"{file.path}: {count} rows; [outputs.{name}] min_rows asks for {output.min_rows}"
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
                "output": table,
                "size": file.bytes,
                "sha256": file.sha256,
                "rows": count,
                "form": _form(reading, result.execution, file) if reading and count is not None else None,
            }
        for name in (RUN_STDOUT, RUN_STDERR):
            content, size = _log(f"{result.directory}/{name}")
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
            "log": None if one.status is Status.OK else _last_words(result.directory),
            "environment": result.environment or context.environment,
            "programs": context.programs,
            "reading": self._reading,
            "purpose": context.purpose,
            "isolation": context.isolation and context.isolation["isolation"],
            "attempt": result.attempt,
        }


def result_hash(outputs: Iterable[OutputFile]) -> str:
    """The Merkle hash of an execution's outputs: their names and digests, in the order of the names."""
    return merkle("result", (f"{file.sha256} {shown(file.path)}" for file in sorted(outputs, key=lambda file: file.path)))


def find_odd(store: Store, session: SessionPaths, context: Context) -> int:
    """Find executions whose tables are not like their siblings', and record that; how many.

    Siblings are the good executions of one experiment with the same programs, whenever they were recorded. What most
    of them have is right (of two that as many have, the more). Row counts and columns of an output with
    `mismatch = "ragged"` may differ, and one that is not required may be absent. What a column holds (numbers, text, …)
    must be the same among siblings; between experiments it may differ, for which `Recorder.notes` has a word.
    """
    with store.ask() as question:
        if not question.sql(ANY_TABLE).num_rows:
            return 0
        rows = question.sql(GOOD + ODD, **_asked(context)).to_pylist()
    tables: dict[tuple[int, str], list[dict[str, Any]]] = {}
    for row in rows:
        tables.setdefault((row["ordinal"], row["output"]), []).append(row)
    found: dict[str, str] = {}
    for (_, name), siblings in sorted(tables.items()):
        for execution, reason in _odd(siblings, name, context.outputs.get(name)):
            found.setdefault(execution, reason)
    now = datetime.now(UTC)
    writer = store.writer(session.segment, context.batch)
    findings = ({"execution": one, "found": now, "status": "mismatch", "reason": reason} for one, reason in found.items())
    writer.rows("findings", findings)
    store.publish(writer)
    return len(found)


def _asked(context: Context) -> dict[str, str]:
    return {"batch": context.batch, "programs": context.programs, "reading": context.reading}


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
    parsed = {form: json.loads(form) for form in forms}
    likely = _likely([(parsed[form], number) for form, number in forms.items()])
    allow = _allowing(name, None if declared else likely["file"])
    for row in having:
        for form in row["forms"]:
            if reason := _unlike(parsed[form], likely, ragged, allow):
                yield row["execution"], f"table {name!r} {reason}"
    if not ragged:
        rows = Counter(row["rows"] for row in having)
        most = max(rows, key=lambda number: (rows[number], number))
        for row in having:
            if row["rows"] != most:
                told = f"has {row['rows']} rows where {rows[most]} of its {count} siblings have {most}"
                yield row["execution"], f"table {name!r} {told} {allow}"


def _allowing(name: str, undeclared: str | None) -> str:
    """How to say that tables may differ."""
    file = f"file = {json.dumps(undeclared, ensure_ascii=False)}, " if undeclared else ""
    return f'(if that may be so: {file}mismatch = "ragged" in [outputs.{name}])'


def _likely(forms: Sequence[tuple[Mapping[str, Any], int]]) -> dict[str, Any]:
    """What most tables look like, each in its turn: where they come from, their columns, what those hold, their end."""
    files: Counter[str | None] = Counter()
    columns: Counter[tuple[str, ...]] = Counter()
    ended: Counter[bool] = Counter()
    for form, number in forms:
        files[form["file"]] += number
        columns[tuple(form["columns"])] += number
        ended[form["ended"]] += number
    return {
        "file": max(files, key=lambda file: files[file]),
        "columns": max(columns, key=lambda names: (columns[names], len(names))),
        "kinds": _likely_kinds(forms),
        "ended": ended[True] >= ended[False],
    }


def _likely_kinds(forms: Iterable[tuple[Mapping[str, Any], int]]) -> dict[str, str]:
    """What each column ought to hold, and whether as text (where all siblings with numbers have kept them so)."""
    counts: dict[str, Counter[str]] = {}
    for form, number in forms:
        for name, kind in form["columns"].items():
            if kind != "empty":
                counts.setdefault(name, Counter())[kind] += number
    return {name: _kind(kinds) for name, kinds in counts.items()}


def _kind(kinds: Mapping[str, int]) -> str:
    """What siblings ought to have in a column. Numbers that are text in all of them stay so: nothing of them is lost."""
    right = right_kind(kinds)
    return right if right in kinds or right == "text" else right + AS_TEXT


def _unlike(form: Mapping[str, Any], likely: Mapping[str, Any], ragged: bool, allow: str) -> str | None:
    """What makes a table unlike its siblings', beside its rows."""
    if form["file"] != likely["file"]:
        return f"comes from {form['file']!r} where its siblings' come from {likely['file']!r}"
    columns = tuple(form["columns"])
    if columns and columns != likely["columns"] and not ragged:
        return f"{difference(columns, likely['columns'])} {allow}"
    if wrong := _misfit(form["columns"], likely["kinds"]):
        name, kind = wrong
        if (hint := form.get("hints", {}).get(name)) and likely["kinds"][name] == "number":
            return f"is unlike its siblings': {hint}"
        told = f"has {_many(kind)} in the column {name!r} where its siblings have {_many(likely['kinds'][name])}"
        again = kind.endswith(AS_TEXT) or likely["kinds"][name] == "text"
        return told + " (it was recorded before most of them; asked again, it is read as they are)" * again
    if likely["ended"] and not form["ended"]:
        return "is cut short: its last line has no line feed at its end"
    return None


def _misfit(columns: Mapping[str, str], kinds: Mapping[str, str]) -> tuple[str, str] | None:
    """The first column that does not hold what it should, and what it holds. Where texts are, all may be kept as text."""
    for name, kind in columns.items():
        right = kinds.get(name, kind)
        if kind not in (right, "empty") and not (right == "text" and kind.endswith(AS_TEXT)):
            return name, kind
    return None


def _only_column(kinds: Iterable[tuple[str, str]], output: str, name: str) -> bool:
    return [key for key in kinds if key[0] == output] == [(output, name)]


def _many(kind: str) -> str:
    own = own_kind(kind)
    return {"number": "numbers", "flag": "flags"}.get(own, own) + kind.removeprefix(own)


GOOD = """
WITH good AS (
    SELECT m.ordinal, e.run, arg_max(e.execution, e.ended) AS execution
    FROM (SELECT DISTINCT ordinal, run FROM members WHERE batch = $batch) m
    JOIN executions e ON e.run = m.run AND e.status = 'ok' AND e.purpose = 'run'
        AND e.programs = $programs AND e.reading = $reading
    GROUP BY ALL
)"""
"""The good executions of a batch, by the place of their experiment."""
FORMS = """
SELECT a.output, a.form, count(DISTINCT a.execution) AS executions
FROM artifacts a WHERE a.kind = 'table' AND a.execution IN (SELECT execution FROM good)
GROUP BY ALL ORDER BY ALL
"""
COPIES = "SELECT c.execution, c.attempt FROM copies c JOIN executions e USING (execution) WHERE e.session = $s"
ANY_TABLE = "SELECT 1 FROM artifacts WHERE kind = 'table' LIMIT 1"
PLACES = "SELECT run, min(ordinal) AS ordinal FROM members WHERE batch = $batch GROUP BY run"
SIBLINGS = """
WITH mine AS (SELECT DISTINCT ordinal, run FROM members WHERE batch = $batch),
alike AS (SELECT DISTINCT mine.ordinal, m.batch, m.ordinal AS theirs FROM mine JOIN members m USING (run)),
family AS (
    SELECT DISTINCT a.ordinal, m.run FROM alike a JOIN members m ON m.batch = a.batch AND m.ordinal = a.theirs
),
good AS (
    SELECT f.ordinal, e.run, arg_max(e.execution, e.ended) AS execution
    FROM family f
    JOIN executions e ON e.run = f.run AND e.status = 'ok' AND e.purpose = 'run'
        AND e.programs = $programs AND e.reading = $reading
    GROUP BY ALL
)"""
"""The good executions of the experiments of a batch, those with other numbers of runs of the same included."""
SIBLINGS_FORMS = """
SELECT DISTINCT a.form FROM artifacts a
WHERE a.kind = 'table' AND a.output = $output AND a.execution IN (SELECT execution FROM good)
"""
SIBLINGS_VOTES = """
SELECT g.ordinal, a.form, count(DISTINCT a.execution) AS executions
FROM artifacts a JOIN good g USING (execution) WHERE a.kind = 'table' AND a.output = $output
GROUP BY ALL
"""
NUMERIC = """
SELECT count(*), count_if(
    TRY_CAST(cell AS DOUBLE) IS NOT NULL OR regexp_full_match(cell, ' *[-+]?[0-9]+,[0-9]+([eE][-+]?[0-9]+)? *')
) FROM (SELECT {column}::VARCHAR AS cell FROM {table} LIMIT 200000) WHERE cell IS NOT NULL
"""
ODD = """,
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


def _hidden(question: Question, name: str) -> Iterator[tuple[str, str, str]]:
    """The columns of an output that an axis hides in SQL, where their values differ: axis, column, what it is called there."""
    axes = {axis.lower(): axis for axis in question.views.axes()}
    files = [path for segment in question.segments for output, path in segment.outputs() if output.lower() == name.lower()]
    question.views.make((name,))
    if not axes or not files:
        return
    described = question.run("DESCRIBE SELECT * FROM read_parquet($files, union_by_name = true)", {"files": files})
    stored = [row[0] for row in described]
    for column, called in zip(stored, column_names(stored, taken=axes.values()), strict=True):
        axis = axes.get(column.lower())
        if axis is not None and question.run(
            UNLIKE.format(axis=identifier(axis), column=identifier(called), table=identifier(name))
        ):
            yield axis, column, called


UNLIKE = """
SELECT 1 FROM {table}
WHERE {column} IS NOT NULL AND {column}::VARCHAR IS DISTINCT FROM {axis}::VARCHAR
    AND coalesce(TRY_CAST({column} AS DOUBLE) <> TRY_CAST({axis} AS DOUBLE), true)
LIMIT 1
"""


def discard(folder: Path) -> None:
    """Remove a run's folder; what is recorded is not needed there any more."""
    worker.remove(str(folder))


def _form(reading: Reading, execution: str, file: OutputFile) -> str:
    """What a table looks like, for a comparison with its siblings'. Only a CSV's columns have an order of their own."""
    shape = reading.shape
    columns = reading.columns[execution, file.path]
    csv = shape.format == "csv"
    whole = file.ended or not csv
    return json.dumps(
        {
            "file": None if shape.many else shown(file.path),
            "columns": columns if csv else dict(sorted(columns.items())),
            "ended": whole,
            **({"hints": dict(hints)} if (hints := reading.hints.get((execution, file.path))) else {}),
        }
    )


def _shape(output: Output) -> Shape:
    many = any(c in output.file for c in "*?[")
    return Shape(output.kind, output.delimiter, output.header, output.columns, many)  # type: ignore[arg-type]


def _written(result: Result, file: OutputFile) -> Written:
    path = str(Path(result.directory, RUN_OUTPUT, file.path))
    return Written(path, result.run, result.execution, file.path, file.head, file.lines, file.ended, file.bytes)


def _log(path: str) -> tuple[bytes, int]:
    """What is kept of a log, and how long it was. A link that a run put in its place is not followed."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return b"", 0
    with os.fdopen(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or Path(path).parent.is_symlink():
            return b"", 0
        size = found.st_size
        if size <= LOG_KEPT:
            return file.read(), size
        head = file.read(LOG_KEPT // 4)
        file.seek(-3 * LOG_KEPT // 4, 2)
        return head + b"\n[... %d bytes left out ...]\n" % (size - LOG_KEPT) + file.read(), size


def _last_words(folder: str) -> str | None:
    for name in (RUN_STDERR, RUN_STDOUT):
        content, _ = _log(f"{folder}/{name}")
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
