"""Evaluation of recorded executions by changed rules, from their recorded files, without executing anything.

An execution is one time that a run was executed. Its judgement depends on the project's rules: the declarations of outputs
and success. These change, so each judgement is a record of its own:

- The first judgement is made when the execution is recorded. It has no row of its own: its id, status and rules are in the
  execution's row.
- Each later judgement is a row of `judgements`. Its artifacts and its output rows are recorded once more, with the
  judgement's id in place of the execution's.

So every output row belongs to exactly one judgement. `effective` takes one judgement of each run: the one by the rules of the
batch's last session. The views of outputs show the rows of that judgement, with the id of the execution. Code that reads
the files of segments uses judgements (`all_judgements`, `all_artifacts`). Code that counts executions uses `executions`. When a
project returns to earlier rules, the earlier judgement is found, and nothing is evaluated.

An execution can be evaluated again if it has the same programs, ended by itself or by a signal, and was successful or failed
only by its rules. The store must have the bytes that the new rules need: of each file that becomes a table, and of the marker.
Rules that read tables as before (`min_rows`, `required`) need no bytes of tables: the recorded rows are copied. The run is
executed instead if bytes are missing, if the marker is a log that was cut, or if the execution failed before and fails by the
new rules too. An execution that is not successful by the new rules has failed, as if it had been executed.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from sierra.config.output_tables import Output, Success
from sierra.errors import Damaged
from sierra.ingest import standard_output
from sierra.ingest.base import Used
from sierra.ingest.match_outputs import OutputMatcher
from sierra.ingest.model import Shape
from sierra.ingest.read_into_segment import TableFile, TableIngest, artifact_rows, recorded_names, tabled, too_few
from sierra.ingest.recording_context import SAME_PROGRAMS, Context, rules_of
from sierra.ingest.success import Judgement, judge
from sierra.ingest.suspicious_tables import TableWarnings, as_files
from sierra.model import ACCEPTED, OutputFile, Result, Status
from sierra.store.copy_rejudged_rows import write_again
from sierra.store.endings import Kind
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT, SessionPaths
from sierra.store.recorded_files import ChosenExecution, Recorded, contents
from sierra.store.row_types import ArtifactRow, IngestRulesRow, JudgementRow
from sierra.store.segments import Writer, disk_errors
from sierra.store.store import Snapshot, Store
from sierra.util.chunking import by_weight
from sierra.util.fs import inside
from sierra.util.hashing import digest_plain
from sierra.util.kept_log import KEPT
from sierra.util.lazy_definitions import dataclass, field, replace
from sierra.worker.files import remove
from sierra.worker.outputs import describe

AT_A_TIME = 4_000
"""The number of runs that are examined and evaluated at a time."""
BYTES = 256 << 20
"""The approximate number of bytes of files that are unpacked at a time."""
LOGS = (RUN_STDOUT, RUN_STDERR)
UNREAD = {"marker": "", "stderr": ""}
"""The rules that need the bytes of a file or of a log, without effect."""
NOT_KEPT = "the bytes of {path!r} are not in the store ([store] raw = false, sierra gc --raw, or an older SIERRA)"
CUT = "the store has only the beginning and the end of {path}"


def judgement_id(execution: str, ingest_rules: str, session: str) -> str:
    """Return the id of the judgement of an execution by a session; `ingest_rules` is the hash of the rules."""
    return digest_plain("judgement", {"execution": execution, "reading": ingest_rules, "session": session})


class _LastJudgement(NamedTuple):
    """An execution and its last judgement."""

    run: str
    execution: str
    exit_code: int | None
    signal: int | None
    found: bool
    """True if it is not successful because it differs from its siblings."""
    status: str
    reason: str | None
    ingest_rules: str
    judgement: str


@dataclass(frozen=True, slots=True)
class Past:
    """A recorded execution with its last judgement, and its files by that judgement."""

    last: _LastJudgement
    outputs: Mapping[str, Output]
    success: Success
    readers: Used
    """The rules of its last judgement are `outputs`, `success` and `readers`."""
    artifacts: tuple[ArtifactRow, ...]
    elsewhere: tuple[str, ...] = ()
    """The files that it wrote, but not among its outputs."""
    robots: Mapping[int, str] = field(default_factory=dict)
    """The names of its robots by place."""
    left_running: tuple[str, ...] = ()
    after_marker: float | None = None
    """These two are as in its result."""
    printed: tuple[ArtifactRow, ...] = ()
    """The standard output, if it is an output by the last rules, but not by the new ones."""
    tabled: bool = False
    """True if the rows of its tables by the new rules are already recorded."""

    @property
    def succeeded(self) -> bool:
        return Status(self.last.status).is_result

    def result(self, execution: str, directory: Path, files: Mapping[str, OutputFile]) -> Result:
        """Return the result that a worker would have reported; `files` are the files whose bytes are in `directory`."""
        paths = {row.path: row for row in self.artifacts if row.kind != "log"}
        outputs = (files.get(path) or _unread(row) for path, row in paths.items())
        return Result(
            run=self.last.run,
            execution=execution,
            directory=str(directory),
            started=0.0,
            ended=0.0,
            exit_code=self.last.exit_code,
            signal=self.last.signal,
            stopped=None,
            user_s=None,
            system_s=None,
            max_rss_bytes=None,
            host="",
            slot=0,
            outputs=tuple(outputs),
            elsewhere=self.elsewhere,
            robots=self.robots,
            left_running=self.left_running,
            after_marker=self.after_marker,
        )

    def failed_by_rules(self, result: Result) -> bool:
        """Check that it was successful, or failed only by its rules, which then give the same reason again."""
        if self.succeeded or self.last.status == Status.MISMATCH:
            return True
        result = replace(result, outputs=(*result.outputs, *map(_unread, self.printed[:1])))
        reasons = {judge(result, self.outputs, self.success)[1]}
        for row in (*self.artifacts, *self.printed):
            output = self.outputs.get(row.output or "")
            if output and row.rows is not None:
                reasons.add(too_few(row.name, row.rows, str(row.output), output))
        return self.last.reason in reasons


def _unread(row: ArtifactRow) -> OutputFile:
    """Return the description of a file whose bytes are not read."""
    return OutputFile(row.path, row.size, row.sha256, 0, True, "")


@dataclass(frozen=True, slots=True)
class Foreseen:
    """The executions that can be evaluated again, and the reasons why others cannot, by run."""

    possible: Mapping[str, Past]
    lacking: Mapping[str, str]


def foresee(store: Store, context: Context, runs: Iterable[str], *, mismatched: bool = False) -> Iterator[Foreseen]:
    """Yield the executions of these runs that can be evaluated by the rules of `context`, for a few thousand runs at a time.

    `mismatched`: include executions that differ from their siblings, because the rules on such differences have changed.
    """
    pending = iter(sorted(runs))
    while some := list(islice(pending, AT_A_TIME)):
        with store.snapshot() as snapshot:
            past = [
                previous
                for previous in _past(snapshot, context, some, mismatched=mismatched)
                if not _is_hopeless(previous, context)
            ]
            sizes = snapshot.kept_sizes({row.sha256 for previous in past for row in previous.artifacts})
        lacking = {previous.last.run: lack for previous in past if (lack := _lacking(previous, context, sizes)) is not None}
        yield Foreseen({previous.last.run: previous for previous in past if previous.last.run not in lacking}, lacking)


PAST = f"""
WITH last AS (
    SELECT e.run, e.execution, any_value(e.exit_code) AS exit_code, any_value(e.signal) AS signal,
           any_value(e.lamport) AS lamport,
           arg_max({{'judgement': e.judgement, 'status': e.status, 'reason': e.reason, 'ingest_rules': e.ingest_rules}},
                   (e.ingest_rules = $ingest_rules, e.place, e.judgement)) AS j
    FROM all_candidates e SEMI JOIN wanted w ON w.run = e.run
    WHERE e.purpose = 'run' AND e.reusing IS NULL AND {SAME_PROGRAMS}
        AND coalesce(e.exit_code, e.signal) IS NOT NULL
    GROUP BY e.run, e.execution
),
may AS (
    SELECT l.*, f.execution IS NOT NULL AS found FROM last l LEFT JOIN findings f ON f.execution = l.j.judgement
    WHERE l.j.status IN ('ok', 'accepted', 'failed', 'mismatch')
        AND (l.j.ingest_rules <> $ingest_rules OR ($mismatched AND f.execution IS NOT NULL))
),
best AS (
    SELECT run, arg_max({{'execution': execution, 'exit_code': exit_code, 'signal': signal, 'found': found, 'status': j.status,
           'reason': j.reason, 'ingest_rules': j.ingest_rules, 'judgement': j.judgement}},
           (j.status IN ('ok', 'accepted'), lamport, execution)) AS b
    FROM may GROUP BY run
)
SELECT run, b.execution AS execution, b.exit_code AS exit_code, b.signal AS signal, b.found AS found, b.status AS status,
       b.reason AS reason, b.ingest_rules AS ingest_rules, b.judgement AS judgement
FROM best ORDER BY run
"""
WRITTEN = "SELECT execution, path FROM files_written WHERE use = 'written' AND list_contains($executions, execution)"
ENDINGS = "SELECT execution, kind, text FROM endings WHERE list_contains($executions, execution)"
ROBOTS = "SELECT execution, place, robot FROM robots WHERE list_contains($executions, execution)"
ARTIFACTS = "SELECT a.* FROM all_artifacts a SEMI JOIN chosen USING (execution) ORDER BY execution, path"


def _past(snapshot: Snapshot, context: Context, runs: Iterable[str], *, mismatched: bool) -> Iterator[Past]:
    """Yield for each run the execution to evaluate again: the last successful one, or else the last one."""
    snapshot.add_table("wanted", run=sorted(runs))
    rows = snapshot.select(
        _LastJudgement, PAST, ingest_rules=context.ingest_rules, mismatched=mismatched, **context.same_programs
    )
    used = {row.ingest_rules for row in rows}
    rules = {
        known.ingest_rules: rules_of(json.loads(known.declared))
        for known in snapshot.select(IngestRulesRow, "SELECT * FROM ingest_rules")
        if known.ingest_rules in used
    }
    snapshot.add_table("chosen", execution=[row.judgement for row in rows])
    artifacts: dict[str, list[ArtifactRow]] = {row.judgement: [] for row in rows}
    for artifact in snapshot.select(ArtifactRow, ARTIFACTS):
        artifacts[artifact.execution].append(artifact)
    robots: dict[str, dict[int, str]] = {}
    snapshot.views.make(("files_written", "robots"))
    for execution, number, name in snapshot.run(ROBOTS, {"executions": [row.execution for row in rows]}):
        robots.setdefault(execution, {})[number] = name
    written: dict[str, list[str]] = {}
    for execution, path in snapshot.run(WRITTEN, {"executions": [row.execution for row in rows]}):
        written.setdefault(execution, []).append(path)
    left, after = _endings(snapshot, [row.execution for row in rows])
    for row in rows:
        if row.ingest_rules in rules:
            elsewhere = tuple(sorted(written.get(row.execution, ())))
            known = robots.get(row.execution, {})
            files, printed = _with_stdout(artifacts[row.judgement], rules[row.ingest_rules][0], context.outputs)
            ended = (tuple(left.get(row.execution, ())), after.get(row.execution))
            previous = Past(row, *rules[row.ingest_rules], files, elsewhere, known, *ended, printed)
            yield replace(previous, tabled=_is_tabled(previous, context))


def _with_stdout(
    artifacts: Iterable[ArtifactRow], before: Mapping[str, Output], now: Mapping[str, Output]
) -> tuple[tuple[ArtifactRow, ...], tuple[ArtifactRow, ...]]:
    """Return the artifacts with standard output as a file if it is an output now, and what is left out if it was one before."""
    rows, printed = tuple(artifacts), tuple(row for row in artifacts if row.path == RUN_STDOUT and row.kind != "log")
    if standard_output.is_in(now):
        logs = (row._replace(kind="file") for row in rows if row.path == RUN_STDOUT and not printed)
        return (*rows, *logs), ()
    if standard_output.is_in(before):
        return tuple(row for row in rows if row not in printed), printed
    return rows, ()


def _endings(snapshot: Snapshot, executions: Sequence[str]) -> tuple[dict[str, list[str]], dict[str, float]]:
    """Return the processes that still ran when the command had ended, and the seconds after a marker, by execution."""
    left: dict[str, list[str]] = {}
    after: dict[str, float] = {}
    if snapshot.holds("endings"):
        snapshot.views.make(("endings",))
        for execution, kind, text in snapshot.run(ENDINGS, {"executions": executions}):
            if kind == Kind.LEFT_RUNNING:
                left.setdefault(execution, []).append(text)
            elif kind == Kind.AFTER_MARKER:
                after[execution] = float(text)
    return left, after


def _is_tabled(previous: Past, context: Context) -> bool:
    """Check that the files that become tables are already recorded as these tables, read in the same way, with their rows."""
    empty = (context.outputs.get(row.output or "") for row in previous.artifacts if row.rows == 0)
    if any(output is not None and output.lines for output in empty):
        return False  # without a line that matches, it is a table only if it is required
    result = previous.result(previous.last.execution, Path(), {})
    if Status.ACCEPTED in (previous.last.status, judge(result, context.outputs, context.success)[0]):
        return False
    if context.success.accept and any((row.output or "").lower().endswith(ACCEPTED) for row in previous.artifacts):
        return False  # the name of its table is refused
    recorded = {(row.output, row.path) for row in previous.artifacts if row.rows is not None}
    before, now = ({(n, file.path): shape for n, shape, file in _tables(previous, rules)} for rules in (previous, context))
    return before == now and now.keys() == recorded


def _tables(one: Past, rules: Past | Context) -> Iterator[tuple[str, Shape, OutputFile]]:
    """Yield the files of an execution that become tables by these rules."""
    known = [(row.path, row.output if row.rows is not None else None) for row in one.artifacts if row.kind != "log"]
    return OutputMatcher(rules.outputs, rules.readers, lambda: known).of(one.result(one.last.execution, Path(), {}))


def _is_hopeless(one: Past, context: Context) -> bool:
    """Check, without reading any bytes, if a run must be executed: it still fails, or did not fail by its rules."""
    if one.succeeded:
        return False
    result = one.result(one.last.execution, Path(), {})
    if not judge(result, context.outputs, context.success.model_copy(update=UNREAD))[0].is_result:
        return True
    return not (one.success.marker or one.success.stderr or one.failed_by_rules(result))


def _has_own_stdout(artifacts: Sequence[ArtifactRow]) -> bool:
    """Check if a run left a file with the name of standard output that is not what it printed."""
    logs = ((row.size, row.sha256) for row in artifacts if row.path == RUN_STDOUT and row.kind == "log")
    size, sha256 = next(logs, (0, ""))
    files = [row for row in artifacts if row.path == RUN_STDOUT and row.kind != "log"]
    return any(row.size != size or (0 < size <= KEPT and row.sha256 != sha256) for row in files)


def _lacking(previous: Past, context: Context, sizes: Mapping[str, int]) -> str | None:
    """Return why the store does not have enough to evaluate an execution again; None if it has."""
    log: list[ArtifactRow] = []
    if standard_output.is_in(context.outputs):
        if _has_own_stdout(previous.artifacts):
            return standard_output.OWN
        logs = {row.sha256 for row in previous.artifacts if row.path == RUN_STDOUT and row.kind == "log"}
        log = [row for row in previous.artifacts if row.path == RUN_STDOUT and row.kind == "file" and row.sha256 in logs]
    for row in (*needed(previous, context), *log):
        if row.sha256 not in sizes:
            return NOT_KEPT.format(path=row.path)
        if sizes[row.sha256] != row.size:
            return CUT.format(path=row.path)
    return None


def needed(one: Past, context: Context) -> list[ArtifactRow]:
    """Return the files to read for an evaluation: files that become tables and are not yet tables, and the markers."""
    tables = set() if one.tabled else {file.path for _, _, file in _tables(one, context)}
    rules = (context.success, *(() if one.succeeded else (one.success,)))
    markers = {path for rule in rules for path in (rule.marker, RUN_STDERR if rule.stderr else "")} - {""}
    files = {row.path: row for row in one.artifacts if row.kind != "log" and row.path in tables | markers}
    return [*files.values(), *(row for row in one.artifacts if row.kind == "log" and row.path in markers)]


@dataclass(slots=True)
class Rejudged:
    """The results of evaluating executions by changed rules."""

    judged: set[str] = field(default_factory=set)
    """The runs of which an execution was evaluated; the store has the results."""
    unread: dict[str, str] = field(default_factory=dict)
    """The runs that were not evaluated because their files cannot be read, with the reasons."""
    notes: list[str] = field(default_factory=list)


def reevaluate(store: Store, session: SessionPaths, context: Context, runs: Iterable[str], *, mismatched: bool) -> Rejudged:
    """Evaluate and record these runs as far as possible. Raises Missing if the disk is full; then nothing is lost."""
    outcome = Rejudged()
    assigning = OutputMatcher(context.outputs, context.readers, partial(recorded_names, store))
    shapes = dict[str, Shape]()

    def size(previous: Past) -> int:
        return sum(row.size for row in needed(previous, context))

    for foreseen in foresee(store, context, runs, mismatched=mismatched):
        outcome.unread |= foreseen.lacking
        past = sorted(foreseen.possible.values(), key=lambda previous: previous.tabled)
        for some in by_weight(past, size, BYTES, lambda group, previous: previous.tabled == group[0].tabled):
            with disk_errors(session.reevaluation):
                session.reevaluation.mkdir()
            try:
                _Group(store, session, context, assigning, shapes, outcome).judge(some)
            finally:
                remove(str(session.reevaluation))
    outcome.notes += [*assigning.renamed.values(), *as_files(assigning.kept), *assigning.on_lines()]
    outcome.notes += [*TableWarnings(store, context, shapes).all()]
    return outcome


@dataclass(frozen=True, slots=True)
class _Group:
    """Executions that are evaluated together, into one segment."""

    store: Store
    session: SessionPaths
    context: Context
    assigning: OutputMatcher
    shapes: dict[str, Shape]
    outcome: Rejudged

    def judge(self, past: Sequence[Past]) -> None:
        """Evaluate the executions and publish the segment."""
        results = {result.execution: (previous, result) for previous, result in self._results(past)}
        first = [
            Judgement(result, *judge(result, self.context.outputs, self.context.success)) for _, result in results.values()
        ]
        # an execution that failed before and still fails is not recorded: its run is executed
        first = [
            judgement for judgement in first if results[judgement.result.execution][0].succeeded or judgement.status.is_result
        ]
        rest = self._record(first, results, copied=past[0].tabled)
        while rest:  # there was no space to unpack all archives together
            rest = self._record(rest, results, copied=False)

    def _record(
        self, first: Sequence[Judgement], results: Mapping[str, tuple[Past, Result]], *, copied: bool
    ) -> Sequence[Judgement]:
        """Publish a segment of executions; return those for which there was no space yet."""
        writer = self.store.writer(self.session.segment, self.context.batch)
        if copied:
            tables: TableIngest = self._copied(
                [results[judgement.result.execution] for judgement in first if judgement.status is Status.OK], writer
            )
        else:
            tables = tabled(first, writer, self.store, self.context, self.assigning, self.shapes)
        judged = [
            (results[judgement.result.execution][0], tables.judged(judgement))
            for judgement in first[: len(first) - len(tables.rest)]
        ]
        writer.records(row for previous, judgement in judged for row in _artifacts(previous, judgement.result, tables))
        writer.records(self._row(previous, judgement) for previous, judgement in judged)
        writer.records([IngestRulesRow(self.context.ingest_rules, self.context.declared)] if judged else [])
        self.store.publish(writer)
        self.outcome.judged |= {previous.last.run for previous, _ in judged}
        return tables.rest

    def _copied(self, good: Sequence[tuple[Past, Result]], writer: Writer) -> TableIngest:
        """Copy recorded rows. Raises Damaged if their number differs from the number in their artifacts."""
        recorded = [(result.execution, row) for previous, result in good for row in previous.artifacts if row.rows is not None]
        tables = Counter[str]()
        for _, row in recorded:
            tables[str(row.output).lower()] += row.rows or 0
        with self.store.snapshot() as snapshot:
            written = write_again(
                snapshot, writer, tables, {previous.last.judgement: result.execution for previous, result in good}
            )
        for name, rows in tables.items():
            if rows != written[name]:
                raise Damaged(f"table {name!r} has {written[name]} rows, but {rows} were recorded; see sierra fsck")
        known: dict[tuple[str, str], list[TableFile]] = {}
        for execution, row in recorded:
            table = TableFile(row.output, row.rows, row.counted_rows, row.table_layout, row.member)
            known.setdefault((execution, row.path), []).append(table)
        return TableIngest(self.context.outputs, known)

    def _results(self, past: Sequence[Past]) -> Iterator[tuple[Past, Result]]:
        """Yield the results that a worker would have reported, with the bytes of the needed files in a folder."""
        folders = {previous.last.execution: self.session.reevaluation / str(number) for number, previous in enumerate(past)}
        read, lost = self._unpacked(past, folders)
        for previous in past:
            judgement = judgement_id(previous.last.execution, self.context.ingest_rules, self.context.session)
            result = previous.result(judgement, folders[previous.last.execution], read.get(previous.last.execution, {}))
            if previous.last.execution in lost:
                self.outcome.unread[previous.last.run] = lost[previous.last.execution]
            elif previous.failed_by_rules(result):
                yield previous, result

    def _unpacked(
        self, past: Sequence[Past], folders: Mapping[str, Path]
    ) -> tuple[dict[str, dict[str, OutputFile]], dict[str, str]]:
        """Write the needed files; return a worker's descriptions of them, and the reasons why some could not be written."""
        read: dict[str, dict[str, OutputFile]] = {}
        lost: dict[str, str] = {}
        files = [_recorded(previous, row) for previous in past for row in needed(previous, self.context)]
        with self.store.snapshot() as snapshot:
            for content in contents(snapshot, files):
                file = content.file
                execution = str(file.taken.execution)
                try:
                    target = _target(folders[execution], file)
                    with disk_errors(target.parent):
                        target.parent.mkdir(parents=True, exist_ok=True)
                        with target.open("wb") as stream:
                            stream.writelines(content.pieces)
                except Damaged as error:
                    lost[execution] = f"{file.path}: {error}"
                    continue
                if file.kind != "log":
                    seen = OutputFile(**describe(str(target), file.path))
                    read.setdefault(execution, {})[file.path] = seen
        return read, lost

    def _row(self, past: Past, judgement: Judgement) -> JudgementRow:
        return JudgementRow(
            judgement=judgement.result.execution,
            execution=past.last.execution,
            run=past.last.run,
            session=self.context.session,
            batch=self.context.batch,
            judged_at=datetime.now(UTC),
            status=str(judgement.status),
            reason=judgement.reason,
            ingest_rules=self.context.ingest_rules,
            lamport=self.context.lamport(),
        )


def _recorded(one: Past, row: ArtifactRow) -> Recorded:
    """Return a file as `sierra.store.recorded_files` describes it, with kind `file` for a table, so that its bytes are read."""
    taken = ChosenExecution("", 0, 0, one.last.run, one.last.execution, one.last.status, "asked", one.last.execution)
    kind = "log" if row.kind == "log" else "file"
    return Recorded(taken, row.path, kind, row.size, row.sha256, row.size, None, None, None)


def _target(folder: Path, file: Recorded) -> Path:
    """Return the path to which a file is written. Raises Damaged for a path that leads out of the folder."""
    return inside(folder if file.kind == "log" else folder / RUN_OUTPUT, file.path)


def _artifacts(past: Past, result: Result, tables: TableIngest) -> Iterator[ArtifactRow]:
    """Yield the artifacts of an execution by its new judgement; logs do not change."""
    yield from artifact_rows(result, tables)
    yield from (row._replace(execution=result.execution) for row in past.artifacts if row.kind == "log")
