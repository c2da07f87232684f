"""`rm`: remove batches, experiments, runs and executions, and nothing else.

A batch is removed with all its records: experiments, members, sessions, replays. The executions of its runs are removed too,
unless another batch has the run. Experiments and runs are part of a batch's identity. So removing one of them removes only its
executions, and the next run of the batch's query executes it again; an experiment's runs that other experiments also have keep
their executions. A run or an execution that is named directly is removed even if other batches have it; the preview names these
batches.

A sequential study is removed with the batches of its looks, and a removed batch with the looks at it. The registration of a
claim is removed only if it is named, or with the last batch of the package that it came in.

Records around executions (run specifications, sources, environments, programs, rules, files) are removed if nothing else
refers to them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from enum import Enum

from sierra.errors import Busy, NotFound
from sierra.execution import recover
from sierra.execution.observer import Observer
from sierra.maintenance.transaction import changing, publish, undisturbed
from sierra.provenance import source
from sierra.store import study_records
from sierra.store.compaction import Compaction, groups, touched
from sierra.store.layout import StorePaths
from sierra.store.row_types import About, Of, To
from sierra.store.schema import RECORDED, columns_with, sql_types
from sierra.store.segments import Segment
from sierra.store.store import Snapshot, Store
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, field, replace
from sierra.util.text import few
from sierra.worker import checkpoints

KINDS = ("batch", "experiment", "run", "execution", "study", "claim")
"""The kinds of objects that have ids."""
SHOWN = 5


@dataclass(frozen=True, slots=True)
class RemovedBatch:
    """A batch that is removed as a whole, with the numbers of its experiments and runs."""

    batch: str
    query: str
    experiments: int
    runs: int


@dataclass(frozen=True, slots=True)
class Removal:
    """The things that a removal deletes, and the named things that stay."""

    batches: tuple[RemovedBatch, ...]
    """Batches that are removed as a whole."""
    runs: int
    """Runs that lose at least one execution."""
    executions: int
    replays: int
    bytes: int
    """The total size in bytes of the files and tables that these executions wrote."""
    losing: tuple[str, ...]
    """Batches that stay but lose executions."""
    shared: int
    """Runs that keep their executions because other experiments or batches have them."""
    sharing: tuple[str, ...]
    """The batches that have these runs."""
    studies: tuple[str, ...] = ()
    """Sequential studies that are removed as a whole."""
    cut: tuple[str, ...] = ()
    """Sequential studies that stay but lose looks."""
    claims: tuple[str, ...] = ()
    """Registered claims that are removed."""
    left: int = 0
    """Old segments that another process was still reading, and that `sierra gc` removes."""

    @property
    def nothing(self) -> bool:
        return not (self.batches or self.executions or self.studies or self.claims)


@dataclass(slots=True)
class _Plan:
    removal: Removal
    drop: dict[str, dict[str, AbstractSet[str]]] = field(default_factory=dict)
    touched: list[Segment] = field(default_factory=list)
    concerned: set[str] = field(default_factory=set)
    """Batches that must not be executing during the removal."""
    seen: set[str] = field(default_factory=set)
    runs: set[str] = field(default_factory=set)
    """Runs whose checkpoints are removed, so that the next execution begins anew."""


def plan(store: Store, prefixes: Sequence[str]) -> Removal:
    """Return the records that `remove` would delete. Raises NotFound for an unknown id, or if no id is given."""
    return _plan(store, _resolve(store, prefixes)).removal


def remove(
    store: Store,
    prefixes: Sequence[str],
    agree: Callable[[Removal], bool] = lambda removal: True,
    observer: Observer | None = None,
) -> Removal | None:
    """Remove the records that these ids name, if `agree` returns true for the preview; return None if it returns false.

    `observer` receives a notice about each session that died and cannot be recorded. Raises NotFound for an unknown id, Missing
    if the disk is full, Busy while one of the batches is executing or if the preview is out of date. If it raises, nothing
    changes.
    """
    recover.finish_dead(store, observer or Observer())
    named = _resolve(store, prefixes)
    first = _plan(store, named)
    if not agree(first.removal):
        return None
    planned = first
    with changing(store.paths) as session:

        def prepare(rewriting: Compaction) -> AbstractSet[str]:
            nonlocal planned
            planned = _plan(store, named)
            if planned.removal != first.removal:
                raise Busy("the store changed since the preview; run the command again")
            for group in groups(planned.touched):
                rewriting.write(group, planned.drop)
            return planned.seen

        left = publish(store.paths, session, prepare, lambda: undisturbed(store.paths, session, planned.concerned))
        _discard_checkpoints(store.paths, planned.runs)
    done = planned.removal
    return replace(done, left=left)


def _discard_checkpoints(paths: StorePaths, runs: AbstractSet[str]) -> None:
    """Remove the checkpoints of these runs that no execution uses."""
    if paths.checkpoints.is_dir():
        for path in sorted(paths.checkpoints.iterdir()):
            if path.name.partition(".")[0] in runs:
                checkpoints.discard(str(path))


def _resolve(store: Store, prefixes: Sequence[str]) -> dict[str, set[str]]:
    named: dict[str, set[str]] = {kind: set() for kind in KINDS}
    for prefix in prefixes:
        resolved = store.identify(prefix)
        if resolved.kind == "study":
            named["study"].add(resolved.id)
            named["batch"].update(look.batch for look in study_records.looks(store, resolved.id))
        else:
            named[resolved.kind].add(resolved.id)
    if not prefixes:
        raise NotFound("give the ids (or their beginnings) of the batches, experiments, runs or executions to remove")
    return named


ASKED = """
CREATE TEMP TABLE asked_members AS SELECT DISTINCT m.batch, m.ordinal, m.run
    FROM batch_runs m JOIN experiments x USING (batch, ordinal)
    WHERE m.batch IN (SELECT id FROM named WHERE kind = 'batch')
    OR x.experiment IN (SELECT id FROM named WHERE kind = 'experiment');
CREATE TEMP TABLE shared AS SELECT DISTINCT a.run, m.batch FROM (SELECT DISTINCT run FROM asked_members) a
    JOIN (SELECT DISTINCT batch, ordinal, run FROM batch_runs
          EXCEPT SELECT batch, ordinal, run FROM asked_members) m USING (run);
"""
REUSED = """
INSERT INTO shared SELECT e.run, f.batch FROM effective f JOIN executions e USING (execution)
    WHERE e.run <> f.run AND e.run IN (SELECT run FROM asked_members)
    AND f.batch NOT IN (SELECT batch FROM asked_members)
"""
FIND = """
CREATE TEMP TABLE gone AS
    SELECT judgement AS execution, execution AS own, run FROM all_judgements
    WHERE execution IN (SELECT id FROM named WHERE kind = 'execution') OR run IN (SELECT id FROM named WHERE kind = 'run')
    OR run IN (SELECT run FROM asked_members EXCEPT SELECT run FROM shared);
CREATE TEMP TABLE gone_batches AS SELECT id AS batch FROM named WHERE kind = 'batch';
CREATE TEMP TABLE gone_looks AS SELECT look, study FROM looks WHERE batch IN (SELECT batch FROM gone_batches);
CREATE TEMP TABLE gone_studies AS SELECT study FROM studies WHERE study IN (SELECT id FROM named WHERE kind = 'study')
    OR study IN (SELECT study FROM gone_looks
                 EXCEPT SELECT study FROM looks WHERE look NOT IN (SELECT look FROM gone_looks));
CREATE TEMP TABLE gone_verdicts AS SELECT replay FROM verdicts WHERE recorded IN (SELECT execution FROM gone)
    OR execution IN (SELECT execution FROM gone);
CREATE TEMP TABLE staying_verdicts AS SELECT DISTINCT replay FROM verdicts
    WHERE (recorded IS NULL OR recorded NOT IN (SELECT execution FROM gone))
    AND (execution IS NULL OR execution NOT IN (SELECT execution FROM gone));
CREATE TEMP TABLE gone_replays AS SELECT replay FROM replays WHERE batch IN (SELECT batch FROM gone_batches)
    OR (replay IN (SELECT replay FROM gone_verdicts) AND replay NOT IN (SELECT replay FROM staying_verdicts));
CREATE TEMP TABLE gone_imported_sessions AS SELECT session FROM imported_sessions
    WHERE batch IN (SELECT batch FROM gone_batches)
    AND session NOT IN (SELECT session FROM executions WHERE execution NOT IN (SELECT own FROM gone));
CREATE TEMP TABLE gone_claims AS SELECT session FROM registered_claims
    WHERE session NOT IN (SELECT session FROM registered_claims WHERE claim NOT IN (SELECT id FROM named WHERE kind = 'claim'))
    OR session IN (SELECT session FROM imported_sessions WHERE packages NOT IN (
        SELECT packages FROM imported_sessions WHERE session NOT IN (SELECT session FROM registered_claims)
        AND session NOT IN (SELECT session FROM gone_imported_sessions)));
INSERT INTO gone_imported_sessions SELECT DISTINCT session FROM gone_claims SEMI JOIN imported_sessions USING (session);
CREATE TEMP TABLE gone_sessions AS SELECT session FROM all_sessions WHERE batch IN (SELECT batch FROM gone_batches)
    UNION SELECT session FROM gone_claims;
"""
BATCHES = "SELECT batch, query, experiments, runs FROM batches WHERE list_contains($b, batch) ORDER BY batch"
GONE: Mapping[Enum, str] = {
    **dict.fromkeys((Of.EXECUTION, Of.JUDGEMENT, About.EXECUTION), "SELECT execution FROM gone"),
    Of.SESSION: "SELECT session FROM gone_sessions",
    About.BATCH: "SELECT batch FROM gone_batches",
    About.REPLAY: "SELECT replay FROM gone_replays",
    About.LOOK: "SELECT look FROM gone_looks",
    About.STUDY: "SELECT study FROM gone_studies",
    About.CLAIM: "SELECT id FROM named WHERE kind = 'claim'",
    About.IMPORTED_SESSION: "SELECT session FROM gone_imported_sessions",
    About.BUILD: "SELECT id FROM gone_builds",
    About.BLOB: "SELECT id FROM gone_blobs",
}
"""Queries for the objects with which records are removed."""
RELATIONS = {
    "executions": "all_judgements",
    "artifacts": "all_artifacts",
    "sessions": "all_sessions",
    "specs": """(
        WITH parts AS (
            SELECT image, image AS part FROM images UNION
            SELECT image, split_part(unnest(variants), '=', 2) FROM images WHERE variants IS NOT NULL
        )
        SELECT r.* REPLACE (s.source AS source, p.part AS image) FROM specs r
        LEFT JOIN sources s ON s.tree = r.source LEFT JOIN parts p ON p.image = r.image)""",
    "programs": "(FROM programs WHERE starts_with(name, '{project}/'))",
    "files_read": "(FROM files_read WHERE use = 'listed' OR starts_with(path, '{project}/'))",
}
"""Tables whose rows name other records than their columns say. The store has programs and files of the project only."""
UNNAMED = {
    To.BUILD: "SELECT build FROM builds WHERE batch IN (SELECT batch FROM gone_batches)",
    To.IMPORT: "SELECT package FROM imports",
    To.REDACTION: "SELECT session FROM redactions",
}
"""Further records that are removed unless a row that stays names them."""


def _plan(store: Store, named: Mapping[str, AbstractSet[str]]) -> _Plan:
    with store.snapshot() as snapshot:
        drop = rows_of(snapshot, store, named)
        planned = _Plan(_removal(snapshot, named))
        planned.drop = drop
        planned.touched = touched(snapshot, snapshot.segments, planned.drop)
        planned.seen = {segment.name for segment in snapshot.segments}
        concerned = "SELECT batch FROM batch_runs WHERE run IN (SELECT run FROM gone) UNION SELECT batch FROM gone_batches"
        planned.concerned = _column(snapshot, concerned)
        removed = "SELECT run FROM gone UNION (SELECT run FROM asked_members EXCEPT SELECT run FROM shared)"
        planned.runs = _column(snapshot, removed)
        return planned


def rows_of(snapshot: Snapshot, store: Store, named: Mapping[str, AbstractSet[str]]) -> dict[str, dict[str, AbstractSet[str]]]:
    """Return the rows that belong only to these objects, by table and column: the values of the column.

    `named`: the ids of each kind (batch, experiment, run, execution, study).
    """
    snapshot.views.make((*(RECORDED.keys() - {"objects"}), "all_judgements", "all_artifacts", "all_sessions", "effective"))
    pairs = [(kind, identity) for kind, ids in named.items() for identity in sorted(ids)]
    snapshot.add_table("named", kind=[kind for kind, _ in pairs], id=[each for _, each in pairs])
    snapshot.run(ASKED)
    if snapshot.holds("reused_executions"):
        snapshot.run(REUSED)
    snapshot.run(FIND)
    return _drop(snapshot, store)


def _removal(snapshot: Snapshot, named: Mapping[str, AbstractSet[str]]) -> Removal:
    batches = [RemovedBatch(*row) for row in snapshot.run(BATCHES, {"b": sorted(named["batch"])})]
    [(runs, executions)] = snapshot.run("SELECT count(DISTINCT run), count(DISTINCT own) FROM gone")
    [(replays,)] = snapshot.run("SELECT count(DISTINCT replay) FROM gone_replays")
    [(size,)] = snapshot.run(
        "SELECT coalesce(sum(size), 0)::BIGINT FROM "
        "(SELECT DISTINCT execution, kind, path, size FROM artifacts WHERE execution IN (SELECT own FROM gone))"
    )
    losing = _column(
        snapshot,
        "SELECT m.batch FROM (SELECT m.batch FROM batch_runs m JOIN gone USING (run) "
        "UNION SELECT batch FROM effective WHERE execution IN (SELECT own FROM gone)) m ANTI JOIN gone_batches g USING (batch)",
    )
    kept = "SELECT run, batch FROM shared WHERE run NOT IN (SELECT run FROM gone)"
    shared = _column(snapshot, f"SELECT run FROM ({kept})")
    sharing = _column(snapshot, f"SELECT batch FROM ({kept})")
    studies = _column(snapshot, "SELECT study FROM gone_studies")
    cut = _column(snapshot, "SELECT study FROM gone_looks") - studies
    return Removal(
        tuple(batches),
        runs,
        executions,
        replays,
        size,
        tuple(sorted(losing)),
        len(shared),
        tuple(sorted(sharing)),
        studies=tuple(sorted(studies)),
        cut=tuple(sorted(cut)),
        claims=tuple(sorted(named["claim"])),
    )


def _drop(snapshot: Snapshot, store: Store) -> dict[str, dict[str, AbstractSet[str]]]:
    """Return the rows to remove: those of the objects that are gone, and the records that only such rows name."""
    drop: dict[str, dict[str, AbstractSet[str]]] = {}
    for to in To:
        if to is To.OBJECT:
            snapshot.add_table("gone_blobs", id=sorted(_blobs(snapshot, store)))
        ids = _column(snapshot, _named_only_by_gone(to))
        snapshot.add_table(f"gone_{to.table}", id=sorted(ids))
        drop[to.table] = {to.key: ids}
    for fact, statement in GONE.items():
        gone = _column(snapshot, statement)
        for table, columns in columns_with(fact).items():
            drop.setdefault(table, {}).update(dict.fromkeys(columns, gone))
    return {
        table: heeded
        for table, columns in drop.items()
        if (heeded := {column: values for column, values in columns.items() if values})
    }


def _named_only_by_gone(to: To) -> str:
    """Return the query for the records that rows name which are removed, and no other rows."""
    gone, staying = [UNNAMED[to]] if to in UNNAMED else [], []
    for name, columns in columns_with(to).items():
        types = sql_types(name)
        is_gone = _is_gone(name)
        for column in columns:
            ids = f"SELECT {f'unnest({column})' if types[column].endswith('[]') else column} FROM {RELATIONS.get(name, name)}"
            gone.append(f"{ids} WHERE {is_gone}")
            staying.append(f"{ids} WHERE NOT coalesce({is_gone}, false)")
    return f"({' UNION '.join(gone)}) EXCEPT ({' UNION '.join(staying)})"


def _is_gone(name: str) -> str:
    """Return the SQL condition that a row of a table is removed."""
    conditions = [f"{column} IN ({ids})" for fact, ids in GONE.items() for column in columns_with(fact).get(name, ())]
    conditions += [f"{to.key} IN (SELECT id FROM gone_{to.table})" for to in To if to.table == name]
    return " OR ".join(conditions)


def _blobs(snapshot: Snapshot, store: Store) -> set[str]:
    """Return the git hashes of the files that only removed sources have. Packages have the files of sources in git too."""
    gone = (
        _column(snapshot, "SELECT files FROM sources SEMI JOIN gone_sources ON id = source")
        if snapshot.holds("blobs")
        else set()
    )
    if not gone:
        return set()
    stay = _column(snapshot, "SELECT files FROM sources ANTI JOIN gone_sources ON id = source")
    theirs = {blob for files in stay for blob in source.blobs(store.object(files))}
    return {blob for files in gone for blob in source.blobs(store.object(files))} - theirs


def _column(snapshot: Snapshot, statement: str) -> set[str]:
    return {row[0] for row in snapshot.run(statement) if row[0] is not None}


def text(removal: Removal) -> list[str]:
    """Return lines that list the records to delete, and those that stay."""
    lines = [
        f"batch {short(row.batch)} ({row.query}): {row.experiments} experiments, {row.runs} runs" for row in removal.batches
    ]
    if removal.executions:
        lines.append(f"{removal.executions} executions of {removal.runs} runs, with their files, tables and logs")
    if removal.replays:
        lines.append(f"{removal.replays} replay{'' if removal.replays == 1 else 's'}")
    if removal.studies:
        lines.append(f"study {_some(removal.studies)}, with its decisions")
    if removal.claims:
        lines.append(f"the registration of claim {_some(removal.claims)}; what is registered again counts as new")
    if removal.cut:
        lines.append(f"the looks at these batches of study {_some(removal.cut)}, which stays; its command looks at them again")
    if removal.losing:
        lines.append(
            f"these executions also belong to batch {_some(removal.losing)}, which stays; its next run executes them again"
        )
    if removal.shared:
        lines.append(
            f"not removed: {removal.shared} runs with their executions, which also belong to batch {_some(removal.sharing)}"
        )
    return lines


def _some(batches: Iterable[str]) -> str:
    return few([short(batch) for batch in batches], SHOWN)
