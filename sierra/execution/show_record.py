"""Read everything that is recorded about one batch, experiment, run, execution or session.

Also: where the executions of a batch or a run took place: isolations, image, programs and environment, as recorded.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from sierra.design import run_values
from sierra.errors import Damaged
from sierra.execution import commands
from sierra.execution.list_batches import OnCluster, on_clusters, whole
from sierra.execution.observation.describe_files import summary
from sierra.execution.observation.file_sets import UsedFile
from sierra.execution.row_queries import RecordedProgram, axis_values, programs, required_row
from sierra.execution.shown_records import (
    Attempt,
    CaptureOfBatch,
    CountedExperiment,
    CountedFiles,
    Failed,
    FirmwareOfBatch,
    ImportOfBatch,
    Nondeterminism,
    Record,
    RecordedFile,
    ReplayOfBatch,
    RobotOfBatch,
    RunOfExperiment,
    Shown,
    ShownBatch,
    ShownBuild,
    ShownEnvironment,
    ShownExecution,
    ShownExperiment,
    ShownImage,
    ShownIsolation,
    ShownObservation,
    ShownRun,
    VerdictOnRun,
)
from sierra.store import endings
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
    Of,
    SessionRow,
    SourceRow,
    SpecRow,
)
from sierra.store.schema import RECORDED, STAMPED, columns_with
from sierra.store.store import ResolvedId, Snapshot, Store
from sierra.util.text import natural


class _Isolations(NamedTuple):
    isolation: str
    executions: int


ISOLATIONS = """
SELECT isolation, count(*) AS executions
FROM executions e SEMI JOIN (SELECT run FROM batch_runs WHERE batch = $b) USING (run)
WHERE purpose = 'run' AND isolation IN (SELECT isolation FROM isolations) GROUP BY isolation ORDER BY max(lamport) DESC
"""


def isolations(snapshot: Snapshot, batch: str) -> list[ShownIsolation]:
    """Return the isolations of the executions of a batch's runs, most recent first."""
    rows = snapshot.select(_Isolations, ISOLATIONS, b=batch)
    return [_shown(snapshot, row.isolation, row.executions) for row in rows]


def isolation(snapshot: Snapshot, identity: str | None) -> ShownIsolation | None:
    """Return one isolation; None if the execution had none."""
    return None if identity is None else _shown(snapshot, identity)


def _shown(snapshot: Snapshot, identity: str, executions: int | None = None) -> ShownIsolation:
    from sierra.containers.container_setup import limits

    rows = snapshot.select(IsolationRow, "SELECT * FROM isolations WHERE isolation = $i", i=identity)
    if not rows:
        return ShownIsolation(identity, None, executions, {}, {})
    return ShownIsolation(identity, rows[0], executions, json.loads(rows[0].mounts or "{}"), limits(rows[0]._asdict()))


def image(snapshot: Snapshot, identity: str | None) -> ShownImage | None:
    """Return one image; None if there was none."""
    if identity is None:
        return None
    rows = snapshot.select(ImageRow, "SELECT * FROM images WHERE image = $i", i=identity)
    if not rows:
        return ShownImage(identity, None, {}, {})
    columns = {"manifests": rows[0].manifests, "labels": rows[0].labels, "variables": rows[0].variables}
    decoded = {name: json.loads(text or "{}") for name, text in columns.items()}
    return ShownImage(identity, rows[0], json.loads(rows[0].packages or "{}"), decoded)


def used_programs(snapshot: Snapshot, identity: str | None) -> list[RecordedProgram]:
    """Return one set of programs.

    A replay's copy of a project's program, which no longer exists, is left out if the project's own is recorded too.
    """
    used = programs(snapshot, [identity]) if identity else []
    lasting = [program for program in used if f"/{STORE}/{WORK}/" not in program.path]
    names = {program.name for program in lasting}
    return [program for program in used if program in lasting or program.name not in names]


def environment(snapshot: Snapshot, identity: str | None) -> ShownEnvironment | None:
    """Return one environment; None if none is recorded."""
    rows = snapshot.select(EnvironmentRow, "SELECT * FROM environments WHERE environment = $e", e=identity)
    if not rows:
        return None
    limits, variables = (json.loads(text or "{}") for text in (rows[0].limits, rows[0].variables))
    return ShownEnvironment(rows[0], limits, variables, rows[0].distributions.splitlines())


def show(store: Store, prefix: str) -> Shown:
    """Return everything that is recorded about the object with this id prefix. Raises NotFound."""
    record = store.resolve(prefix)
    with store.snapshot() as snapshot:
        match record.kind:
            case "batch":
                return _batch(snapshot, record.id, on_clusters(store).get(record.id, []))
            case "experiment":
                return _experiment(snapshot, record)
            case "run":
                return _run(snapshot, record)
            case _:
                return _execution(snapshot, record.id)


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
        image=image(snapshot, spec.image),
        isolations=isolations(snapshot, identity),
        source=_source(snapshot, identity, spec.source),
        programs=used_programs(snapshot, last.programs),
        environment=environment(snapshot, last.environment),
        build=_build(snapshot, identity),
        failures=_failures(snapshot, identity, experiments),
        nondeterminism=snapshot.select(Nondeterminism, NONDETERMINISM, b=identity, r=None),
        replays=snapshot.select(ReplayOfBatch, REPLAYS, b=identity),
        attempts=snapshot.select(Attempt, ATTEMPTS_OF_BATCH, b=identity),
        sessions=sessions,
        clusters=clusters,
        targets=sorted({session.target for session in sessions if session.target}),
        captures=snapshot.select(CaptureOfBatch, CAPTURES, b=identity) if snapshot.holds("captures") else (),
        imports=snapshot.select(ImportOfBatch, IMPORTS, b=identity) if snapshot.holds("imports") else (),
        robots=snapshot.select(RobotOfBatch, ROBOTS, b=identity) if spec.robots else (),
        firmware=snapshot.select(FirmwareOfBatch, FIRMWARE, b=identity) if spec.robots else (),
        notes=list(endings.notes(snapshot, identity)),
    )


CAPTURES = """
SELECT m.ordinal, m.number, c.run, c.execution, c.frames, c.verdict, c.reason
FROM captures c JOIN (SELECT DISTINCT ordinal, number, run FROM batch_runs WHERE batch = $b) m USING (run)
QUALIFY row_number() OVER (PARTITION BY m.ordinal, m.number, c.run ORDER BY c.lamport DESC) = 1 ORDER BY m.ordinal, m.number
"""
IMPORTS = """
SELECT i.package, i.title, i.date, i.imported_at, coalesce(o.packages[1] = i.package, false) AS counts
FROM imports i LEFT JOIN origins o ON o.batch = $b WHERE list_contains(i.batches, $b) ORDER BY i.lamport
"""
ROBOTS = """
SELECT robot, place, robot_group, firmware, count(*) AS runs
FROM robots SEMI JOIN (SELECT execution FROM effective WHERE batch = $b) USING (execution)
GROUP BY ALL ORDER BY place, robot, firmware
"""
FIRMWARE = """
WITH taken AS (SELECT * FROM robots SEMI JOIN (SELECT execution FROM effective WHERE batch = $b) USING (execution))
SELECT firmware, count(DISTINCT robot) AS robots, count(DISTINCT execution) AS runs FROM taken
WHERE firmware IS NOT NULL AND EXISTS (SELECT 1 FROM taken GROUP BY place HAVING count(DISTINCT firmware) > 1)
GROUP BY firmware ORDER BY firmware
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
    accepted: int
    failed: int


COUNTS = """
WITH tried AS (SELECT run, arg_max(status, lamport) AS last FROM executions WHERE purpose = 'run' GROUP BY run),
good AS (SELECT ordinal, run, outcome FROM effective WHERE batch = $b)
SELECT ordinal, count(*) AS runs, count(*) FILTER (outcome = 'success') AS succeeded,
       count(*) FILTER (outcome <> 'success') AS accepted,
       count(*) FILTER (outcome IS NULL AND last NOT IN ('ok', 'accepted')) AS failed
FROM (SELECT DISTINCT ordinal, run FROM batch_runs WHERE batch = $b)
LEFT JOIN tried USING (run) LEFT JOIN good USING (ordinal, run) GROUP BY ordinal ORDER BY ordinal
"""


def _experiments(snapshot: Snapshot, batch: str, axes: Sequence[str]) -> list[CountedExperiment]:
    cells = snapshot.cells(batch)
    return [
        CountedExperiment(
            row.ordinal, str(cell["experiment"]), axis_values(axes, cell), row.runs, row.succeeded, row.failed, row.accepted
        )
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
    WHERE t.last.status NOT IN ('ok', 'accepted')
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
       CASE WHEN any_value(c.outcome) = 'success' THEN 'ok' WHEN any_value(c.outcome) IS NOT NULL THEN 'accepted'
            WHEN arg_max(e.status, e.lamport) IN ('ok', 'accepted') THEN 'stale'
            ELSE coalesce(arg_max(e.status, e.lamport), 'missing') END AS status,
       arg_max(e.reason, e.lamport) AS reason
FROM (SELECT DISTINCT number, run, seed FROM batch_runs WHERE batch = $b AND ordinal = $o) m
LEFT JOIN executions e USING (run) LEFT JOIN effective c ON c.run = m.run AND c.batch = $b AND c.ordinal = $o
GROUP BY ALL ORDER BY m.number
"""


def _experiment(snapshot: Snapshot, found: ResolvedId) -> ShownExperiment:
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


def _run(snapshot: Snapshot, record: ResolvedId) -> ShownRun:
    [row] = snapshot.rows("SELECT * FROM runs WHERE run = $r", r=record.id)
    files = recorded(snapshot, take(snapshot, record))
    spec = required_row(SpecRow, snapshot, "SELECT * FROM specs WHERE spec = $r", r=str(row["spec"]))
    return ShownRun(
        row=row,
        command=_command(snapshot, spec, str(row["seed"]), [file for file in files if file.kind == "input"]),
        spec=spec,
        executions=snapshot.select(ExecutionRow, "SELECT * FROM executions WHERE run = $r ORDER BY lamport", r=record.id),
        reused_from=next(iter(snapshot.values(str, REUSED_FROM, r=record.id)), None),
        batches=snapshot.values(str, BATCHES, r=record.id),
        attempts=snapshot.select(Attempt, ATTEMPTS_AT_RUN, r=record.id, e=None),
        nondeterminism=snapshot.select(Nondeterminism, NONDETERMINISM, b=None, r=record.id),
        verdicts=snapshot.select(VerdictOnRun, VERDICTS, r=record.id),
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
        image=image(snapshot, spec.image),
        host_access=spec.host_access,
        isolation=isolation(snapshot, row.isolation),
        programs=used_programs(snapshot, row.programs),
        environment=environment(snapshot, row.environment),
        observation=_observation(snapshot, row),
        packages=snapshot.values(str, PACKAGES, s=row.session),
        records=dict(_records(snapshot, identity)),
    )


APART = ("executions", "artifacts", "observations", "files_written")
"""Tables of executions that are shown in forms of their own."""
REMARKS = {"trials": "all_trials"}
"""Views that have all records of a table, which itself has only the last ones."""
KEYS = ("execution", "lamport")
"""Columns that say to which execution a row belongs, and its position: the rows are those of one execution, in order."""


def _records(snapshot: Snapshot, identity: str) -> Iterator[tuple[str, list[Record]]]:
    """Yield the rows of an execution in further tables, without those that are NULL. Tables without rows are left out."""
    for table in columns_with(Of.EXECUTION, Of.JUDGEMENT):
        if table in RECORDED and table not in APART and snapshot.holds(table):
            order = "lamport" if table in STAMPED else "ALL"
            if rows := snapshot.rows(f"FROM {REMARKS.get(table, table)} WHERE execution = $e ORDER BY {order}", e=identity):
                yield table, [{name: row[name] for name in row if row[name] is not None and name not in KEYS} for row in rows]


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
       (SELECT count(DISTINCT w.path) FROM files_written w WHERE w.execution = $e) AS written, o.notes
FROM observations o LEFT JOIN files_read f USING (files) WHERE o.execution = $e GROUP BY ALL
"""
