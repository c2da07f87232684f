"""The recorder, which writes results to segments of the store from time to time.

Also: a note on successful runs that wrote no file: they are no failures, because a program may only be timed.
"""

from __future__ import annotations

import contextlib
import math
import shutil
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

from sierra.config.output_tables import volatile_and_rates
from sierra.containers import engines
from sierra.ingest import astray, changed_files, compare_observations, compare_robots, shared_use, standard_output, stderr
from sierra.ingest.changed_files import UNOBSERVED, Doubt
from sierra.ingest.match_outputs import NOTED_AT_MOST, OutputMatcher
from sierra.ingest.messages import shown
from sierra.ingest.model import Shape
from sierra.ingest.observations import WRITTEN, observed, written
from sierra.ingest.read_into_segment import TableIngest, file_rows, recorded_names, tabled
from sierra.ingest.recording_context import Context
from sierra.ingest.success import Judgement, judge
from sierra.ingest.suspicious_tables import TableWarnings, as_files, lost
from sierra.model import LateFiles, OutputFile, Purpose, Result, Status
from sierra.provenance.hash_cache import HashCache
from sierra.store import endings, equal_runs
from sierra.store.endings import Kind
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT, SessionPaths
from sierra.store.objects import Objects
from sierra.store.row_types import (
    ArtifactRow,
    ChannelRow,
    DuplicateRow,
    EndingRow,
    ExecutionRow,
    FileWrittenRow,
    IngestRulesRow,
)
from sierra.store.segments import Writer
from sierra.store.store import Store
from sierra.store.views import INVALID_TRIAL
from sierra.util.fs import inside, write_whole
from sierra.util.hashing import merkle, short
from sierra.util.json_types import RecordValue
from sierra.util.kept_log import kept_of, with_cause
from sierra.util.text import one_line
from sierra.worker import checkpoints
from sierra.worker.files import remove
from sierra.worker.outputs import described, list_files

LINES = 3
"""The number of lines at the end of standard error that are shown."""
SHOWN = 300


class SilentRuns:
    """The number of runs that wrote no file, with the last lines that one of them printed on standard error."""

    def __init__(self) -> None:
        self._runs = 0
        self._said = ""

    def add(self, stderr: Callable[[], bytes]) -> None:
        """Count one run; `stderr` reads the end of its standard error."""
        self._runs += 1
        if not self._said:
            lines = [line.strip() for line in stderr().decode("utf-8", "replace").splitlines()]
            self._said = " / ".join([one_line(line) for line in lines if line][-LINES:])[-SHOWN:]

    def notes(self) -> Iterator[str]:
        if self._runs:
            one = self._runs == 1
            who, whose = ("1 run", "its program") if one else (f"{self._runs} runs", "their programs")
            said = f"said on stderr: {self._said}" if self._said else "said nothing on stderr"
            yield f"{who} wrote no file; {whose} {said}"


PENDING_RUNS = 4_000
PENDING_BYTES = 256 << 20
SOON_S, LATE_S = 2.0, 600.0
LOG_SHOWN = 2000
LATE = "late"
"""The folder of the files of robots that were lost, and have given them back later; each place has a folder."""
WITH_EXECUTION = ("robots", "trials")
"""Tables of which a runner reports rows that are recorded with their execution."""
CUT_OFF = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals by which others end a run."""
ONCE = {"environments": "environment", "isolations": "isolation"}
"""Tables of which a runner reports the same rows again and again, with the columns that identify them."""
TRACED = "strace"
"""The method of observations by the tracer."""
COUNT = "SELECT count(*) AS executions FROM executions WHERE session = $s"
RESULTS = "SELECT execution, result FROM executions WHERE session = $s"
LACKING = f"""
SELECT run, batch FROM executions WHERE execution = $e AND NOT EXISTS (
    FROM artifacts a WHERE a.execution = $e AND (starts_with(path, $p) OR starts_with(path, '{LATE}/' || $p)))
"""
COPIES = "SELECT c.execution, c.attempt FROM duplicates c JOIN executions e USING (execution) WHERE e.session = $s"


class _Execution(NamedTuple):
    run: str
    batch: str


class _ResultHash(NamedTuple):
    execution: str
    result: str


class _Copy(NamedTuple):
    execution: str
    attempt: str


class Recorder:
    """A collector of results, which writes them to the store from time to time and at the end."""

    def __init__(
        self,
        store: Store,
        session: SessionPaths,
        context: Context,
        kept: Path | None = None,
        doubt: Callable[[], Doubt | None] = lambda: None,
    ) -> None:
        """`kept`: the folder to which the folders of ended and of interrupted runs are moved; if None, they are removed.

        `doubt`: a function that is called before each write. It returns the reason why pending executions cannot be
        successful, or None.
        """
        self._kept = kept
        self._doubt = doubt
        self._store = store
        self._session = session
        self.context = context
        self._reading = context.ingest_rules
        self._pending: list[Judgement] = []
        self._waiting: list[Judgement] = []
        """Unobserved executions of which only observed ones can tell whether they used files that have changed."""
        self.doubted = False
        """True if executions have failed because files have changed."""
        self._other_rows: dict[str, list[Mapping[str, RecordValue]]] = {}
        self._parts: dict[str, list[tuple[str, Mapping[str, RecordValue]]]] = {}
        """The rows of `WITH_EXECUTION` that are not recorded yet, with their tables, by execution."""
        self._once: set[str] = set()
        """The ids of the rows of `ONCE` that are recorded or will be; usually one for all elements."""
        self._ruled = 0
        """The number of segments that record the data shared by all executions."""
        self._position: int | None = None
        """The position of the next execution in the session; earlier ones may be other processes'. None if it is unknown."""
        self._file_sets: set[str] = set()
        """The recorded sets of files that executions used."""
        self._reasons: dict[str, None] = {}
        """The reasons why observations by a tracer are incomplete."""
        self._complete = False
        """True if an observation is complete."""
        self._untraced: dict[str, None] = {}
        """The reasons why runs could not be observed by a tracer."""
        self._astray: set[str] = set()
        """The files that executions wrote, but not among their outputs."""
        self.lost = math.inf
        """The time since which a run was executing that was interrupted, and so is not recorded, in seconds since the epoch."""
        self._left_nothing = False
        """True if some execution has left no file."""
        self._silent = SilentRuns()
        self._late: list[LateFiles] = []
        self._collected: dict[str, None] = {}
        """Notes about late files."""
        self._outdated: set[str] = set()
        """The checkpoints to remove: an execution that has just ended may still hold its own."""
        self._copies: list[Result] = []
        self._copied = self._unlike = 0
        self._bytes = 0
        self._began = self._flushed = time.monotonic()
        self._shapes: dict[str, Shape] = {}
        self._assigning = OutputMatcher(context.outputs, context.readers, partial(recorded_names, store))
        self._left_out: dict[str, None] = {}

    def add(self, result: Result) -> Status:
        """Add one result and return its preliminary status. An interrupted execution is not recorded."""
        result = standard_output.added(self._ended(result), self.context.outputs)
        result = replace(result, elsewhere=written(result))
        status, reason = judge(result, self.context.outputs, self.context.success)
        if status is Status.INTERRUPTED:
            self._parts.pop(result.execution, None)
            self.lost = min(self.lost, result.started)
            if (checkpoint := self._checkpoint(result.run)) is not None and self._doubt() is not None:
                self._outdated.add(checkpoint)
            self._move_or_remove(result)
        else:
            trial = self.context.trial
            if trial is not None and trial["execution"] == result.execution:
                self.add_rows([("trials", {**trial, "marked": datetime.now(UTC)})], ())
            self._left_out.update(dict.fromkeys(result.left_out[: max(NOTED_AT_MOST - len(self._left_out), 0)]))
            self._pending.append(Judgement(result, status, reason))
            self._astray.update(result.elsewhere)
            self._left_nothing = self._left_nothing or not result.outputs
            self._bytes += sum(file.bytes for file in result.outputs)
            if status is Status.OK and not (result.outputs or result.elsewhere or self.context.outputs):
                self._silent.add(lambda: kept_of(f"{result.directory}/{RUN_STDERR}")[0][-LOG_SHOWN:])
        return status

    def _ended(self, result: Result) -> Result:
        """Return the result as the engine classifies it, if the engine's client ran between the program and the worker."""
        if self.context.isolation is None or self.context.shared or result.exit_code == 0:
            return result
        errors = kept_of(f"{result.directory}/{RUN_STDERR}")[0][-LOG_SHOWN:].decode("utf-8", "replace")
        engine = engines.find(self.context.engine, self.context.engines)
        return engine.classify(result, errors, frozenset(self.context.enforced))

    def add_rows(self, rows: Iterable[tuple[str, Mapping[str, RecordValue]]], copies: Iterable[Result]) -> None:
        """Add other records: rows by table, and runs that were executed once more than requested."""
        for table, row in rows:
            if table in WITH_EXECUTION:
                self._parts.setdefault(str(row["execution"]), []).append((table, row))
                continue
            if (column := ONCE.get(table)) is not None:
                if row[column] in self._once:
                    continue
                self._once.add(str(row[column]))
            self._other_rows.setdefault(table, []).append(row)
        self._copies += (standard_output.added(copy, self.context.outputs) for copy in copies)

    def add_late(self, late: Iterable[LateFiles]) -> None:
        """Add files of executions that are recorded already, or will be with the next write."""
        self._late += late

    def due(self) -> bool:
        """Check if it is time to write: soon at first, then less and less often, so that there are few segments."""
        now = time.monotonic()
        patience = min(max(SOON_S, 0.5 * (now - self._began)), LATE_S)
        many = len(self._pending) >= PENDING_RUNS or self._bytes >= PENDING_BYTES
        return bool(self._pending) and (many or now - self._flushed >= patience)

    def flush(self, *, last: bool = False) -> list[tuple[str, Status, str]]:
        """Write everything pending; return the run, status and reason of each execution that is not successful.

        If files have changed, executions that were not observed wait until the `last` call, when all that are observed are
        recorded: any of these may still show that the experiment uses the files.
        Raises Missing if the disk is full or read-only; then nothing is lost.
        """
        self._flushed = time.monotonic()
        doubt = self._doubt() if self._pending or self._waiting else None
        if doubt is not None:
            self._note(doubt)
            self._pending = list(self._by_observation(doubt))
        failed = self._record_pending() if self._pending or self._other_rows or self._copies else []
        if doubt is not None and self._waiting:
            self._pending, self._waiting = self._by_others(doubt, last=last)
            failed += self._record_pending() if self._pending else []
        self._record_late()
        self._discard_outdated()
        return failed

    def _discard_outdated(self) -> None:
        """Remove the checkpoints from which no execution is to continue, as far as no execution holds them any more."""
        self._outdated = {checkpoint for checkpoint in self._outdated if not checkpoints.discard(checkpoint)}

    def _note(self, doubt: Doubt) -> None:
        """Note a doubt for another process that may have to record the rest of the session."""
        if not self._session.doubt.exists():
            write_whole(self._session.doubt, doubt.reason.encode("utf-8", "backslashreplace"))

    def _by_observation(self, doubt: Doubt) -> Iterator[Judgement]:
        """Yield the judgements of pending executions that are decided; keep the others waiting."""
        for pending in self._pending:
            decided = changed_files.by_observation(pending, doubt)
            if decided is None:
                self._waiting.append(pending)
                continue
            self.doubted |= decided is not pending
            yield decided

    def _by_others(self, doubt: Doubt, *, last: bool) -> tuple[list[Judgement], list[Judgement]]:
        """Return the judgements of waiting executions that recorded ones decide, and the executions that go on waiting."""
        counts = changed_files.by_siblings(self._store, self.context, {waiting.result.run for waiting in self._waiting}, doubt)
        judged, waiting = [], []
        for pending in self._waiting:
            verdict = counts.get(pending.result.run)
            if verdict is not False and not last:
                waiting.append(pending)
            elif verdict:
                judged.append(pending)
            else:
                self.doubted = True
                judged.append(doubt.failed(pending, UNOBSERVED if verdict is None else ""))
        return judged, waiting

    def _record_pending(self) -> list[tuple[str, Status, str]]:
        """Write everything pending; return the run, status and reason of each execution that is not successful."""
        failed: list[tuple[str, Status, str]] = []
        while True:
            writer = self._store.writer(self._session.segment, self.context.batch)
            for table, rows in self._other_rows.items():
                writer.rows(table, rows)
            writer.records(self._compared())
            judged, rest = self._write(writer)
            first = self._next()
            writer.records(self._execution(judgement, position) for position, judgement in enumerate(judged, first))
            self._position = first + len(judged)
            judged = [self._marked(judgement) for judgement in judged]
            self._write_parts(writer, judged)
            ended = [judgement.result.run for judgement in judged if not _keeps_checkpoint(judgement, doubted=self.doubted)]
            self._outdated.update(filter(None, map(self._checkpoint, ended)))
            self._discard_outdated()  # first: nobody looks for the checkpoint of a recorded run after a crash
            self._store.publish(writer)
            self._ruled += 1
            for judgement in judged:
                self._move_or_remove(judgement.result)
            self._pending = rest
            self._other_rows, self._copies = {}, []
            failed += [
                (judgement.result.run, judgement.status, judgement.reason or "")
                for judgement in judged
                if not judgement.status.is_result
            ]
            if not rest:
                break  # otherwise there was no space to unpack all archives together
        self._bytes = 0
        return failed

    def _compared(self) -> Iterator[DuplicateRow]:
        """Yield the copies that are not recorded yet, each compared with the record of its execution."""
        if not self._copies:
            return
        recorded = {judgement.result.execution: result_hash(judgement.result.outputs) for judgement in self._pending}
        recorded |= dict(self._store.select(_ResultHash, RESULTS, s=self.context.session))
        known = set(self._store.select(_Copy, COPIES, s=self.context.session))
        for copy in (copy for copy in self._copies if _Copy(copy.execution, copy.attempt or "") not in known):
            result = result_hash(copy.outputs)
            same = recorded.get(copy.execution) == result
            self._copied, self._unlike = self._copied + 1, self._unlike + (not same)
            yield DuplicateRow(copy.execution, copy.run, copy.attempt or "", result, same)

    def _move_or_remove(self, result: Result) -> None:
        """Move the folder of an ended or interrupted run to where folders are kept; without such a place, remove it."""
        folder = Path(result.directory)
        if self._kept is not None:
            self._kept.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):
                shutil.move(folder, inside(self._kept, short(result.run)))
        discard(folder, self._session)

    def _checkpoint(self, run: str) -> str | None:
        """Return the checkpoint of a run; None if it has none that executions of this purpose use."""
        path = self._store.paths.checkpoint(run, self.context.programs)
        return str(path) if self.context.purpose == Purpose.RUN and path.is_dir() else None

    def find_astray(self) -> set[str]:
        """Find executions that most likely wrote all their files elsewhere, record findings, and return their runs.

        Call it once, after everything is recorded.
        """
        return astray.find_siblings(self._store, self._session, self.context) if self._left_nothing else set()

    def notes(self) -> list[str]:
        """Return warnings about records that are allowed but probably not intended, one line each.

        This queries the store, so call it once, after everything is recorded and `find_inconsistent` has checked it.
        """
        remarks = TableWarnings(self._store, self.context, self._shapes)
        kept = self._assigning.kept
        used = compare_observations.notes(self._store, self.context.session) if len(self._file_sets) > 1 else ()
        elsewhere = astray.notes(self._astray)
        servers = shared_use.notes(self._store, self.context) if self._file_sets else ()
        unseen = [
            *compare_observations.changed_meanwhile(self._reasons),
            *compare_observations.incomplete(() if self._complete else self._reasons),
            *compare_observations.untraced(self._untraced),
        ]
        return [
            *self._twice(),
            *endings.of_batch(self._store, self.context.batch),
            *self._collected,
            *lost(list(self._left_out)),
            *self._silent.notes(),
            *elsewhere,
            *unseen,
            *used,
            *servers,
            *compare_robots.notes(self._store, self.context.batch),
            *self._assigning.renamed.values(),
            *as_files(kept),
            *self._assigning.on_lines(),
            *remarks.all(),
            *equal_runs.of_batch(self._store, self.context.batch, *volatile_and_rates(self.context.outputs)),
        ]

    def _twice(self) -> Iterator[str]:
        """Yield a warning about runs that two attempts executed at the same time."""
        if self._copied:
            message = f"{self._copied} runs were executed twice, because copies of their array tasks ran at the same time"
            unlike = f"; {self._unlike} of them have different results: they are not deterministic" if self._unlike else ""
            yield f"{message}{unlike}; see the table duplicates"

    def _write(self, writer: Writer) -> tuple[list[Judgement], list[Judgement]]:
        """Write what belongs to pending executions; return their final judgements, and the executions that had no space yet."""
        tables = tabled(self._pending, writer, self._store, self.context, self._assigning, self._shapes)
        pending = self._pending[: len(self._pending) - len(tables.rest)]
        judged = [tables.judged(judgement) for judgement in pending]
        objects = Objects(writer.path("objects"))
        artifacts = [row for judgement in judged for row in _artifacts(judgement.result, tables, objects, raw=self.context.raw)]
        objects.close()
        writer.records(artifacts)
        self._write_observations(writer, pending)
        if self._ruled < 2:  # in two segments, so that one damaged segment does not make the others useless
            writer.records([IngestRulesRow(self._reading, self.context.declared)])
            writer.records([self.context.isolation] if self.context.isolation else [])
        return judged, tables.rest

    def _record_late(self) -> None:
        """Record late files with the batches of their executions, if these are recorded without files of the same robot."""
        while self._late:
            late = self._late[0]
            for execution in self._store.select(_Execution, LACKING, e=late.execution, p=f"{late.place}/"):
                writer = self._store.writer(self._session.segment, execution.batch)
                objects = Objects(writer.path("objects"))
                rows = list(_late_artifacts(late, execution.run, objects))
                writer.records(rows)
                objects.close()
                self._store.publish(writer)
                said = f"{late.robot}: collected what it had measured in a run of which it was lost"
                if rows:
                    self._collected[f"{said}; sierra show {short(late.execution)} --files lists it in {LATE}/{late.place}"] = (
                        None
                    )
            discard(Path(late.directory), self._session)
            self._late.pop(0)

    def _marked(self, one: Judgement) -> Judgement:
        """Return the judgement by which the run is reported: that of a person who found the trial invalid, if there is one."""
        trials = [row for table, row in self._parts.get(one.result.execution, ()) if table == "trials"]
        if not one.status.is_result or not trials or trials[-1].get("valid") in (None, True):
            return one
        reason = trials[-1].get("reason")
        return Judgement(one.result, Status.INVALID, f"{INVALID_TRIAL}: {reason}" if reason else INVALID_TRIAL)

    def _write_parts(self, writer: Writer, judged: Iterable[Judgement]) -> None:
        """Write the rows that belong to these executions."""
        rows: dict[str, list[Mapping[str, RecordValue]]] = {}
        for one in judged:
            for table, row in self._parts.pop(one.result.execution, ()):
                own = {"lamport": self.context.lamport()} if table == "trials" else {}
                rows.setdefault(table, []).append({**row, **own})
        for table, several in rows.items():
            writer.rows(table, several)

    def _write_observations(self, writer: Writer, pending: list[Judgement]) -> None:
        records = [record for record in (observed(judgement.result) for judgement in pending) if record is not None]
        writer.records(record.observation for record in records)
        for record in records:
            if record.observation.reason is None:
                self._complete = True
            elif record.observation.method == TRACED:
                self._reasons[record.observation.reason] = None
            else:
                self._untraced |= dict.fromkeys(compare_observations.why_untraced(record.observation.reason))
        sets = {record.observation.files: record.read for record in records if record.observation.files not in self._file_sets}
        writer.records(row for rows in sets.values() for row in rows)
        new = {row.sha256: row for record in records if record.observation.files in sets for row in record.listings}
        writer.records(new.values())
        writer.records(row for record in records for row in record.written)
        writer.records(row for record in records for row in record.channels)
        given = ((judgement.result.execution, port) for judgement in pending for port in judgement.result.ports)
        writer.records(ChannelRow(execution, f"127.0.0.1:{port}", "given") for execution, port in dict.fromkeys(given))
        own = (
            (judgement.result.execution, path)
            for judgement in pending
            for path in judgement.result.elsewhere
            if path.startswith(astray.RUN)
        )
        writer.records(FileWrittenRow(execution, path, WRITTEN) for execution, path in own)
        writer.records(row for judgement in pending for row in _endings(judgement))
        self._file_sets |= sets.keys()
        if digests := {path: fact for record in records for path, fact in record.digests.items()}:
            cache = HashCache()
            cache.learn(digests)
            cache.save()

    def _next(self) -> int:
        """Return the position of the next execution in its session."""
        if self._position is None:
            [self._position] = self._store.values(int, COUNT, s=self.context.session)
        return self._position

    def _execution(self, judgement: Judgement, position: int) -> ExecutionRow:
        result, context = judgement.result, self.context
        return ExecutionRow(
            execution=result.execution,
            run=result.run,
            session=context.session,
            batch=context.batch,
            started=_moment(result.started),
            ended=_moment(result.ended),
            status=str(judgement.status),
            reason=judgement.reason,
            exit_code=result.exit_code,
            signal=result.signal,
            wall_s=result.ended - result.started,
            user_s=result.user_s,
            system_s=result.system_s,
            max_rss_bytes=result.max_rss_bytes,
            host=result.host,
            slot=result.slot,
            result=result_hash(result.outputs),
            log_tail=None if judgement.status is Status.OK else last_words(result.directory),
            environment=result.environment or context.environment,
            programs=context.programs,
            ingest_rules=self._reading,
            purpose=context.purpose,
            isolation=result.isolation or (context.isolation and context.isolation.isolation),
            attempt=result.attempt,
            lamport=context.lamport(position),
            gpus=list(result.gpus) or None,
            gpu_limit=result.gpu_limit,
            gpu_s=result.gpu_s,
            gpu_memory_bytes=result.gpu_memory_bytes,
        )


def _keeps_checkpoint(judgement: Judgement, *, doubted: bool) -> bool:
    """Return whether the next execution of a run continues from its checkpoint: this one was cut off, or failed for once.

    If an execution that had continued fails by itself, or has too many files, its checkpoint may be the cause: the next one
    begins anew. `doubted`: files have changed, so that the checkpoint may be one of other code.
    """
    result = judgement.result
    if judgement.status.is_result or doubted:
        return False
    if result.stopped is not None:
        return result.stopped != Status.OUTPUT or not result.resumed
    if result.signal in CUT_OFF:
        return True
    return result.exit_code != 0 and not result.resumed


def _endings(judgement: Judgement) -> Iterator[EndingRow]:
    """Yield the remarks on how an execution ended. An error counts only if its status does not say the same."""
    result = judgement.result
    for name in result.left_running:
        yield EndingRow(result.execution, Kind.LEFT_RUNNING, name)
    if result.resumed:
        yield EndingRow(result.execution, Kind.RESUMED, "{checkpoint}")
    if result.after_marker is not None:
        yield EndingRow(result.execution, Kind.AFTER_MARKER, f"{result.after_marker:g}")
    elif judgement.status is Status.OK and result.exit_code == 0 and (error := stderr.error_at_end(result.directory)):
        yield EndingRow(result.execution, *error)


def _artifacts(result: Result, tables: TableIngest, objects: Objects, *, raw: bool) -> Iterator[ArtifactRow]:
    """Yield a row for each file that a run left, and store its bytes as an object; those of tables only with `raw`."""
    for file in result.outputs:
        for row in file_rows(result, file, tables):
            if raw or row.kind == "file":
                objects.add_file(Path(result.directory, RUN_OUTPUT, file.path), file.sha256, file.bytes)
            yield row
    yield from _logs(result.directory, result.execution, result.run, objects)


def _logs(directory: str, execution: str, run: str, objects: Objects, prefix: str = "") -> Iterator[ArtifactRow]:
    """Yield the rows of a run's logs, and store what is kept of them."""
    for name in (RUN_STDOUT, RUN_STDERR):
        content, size = kept_of(f"{directory}/{name}")
        if size:
            digest = objects.add(content)
            yield ArtifactRow(execution, run, prefix + name, "log", None, size, digest, None, None, None)


def _late_artifacts(late: LateFiles, run: str, objects: Objects) -> Iterator[ArtifactRow]:
    """Yield the rows of a lost robot's files, and store them. As logs, they are no part of the result, and of no table."""
    prefix = f"{LATE}/{late.place}/"
    yield from _logs(late.directory, late.execution, run, objects, prefix)
    files, _ = list_files(f"{late.directory}/{RUN_OUTPUT}")
    for file in described(files, lambda: None):
        objects.add_file(Path(late.directory, RUN_OUTPUT, file["path"]), file["sha256"], file["bytes"])
        path = f"{prefix}{RUN_OUTPUT}/{file['path']}"
        yield ArtifactRow(late.execution, run, path, "log", None, file["bytes"], file["sha256"], None, None, None)


def result_hash(outputs: Iterable[OutputFile]) -> str:
    """Return the Merkle hash of an execution's outputs: their digests and names, in the order of the names."""
    return merkle("result", (f"{file.sha256} {shown(file.path)}" for file in sorted(outputs, key=lambda file: file.path)))


def discard(folder: Path, session: SessionPaths) -> None:
    """Remove a run's folder once it is recorded. A run that could not begin has no folder of its own."""
    if folder.name.isdigit() and folder not in (session.root, session.runs):
        remove(str(folder))


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def last_words(folder: str) -> str | None:
    for name in (RUN_STDERR, RUN_STDOUT):
        content, _ = kept_of(f"{folder}/{name}")
        if content.strip():
            return with_cause(content.decode("utf-8", "replace"), LOG_SHOWN)
    return None
