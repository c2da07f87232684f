"""Importing a package: the records of another laboratory are added to a store, and stay apart from its own.

A package may come from anybody. All its files are checked, then its records, as `sierra fsck` does: each id is computed again
from its record. What has no id of that kind, such as the result of a run, is only a claim. So:

- The store keeps in `imports` and `imported_sessions` where records came from.
- In a batch that was executed here, no imported execution counts (see the table `effective`). If it was not, those of the
  package that was imported first count. Imports never change what counts in a batch that has records.
- Imported executions are never reused.
- A record that the store has already is not replaced. Later judgements and findings on such records are not imported.

- A registered claim only counts for executions that came in the same package.

Replays, deliverables and sequential studies are not imported: they state what was done in the other store.

Everything appears at one moment (see `sierra.maintenance.transaction`). A second import of the same package adds nothing.
"""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from sierra.errors import Damaged, Missing, UsageError
from sierra.execution import recover
from sierra.execution.observer import Observer
from sierra.maintenance import fsck, transaction
from sierra.maintenance.findings import Kind
from sierra.packages import manifest
from sierra.packages.archive import Archive
from sierra.packages.layout import PACKAGE, PROJECT, STORED
from sierra.packages.manifest import PackageManifest
from sierra.packages.reading.received import records
from sierra.store import index_builder
from sierra.store.compaction import Compaction, groups
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.lamport_clock import HIGHEST, number_of, stamp
from sierra.store.row_types import ImportedSessionRow, ImportRow, Of
from sierra.store.schema import STAMPED, columns_with
from sierra.store.segments import OUTPUT, Segment, listed
from sierra.store.store import Snapshot, Store
from sierra.store.views import ONCE
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, replace

Drop = dict[str, dict[str, AbstractSet[str]]]
BY_EXECUTION, BY_JUDGEMENT, BY_SESSION = map(columns_with, (Of.EXECUTION, Of.JUDGEMENT, Of.SESSION))
"""Tables whose rows are added with an execution, a judgement or a session; the first two in the column `execution`."""
NO_IDS = ("findings", "imports", "imported_sessions", "registered_claims")
"""Tables with keys that do not say which records are the same in two stores."""
BY_ID = {
    **{name: keys[0] for name, keys in ONCE.items() if name not in NO_IDS},
    "batch_runs": "batch",
}
"""Tables whose records are not added if the store has one with the same id, in this column."""
IMPORTED = frozenset((*BY_EXECUTION, *BY_JUDGEMENT, *BY_SESSION, *BY_ID))
"""The tables that are imported."""
LAST_NUMBER = HIGHEST // 2
"""The largest Lamport number that is imported. A larger one would leave too few for later sessions of this store."""


class ImportedBatch(NamedTuple):
    """A batch of an imported package."""

    batch: str
    query: str
    runs: int
    """Number of its runs."""
    counts: bool | None
    """True if executions of this import count in it; False if those of this store or of an earlier package do; None if this
    store has no executions of it from elsewhere."""


@dataclass(frozen=True, slots=True)
class Imported:
    """The result of an import."""

    package: str
    title: str
    batches: tuple[ImportedBatch, ...]
    executions: int
    """Number of executions that were added."""
    known: int
    """Number of its executions that the store had already."""
    replays: int
    """Number of executions that were left out, because replays made them."""
    studies: int
    """Number of studies that were left out: another store has decided when they end."""


@dataclass(frozen=True, slots=True)
class _Received:
    """The checked records of a package, in a folder of the importing session."""

    id: str
    described: PackageManifest
    store: Store
    batches: list[str]


@dataclass(frozen=True, slots=True)
class _Change:
    """The additions of an import, and the segments of this store from which they follow."""

    drop: Drop
    sessions: list[ImportedSessionRow]
    executions: int
    known: int
    replays: int
    seen: set[str]


def import_package(store: Store, path: Path, observer: Observer | None = None) -> Imported:
    """Add the records of a package to a store.

    `observer` receives a notice about each session that died here and cannot be recorded. Raises Missing if it cannot be read
    or the disk is full, Damaged if it is no package, not a safe one, or if its records are not consistent, UsageError if they
    contradict records of this store. If it raises, nothing changes.
    """
    recover.finish_dead(store, observer or Observer())
    with transaction.changing(store.paths) as session:
        received = _received(path, session.paths.root / "package")
        session.take_number()
        changes: list[_Change] = []

        def prepare(adding: Compaction) -> AbstractSet[str]:
            changes.append(_change(store, received, stamp(session.number, session.id)))
            _write(adding, received, changes[-1], stamp(session.number, session.id))
            return changes[-1].seen

        def valid(now: AbstractSet[str], seen: AbstractSet[str]) -> bool:
            """Allow records that sessions have added meanwhile, but no removal and no other import."""
            new = [segment for segment in listed(store.paths.segments) if segment.name in now - seen]
            return seen <= now and not any("imports" in segment.files for segment in new)

        transaction.publish(store.paths, session, prepare, valid=valid)
        index_builder.keep_up(store.paths)
        return _result(store, received, changes[-1])


def _received(path: Path, folder: Path) -> _Received:
    """Extract and check the records of a package. Nothing of a file is used before all files were checked."""
    with Archive(path) as archive:
        archive.verify()
        described = manifest.read(archive.read(PACKAGE))
        archive.extract(records(archive), folder)
        identity = archive.id
    store = Store(folder / STORED)
    _check(path, store, folder / PROJECT)
    return _Received(identity, described, store, store.values(str, "SELECT batch FROM batches ORDER BY lamport, batch"))


def _check(path: Path, store: Store, root: Path) -> None:
    """Raise Damaged unless the records are consistent, Missing if this cannot be checked."""
    for finding in fsck.check(store.paths, root).report.findings:
        if finding.kind is Kind.UNCHECKED:
            raise Missing(f"{path}: the records of the package cannot be checked: {finding}")
        if finding.kind.wrong and finding.kind is not Kind.GONE:
            raise Damaged(f"{path}: the records of the package are not consistent: {finding}")
    with store.snapshot() as snapshot:
        if not snapshot.holds("batches"):
            raise Damaged(f"{path} has no batch")
        numbers = [number_of(stamp) for table in STAMPED for stamp in _stamps(snapshot, table)]
    if max(numbers) > LAST_NUMBER:
        raise Damaged(f"{path}: there are records with the Lamport number {max(numbers)}, which SIERRA never assigns")


def _stamps(snapshot: Snapshot, table: str) -> list[int]:
    """Return the greatest value of a table's column `lamport`, if there is one."""
    greatest = f"SELECT max(lamport) FROM {table} HAVING max(lamport) IS NOT NULL"  # noqa: S608 - of our own parts
    return snapshot.values(int, greatest) if snapshot.holds(table) else []


def _change(store: Store, received: _Received, lamport: int) -> _Change:
    """Return the records to add. Raises UsageError if the package contradicts this store."""
    with store.snapshot() as own, received.store.snapshot() as theirs:
        for snapshot in (own, theirs):
            snapshot.views.make(("all_judgements", "all_sessions", "imported_sessions", "registered_claims"))
        _check_against(own, theirs, received)
        executions = _column(theirs, "SELECT execution FROM all_judgements")
        replayed = _column(theirs, "SELECT execution FROM all_judgements WHERE purpose <> 'run'")
        known = executions & _column(own, "SELECT execution FROM all_judgements")
        added = executions - replayed - known
        theirs.add_table("added", execution=sorted(added))
        sessions = [row for row in theirs.run(ORIGINS) if row[0] not in _column(own, RECORDED_SESSIONS)]
        drop = _drop(own, theirs, added, {row[0] for row in sessions})
        seen = {segment.name for segment in own.segments}
        new = _column(own, "SELECT session FROM imported_sessions")
        rows = [
            ImportedSessionRow(session, batch, [received.id, *(packages or ())], lamport)
            for session, batch, packages in sessions
            if session not in new
        ]
        return _Change(drop, rows, len(added), len(known - replayed), len(replayed), seen)


def _drop(own: Snapshot, theirs: Snapshot, executions: AbstractSet[str], sessions: AbstractSet[str]) -> Drop:
    """Return the rows of the package that are not added, if these executions and sessions are."""
    judged = executions | _column(theirs, "SELECT judgement FROM all_judgements SEMI JOIN added USING (execution)")
    drop: Drop = {}
    for name in {"output" if name.startswith(OUTPUT) else name for segment in theirs.segments for name in segment.files}:
        if name in BY_ID:
            key = BY_ID[name]
            drop[name] = {key: _values(own, name, key)}
        elif name in BY_EXECUTION:
            drop[name] = {"execution": _values(theirs, name, "execution") - executions}
        elif name in BY_JUDGEMENT:
            drop[name] = {"execution": _values(theirs, name, "execution") - judged}
        elif name in BY_SESSION:
            drop[name] = {"session": _values(theirs, name, "session") - sessions}
    return {name: columns for name, columns in drop.items() if any(columns.values())}


def _values(snapshot: Snapshot, table: str, column: str) -> set[str]:
    """Return the values of a column in all files of a table; `output` stands for all outputs."""
    files = [
        path
        for segment in snapshot.segments
        for name, path in segment.files.items()
        if name == table or (table == "output" and name.startswith(OUTPUT))
    ]
    return _column(snapshot, f"SELECT DISTINCT {column} FROM {read_parquet(files)}") if files else set()  # noqa: S608


def _column(snapshot: Snapshot, statement: str) -> set[str]:
    return {row[0] for row in snapshot.run(statement) if row[0] is not None}


RECORDED_SESSIONS = """
SELECT session FROM all_sessions UNION SELECT session FROM all_judgements ANTI JOIN imported_sessions USING (session)
UNION SELECT session FROM registered_claims
"""
"""Sessions of this store, and imported sessions that had ended when they were packed."""
ORIGINS = """
SELECT a.session, max(a.batch), any_value(i.packages) FROM (
    SELECT session, batch FROM all_sessions UNION SELECT session, batch FROM all_judgements SEMI JOIN added USING (execution)
    UNION SELECT session, '' FROM registered_claims
) a LEFT JOIN imported_sessions i ON i.session = a.session GROUP BY a.session ORDER BY a.session
"""


def _check_against(own: Snapshot, theirs: Snapshot, received: _Received) -> None:
    """Raise UsageError if records of the package claim to be of this store, or differ from records here with the same id."""
    rows = theirs.run("SELECT DISTINCT execution, run, result, session FROM all_judgements")
    own.add_table(
        "theirs", **{name: [row[nth] for row in rows] for nth, name in enumerate(("execution", "run", "result", "session"))}
    )
    if other := own.run(OTHER):
        raise UsageError(
            f"package {short(received.id)} has execution {short(other[0][0])} with another run or result than this store"
        )
    if lost := own.run(LOST):
        raise UsageError(
            f"package {short(received.id)} has executions of session {lost[0][0]}, which was executed here, but this store "
            "does not have them; if you have removed them, remove the rest of their batch too, and import the package again"
        )


OTHER = """
SELECT t.execution FROM theirs t JOIN all_judgements e USING (execution)
WHERE e.run IS DISTINCT FROM t.run OR e.result IS DISTINCT FROM t.result LIMIT 1
"""
LOST = """
SELECT t.session FROM theirs t ANTI JOIN all_judgements e USING (execution)
WHERE t.session IN (SELECT session FROM all_sessions UNION SELECT session FROM all_judgements)
AND t.session NOT IN (SELECT session FROM imported_sessions) LIMIT 1
"""


def _write(adding: Compaction, received: _Received, change: _Change, lamport: int) -> None:
    """Write the new records. Each new segment also says where they came from, so that the loss of another one hides nothing."""
    described = received.described
    row = ImportRow(received.id, described.title, described.date, received.batches, datetime.now(UTC), lamport)
    segments = [_imported(segment) for segment in received.store.segments()]
    for group in groups(segment for segment in segments if segment.files):
        writer = adding.add(group, change.drop)
        if any(writer.folder.iterdir()):
            writer.records([row])
            writer.records(change.sessions)


def _imported(segment: Segment) -> Segment:
    """Return a segment with only the files that are imported."""
    names = [name for name in segment.files if ("output" if name.startswith(OUTPUT) else name) in IMPORTED]
    return replace(segment, files={name: segment.files[name] for name in names})


BATCHES = """
SELECT b.batch, b.query, b.runs, CASE WHEN o.batch IS NOT NULL THEN coalesce(o.packages[1] = $package, false) END AS counts
FROM batches b LEFT JOIN origins o USING (batch) WHERE list_contains($batches, b.batch) ORDER BY b.lamport, b.batch
"""


def _result(store: Store, received: _Received, change: _Change) -> Imported:
    rows = store.select(ImportedBatch, BATCHES, package=received.id, batches=received.batches)
    studies = len(received.store.values(str, "SELECT study FROM studies"))
    return Imported(
        received.id, received.described.title, tuple(rows), change.executions, change.known, change.replays, studies
    )
