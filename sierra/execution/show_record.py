"""Everything that is recorded about one batch, experiment, run, execution or session.

`as_dict` of each returns its form in JSON: the columns of its row, then what belongs to it.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeAlias

from sierra.design import run_values
from sierra.errors import Damaged
from sierra.execution import commands
from sierra.execution.list_batches import OnCluster, on_clusters, whole
from sierra.execution.observation.describe_files import summary
from sierra.execution.observation.file_sets import UsedFile
from sierra.execution.row_queries import RecordedProgram, axis_values, programs, required_row
from sierra.model import Value
from sierra.store.layout import STORE, WORK
from sierra.store.recorded_files import INPUT_FOLDER, Recorded, contents, recorded, take
from sierra.store.row_types import (
    ArtifactRow,
    BatchRow,
    BuildProductRow,
    BuildRow,
    EnvironmentRow,
    ExecutionRow,
    ImageRow,
    IsolationRow,
    RobotRow,
    SessionRow,
    SourceRow,
    SpecRow,
    TrialRow,
)
from sierra.store.sql_result import SqlValue
from sierra.store.store import Found, Snapshot, Store
from sierra.util.json_types import Json
from sierra.util.text import natural

if TYPE_CHECKING:
    from sierra.provenance.commits_between import Known

Record: TypeAlias = dict[str, object]


@dataclass(frozen=True, slots=True)
class CountedExperiment:
    """An experiment of a batch, with the numbers of its runs."""

    ordinal: int
    experiment: str
    values: Mapping[str, Value]
    """Values of the batch's axes in the order of its query, without the axes of other batches."""
    runs: int
    succeeded: int
    failed: int

    def as_dict(self) -> Record:
        counts = {"runs": self.runs, "succeeded": self.succeeded, "failed": self.failed}
        return {"ordinal": self.ordinal, "experiment": self.experiment, **self.values, **counts}


@dataclass(frozen=True, slots=True)
class Failed:
    """Runs of a batch that failed for one reason: their number, and the first of them."""

    reason: str
    runs: int
    run: str
    number: int
    values: Mapping[str, Value]


class Attempt(NamedTuple):
    """An attempt at an array task; see the table `attempts`."""

    session: str
    array_task: int
    job: str | None
    node: str
    started: datetime
    ended: datetime
    runs: int
    interrupted_runs: int
    state: str
    error: str | None
    executed: bool | None
    """True if it executed the shown run, False if not, None if a batch is shown."""


class Nondeterminism(NamedTuple):
    """A run whose output changed; see the table of the same name."""

    run: str
    executions: int
    results: int
    verdict: str | None
    programs: str


class ReplayOfBatch(NamedTuple):
    """A replay of a batch, or of a part of it."""

    replay: str
    started: datetime
    kind: str
    target: str
    runs: int
    verdict: str


class ImportOfBatch(NamedTuple):
    """A package that was imported and has executions of the batch."""

    package: str
    title: str
    date: str
    imported_at: datetime
    counts: bool
    """True if its executions count in the batch; otherwise they stand beside those that do."""


class VerdictOnRun(NamedTuple):
    """The verdict of a replay on an output of a run."""

    replay: str
    started: datetime
    path: str | None
    verdict: str
    reason: str | None


class RunOfExperiment(NamedTuple):
    """A run of an experiment, with its state."""

    number: int
    run: str
    seed: int
    executions: int
    status: str
    reason: str | None


@dataclass(frozen=True, slots=True)
class RecordedFile:
    """A recorded file of a run."""

    path: str
    kind: str
    bytes: int | None
    sha256: str | None


@dataclass(frozen=True, slots=True)
class ShownImage:
    """An image, with its JSON texts decoded; `row` is None if it is not recorded."""

    image: str
    row: ImageRow | None
    packages: Mapping[str, Sequence[str]]
    decoded: Mapping[str, Json]

    def as_dict(self) -> Record:
        return {**self.row._asdict(), **self.decoded, "packages": self.packages} if self.row else {"image": self.image}


@dataclass(frozen=True, slots=True)
class ShownIsolation:
    """An isolation, with its JSON texts decoded; `row` is None if it is not recorded."""

    isolation: str
    row: IsolationRow | None
    executions: int | None
    """Number of executions of the batch that were isolated so; None for a single execution."""
    mounts: Mapping[str, str]
    limits: Mapping[str, Mapping[str, float]]
    """Requested, enforced, monitored and ignored limits."""

    def as_dict(self) -> Record:
        if self.row is None:
            return {"isolation": self.isolation}
        count = {} if self.executions is None else {"executions": self.executions}
        return {**self.row._asdict(), **count, "mounts": self.mounts, **self.limits}


@dataclass(frozen=True, slots=True)
class ShownEnvironment:
    """An environment, with its JSON texts and lists decoded."""

    row: EnvironmentRow
    limits: Mapping[str, Sequence[float | None]]
    variables: Mapping[str, str]
    distributions: Sequence[str]

    def as_dict(self) -> Record:
        return self.row._asdict() | _members(self)


@dataclass(frozen=True, slots=True)
class ShownBuild:
    """The build whose products a batch used last."""

    row: BuildRow
    products: Sequence[BuildProductRow]

    def as_dict(self) -> Record:
        products = [_without(product._asdict(), "build", "session") for product in self.products]
        return {**self.row._asdict(), "products": products}


@dataclass(frozen=True, slots=True)
class ShownBatch:
    """A batch; its row has the controller and the scenario of the whole batch."""

    kind: ClassVar[str] = "batch"
    row: BatchRow
    spec: SpecRow
    experiments: Sequence[CountedExperiment]
    image: ShownImage | None
    isolations: Sequence[ShownIsolation]
    source: SourceRow | None
    programs: Sequence[RecordedProgram]
    environment: ShownEnvironment | None
    build: ShownBuild | None
    """None if there is no `[build]`."""
    failures: Sequence[Failed]
    nondeterminism: Sequence[Nondeterminism]
    replays: Sequence[ReplayOfBatch]
    attempts: Sequence[Attempt]
    sessions: Sequence[SessionRow]
    clusters: Sequence[OnCluster]
    targets: Sequence[str] = ()
    """Targets that it was requested for."""
    history: Known | None = None
    """The recorded commit as the repository has it now."""
    imports: Sequence[ImportOfBatch] = ()
    """Packages from which executions of its sessions came."""
    log_file: str | None = None
    """Log file of the last session."""

    def as_dict(self) -> Record:
        attempts = [_without(attempt._asdict(), "executed") for attempt in self.attempts]
        return {"kind": self.kind, **self.row._asdict(), **_members(self), "attempts": attempts}


@dataclass(frozen=True, slots=True)
class ShownExperiment:
    """An experiment of a batch."""

    kind: ClassVar[str] = "experiment"
    experiment: str
    batch: str
    ordinal: int
    values: Mapping[str, Value]
    runs: Sequence[RunOfExperiment]

    def as_dict(self) -> Record:
        place = {"experiment": self.experiment, "batch": self.batch, "ordinal": self.ordinal}
        return {"kind": self.kind, **place, **self.values, "runs": self.runs}


@dataclass(frozen=True, slots=True)
class ShownRun:
    """A run; its row in the table `runs` has a column for each independent variable of any batch."""

    kind: ClassVar[str] = "run"
    row: Mapping[str, SqlValue]
    command: Sequence[str]
    """The spec's command with the seed and the values of variables; paths of machines are still placeholders."""
    spec: SpecRow
    executions: Sequence[ExecutionRow]
    reused_from: str | None
    """The run that was executed, if the effective execution is one of a run with another source."""
    batches: Sequence[str]
    attempts: Sequence[Attempt]
    nondeterminism: Sequence[Nondeterminism]
    verdicts: Sequence[VerdictOnRun]
    files: Sequence[RecordedFile]

    def as_dict(self) -> Record:
        executions = [_without(execution._asdict(), "run") for execution in self.executions]
        return {"kind": self.kind, **_without_nulls(self.row), **_members(self), "executions": executions}


@dataclass(frozen=True, slots=True)
class ShownObservation:
    """Summary of what an observed execution used; the tables files_read and files_written name the files."""

    used: str
    row: CountedFiles

    def as_dict(self) -> Record:
        return {"used": self.used, **self.row._asdict()}


class CountedFiles(NamedTuple):
    """The number of files that an observed execution used."""

    method: str
    reason: str | None
    """The reason why it may have used other files too; None if all were seen."""
    executed: int
    read: int
    missed: int
    """The number of files that it looked for and that were absent."""
    listed: int
    """The number of folders whose names it read."""
    written: int
    """The number of files that it wrote or removed outside its own folders."""
    notes: Sequence[str]


@dataclass(frozen=True, slots=True)
class ShownExecution:
    """An execution."""

    kind: ClassVar[str] = "execution"
    row: ExecutionRow
    attempts: Sequence[Attempt]
    artifacts: Sequence[ArtifactRow]
    image: ShownImage | None
    host_access: Sequence[str]
    isolation: ShownIsolation | None
    programs: Sequence[RecordedProgram]
    environment: ShownEnvironment | None
    observation: ShownObservation | None = None
    """The files that it used; None if it was not observed."""
    packages: Sequence[str] = ()
    """The packages in which it came, the imported one first; empty if it was made here."""
    log_file: str | None = None
    """Log file of its session."""
    robots: Sequence[RobotRow] = ()
    trials: Sequence[TrialRow] = ()
    """Remarks that people made on it, the one that counts last."""

    def as_dict(self) -> Record:
        members = _members(self) if self.isolation else _without(_members(self), "isolation")
        artifacts = [_without(artifact._asdict(), "execution", "run") for artifact in self.artifacts]
        robots = [_without_nulls(_without(one._asdict(), "execution")) for one in self.robots]
        trials = [_without_nulls(_without(one._asdict(), "execution", "lamport")) for one in self.trials]
        own = {"robots": robots, "trials": trials, "artifacts": artifacts}
        return {"kind": self.kind, **_without_nulls(self.row._asdict()), **members, **own}


@dataclass(frozen=True, slots=True)
class ShownSession:
    """A session; `row` is None if only its log file is left."""

    kind: ClassVar[str] = "session"
    session: str
    row: SessionRow | None
    log_file: str | None

    def as_dict(self) -> Record:
        row = self.row._asdict() if self.row else {"session": self.session}
        return {"kind": self.kind, **row, "log_file": self.log_file}


Shown: TypeAlias = ShownBatch | ShownExperiment | ShownRun | ShownExecution | ShownSession


def _members(shown: ShownBatch | ShownRun | ShownExecution | ShownEnvironment) -> Record:
    """Return the fields except the row, with the form in JSON of those that have one."""
    return {field.name: _form(getattr(shown, field.name)) for field in fields(shown) if field.name != "row"}


def _form(value: object) -> object:
    match value:
        case ShownBuild() | ShownImage() | ShownIsolation() | ShownEnvironment() | ShownObservation() | CountedExperiment():
            return value.as_dict()
        case list():
            return [_form(inner) for inner in value]
        case _:
            return value


def _without(row: Mapping[str, object], *names: str) -> Record:
    return {name: value for name, value in row.items() if name not in names}


def _without_nulls(row: Mapping[str, object]) -> Record:
    return {name: value for name, value in row.items() if value is not None}


def show(store: Store, prefix: str) -> Shown:
    """Return everything that is recorded about the object with this id prefix. Raises NotFound."""
    found = store.resolve(prefix)
    with store.snapshot() as snapshot:
        match found.kind:
            case "batch":
                return _batch(snapshot, found.id, on_clusters(store).get(found.id, []))
            case "experiment":
                return _experiment(snapshot, found)
            case "run":
                return _run(snapshot, found)
            case _:
                return _execution(snapshot, found.id)


def batch(store: Store, identity: str) -> ShownBatch:
    """Return everything that is recorded about the batch with this id. Raises NotFound."""
    with store.snapshot() as snapshot:
        return _batch(snapshot, identity, on_clusters(store).get(identity, []))


def _batch(snapshot: Snapshot, identity: str, clusters: Sequence[OnCluster]) -> ShownBatch:
    row = required_row(BatchRow, snapshot, "SELECT * FROM batches WHERE batch = $b", b=identity)
    spec = required_row(SpecRow, snapshot, "SELECT * FROM specs WHERE spec = $r", r=row.spec)
    controller, scenario = whole(row.axes, row.controller, row.scenario)
    [last] = snapshot.select(LastHost, LAST_HOST, b=identity)
    experiments = _experiments(snapshot, identity, row.axes)
    sessions = snapshot.select(SessionRow, "SELECT * FROM sessions WHERE batch = $b ORDER BY lamport", b=identity)
    return ShownBatch(
        row=row._replace(controller=controller, scenario=scenario),
        spec=spec,
        experiments=experiments,
        image=_image(snapshot, spec.image),
        isolations=_isolations(snapshot, identity),
        source=_source(snapshot, identity, spec.source),
        programs=_programs(snapshot, last.programs),
        environment=_environment(snapshot, last.environment),
        build=_build(snapshot, identity),
        failures=_failures(snapshot, identity, experiments),
        nondeterminism=snapshot.select(Nondeterminism, NONDETERMINISM, b=identity, r=None),
        replays=snapshot.select(ReplayOfBatch, REPLAYS, b=identity),
        attempts=snapshot.select(Attempt, ATTEMPTS_OF_BATCH, b=identity),
        sessions=sessions,
        clusters=clusters,
        targets=sorted({one.target for one in sessions if one.target}),
        imports=snapshot.select(ImportOfBatch, IMPORTS, b=identity) if snapshot.holds("imports") else (),
    )


IMPORTS = """
SELECT i.package, i.title, i.date, i.imported_at, coalesce(o.packages[1] = i.package, false) AS counts
FROM imports i LEFT JOIN origins o ON o.batch = $b WHERE list_contains(i.batches, $b) ORDER BY i.lamport
"""
PACKAGES = "SELECT unnest(packages) FROM imported_sessions WHERE session = $s"


class LastHost(NamedTuple):
    """Programs and environment of a batch's last session or execution, if there is one."""

    programs: str | None
    environment: str | None


LAST_HOST = """
SELECT arg_max(programs, lamport) AS programs, arg_max(environment, lamport) AS environment
FROM (SELECT programs, environment, lamport FROM sessions WHERE batch = $b UNION ALL
      SELECT programs, environment, lamport FROM executions WHERE batch = $b AND purpose = 'run')
"""
NONDETERMINISM = """
SELECT run, executions, results, verdict, programs FROM nondeterminism
WHERE run = $r OR run IN (SELECT run FROM batch_runs WHERE batch = $b) ORDER BY run
"""
ATTEMPT = "session, a.array_task, a.job, a.node, a.started, a.ended, a.runs, a.interrupted_runs, a.state, a.error"
ATTEMPTS_OF_BATCH = f"""
SELECT {ATTEMPT}, NULL::BOOLEAN AS executed FROM attempts a WHERE batch = $b ORDER BY state = 'finished', array_task, started
"""  # noqa: S608 - of our own parts
"""Attempts at the array tasks of a batch on clusters; those that were cut off come first."""
ATTEMPTS_AT_RUN = f"""
WITH mine AS (SELECT attempt FROM executions WHERE run = $r AND (execution = $e OR $e IS NULL))
SELECT {ATTEMPT}, attempt IN (SELECT attempt FROM mine) AS executed
FROM attempts a SEMI JOIN (SELECT session, array_task FROM attempts SEMI JOIN mine USING (attempt)) USING (session, array_task)
ORDER BY started
"""  # noqa: S608 - of our own parts
"""Attempts at the array tasks that executed a run, and whether each attempt executed this run."""
REPLAYS = "SELECT replay, started, kind, target, runs, verdict FROM replays WHERE batch = $b ORDER BY lamport"
BUILD = """
SELECT b.* FROM builds b
JOIN (SELECT arg_max(build, lamport) AS build, max(lamport) AS lamport FROM sessions WHERE batch = $b) s USING (build)
WHERE b.purpose = 'run' AND b.result IS NOT NULL AND b.lamport < s.lamport ORDER BY b.lamport DESC LIMIT 1
"""
"""The build that the last session of a batch used: the last successful one with its id before the session."""
PRODUCTS = "SELECT * FROM build_products WHERE build = $b AND session = $s ORDER BY name"


def _build(snapshot: Snapshot, batch: str) -> ShownBuild | None:
    rows = snapshot.select(BuildRow, BUILD, b=batch)
    if not rows:
        return None
    return ShownBuild(rows[0], snapshot.select(BuildProductRow, PRODUCTS, b=rows[0].build, s=rows[0].session))


SOURCE = """
SELECT s.* FROM sources s LEFT JOIN sessions n ON n.source = s.source AND n.batch = $b
WHERE s.tree = $t ORDER BY n.lamport NULLS LAST LIMIT 1
"""


def _source(snapshot: Snapshot, batch: str, tree: str | None) -> SourceRow | None:
    return next(iter(snapshot.select(SourceRow, SOURCE, b=batch, t=tree)), None)


class _Counts(NamedTuple):
    ordinal: int
    runs: int
    succeeded: int
    failed: int


COUNTS = """
WITH tried AS (SELECT run, arg_max(status, lamport) AS last FROM executions WHERE purpose = 'run' GROUP BY run),
good AS (SELECT ordinal, run, true AS good FROM effective WHERE batch = $b)
SELECT ordinal, count(*) AS runs, count(good) AS succeeded, count(*) FILTER (good IS NULL AND last <> 'ok') AS failed
FROM (SELECT DISTINCT ordinal, run FROM batch_runs WHERE batch = $b)
LEFT JOIN tried USING (run) LEFT JOIN good USING (ordinal, run) GROUP BY ordinal ORDER BY ordinal
"""


def _experiments(snapshot: Snapshot, batch: str, axes: Sequence[str]) -> list[CountedExperiment]:
    cells = snapshot.cells(batch)
    return [
        CountedExperiment(row.ordinal, str(cell["experiment"]), axis_values(axes, cell), row.runs, row.succeeded, row.failed)
        for row in snapshot.select(_Counts, COUNTS, b=batch)
        if (cell := cells.get(row.ordinal)) is not None
    ]


class _Failures(NamedTuple):
    reason: str
    runs: int
    run: str
    number: int
    ordinal: int


FAILURES = """
WITH tried AS (
    SELECT run, arg_max({'status': status, 'reason': reason}, lamport) AS last
    FROM executions WHERE purpose = 'run' GROUP BY run
),
failed AS (
    SELECT m.ordinal, m.number, m.run, coalesce(t.last.reason, t.last.status) AS reason
    FROM (SELECT DISTINCT ordinal, number, run FROM batch_runs WHERE batch = $b) m JOIN tried t USING (run)
    ANTI JOIN (SELECT ordinal, run FROM effective WHERE batch = $b) c ON c.ordinal = m.ordinal AND c.run = m.run
    WHERE t.last.status <> 'ok'
)
SELECT reason, count(*) AS runs, arg_min(run, (ordinal, number)) AS run, arg_min(number, (ordinal, number)) AS number,
       min(ordinal) AS ordinal
FROM failed GROUP BY reason ORDER BY runs DESC, reason
"""


def _failures(snapshot: Snapshot, batch: str, experiments: Sequence[CountedExperiment]) -> list[Failed]:
    """Return the reasons why runs of a batch failed, most frequent first."""
    values = {experiment.ordinal: experiment.values for experiment in experiments}
    rows = snapshot.select(_Failures, FAILURES, b=batch)
    return [Failed(row.reason, row.runs, row.run, row.number, values[row.ordinal]) for row in rows]


RUNS = """
SELECT m.number, m.run, m.seed, count(e.execution) AS executions,
       CASE WHEN any_value(c.execution) IS NOT NULL THEN 'ok'
            WHEN arg_max(e.status, e.lamport) = 'ok' THEN 'stale'
            ELSE coalesce(arg_max(e.status, e.lamport), 'missing') END AS status,
       arg_max(e.reason, e.lamport) AS reason
FROM (SELECT DISTINCT number, run, seed FROM batch_runs WHERE batch = $b AND ordinal = $o) m
LEFT JOIN executions e USING (run) LEFT JOIN effective c ON c.run = m.run AND c.batch = $b AND c.ordinal = $o
GROUP BY ALL ORDER BY m.number
"""


def _experiment(snapshot: Snapshot, found: Found) -> ShownExperiment:
    batch = required_row(BatchRow, snapshot, "SELECT * FROM batches WHERE batch = $b", b=str(found.batch))
    cells = ((ordinal, cell) for ordinal, cell in snapshot.cells(batch.batch).items() if cell["experiment"] == found.id)
    if (place := next(cells, None)) is None:
        raise Damaged(f"the store has no experiment {found.id[:10]} of batch {batch.batch[:10]}")
    ordinal, cell = place
    runs = snapshot.select(RunOfExperiment, RUNS, b=batch.batch, o=ordinal)
    return ShownExperiment(found.id, batch.batch, ordinal, axis_values(batch.axes, cell), runs)


BATCHES = "SELECT DISTINCT batch FROM batch_runs WHERE run = $r ORDER BY 1"
VERDICTS = """
SELECT v.replay, r.started, v.path, v.verdict, v.reason FROM verdicts v JOIN replays r USING (replay)
WHERE v.run = $r ORDER BY r.lamport, v.path
"""


def _run(snapshot: Snapshot, found: Found) -> ShownRun:
    [row] = snapshot.rows("SELECT * FROM runs WHERE run = $r", r=found.id)
    files = recorded(snapshot, take(snapshot, found))
    spec = required_row(SpecRow, snapshot, "SELECT * FROM specs WHERE spec = $r", r=str(row["spec"]))
    return ShownRun(
        row=row,
        command=_command(snapshot, spec, str(row["seed"]), [file for file in files if file.kind == "input"]),
        spec=spec,
        executions=snapshot.select(ExecutionRow, "SELECT * FROM executions WHERE run = $r ORDER BY lamport", r=found.id),
        reused_from=next(iter(snapshot.values(str, REUSED_FROM, r=found.id)), None),
        batches=snapshot.values(str, BATCHES, r=found.id),
        attempts=snapshot.select(Attempt, ATTEMPTS_AT_RUN, r=found.id, e=None),
        nondeterminism=snapshot.select(Nondeterminism, NONDETERMINISM, b=None, r=found.id),
        verdicts=snapshot.select(VerdictOnRun, VERDICTS, r=found.id),
        files=[RecordedFile(file.path, file.kind, file.bytes, file.sha256) for file in files],
    )


def _command(snapshot: Snapshot, spec: SpecRow, seed: str, inputs: Sequence[Recorded]) -> Sequence[str]:
    """Return the command of a run; without the values of variables if their file is damaged."""
    files = [file for file in inputs if file.path == INPUT_FOLDER + run_values.FILE]
    given = run_values.Given()
    with contextlib.suppress(Damaged):
        given = run_values.read(tuple((run_values.FILE, b"".join(found.pieces)) for found in contents(snapshot, files)))
    return commands.with_texts(spec.command, {**given.values, "seed": seed})


SPEC_OF_RUN = """
SELECT s.* FROM batch_runs m JOIN specs s USING (spec)
WHERE m.run = $r OR m.run IN (SELECT r.run FROM reused_executions r JOIN executions e USING (execution) WHERE e.run = $r)
ORDER BY m.run = $r DESC LIMIT 1
"""
REUSED_FROM = """
SELECT e.run FROM runs r JOIN executions e USING (execution) WHERE r.run = $r AND e.run <> $r
"""


def _execution(snapshot: Snapshot, identity: str) -> ShownExecution:
    row = required_row(ExecutionRow, snapshot, "SELECT * FROM executions WHERE execution = $e", e=identity)
    artifacts = snapshot.select(ArtifactRow, "SELECT * FROM artifacts WHERE execution = $e", e=identity)
    spec = required_row(SpecRow, snapshot, SPEC_OF_RUN, r=row.run)
    return ShownExecution(
        row=row,
        attempts=snapshot.select(Attempt, ATTEMPTS_AT_RUN, r=row.run, e=identity),
        artifacts=sorted(artifacts, key=lambda artifact: natural(artifact.path)),
        image=_image(snapshot, spec.image),
        host_access=spec.host_access,
        isolation=_isolation_of(snapshot, row.isolation),
        programs=_programs(snapshot, row.programs),
        environment=_environment(snapshot, row.environment),
        observation=_observation(snapshot, row),
        packages=snapshot.values(str, PACKAGES, s=row.session),
        robots=snapshot.select(RobotRow, "SELECT * FROM robots WHERE execution = $e ORDER BY place", e=identity),
        trials=snapshot.select(TrialRow, "SELECT * FROM all_trials WHERE execution = $e ORDER BY lamport", e=identity),
    )


def _observation(snapshot: Snapshot, row: ExecutionRow) -> ShownObservation | None:
    counts = snapshot.select(CountedFiles, OBSERVATION, e=row.execution)
    if not counts:
        return None
    files = snapshot.select(UsedFile, USED_FILES, e=row.execution)
    distributions = snapshot.values(str, USED_DISTRIBUTIONS, e=row.execution)
    used = programs(snapshot, [row.programs]) if row.programs else []
    return ShownObservation(summary(files, used, distributions), counts[0])


USED_DISTRIBUTIONS = "SELECT unnest(distributions) FROM observations WHERE execution = $e"
USED_FILES = """
SELECT DISTINCT f.path, f.use, f.sha256 FROM observations o JOIN files_read f USING (files)
WHERE o.execution = $e AND f.use IN ('executed', 'read') ORDER BY ALL
"""
OBSERVATION = """
SELECT o.method, o.reason, count(*) FILTER (f.use = 'executed') AS executed, count(*) FILTER (f.use = 'read') AS read,
       count(*) FILTER (f.use = 'missed') AS missed, count(*) FILTER (f.use = 'listed') AS listed,
       (SELECT count(*) FROM files_written w WHERE w.execution = $e) AS written, o.notes
FROM observations o LEFT JOIN files_read f USING (files) WHERE o.execution = $e GROUP BY ALL
"""


class _Isolations(NamedTuple):
    isolation: str
    executions: int


ISOLATIONS = """
SELECT isolation, count(*) AS executions
FROM executions e SEMI JOIN (SELECT run FROM batch_runs WHERE batch = $b) USING (run)
WHERE purpose = 'run' AND isolation IN (SELECT isolation FROM isolations) GROUP BY isolation ORDER BY max(lamport) DESC
"""
"""Isolations of the executions of a batch's runs, most recent first."""


def _isolations(snapshot: Snapshot, batch: str) -> list[ShownIsolation]:
    rows = snapshot.select(_Isolations, ISOLATIONS, b=batch)
    return [_isolation(snapshot, row.isolation, row.executions) for row in rows]


def _isolation_of(snapshot: Snapshot, identity: str | None) -> ShownIsolation | None:
    return None if identity is None else _isolation(snapshot, identity)


def _isolation(snapshot: Snapshot, identity: str, executions: int | None = None) -> ShownIsolation:
    from sierra.containers.container_setup import limits

    rows = snapshot.select(IsolationRow, "SELECT * FROM isolations WHERE isolation = $i", i=identity)
    if not rows:
        return ShownIsolation(identity, None, executions, {}, {})
    return ShownIsolation(identity, rows[0], executions, json.loads(rows[0].mounts or "{}"), limits(rows[0]._asdict()))


def _image(snapshot: Snapshot, identity: str | None) -> ShownImage | None:
    if identity is None:
        return None
    rows = snapshot.select(ImageRow, "SELECT * FROM images WHERE image = $i", i=identity)
    if not rows:
        return ShownImage(identity, None, {}, {})
    columns = {"manifests": rows[0].manifests, "labels": rows[0].labels, "variables": rows[0].variables}
    decoded = {name: json.loads(text or "{}") for name, text in columns.items()}
    return ShownImage(identity, rows[0], json.loads(rows[0].packages or "{}"), decoded)


def _programs(snapshot: Snapshot, identity: str | None) -> list[RecordedProgram]:
    """Return one set of programs.

    A replay's copy of a project's program, which no longer exists, is left out if the project's own is recorded too.
    """
    used = programs(snapshot, [identity]) if identity else []
    lasting = [program for program in used if f"/{STORE}/{WORK}/" not in program.path]
    names = {program.name for program in lasting}
    return [program for program in used if program in lasting or program.name not in names]


def _environment(snapshot: Snapshot, identity: str | None) -> ShownEnvironment | None:
    rows = snapshot.select(EnvironmentRow, "SELECT * FROM environments WHERE environment = $e", e=identity)
    if not rows:
        return None
    limits, variables = (json.loads(text or "{}") for text in (rows[0].limits, rows[0].variables))
    return ShownEnvironment(rows[0], limits, variables, rows[0].distributions.splitlines())
