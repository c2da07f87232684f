"""Check that each record has the id that follows from its content, and that everything it refers to is present.

Each id follows from the record itself (see DESIGN: identity is content). So a forged or wrongly written record is found even if
its file has the bytes that were written. For facts without an id of their own (when an execution ended, on which host), only
the hash of the segment protects them.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple, TypeVar

import pyarrow as pa

from sierra.containers.images.image import variants_id
from sierra.design.expand import exact, run_id
from sierra.errors import Damaged, Missing, SierraError
from sierra.execution.build.recipe import PLATFORM, build_id
from sierra.execution.build_products import Product
from sierra.execution.build_products import result as products_hash
from sierra.execution.shared_files import shared_id
from sierra.ingest.observations import file_set
from sierra.ingest.recording_context import UNREAD
from sierra.ingest.rejudge import judgement_id
from sierra.maintenance.check_files import Contents, Objects
from sierra.maintenance.findings import Affected, Finding, Kind, of
from sierra.model import REDACTED, RunSpec, Value
from sierra.provenance import environment, source
from sierra.provenance.dependency_model import Identified, fingerprint, fingerprint_by_name
from sierra.provenance.source.stored_repositories import proves
from sierra.store import claim_records
from sierra.store.deliverable_records import deliverable_id
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.duckdb_messages import first_line
from sierra.store.layout import RUN_STDOUT, StorePaths
from sierra.store.parquet_row_counts import rows_by_file
from sierra.store.row_types import TABLES as TABLE_NAMES
from sierra.store.row_types import (
    BuildProductRow,
    DeliverableRow,
    EnvironmentRow,
    IngestRulesRow,
    IsolationRow,
    LookIntervalRow,
    LookRow,
    Of,
    RegisteredClaimRow,
    SharedFileRow,
    SourceRow,
    SpecRow,
    StudyRow,
)
from sierra.store.schema import RECORDED, TIME, columns_with, sql_types
from sierra.store.spec_rows import run_spec
from sierra.store.sql_result import RawRow
from sierra.store.store import Snapshot
from sierra.store.study_records import look_id, study_id
from sierra.store.views import records as records_of
from sierra.util.hashing import canonical_plain, digest, merkle, sha256, short
from sierra.util.json_types import JsonView
from sierra.util.shortage import lacking

SHOWN = 3
MEMORY = "1GB"


R = TypeVar("R", bound=NamedTuple)


class Records:
    """The records of all sound files, on one connection."""

    def __init__(self, paths: StorePaths, contents: Contents, objects: Objects) -> None:
        self.paths = paths
        self.contents = contents
        self.objects = objects
        self.files: dict[str, list[str]] = {}
        for segment in contents.sound:
            for name, path in segment.files.items():
                self.files.setdefault(name, []).append(path)
        self.snapshot = Snapshot(paths.root, contents.sound)
        self.snapshot.run(f"SET memory_limit = '{MEMORY}'")
        self.snapshot.run("SET preserve_insertion_order = true")
        self.snapshot.add_table("kept", sha256=sorted(objects.whole))
        for name in (*(name for name in RECORDED if name != "objects"), "all_judgements", "all_artifacts", "all_sessions"):
            with contextlib.suppress(Damaged):  # the checks that need it report that it cannot be read
                self.snapshot.views.make((name,))

    def each(self, statement: str, **parameters: object) -> Iterator[RawRow]:
        return self.snapshot.each(statement, parameters)

    def column(self, statement: str, **parameters: object) -> list[str]:
        """Return the first column of a statement's result."""
        return [row[0] for row in self.each(statement, **parameters)]

    def of_batches(self, statement: str, **parameters: object) -> Affected:
        """Return what a problem of the batches in a statement's result affects."""
        return of(self.snapshot, batches=self.column(statement, **parameters))

    def raw(self, name: str) -> str:
        """Return a SQL relation of all rows of a table as the files hold them, with the file's name."""
        if name in self.files:
            return records_of(name, self.files[name], filename=True)
        columns = ", ".join(f'NULL::{c.type} AS "{c.name}"' for c in RECORDED[name].columns)
        return f"(SELECT {columns}, '' AS filename WHERE false)"

    def rows(self, kind: type[R]) -> Iterator[tuple[R, str]]:
        """Yield the distinct records of a table, each with one file that has it; times are texts.

        Any value may be NULL in a damaged store.
        """
        types = sql_types(TABLE_NAMES[kind])
        listed = ", ".join(f'"{column}"::VARCHAR' if types[column] == TIME else f'"{column}"' for column in kind._fields)
        for *row, path in self.each(f"SELECT {listed}, min(filename) FROM {self.raw(TABLE_NAMES[kind])} GROUP BY ALL"):
            yield kind._make(row), path

    def shown(self, path: str) -> str:
        """Return a file's path relative to the store."""
        return str(Path(path).relative_to(self.paths.root)) if path else ""

    def wrong(self, path: str, what: str, affected: Affected) -> Finding:
        return Finding(Kind.INCONSISTENT, self.shown(path), what, affected)


Check = Callable[[Records], Iterator[Finding]]


def check(records: Records, root: Path) -> Iterator[Finding]:
    """Yield all problems of the records; `root` is the project's folder, whose git repository holds the sources."""
    for one in CHECKS:
        yield from _tried(one.__name__.strip("_"), one(records))
    yield from _tried("sources", _gone(records, root))


def _tried(what: str, found: Iterator[Finding]) -> Iterator[Finding]:
    """Yield the findings of a check; if it fails because records cannot be read, yield a finding about that."""
    try:
        yield from found
    except (SierraError, ValueError, TypeError, KeyError, MemoryError, RecursionError) as error:
        kind = Kind.INCONSISTENT if lacking(error) is None else Kind.UNCHECKED
        yield Finding(kind, what, f"cannot be checked: {first_line(error) or repr(error)}")


# ids


def _id(what: Callable[[], str]) -> str | None:
    """Return an id that follows from a record; None if the record cannot be read."""
    try:
        return what()
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def _recipes(records: Records) -> Iterator[Finding]:
    yield from _own(records, SpecRow, lambda row: digest("recipe", run_spec(row).preimage()))


def _environments(records: Records) -> Iterator[Finding]:
    yield from _own(records, EnvironmentRow, lambda row: environment.identity(row._asdict()))


class _Build(NamedTuple):
    """The facts from which the id and the result of a build follow."""

    build: str
    session: str
    source: str | None
    command: list[str]
    folder: str
    produces: list[str]
    variables: str
    image: str | None
    host_access: list[str] | None
    programs: str
    processors: list[str] | None
    result: str | None

    def id(self) -> str:
        host_access = tuple(self.host_access or ())
        spec = RunSpec(PLATFORM, tuple(self.command), json.loads(self.variables), self.source, self.image, host_access)
        return build_id(spec, self.folder, tuple(self.produces), self.programs, tuple(self.processors or ()))


def _builds(records: Records) -> Iterator[Finding]:
    """Check the ids and the results of builds, and that nothing is missing that they, or sessions, refer to."""
    products_of: dict[tuple[str, str], list[Product]] = {}
    for row, _ in records.rows(BuildProductRow):
        products_of.setdefault((row.build, row.session), []).append(Product(row.name, row.size, row.sha256))
    statement = f"SELECT DISTINCT {', '.join(_Build._fields)}, filename FROM {records.raw('builds')}"
    for *columns, path in list(records.each(statement)):
        build = _Build._make(columns)
        products = sorted(products_of.get((build.build, build.session), ()), key=lambda product: product.name)
        if _id(build.id) != build.build or (build.result is not None and products_hash(products) != build.result):
            what = f"build {short(str(build.build))} does not have the id or the result that follows from its record"
            yield records.wrong(path, what, _using(records, "build", build.build))
    for what, statement in LOST_BY_BUILD.items():
        if batches := records.column(statement):
            yield Finding(Kind.LOST, "builds", what, of(records.snapshot, batches=batches))


LOST_BY_BUILD = {
    "logs of builds are not in the store": "SELECT DISTINCT batch FROM builds b ANTI JOIN kept k ON k.sha256 = b.log",
    "builds of sessions are not recorded": """
        SELECT DISTINCT batch FROM all_sessions s ANTI JOIN builds b ON b.build = s.build WHERE s.build IS NOT NULL""",
}


def _sources(records: Records) -> Iterator[Finding]:
    yield from _own(records, SourceRow, lambda row: digest("source", _fields(row, source.RECORDED)))


def _readings(records: Records) -> Iterator[Finding]:
    def ingest_rules(row: IngestRulesRow) -> str:
        declared = json.loads(row.declared)
        heeded = {
            name: {key: value for key, value in output.items() if key not in {"mismatch", *UNREAD}}
            for name, output in declared["outputs"].items()
        }
        return digest("reading", {**declared, "outputs": heeded})

    yield from _own(records, IngestRulesRow, ingest_rules)


def _judgements(records: Records) -> Iterator[Finding]:
    """Check the ids of judgements, and that each judgement has the run of the execution that it judges."""
    rows = f"SELECT judgement, execution, ingest_rules, session, filename FROM {records.raw('judgements')}"
    for judgement, execution, ingest_rules, session, filename in list(records.each(rows)):
        if _id(lambda: judgement_id(execution, ingest_rules, session)) != judgement:  # noqa: B023
            what = f"judgement {short(str(judgement))} does not have the id that follows from its columns"
            yield records.wrong(filename, what, of(records.snapshot, [judgement]))
    statement = "SELECT j.judgement FROM judgements j JOIN executions e USING (execution) WHERE j.run <> e.run"
    if named := records.column(statement):
        what = "judgements have other runs than their executions"
        yield Finding(Kind.INCONSISTENT, "judgements", what, of(records.snapshot, named))


def _isolations(records: Records) -> Iterator[Finding]:
    yield from _own(records, IsolationRow, lambda row: digest("isolation", _fields(row, IsolationRow._fields[1:])))


def _deliverables(records: Records) -> Iterator[Finding]:
    """Check the ids of deliverables, and that their batches are recorded."""
    yield from _own(records, DeliverableRow, deliverable_id)
    for (batch,) in records.each("SELECT DISTINCT batch FROM deliverables ANTI JOIN batches USING (batch)"):
        yield Finding(Kind.LOST, "deliverables", f"deliverables belong to batch {short(str(batch))}, which is not recorded")


def _registered_claims(records: Records) -> Iterator[Finding]:
    """Check the ids of registered claims."""
    yield from _own(records, RegisteredClaimRow, claim_records.row_id)


def _studies(records: Records) -> Iterator[Finding]:
    """Check the ids of studies and looks, and that the studies and the batches of looks are recorded."""
    yield from _own(records, StudyRow, study_id)
    seen: dict[str, list[LookIntervalRow]] = {}
    for interval, _ in records.rows(LookIntervalRow):
        seen.setdefault(interval.look, []).append(interval)
    yield from _own(records, LookRow, lambda row: look_id(row, seen.get(row.look, ())))
    for what, statement in LOST_BY_LOOK.items():
        if batches := records.column(statement):
            yield Finding(Kind.LOST, "looks", what, of(records.snapshot, batches=batches))
    if seen.keys() - set(records.column("SELECT DISTINCT look FROM looks")):
        yield Finding(Kind.LOST, "looks", "looks of recorded intervals are not recorded")


LOST_BY_LOOK = {
    "studies of looks are not recorded": "SELECT DISTINCT batch FROM looks ANTI JOIN studies USING (study)",
    "batches of looks are not recorded": "SELECT DISTINCT batch FROM looks ANTI JOIN batches USING (batch)",
}


def _fields(row: NamedTuple, names: Iterable[str]) -> dict[str, JsonView]:
    return {name: getattr(row, name) for name in names}


def _own(records: Records, kind: type[R], identity: Callable[[R], str]) -> Iterator[Finding]:
    """Yield the records whose id, which is their first column, does not follow from their columns."""
    key = kind._fields[0]
    for row, path in records.rows(kind):
        if _id(partial(identity, row)) != row[0]:
            what = f"{key} {short(str(row[0]))} does not have the id that follows from its columns"
            yield records.wrong(path, what, _using(records, key, row[0]))


USING = {
    "spec": "SELECT DISTINCT batch FROM batch_runs WHERE spec = $id",
    "environment": "SELECT DISTINCT batch FROM executions WHERE environment = $id",
    "ingest_rules": "SELECT DISTINCT batch FROM executions WHERE ingest_rules = $id",
    "isolation": "SELECT DISTINCT batch FROM executions WHERE isolation = $id",
    "programs": "SELECT DISTINCT batch FROM executions WHERE programs = $id",
    "source": "SELECT DISTINCT batch FROM all_sessions WHERE source = $id",
    "build": "SELECT DISTINCT batch FROM all_sessions WHERE build = $id",
    "deliverable": "SELECT DISTINCT batch FROM deliverables WHERE deliverable = $id",
    "study": "SELECT DISTINCT batch FROM looks WHERE study = $id",
    "look": "SELECT DISTINCT batch FROM looks WHERE look = $id",
    "claim": "SELECT batch FROM batches WHERE batch = $id",  # a claim belongs to no batch
}


def _using(records: Records, key: str, identity: str) -> Affected:
    return of(records.snapshot, batches=[found[0] for found in records.each(USING[key], id=identity) if found[0]])


def _programs(records: Records) -> Iterator[Finding]:
    """Check the ids of program lists. The programs of one fingerprint are adjacent, repeated as often as they were recorded."""
    for path in records.files.get("programs", ()):
        statement = f"SELECT programs, name, path, sha256 FROM {read_parquet([path])}"
        for identity, rows in groupby(records.each(statement), itemgetter(0)):
            if not _is_fingerprint(identity, [row[1:] for row in rows if row[1] is not None]):
                what = f"programs {short(str(identity))} do not have the id that follows from their names and SHA-256"
                yield Finding(Kind.INCONSISTENT, records.shown(path), what, _using(records, "programs", identity))


def _is_fingerprint(identity: str, programs: Sequence[Identified]) -> bool:
    """Check an id of programs. In redacted records, the folders of programs are not those of which the id was made."""
    if identity in (fingerprint(programs), fingerprint_by_name(programs)):
        return True
    return fingerprint(programs) != fingerprint_by_name(programs) and any(
        part is not None and REDACTED in part for name, path, _ in programs for part in (name, path)
    )


def _file_sets(records: Records) -> Iterator[Finding]:
    """Check the ids of sets of files."""
    using = "SELECT execution FROM observations WHERE files = $id"
    for path in records.files.get("files_read", ()):
        statement = f"SELECT files, path, use, sha256, size FROM {read_parquet([path])}"
        for identity, rows in groupby(records.each(statement), itemgetter(0)):
            if _id(lambda: file_set(row[1:] for row in rows)) != identity:  # noqa: B023
                what = f"the set of files {short(str(identity))} does not have the id that follows from its files"
                yield records.wrong(path, what, of(records.snapshot, records.column(using, id=identity)))


def _shared_files(records: Records) -> Iterator[Finding]:
    """Check the ids of sets of files beside inputs, that the sets are there, and that the store has the files."""
    files: dict[str, list[SharedFileRow]] = {}
    for row, path in records.rows(SharedFileRow):
        files.setdefault(row.shared, []).append(row)
        if row.sha256 not in records.objects.whole:
            what = f"{row.name}, a file beside the inputs of runs, is not in the store"
            yield Finding(Kind.LOST, records.shown(path), what, records.of_batches(OF_SHARED, s=row.shared))
    needed = records.column("SELECT DISTINCT shared_files FROM specs WHERE shared_files IS NOT NULL")
    for shared in dict.fromkeys((*files, *needed)):
        if _id(lambda: shared_id(files.get(shared, ()))) != shared:  # noqa: B023
            what = f"the files {short(str(shared))} beside the inputs of runs do not have the id that follows from them"
            yield Finding(Kind.INCONSISTENT, "shared_files", what, records.of_batches(OF_SHARED, s=shared))


OF_SHARED = "SELECT DISTINCT batch FROM batch_runs SEMI JOIN (SELECT spec FROM specs WHERE shared_files = $s) USING (spec)"
RUNS = """
SELECT DISTINCT m.run, m.seed, m.spec, [m.input] || m.other_inputs AS inputs, r.files, m.filename
FROM {members} m LEFT JOIN specs r ON r.spec = m.spec
"""


def _runs(records: Records) -> Iterator[Finding]:
    bad: dict[tuple[str, str], set[str]] = {}
    for run, seed, spec, inputs, files, path in records.each(RUNS.format(members=records.raw("batch_runs"))):
        if files is None:
            bad.setdefault((path, f"its spec {short(str(spec))} is not recorded"), set()).add(run)
        elif _id(lambda: run_id(spec, zip(files, inputs, strict=True), seed)) != run:  # noqa: B023
            bad.setdefault((path, "runs do not have the ids that follow from their spec, inputs and seeds"), set()).add(run)
    for (path, what), runs in bad.items():
        yield Finding(Kind.INCONSISTENT, records.shown(path), what, of(records.snapshot, runs=runs))


def _batches(records: Records) -> Iterator[Finding]:
    """Check the ids of experiments and batches.

    Values are read file by file, because a column may hold numbers in one file and texts in another.
    """
    axes = {batch: names or [] for batch, names in records.each(f"SELECT DISTINCT batch, axes FROM {records.raw('batches')}")}
    recorded: dict[str, dict[int, str]] = {}
    for path in records.files.get("experiments", ()):
        statement = f"SELECT * FROM {read_parquet([path])}"
        names = [column[0] for column in records.each(f"DESCRIBE {statement}")]
        for row in (dict(zip(names, values, strict=True)) for values in list(records.each(statement))):
            batch, ordinal, own = row["batch"], row["ordinal"], row["experiment"]
            recorded.setdefault(batch, {})[ordinal] = own
            if batch in axes and not _is_experiment(records, row, axes[batch]):
                what = f"experiment {short(str(own))} does not have the id that follows from its values and runs"
                runs = records.column(MEMBERS, b=batch, o=ordinal)
                yield records.wrong(path, what, of(records.snapshot, runs=runs, batches=[batch]))
    for batch in axes:
        ids = [experiment for _, experiment in sorted(recorded.get(batch, {}).items())]
        if _id(lambda: merkle("batch", ids)) != batch:  # noqa: B023
            yield Finding(
                Kind.INCONSISTENT,
                "batches",
                f"batch {short(batch)} does not have the id that follows from its experiments",
                of(records.snapshot, batches=[batch]),
            )
    yield from _parted(records, recorded.keys() - axes.keys())


MEMBERS = "SELECT run FROM batch_runs WHERE batch = $b AND ordinal = $o GROUP BY run, number ORDER BY number"


def _is_experiment(records: Records, row: Mapping[str, Value | None], axes: Sequence[str]) -> bool:
    values = {axis: row.get(axis) for axis in axes}
    if any(isinstance(value, float) and abs(value) >= 2**53 for value in values.values()):
        return True  # a column of fractions cannot hold so large a whole number exactly
    runs = records.column(MEMBERS, b=row["batch"], o=row["ordinal"])
    shown = {name: exact(value) for name, value in values.items() if value is not None}
    return bool(_id(lambda: merkle("experiment", runs, {"values": shown})) == row["experiment"])


def _parted(records: Records, batches: Iterable[str]) -> Iterator[Finding]:
    members = set(records.column("SELECT DISTINCT batch FROM batch_runs"))
    known = set(records.column("SELECT DISTINCT batch FROM batches"))
    for batch in sorted({*batches, *(members - known)}):
        yield Finding(
            Kind.LOST,
            "batches",
            f"batch {short(batch)} is not recorded, but parts of it are",
            of(records.snapshot, batches=[batch]),
        )


RESULTS = """
SELECT e.execution, e.result, e.first, array_agg(a.sha256 || ' ' || a.path ORDER BY a.path) FILTER (a.path IS NOT NULL)
FROM (
    SELECT DISTINCT execution, result, NULL AS first FROM {executions}
    UNION SELECT j.judgement, e.result, e.execution FROM judgements j JOIN {executions} e USING (execution)
) e
LEFT JOIN (SELECT DISTINCT execution, sha256, path FROM all_artifacts WHERE kind <> 'log') a USING (execution) GROUP BY ALL
"""


PRINTED = f"SELECT DISTINCT execution, sha256 FROM all_artifacts WHERE kind <> 'log' AND path = '{RUN_STDOUT}'"


def _result(members: Sequence[str]) -> str:
    return sha256(canonical_plain({"sierra": "result", "format": 1, "members": members}))


def _results(records: Records) -> Iterator[Finding]:
    bad = []
    printed: dict[str, str] = dict(records.each(PRINTED))
    for execution, result, first, members in records.each(RESULTS.format(executions=records.raw("executions"))):
        odd = any("\\" in member for member in members or ())  # a name that is not UTF-8 was sorted by its bytes
        if odd or _result(members or []) == result:
            continue
        # standard output may be an output only since a later judgement, or until then
        others = [member for member in members or () if member.partition(" ")[2] != RUN_STDOUT]
        then = [*others, f"{printed[first]} {RUN_STDOUT}"] if first in printed else others
        if first is None or _result(sorted(then, key=lambda member: member.partition(" ")[2])) != result:
            bad.append(execution)
    if bad := _unless_broken(records, bad):
        what = "executions do not have the result hash that follows from their artifacts"
        yield Finding(Kind.INCONSISTENT, "executions", what, of(records.snapshot, bad))


# references


def _unless_broken(records: Records, executions: Iterable[str]) -> list[str]:
    """Return the executions, except those in segments with a lost file: these have been reported."""
    named = set(executions)
    for segment in records.contents.sound:
        if segment.name in records.contents.broken:
            for table in ("executions", "artifacts", "judgements"):
                if table in segment.files:
                    key = "judgement" if table == "judgements" else "execution"
                    rows = records.each(f"SELECT DISTINCT {key} FROM {read_parquet([segment.files[table]])}")
                    named -= {row[0] for row in rows}
    return sorted(named)


ORPHANS = "their runs belong to no recorded batch; run the batch's query again to record it"
LOST_BY_EXECUTION = {
    "files or logs of executions are not in the store": """
        SELECT DISTINCT execution FROM all_artifacts a ANTI JOIN kept USING (sha256) WHERE a.kind IN ('file', 'log')""",
    ORPHANS: """
        SELECT DISTINCT execution FROM executions ANTI JOIN batch_runs USING (run)
        WHERE execution NOT IN (SELECT execution FROM reused_executions)""",
    "the ingest rules of executions are not recorded": """
        SELECT DISTINCT judgement FROM all_judgements ANTI JOIN ingest_rules USING (ingest_rules)""",
    "the isolation of executions is not recorded": """
        SELECT DISTINCT execution FROM executions ANTI JOIN isolations USING (isolation) WHERE isolation IS NOT NULL""",
    "the files that executions used are not recorded": f"""
        SELECT DISTINCT execution FROM observations ANTI JOIN files_read USING (files) WHERE files <> '{file_set(())}'""",
    "executions that other runs reuse are not recorded": """
        SELECT DISTINCT execution FROM reused_executions ANTI JOIN executions USING (execution)""",
    "the names in folders that executions listed are not recorded": """
        SELECT DISTINCT execution FROM observations JOIN files_read f USING (files) ANTI JOIN listings l ON l.sha256 = f.sha256
        WHERE f.use = 'listed' AND f.sha256 IS NOT NULL""",
    "judgements belong to executions that are not recorded": """
        SELECT DISTINCT judgement FROM judgements ANTI JOIN executions USING (execution)""",
    "verdicts belong to executions that are not recorded": """
        SELECT DISTINCT recorded FROM verdicts v WHERE recorded NOT IN (SELECT execution FROM executions)
        UNION SELECT execution FROM verdicts WHERE execution NOT IN (SELECT execution FROM executions)""",
    "captures belong to executions that are not recorded": """
        SELECT execution FROM captures WHERE execution NOT IN (SELECT execution FROM executions)""",
}


OWNERS = {Of.EXECUTION: "executions o ON o.execution", Of.JUDGEMENT: "all_judgements o ON o.judgement"}


def _lost_owners(records: Records) -> Iterator[tuple[str, str]]:
    """Yield a check for each table whose records belong to executions or judgements: its message and its statement."""
    for fact, owners in OWNERS.items():
        for table in sorted(RECORDED.keys() & columns_with(fact).keys() - {"executions", "judgements"}):
            yield (
                f"{table} belong to executions that are not recorded",
                f"SELECT DISTINCT r.execution FROM {records.raw(table)} r ANTI JOIN {owners} = r.execution",
            )


def _references(records: Records) -> Iterator[Finding]:
    for what, statement in (*LOST_BY_EXECUTION.items(), *_lost_owners(records)):
        if named := _unless_broken(records, (row[0] for row in records.each(statement))):
            yield Finding(Kind.LOST, "executions", what, of(records.snapshot, named))
    doubled = (
        f"SELECT execution FROM (SELECT execution FROM {records.raw('executions')} UNION ALL "
        f"SELECT judgement FROM {records.raw('judgements')}) GROUP BY execution HAVING count(*) > 1"
    )
    if named := records.column(doubled):
        yield Finding(Kind.INCONSISTENT, "executions", "executions are recorded more than once", of(records.snapshot, named))
    for replay in lost_replays(records):
        yield Finding(Kind.LOST, "replays", f"replay {short(replay)} is not recorded, but its verdicts are")
    for table, key in (("environments", "environment"), ("programs", "programs")):
        statement = f"SELECT execution FROM executions ANTI JOIN {table} USING ({key}) WHERE {key} <> $nothing"
        if named := records.column(statement, nothing=fingerprint(())):
            yield Finding(
                Kind.UNKNOWN,
                table,
                f"the {table} of executions are not recorded (their session was killed)",
                of(records.snapshot, named),
            )
    if named := _unless_broken(records, records.column(WITHOUT_ROBOTS)):
        what = "the clocks, batteries and ends of the robots of executions are not recorded"
        yield Finding(Kind.UNKNOWN, "robots", what, of(records.snapshot, named))


def lost_replays(records: Records) -> list[str]:
    """Return the replays of which only the verdicts are recorded."""
    of_verdicts = "SELECT replay FROM verdicts UNION SELECT replay FROM equivalences"
    return records.column(f"SELECT replay FROM ({of_verdicts}) ANTI JOIN replays USING (replay)")


WITHOUT_ROBOTS = """
SELECT DISTINCT execution FROM executions SEMI JOIN (
    SELECT run FROM batch_runs JOIN specs USING (spec) WHERE specs.robots IS NOT NULL
) USING (run) ANTI JOIN robots USING (execution)
"""
"""SQL: the executions on robots of which no robot is recorded."""
INPUTS = """
SELECT DISTINCT run FROM (SELECT run, unnest([input] || other_inputs) AS sha256 FROM batch_runs) ANTI JOIN kept USING (sha256)
"""


def _inputs(records: Records) -> Iterator[Finding]:
    if lost := records.column(INPUTS):
        yield Finding(Kind.LOST, "batch_runs", "input files of runs are not in the store", of(records.snapshot, runs=lost))


EXPECTED = """
SELECT execution, lower(output) AS output, CASE WHEN table_layout->>'$.file' IS NULL THEN name ELSE '' END AS file,
    any_value(name) AS path, sum(rows)::BIGINT AS rows, sum(counted_rows)::BIGINT AS counted
FROM (SELECT *, concat_ws('/', path, member) AS name FROM all_artifacts WHERE kind = 'table') GROUP BY ALL
"""
TABLES = f"""
SELECT execution, output, coalesce(e.path, file), coalesce(e.counted, e.rows, 0), coalesce(w.rows, 0)
FROM ({EXPECTED}) e FULL JOIN written w USING (execution, output, file)
WHERE coalesce(e.rows, 0) <> coalesce(w.rows, 0) OR e.counted <> coalesce(w.rows, 0)
ORDER BY ALL
"""


def _tables(records: Records) -> Iterator[Finding]:
    """Check the rows of outputs: each file of an execution has as many rows as were read and counted. Report extra rows."""
    records.snapshot.connection.register("written", _written(records))
    bad: dict[str, list[tuple[str, str]]] = {}
    for execution, output, path, expected, counted in records.each(TABLES):
        bad.setdefault(output, []).append((execution, f"{path}: {counted} instead of {expected}"))
    for output, executions in sorted(bad.items()):
        if named := _unless_broken(records, (execution for execution, _ in executions)):
            first = next(difference for execution, difference in executions if execution in named)
            what = f"table {output!r} does not have as many rows as executions wrote ({first})"
            yield Finding(Kind.LOST, "output." + output, what, of(records.snapshot, named))


def _written(records: Records) -> pa.Table:
    """Return the number of rows of each file of each execution in the store, counted without DuckDB."""
    rows = [
        (execution, output.lower(), file or "", count)
        for segment in records.contents.sound
        for output, path in segment.outputs()
        for (execution, file), count in rows_by_file(path).items()
    ]
    table = pa.table([list(column) for column in zip(*rows, strict=True)] or [[]] * 4, schema=WRITTEN)
    return table.group_by(WRITTEN.names[:3]).aggregate([("rows", "sum")]).rename_columns(WRITTEN.names)


WRITTEN = pa.schema([("execution", pa.string()), ("output", pa.string()), ("file", pa.string()), ("rows", pa.int64())])


def _manifests(records: Records) -> Iterator[Finding]:
    """Check the files of sources: their list is present and gives the tree; outside git, each file is present."""
    wanted: dict[str, str] = dict(records.each("SELECT blob, sha256 FROM blobs"))
    for blob, content in wanted.items():
        if content not in records.objects.whole:
            yield Finding(
                Kind.LOST, "blobs", f"a file of a source, {short(blob)}, is not in the store", records.of_batches(OF_SOURCES)
            )
        elif records.objects.blobs.get(content, blob) != blob and not proves(_object(records, content), blob):
            yield Finding(Kind.INCONSISTENT, "blobs", f"{short(blob)} is not git's hash of its file")
    for row, path in records.rows(SourceRow):
        if row.files not in records.objects.whole:
            what = f"the list of the files of source {short(row.source)} is not in the store"
            yield Finding(Kind.LOST, "sources", what, records.of_batches(OF_TREE, t=row.tree))
        elif (tree := source.tree_of(_object(records, row.files))) is not None and source.SWHID + tree != row.tree:
            what = f"the files of source {short(row.source)} do not have its tree's hash"
            yield records.wrong(path, what, records.of_batches(OF_TREE, t=row.tree))
    known = set(records.column("SELECT DISTINCT tree FROM sources"))
    for (tree,) in records.each("SELECT DISTINCT source FROM specs WHERE source IS NOT NULL"):
        if tree not in known:
            yield Finding(Kind.LOST, "sources", f"the source {tree} is not recorded", records.of_batches(OF_TREE, t=tree))


def _images(records: Records) -> Iterator[Finding]:
    """Check that the images of run specifications are recorded, and that the lists of their files are present."""
    for identity, kind, files, variants in records.each(IMAGES):
        if kind is None:
            what = f"the image {identity} is not recorded"
        elif variants is not None:
            ids = dict(variant.split("=", 1) for variant in variants if "=" in variant)
            if variants_id(ids) == identity:
                continue
            what = f"the images by processor of {identity} have another hash"
        elif files not in records.objects.whole:
            what = f"the list of the files of image {identity} is not in the store"
        else:
            continue
        yield Finding(Kind.LOST, "images", what, records.of_batches(OF_IMAGE, i=identity))


IMAGES = """
SELECT DISTINCT coalesce(r.image, i.image), i.kind, i.files, i.variants
FROM (SELECT image FROM specs WHERE image IS NOT NULL) r FULL JOIN images i USING (image)
"""


OF_IMAGE = "SELECT DISTINCT batch FROM batch_runs SEMI JOIN (SELECT spec FROM specs WHERE image = $i) USING (spec)"


def _object(records: Records, digest: str) -> bytes:
    statement = f"SELECT DISTINCT ON (part) content FROM {records.raw('objects')} WHERE sha256 = $d ORDER BY part"
    return b"".join(row[0] for row in records.each(statement, d=digest))


OF_TREE = "SELECT DISTINCT batch FROM batch_runs SEMI JOIN (SELECT spec FROM specs WHERE source = $t) USING (spec)"
OF_SOURCES = """
SELECT DISTINCT m.batch FROM batch_runs m JOIN specs r USING (spec) JOIN sources s ON s.tree = r.source WHERE s.vcs = 'none'
"""
HEALS = "sierra source fetch gets sources that were shared with sierra source push"


def _gone(records: Records, root: Path) -> Iterator[Finding]:
    """Yield the sources of which neither git nor the store has all files."""
    stored: set[str] = set(records.column("SELECT DISTINCT blob FROM blobs"))
    for tree, files in list(records.each("SELECT tree, any_value(files) FROM sources WHERE vcs = 'git' GROUP BY tree")):
        manifest = _object(records, files)
        try:
            there = source.blobs(manifest) <= stored or source.is_available(root, tree, manifest)
        except Missing as error:
            yield Finding(Kind.GONE, "sources", str(error))
            return
        if not there:
            affected = records.of_batches(OF_TREE, t=tree)
            yield Finding(Kind.GONE, "sources", f"{tree} is not in git, so its runs cannot be replayed here; {HEALS}", affected)


CHECKS: Sequence[Check] = (
    _recipes,
    _environments,
    _sources,
    _readings,
    _judgements,
    _deliverables,
    _registered_claims,
    _studies,
    _isolations,
    _builds,
    _programs,
    _file_sets,
    _runs,
    _batches,
    _results,
    _references,
    _inputs,
    _tables,
    _manifests,
    _shared_files,
    _images,
)
