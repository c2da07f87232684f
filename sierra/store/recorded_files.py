"""Recorded files of runs: their list, and their bytes, streamed and verified.

The store has input files, logs and outputs byte for byte, as objects. An exception is an output that became a table: its
bytes may be missing (`[store] raw = false`, `sierra gc --raw`, or a record of an older SIERRA). Its rows are in the store.

Memory use grows with the number of requested files, not with their sizes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from hashlib import sha256
from typing import TYPE_CHECKING

from sierra.errors import Damaged
from sierra.store.duckdb_messages import first_line
from sierra.store.segments import Segment
from sierra.store.store import ResolvedId, Snapshot
from sierra.store.verified_files import verify
from sierra.store.view_sql import ORDER
from sierra.store.views import KEPT_OBJECTS
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import natural

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

INPUT_FOLDER = "input/"
OUTPUT_FOLDER = "output/"
BATCH = 4 << 20
"""The bytes of objects that are in memory at a time; an object that is larger is alone."""
UNREADABLE = (OSError, ValueError)
"""The errors that pyarrow raises for a damaged file; its ArrowInvalid is a ValueError."""


@dataclass(frozen=True, slots=True)
class ChosenExecution:
    """A run at its position in a batch, with the execution whose files are requested."""

    experiment: str
    ordinal: int
    number: int
    run: str
    execution: str | None
    status: str | None
    which: str
    """`counts` (the effective execution), `last` (none is effective), `asked` (the id names it), or `none` (never executed)."""
    judgement: str | None = None
    """The judgement under which the execution's files and rows are recorded."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """One recorded file of a run."""

    taken: ChosenExecution
    path: str
    """`input/…`, `output/…`, `stdout` or `stderr`."""
    kind: str
    """input, table, file or log."""
    bytes: int | None
    sha256: str | None
    """The SHA-256; of a log that was cut, that of the kept part. None for an input that the store does not know by its name."""
    kept: int | None
    """The number of its bytes in the store. None if the bytes are missing, even if the rows of its table are there."""
    output: str | None
    form: str | None
    rows: int | None

    @property
    def is_dropped(self) -> bool:
        """True if the store has the rows of the file, and was told not to keep its bytes."""
        return self.kind == "table" and self.kept is None

    @property
    def remark(self) -> str:
        """A short note on anything unusual; otherwise empty."""
        match self.kind:
            case _ if self.is_dropped:
                return f"not in the store, which has its rows: table {self.output}"
            case _ if self.kept is None:
                return "not in the store"
            case "log" if self.kept != self.bytes:
                return f"cut: {self.kept} bytes of its beginning and end are kept"
            case _:
                return ""


def take(snapshot: Snapshot, found: ResolvedId) -> list[ChosenExecution]:
    """Return the runs that an id names, in order, each with its effective execution or else its last one.

    A run or an experiment that belongs to several batches is taken from the batch that was submitted last. Batches that were
    executed here come before imported ones.
    """
    place = where(snapshot, found)
    statement = TAKEN.format(only=place.only, order=ORDER)
    return [ChosenExecution(*row) for row in snapshot.each(statement, {**place.parameters, "named": place.execution})]


@dataclass(frozen=True, slots=True)
class Place:
    """The position of a named batch, experiment, run or execution in a batch."""

    batch: str
    ordinal: int | None = None
    run: str | None = None
    execution: str | None = None

    @property
    def only(self) -> str:
        """The SQL condition on `batch_runs` m that selects the part of the batch."""
        return (self.ordinal is not None) * "AND m.ordinal = $o " + (self.run is not None) * "AND m.run = $r"

    @property
    def parameters(self) -> dict[str, str | int]:
        every = {"b": self.batch, "o": self.ordinal, "r": self.run}
        return {name: value for name, value in every.items() if value is not None}


def where(snapshot: Snapshot, resolved: ResolvedId) -> Place:
    """Return the position of an id. Of several batches, the last submitted one of those executed here is taken."""
    snapshot.views.make(
        ("batch_runs", "experiments", "batches", "executions", "all_judgements", "effective", "sessions", "origins")
    )
    run = resolved.id if resolved.kind == "run" else None
    if resolved.kind == "batch":
        return Place(resolved.id)
    if resolved.kind == "execution":
        snapshot.views.make(("reused_executions",))
        [(run,)] = snapshot.run(RUN_OF_EXECUTION, {"e": resolved.id})
    experiment = resolved.id if resolved.kind == "experiment" else None
    [(batch, ordinal), *_] = snapshot.run(LATEST, {"run": run, "experiment": experiment})
    return Place(batch, ordinal, run, resolved.id if resolved.kind == "execution" else None)


RUN_OF_EXECUTION = """
SELECT CASE WHEN run IN (SELECT run FROM batch_runs) THEN run
    ELSE coalesce((SELECT max(run) FROM reused_executions WHERE execution = $e), run) END
FROM executions WHERE execution = $e
"""
"""The run that was executed, or one that reuses the execution, if the batches of the first run were removed."""
LATEST = """
SELECT m.batch, m.ordinal
FROM batch_runs m JOIN experiments x USING (batch, ordinal) JOIN batches b USING (batch)
LEFT JOIN (SELECT batch, max(lamport) AS asked FROM sessions GROUP BY batch) s USING (batch) LEFT JOIN origins o USING (batch)
WHERE m.run = $run OR x.experiment = $experiment
ORDER BY o.packages IS NOT NULL, coalesce(s.asked, b.lamport) DESC, m.batch, m.ordinal LIMIT 1
"""

TAKEN = """
WITH m AS (SELECT DISTINCT m.ordinal, m.number, m.run FROM batch_runs m WHERE m.batch = $b {only}),
c AS (SELECT ordinal, run, execution, judgement FROM effective WHERE batch = $b),
l AS (SELECT e.run, arg_max(e.judgement, {order}) AS judgement FROM all_judgements e WHERE e.purpose = 'run' GROUP BY e.run),
n AS (SELECT e.run, arg_max(e.judgement, {order}) AS judgement FROM all_judgements e WHERE e.execution = $named GROUP BY e.run),
t AS (
    SELECT x.experiment, m.ordinal, m.number, m.run,
           CASE WHEN $named IS NULL OR $named = c.execution THEN coalesce(c.judgement, l.judgement)
                ELSE n.judgement END AS judgement,
           CASE WHEN $named IS NOT NULL THEN 'asked' WHEN c.execution IS NOT NULL THEN 'counts'
                WHEN l.judgement IS NOT NULL THEN 'last' ELSE 'none' END AS which
    FROM m JOIN experiments x ON x.batch = $b AND x.ordinal = m.ordinal
    LEFT JOIN c ON c.ordinal = m.ordinal AND c.run = m.run LEFT JOIN l ON l.run = m.run LEFT JOIN n ON n.run = m.run
)
SELECT t.experiment, t.ordinal, t.number, t.run, e.execution, e.status, t.which, t.judgement
FROM t LEFT JOIN all_judgements e ON e.judgement = t.judgement ORDER BY t.ordinal, t.number
"""


def recorded(
    snapshot: Snapshot, runs: Sequence[ChosenExecution], *, inputs: bool = False, check: bool = True
) -> list[Recorded]:
    """Return the recorded files of these runs, in order: input files, outputs, logs; with `inputs`, only the input files.

    Input files are in the order of the run, which says which one `{input}` is. Without `check`, files of objects are not
    verified, so that a damaged one does not hide the others. Then the caller reports damage, see `check_objects`.
    """
    if not check:
        snapshot.views.unchecked.add("objects")
    snapshot.add_table(
        "taken", place=range(len(runs)), run=(run.run for run in runs), execution=(run.judgement for run in runs)
    )
    snapshot.views.make(("batch_runs", "specs", "all_artifacts", KEPT_OBJECTS))
    rows = [(ordinal, nth, Recorded(runs[ordinal], *rest)) for ordinal, nth, *rest in snapshot.each(FILES, {"all": not inputs})]
    rows.sort(key=lambda row: (row[0], PARTS.get(row[2].kind, 1), row[1], natural(row[2].path)))
    return [file for _, _, file in rows]


PARTS = {"input": 0, "log": 2}
"""The order of the kinds of files; outputs come between inputs and logs."""
FILES = f"""
WITH inputs AS (
    SELECT t.place, m.inputs, r.files, unnest(range(len(r.files))) AS nth
    FROM taken t JOIN (SELECT run, any_value([input] || other_inputs) AS inputs, any_value(spec) AS spec FROM batch_runs
                       WHERE run IN (SELECT run FROM taken) GROUP BY run) m USING (run) JOIN specs r USING (spec)
),
listed AS (
    SELECT place, nth, '{INPUT_FOLDER}' || files[nth + 1] AS path, 'input' AS kind, NULL::BIGINT AS size,
           inputs[nth + 1] AS sha256, NULL AS output, NULL AS table_layout, NULL::BIGINT AS rows FROM inputs
    UNION ALL
    SELECT t.place, 0 AS nth, CASE a.kind WHEN 'log' THEN a.path ELSE '{OUTPUT_FOLDER}' || a.path END, a.kind, a.size, a.sha256,
           a.output, a.table_layout, a.rows
    FROM taken t JOIN all_artifacts a USING (execution) WHERE $all
    QUALIFY row_number() OVER (PARTITION BY t.place, a.kind = 'log', a.path ORDER BY a.output) = 1
),
kept AS (SELECT sha256, any_value(size) AS kept FROM "{KEPT_OBJECTS}" GROUP BY sha256)
SELECT l.place, l.nth, l.path, l.kind, coalesce(l.size, k.kept), l.sha256, k.kept,
       l.output, l.table_layout, l.rows
FROM listed l LEFT JOIN kept k ON k.sha256 = l.sha256
"""


def check_objects(snapshot: Snapshot) -> None:
    """Raise Damaged if a file of objects is not the recorded one."""
    verify(segment.files["objects"] for segment in snapshot.segments if "objects" in segment.files)


class FileContent:
    """One file's bytes; they can be read once, and only before the next file's."""

    def __init__(self, file: Recorded, pieces: Callable[[FileContent], Iterator[bytes]]) -> None:
        self.file = file
        self.identical: bool | None = None
        """True if these are exactly the bytes that the run had; known when `pieces` ends."""
        self.pieces = pieces(self)
        """The bytes in order. Raises Damaged if they differ from the record."""


def contents(snapshot: Snapshot, files: Sequence[Recorded]) -> Iterator[FileContent]:
    """Yield the contents of these files, each once, in the order of the store."""
    those = holding(snapshot, {file.taken.judgement for file in files if file.taken.judgement})
    yield from _objects(snapshot.holding({file.sha256 for file in files if file.sha256}), those, files)


def holding(snapshot: Snapshot, judgements: Iterable[str]) -> list[Segment]:
    """Return the segments that contain these judgements."""
    snapshot.add_table("asked", execution=judgements)
    return snapshot.recording("SELECT execution FROM asked")


def _objects(segments: Sequence[Segment], holding: Sequence[Segment], files: Sequence[Recorded]) -> Iterator[FileContent]:
    wanted: dict[str, list[Recorded]] = {}
    for file in files:
        wanted.setdefault(file.sha256 or "", []).append(file)
    first = {segment.name for segment in holding}
    ordered = sorted(segments, key=lambda segment: segment.name not in first)
    groups = _Groups([segment.files["objects"] for segment in ordered if "objects" in segment.files])
    for digest in sorted(wanted, key=groups.find(wanted)):
        for file in wanted[digest]:
            yield FileContent(file, groups.pieces)


class _Groups:
    """Objects in several files. The compressed bytes of one row group are in memory (at most 32 MiB), and a few rows of it."""

    def __init__(self, paths: Sequence[str]) -> None:
        self._paths = paths
        self._parts: dict[str, list[tuple[int, int, int]]] = {}
        """The location of each object's parts: file, row group, row."""
        self._file: tuple[int, pq.ParquetFile] = (-1, None)
        self._group: tuple[int, int] | None = None
        """The row group that is being read; None after an error."""
        self._batches: Iterator[pa.RecordBatch] = iter(())
        self._first = 0
        self._column: Sequence[pa.Scalar] = ()
        """The place of the last batch in its row group, and its column."""

    def find(self, wanted: Iterable[str]) -> Callable[[str], tuple[int, int, int]]:
        """Locate these digests. Return a sort key for digests: the location of the first part."""
        missing = set(wanted)
        for place in range(len(self._paths)):
            if not missing:
                break
            for digest, group, row in self._in_file(place, missing):
                self._parts.setdefault(digest, []).append((place, group, row))
            missing -= self._parts.keys()
        return lambda digest: self._parts[digest][0] if digest in self._parts else (-1, -1, -1)

    def _in_file(self, place: int, wanted: set[str]) -> Iterator[tuple[str, int, int]]:
        """Yield the parts of wanted objects: digest, row group, row. Skip unreadable parts; `pieces` reports them."""
        with contextlib.suppress(*UNREADABLE):
            for group in range(self._open(place).num_row_groups):
                with contextlib.suppress(*UNREADABLE):
                    digests = self._open(place).read_row_group(group, columns=["sha256"]).column(0).to_pylist()
                    yield from ((digest, group, row) for row, digest in enumerate(digests) if digest in wanted)

    def pieces(self, content: FileContent) -> Iterator[bytes]:
        """Yield the bytes of one object. The whole object is verified by its hash before the first byte is yielded."""
        file = content.file
        if file.sha256 is None or file.is_dropped:
            raise Damaged(file.remark)
        parts = self._parts.get(file.sha256)
        if parts is None:
            raise Damaged(f"not in the store, or not readable there (SHA-256 {file.sha256})")
        try:
            whole = [self._read(*parts[0])] if len(parts) == 1 else None
            digest = sha256()
            for piece in whole or (self._read(*part) for part in parts):
                digest.update(piece)
        except UNREADABLE as error:
            raise Damaged(f"cannot be read from {self._paths[parts[0][0]]}: {first_line(error)}") from error
        if digest.hexdigest() != file.sha256:
            raise Damaged(f"its content in the store differs from the record (SHA-256 {file.sha256})")
        content.identical = file.bytes == file.kept
        yield from whole or (self._read(*part) for part in parts)

    def _open(self, place: int) -> pq.ParquetFile:
        import pyarrow.parquet as pq

        if self._file[0] != place:
            self._file = (place, pq.ParquetFile(self._paths[place]))
        return self._file[1]

    def _read(self, place: int, group: int, row: int) -> bytes:
        if self._group != (place, group) or row < self._first:
            self._begin(place, group)
        while row >= self._first + len(self._column):
            self._next()
        piece: bytes = self._column[row - self._first].as_py()
        return piece

    def _begin(self, place: int, group: int) -> None:
        """Begin to read a row group from its first row."""
        opened = self._open(place)
        facts = opened.metadata.row_group(group)
        rows = max(1, BATCH * facts.num_rows // max(1, facts.total_byte_size))
        self._batches = opened.iter_batches(batch_size=rows, row_groups=[group], columns=["content"], use_threads=False)
        self._group, self._first, self._column = (place, group), 0, ()

    def _next(self) -> None:
        """Read the next rows. Raises one of `UNREADABLE`; then the row group is read from its first row the next time."""
        group, self._group = self._group, None
        self._first += len(self._column)
        self._column = ()
        batch = next(self._batches, None)
        if batch is None:
            raise OSError("the file ends too early")
        self._group, self._column = group, batch.column(0)


def runs_of_keys(keys: pa.Array) -> Iterator[tuple[str, str, int, int]]:
    """Yield each run of equal keys `execution/file`: the execution, the file, the place of the first, and their number."""
    import pyarrow.compute as pc

    runs, begin = pc.run_end_encode(keys), 0
    for key, end in zip(runs.values.to_pylist(), runs.run_ends.to_pylist(), strict=True):
        execution, _, file = key.partition("/")
        yield execution, file, begin, end - begin
        begin = end
