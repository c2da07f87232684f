"""Judging recorded executions anew: by other rules, from their recorded files, without executing anything.

An execution is one time that a run was executed. How it is judged depends on what the project declares of outputs and success,
its rules, and these change. So each judgement is a record of its own:

- The first is made as the execution is recorded. It has no row of its own: its id, status and rules are the execution's.
- Each later one is a row of `judgements`. Its artifacts and its rows of outputs are recorded once more, with the judgement's id
  where the execution's stood.

No row of an output is thus of two judgements. `counting` takes one judgement of each run, that by the rules of the batch's last
asking, and the views of outputs show the rows of that one, with the id of the execution. Whoever reads the files of segments
looks for judgements (`judged`, `judged_artifacts`), whoever counts what happened looks for `executions`. Going back to
earlier rules finds the judgement by them, and judges nothing.

What can be judged anew is an execution with the same programs that ended by itself, and was good or failed by its rules alone.
The bytes that the new rules look at must be in the store: those of each file that is to be a table, and of the marker. Rules
that read tables as before (`min_rows`, `required`) look at no bytes of theirs: the rows that are recorded are copied. Where
bytes are not there, where a log that is the marker was cut, and where an execution failed before and fails by the new rules
at once, the run is executed. What is judged anew and is not good by that has failed, as if it had been executed.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

from sierra.config.project_file import Output, Success
from sierra.errors import Damaged
from sierra.ingest.context import Context, rules_of
from sierra.ingest.match_outputs import OutputMatcher
from sierra.ingest.model import Shape
from sierra.ingest.success import Judgement, judge
from sierra.ingest.tables import TableIngest, artifact_rows, tabled, too_few
from sierra.ingest.warnings import TableWarnings, as_files
from sierra.model import OutputFile, Result, Status
from sierra.store.again import write_again
from sierra.store.files import Recorded, Taken, contents
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT, SessionPaths
from sierra.store.segments import Writer, disk_errors
from sierra.store.store import Snapshot, Store
from sierra.util.fs import inside
from sierra.util.hashing import digest_plain
from sierra.worker import worker

AT_A_TIME = 4_000
"""Runs that are looked at, and judged, at a time."""
BYTES = 256 << 20
"""Bytes of their files, about."""
LOGS = (RUN_STDOUT, RUN_STDERR)
NOT_KEPT = "the bytes of {path!r} are not in the store ([store] raw = false, sierra gc --raw, or an older SIERRA)"
CUT = "of its {path} only the beginning and the end are in the store"

Artifact = Mapping[str, Any]


def judgement_id(execution: str, reading: str, session: str) -> str:
    """Return the id of the judgement that a session makes of an execution, by the rules that `reading` is the hash of."""
    return digest_plain("judgement", {"execution": execution, "reading": reading, "session": session})


@dataclass(frozen=True, slots=True)
class Past:
    """A recorded execution, how it was judged last, and its files by that judgement."""

    run: str
    execution: str
    status: str
    reason: str | None
    found: bool
    """Whether it is not good because it was found to be unlike its siblings."""
    exit_code: int
    outputs: Mapping[str, Output]
    success: Success
    """The rules by which it was judged."""
    artifacts: tuple[Artifact, ...]
    judgement: str
    """By which its artifacts and rows are recorded."""
    tabled: bool = False
    """Whether the rows that its tables have by the new rules are recorded."""

    @property
    def good(self) -> bool:
        return self.status == Status.OK

    def result(self, execution: str, directory: Path, files: Mapping[str, OutputFile]) -> Result:
        """What a worker would have said of it; `files` are those whose bytes are in `directory`."""
        outputs = (files.get(row["path"]) or _unread(row) for row in self.artifacts if row["kind"] != "log")
        return Result(
            run=self.run,
            execution=execution,
            directory=str(directory),
            started=0.0,
            ended=0.0,
            exit_code=self.exit_code,
            signal=None,
            stopped=None,
            user_s=None,
            system_s=None,
            max_rss_bytes=None,
            host="",
            slot=0,
            outputs=tuple(outputs),
        )

    def failed_by_rules(self, result: Result) -> bool:
        """Check that its rules alone are why it is not good: that they give the same reason once more."""
        if self.good or self.status == Status.MISMATCH:
            return True
        reasons = {judge(result, self.outputs, self.success)[1]}
        for row in self.artifacts:
            output = self.outputs.get(row["output"] or "")
            if output and row["rows"] is not None and row["rows"] < output.min_rows:
                reasons.add(too_few(row["path"], row["rows"], row["output"], output))
        return self.reason in reasons


def _unread(row: Artifact) -> OutputFile:
    """A file whose bytes nobody looks at."""
    return OutputFile(row["path"], row["size"], row["sha256"], 0, True, "")


@dataclass(frozen=True, slots=True)
class Foreseen:
    """What can be judged anew, and what cannot and why not, by run."""

    possible: Mapping[str, Past]
    lacking: Mapping[str, str]


def foresee(store: Store, context: Context, runs: Iterable[str], *, mismatched: bool = False) -> Iterator[Foreseen]:
    """Find the executions of these runs that can be judged anew, by the rules of `context`; of a few thousand runs at a time.

    `mismatched`: also those that were found to be unlike their siblings, as what may differ between siblings has changed.
    """
    pending = iter(sorted(runs))
    while some := list(islice(pending, AT_A_TIME)):
        with store.snapshot() as snapshot:
            past = [one for one in _past(snapshot, context, some, mismatched=mismatched) if not _is_hopeless(one, context)]
            sizes = _kept(snapshot, {row["sha256"] for one in past for row in one.artifacts})
        lacking = {one.run: lack for one in past if (lack := _lacking(one, context, sizes)) is not None}
        yield Foreseen({one.run: one for one in past if one.run not in lacking}, lacking)


PAST = """
WITH last AS (
    SELECT e.run, e.execution, any_value(e.exit_code) AS exit_code, any_value(e.lamport) AS lamport,
           arg_max({'judgement': e.judgement, 'status': e.status, 'reason': e.reason, 'reading': e.reading},
                   (e.reading = $reading, e.place, e.judgement)) AS j
    FROM judged e SEMI JOIN wanted w ON w.run = e.run
    WHERE e.purpose = 'run' AND e.programs = $programs AND e.exit_code IS NOT NULL GROUP BY e.run, e.execution
),
may AS (
    SELECT l.*, f.execution IS NOT NULL AS found FROM last l LEFT JOIN findings f ON f.execution = l.j.judgement
    WHERE l.j.status IN ('ok', 'failed', 'mismatch')
        AND (l.j.reading <> $reading OR ($mismatched AND f.execution IS NOT NULL))
),
best AS (
    SELECT run, arg_max({'execution': execution, 'exit_code': exit_code, 'found': found, 'status': j.status,
           'reason': j.reason, 'reading': j.reading, 'judgement': j.judgement}, (j.status = 'ok', lamport, execution)) AS b
    FROM may GROUP BY run
)
SELECT run, b.execution AS execution, b.exit_code AS exit_code, b.found AS found, b.status AS status, b.reason AS reason,
       b.reading AS reading, b.judgement AS judgement
FROM best ORDER BY run
"""
ARTIFACTS = "SELECT a.* FROM judged_artifacts a SEMI JOIN chosen USING (execution) ORDER BY execution, path"


def _past(snapshot: Snapshot, context: Context, runs: Iterable[str], *, mismatched: bool) -> Iterator[Past]:
    """Of each run, the execution to judge anew: the last of the good ones, or else the last one."""
    import pyarrow as pa

    snapshot.register("wanted", pa.table({"run": pa.array(sorted(runs), pa.string())}))
    asked = {"reading": context.reading, "programs": context.programs, "mismatched": mismatched}
    rows = snapshot.sql(PAST, **asked).to_pylist()
    declared = {row["reading"]: row["declared"] for row in snapshot.sql("SELECT * FROM readings").to_pylist()}
    rules = {name: rules_of(json.loads(text)) for name, text in declared.items() if any(row["reading"] == name for row in rows)}
    snapshot.register("chosen", pa.table({"execution": pa.array([row["judgement"] for row in rows], pa.string())}))
    artifacts: dict[str, list[Artifact]] = {row["judgement"]: [] for row in rows}
    for row in snapshot.sql(ARTIFACTS).to_pylist():
        artifacts[row["execution"]].append(row)
    for row in rows:
        if row["reading"] in rules:
            named = {name: row[name] for name in ("run", "execution", "status", "reason", "found", "exit_code", "judgement")}
            outputs, success = rules[row["reading"]]
            one = Past(**named, outputs=outputs, success=success, artifacts=tuple(artifacts[row["judgement"]]))
            yield replace(one, tabled=_is_tabled(one, context))


def _is_tabled(one: Past, context: Context) -> bool:
    """Check whether the files that are to be tables are recorded as those tables, read in the same way, with their rows."""
    recorded = {(row["output"], row["path"]) for row in one.artifacts if row["rows"] is not None}
    before, now = ({(n, file.path): shape for n, shape, file in _tables(one, o)} for o in (one.outputs, context.outputs))
    return before == now and now.keys() == recorded


def _tables(one: Past, outputs: Mapping[str, Output]) -> Iterator[tuple[str, Shape, OutputFile]]:
    return OutputMatcher(outputs).of(one.result(one.execution, Path(), {}))


def _is_hopeless(one: Past, context: Context) -> bool:
    """Check whether it is known without any bytes that a run must be executed: it fails still, or its rules were not why."""
    if one.good:
        return False
    result = one.result(one.execution, Path(), {})
    if judge(result, context.outputs, context.success.model_copy(update={"marker": ""}))[0] is not Status.OK:
        return True
    return not (one.success.marker or one.failed_by_rules(result))


def _kept(snapshot: Snapshot, digests: AbstractSet[str]) -> dict[str, int]:
    """Return the sizes of those of these files whose bytes are in the store."""
    import pyarrow as pa

    snapshot.register("digests", pa.table({"sha256": pa.array(sorted(digests), pa.string())}))
    snapshot.views.make(("objects",))
    return dict(snapshot.run("SELECT sha256, any_value(size) FROM objects SEMI JOIN digests USING (sha256) GROUP BY sha256"))


def _lacking(one: Past, context: Context, sizes: Mapping[str, int]) -> str | None:
    """Why an execution cannot be judged anew from what is in the store."""
    for row in needed(one, context):
        if row["sha256"] not in sizes:
            return NOT_KEPT.format(path=row["path"])
        if row["kind"] == "log" and sizes[row["sha256"]] != row["size"]:
            return CUT.format(path=row["path"])
    return None


def needed(one: Past, context: Context) -> list[Artifact]:
    """Return the files that are read to judge an execution: those that are to be tables and are none yet, and the markers."""
    tables = set() if one.tabled else {file.path for _, _, file in _tables(one, context.outputs)}
    markers = {context.success.marker, *(() if one.good else (one.success.marker,))} - {""}
    files = [row for row in one.artifacts if row["kind"] != "log" and row["path"] in tables | markers]
    return [*files, *(row for row in one.artifacts if row["kind"] == "log" and row["path"] in markers)]


@dataclass(slots=True)
class Rejudged:
    """What judging anew has come to."""

    judged: set[str] = field(default_factory=set)
    """Runs of which an execution was judged anew; whether it is good, the store says."""
    unread: dict[str, str] = field(default_factory=dict)
    """Runs that were not, because their files cannot be read, and why that is."""
    notes: list[str] = field(default_factory=list)


def judge_anew(store: Store, session: SessionPaths, context: Context, runs: Iterable[str], *, mismatched: bool) -> Rejudged:
    """Judge anew what can be of these runs, and record that. Raises Missing where the disk is full; nothing is lost then."""
    anew = Rejudged()
    assigning, shapes = OutputMatcher(context.outputs), dict[str, Shape]()
    for foreseen in foresee(store, context, runs, mismatched=mismatched):
        anew.unread |= foreseen.lacking
        for some in _by_weight(sorted(foreseen.possible.values(), key=lambda one: one.tabled), context):
            with disk_errors(session.anew):
                session.anew.mkdir()
            try:
                _Group(store, session, context, assigning, shapes, anew).judge(some)
            finally:
                worker.remove(str(session.anew))
    anew.notes += [*as_files(assigning.kept), *TableWarnings(store, context, shapes).all()]
    return anew


def _by_weight(past: Iterable[Past], context: Context) -> Iterator[list[Past]]:
    """Executions of one kind of which not too much must lie unpacked on the disk at a time; one at least."""
    some: list[Past] = []
    weight = 0
    for one in past:
        more = sum(row["size"] for row in needed(one, context))
        if some and (weight + more > BYTES or one.tabled != some[0].tabled):
            yield some
            some, weight = [], 0
        some.append(one)
        weight += more
    if some:
        yield some


@dataclass(frozen=True, slots=True)
class _Group:
    """Some executions, judged anew in one segment."""

    store: Store
    session: SessionPaths
    context: Context
    assigning: OutputMatcher
    shapes: dict[str, Shape]
    anew: Rejudged

    def judge(self, past: Sequence[Past]) -> None:
        """Judge them, and publish the segment."""
        results = {result.execution: (one, result) for one, result in self._results(past)}
        first = [
            Judgement(result, *judge(result, self.context.outputs, self.context.success)) for _, result in results.values()
        ]
        first = [one for one in first if self._is_worth(results[one.result.execution][0], one)]
        writer = self.store.writer(self.session.segment, self.context.batch)
        if past[0].tabled:
            tables: TableIngest = self._copied(
                [results[one.result.execution] for one in first if one.status is Status.OK], writer
            )
        else:
            tables = tabled(first, writer, self.store, self.context, self.assigning, self.shapes)
        made = [(results[one.result.execution][0], tables.judged(one)) for one in first]
        writer.rows("artifacts", (row for of, one in made for row in _artifacts(of, one.result, tables)))
        writer.rows("judgements", (self._row(of, one) for of, one in made))
        writer.rows("readings", [{"reading": self.context.reading, "declared": self.context.declared}] if made else [])
        self.store.publish(writer)
        self.anew.judged |= {of.run for of, _ in made}

    def _copied(self, good: Sequence[tuple[Past, Result]], writer: Writer) -> TableIngest:
        """Write the rows that are recorded once more. Raises Damaged where these are not as many as their artifacts say."""
        recorded = {
            (result.execution, row["path"]): row for one, result in good for row in one.artifacts if row["rows"] is not None
        }
        tables = Counter[str]()
        for row in recorded.values():
            tables[row["output"].lower()] += row["rows"]
        with self.store.snapshot() as snapshot:
            written = write_again(snapshot, writer, tables, {one.judgement: result.execution for one, result in good})
        for name, rows in tables.items():
            if rows != written[name]:
                raise Damaged(f"table {name!r} has {written[name]} rows where {rows} were recorded; see sierra fsck")
        return Recalled(self.context.outputs, recorded=recorded)

    def _is_worth(self, past: Past, one: Judgement) -> bool:
        """Whether it is recorded how an execution is judged now; where it failed before and fails still, it is executed."""
        return past.good or one.status is Status.OK

    def _results(self, past: Sequence[Past]) -> Iterator[tuple[Past, Result]]:
        """What a worker would have said of each, with the bytes of the files that are needed in a folder."""
        folders = {one.execution: self.session.anew / str(number) for number, one in enumerate(past)}
        read, lost = self._unpacked(past, folders)
        for one in past:
            made = judgement_id(one.execution, self.context.reading, self.context.session)
            result = one.result(made, folders[one.execution], read.get(one.execution, {}))
            if one.execution in lost:
                self.anew.unread[one.run] = lost[one.execution]
            elif one.failed_by_rules(result):
                yield one, result

    def _unpacked(
        self, past: Sequence[Past], folders: Mapping[str, Path]
    ) -> tuple[dict[str, dict[str, OutputFile]], dict[str, str]]:
        """Write the files that are needed; each as a worker describes it, and why some could not be."""
        read: dict[str, dict[str, OutputFile]] = {}
        lost: dict[str, str] = {}
        files = [_recorded(one, row) for one in past for row in needed(one, self.context)]
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
                    seen = OutputFile(**worker.describe(str(target), file.path))
                    read.setdefault(execution, {})[file.path] = seen
        return read, lost

    def _row(self, past: Past, one: Judgement) -> dict[str, Any]:
        return {
            "judgement": one.result.execution,
            "execution": past.execution,
            "run": past.run,
            "session": self.context.session,
            "batch": self.context.batch,
            "judged": datetime.now(UTC),
            "status": str(one.status),
            "reason": one.reason,
            "reading": self.context.reading,
            "lamport": self.context.lamport(),
        }


@dataclass(frozen=True, slots=True)
class Recalled(TableIngest):
    """What is recorded of the tables of judgements, by which others have the same."""

    recorded: Mapping[tuple[str, str], Artifact] = field(default_factory=dict)

    def table(self, execution: str, file: OutputFile) -> str | None:
        name: str | None = self._of(execution, file).get("output")
        return name

    def rows(self, execution: str, file: OutputFile) -> int | None:
        count: int | None = self._of(execution, file).get("rows")
        return count

    def counted(self, execution: str, file: OutputFile) -> int | None:
        count: int | None = self._of(execution, file).get("counted")
        return count

    def form(self, execution: str, file: OutputFile) -> str:
        return str(self._of(execution, file)["form"])

    def _of(self, execution: str, file: OutputFile) -> Artifact:
        return self.recorded.get((execution, file.path), {})


def _recorded(one: Past, row: Artifact) -> Recorded:
    """A file as `sierra.store.files` knows it; a table too is read as the bytes that it was."""
    taken = Taken("", 0, 0, one.run, one.execution, one.status, "asked", one.execution)
    kind = "log" if row["kind"] == "log" else "file"
    return Recorded(taken, row["path"], kind, row["size"], row["sha256"], row["size"], None, None, None)


def _target(folder: Path, file: Recorded) -> Path:
    """Return where a file is written. Raises Damaged for a path that leads out of the folder."""
    return inside(folder if file.kind == "log" else folder / RUN_OUTPUT, file.path)


def _artifacts(past: Past, result: Result, tables: TableIngest) -> Iterator[dict[str, Any]]:
    """Yield the artifacts of an execution as they are judged now; logs are what they were."""
    yield from artifact_rows(result, tables)
    yield from ({**row, "execution": result.execution} for row in past.artifacts if row["kind"] == "log")
