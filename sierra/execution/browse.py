"""Listings of the store for people: all batches, or everything about one object by its id."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sierra.errors import Damaged
from sierra.execution import sessions
from sierra.store.layout import STORE, WORK
from sierra.store.recorded_files import recorded, take
from sierra.store.store import Found, Snapshot, Store
from sierra.util.text import natural

BATCHES = """
WITH last AS (
    SELECT batch, max(lamport) AS lamport, arg_max(ended, lamport) AS submitted, arg_max(failed, lamport) AS failed,
           arg_max(missing, lamport) AS missing, arg_max(query, lamport) AS query, sum(reexecuted) AS reexecuted
    FROM sessions GROUP BY batch
)
SELECT b.batch, b.created, coalesce(l.query, b.query) AS query, b.controller, b.scenario, b.experiments, b.runs,
       l.submitted, l.failed, l.missing, b.batch IN (
           SELECT m.batch FROM findings f JOIN all_judgements e ON e.judgement = f.execution JOIN batch_runs m ON m.run = e.run
       ) AS doubted, coalesce(l.reexecuted, 0) > 0 OR b.batch IN (SELECT batch FROM replays) AS repeated
FROM batches b LEFT JOIN last l USING (batch)
ORDER BY coalesce(l.lamport, b.lamport), b.batch
"""

COUNTS = """
WITH members_of AS (SELECT DISTINCT batch, run FROM batch_runs WHERE list_contains($batches, batch)),
tried AS (SELECT run, arg_max(status, lamport) AS last FROM executions WHERE purpose = 'run' GROUP BY run),
good AS (SELECT DISTINCT batch, run, true AS good FROM effective WHERE list_contains($batches, batch))
SELECT batch, count(good) AS succeeded, count(*) FILTER (good IS NULL AND last <> 'ok') AS failed
FROM members_of LEFT JOIN tried USING (run) LEFT JOIN good USING (batch, run) GROUP BY batch
"""

UNLIKE = """
SELECT m.batch, count(DISTINCT m.run) AS runs FROM nondeterminism n JOIN batch_runs m USING (run)
WHERE list_contains($batches, m.batch) AND (n.verdict IS NULL OR n.verdict = 'different') GROUP BY m.batch
"""


def batches(store: Store) -> list[dict[str, Any]]:
    """Return all batches, ordered by their last session.

    `failed` and `missing` are numbers of runs without a successful execution, tried or not. If the last session left both at 0,
    they are not counted again, unless records were rewritten since, because executions may have been removed.
    `nondeterministic` is the number of runs whose output changed when they were executed again with the same programs, apart
    from outputs that the project declares to be volatile or within tolerance. `overrides` are the changes that were set for
    all runs. `changed` lists other differences from the previous batch with the same query, controller, scenario and
    overrides. `clusters` are the sessions that were submitted for a batch and are not closed yet; for their state, see
    `sierra.execution.cluster_status`.
    """
    with store.snapshot() as snapshot:
        rewritten = any(segment.replaces for segment in snapshot.segments)
        rows: list[dict[str, Any]] = snapshot.rows(BATCHES)
        open_ones = [
            row["batch"] for row in rows if row.pop("doubted") or rewritten or row["failed"] != 0 or row["missing"] != 0
        ]
        counted = {}
        if open_ones:
            counted = {row["batch"]: row for row in snapshot.rows(COUNTS, batches=open_ones)}
        repeated = [row["batch"] for row in rows if row.pop("repeated")]
        found = snapshot.rows(UNLIKE, batches=repeated) if repeated else []
        unlike = {row["batch"]: row["runs"] for row in found}
        _add_settings(snapshot, rows)
    there = _on_clusters(store)
    for row in rows:
        row["clusters"] = there.get(row["batch"], [])
        row["nondeterministic"] = unlike.get(row["batch"], 0)
        count = counted.get(row["batch"])
        if count is not None:
            row["failed"] = count["failed"]
            row["missing"] = row["runs"] - count["succeeded"] - count["failed"]
    return rows


SETTINGS = """
SELECT batch, axes, overrides, base_seed, template_sha256, source, image, command, variables, host_access
FROM batches JOIN specs USING (spec)
"""
DIFFERENCES = {
    "runs": "runs",
    "base_seed": "base seed",
    "template_sha256": "template",
    "source": "code",
    "image": "image",
    "command": "command",
    "variables": "environment",
    "host_access": "host access",
}
"""Names for people of the settings in which batches of one query can differ."""
ELSE = "settings"
"""Name for all other differences: changes that `sierra.toml` makes to the template."""


def _add_settings(snapshot: Snapshot, rows: Sequence[dict[str, Any]]) -> None:
    """Add the differences between batches of one query: what was set, and what differs from the previous one."""
    settings = {row["batch"]: row for row in snapshot.rows(SETTINGS)}
    before: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        own = {"axes": [], "overrides": [], **settings.get(row["batch"], {}), "runs": row["runs"]}
        row.update(_named(row, own["axes"]), overrides=own["overrides"], changed=[])
        called = (row["query"], row["controller"], row["scenario"], *own["overrides"])
        if (last := before.get(called)) is not None:
            differing = [text for name, text in DIFFERENCES.items() if last.get(name) != own.get(name)]
            row["changed"] = differing or [ELSE]
        before[called] = own


def _named(row: Mapping[str, Any], axes: Sequence[str]) -> dict[str, Any]:
    """Return the controller and the scenario of a whole batch; None for one that is an axis of the batch."""
    return {name: None if name in axes else row[name] for name in ("controller", "scenario")}


def _on_clusters(store: Store) -> dict[str, list[dict[str, Any]]]:
    """Return the sessions that are on clusters, by batch, as far as this machine knows them."""
    found: dict[str, list[dict[str, Any]]] = {}
    for paths in sessions.submitted(store.paths):
        from sierra.execution.cluster_status import submitted  # most projects have nothing on a cluster

        with contextlib.suppress(Damaged):  # it belongs to another version of SIERRA, which must continue it
            if one := submitted(paths):
                told = {name: getattr(one, name) for name in ("session", "runner", "jobs", "array_tasks", "runs", "since")}
                found.setdefault(one.batch, []).append(told)
    return found


def show(store: Store, prefix: str) -> dict[str, Any]:
    """Return everything that is recorded about the object with this id prefix; `kind` is its type.

    For a batch, also return its sessions on clusters.
    """
    found = store.resolve(prefix)
    with store.snapshot() as snapshot:
        shown = {"kind": found.kind, **SHOWN[found.kind](snapshot, found)}
    return shown | ({"clusters": _on_clusters(store).get(found.id, [])} if found.kind == "batch" else {})


def _batch(snapshot: Snapshot, found: Found) -> dict[str, Any]:
    row: dict[str, Any]
    [row] = snapshot.rows("SELECT * FROM batches WHERE batch = $b", b=found.id)
    [spec] = snapshot.rows("SELECT * FROM specs WHERE spec = $r", r=row["spec"])
    row |= {"spec": spec, **_named(row, row["axes"])}
    row["image"] = _image(snapshot, spec["image"])
    row["isolations"] = [_isolation(one) for one in snapshot.rows(ISOLATIONS, b=found.id)]
    row["source"] = _source(snapshot, found.id, spec["source"])
    last = snapshot.rows(LAST_AROUND, b=found.id)[0]
    row["programs"] = _programs(snapshot, last["programs"])
    row["environment"] = _environment(snapshot, last["environment"])
    row["experiments"] = _experiments(snapshot, found.id, row["axes"])
    row["failures"] = _failures(snapshot, found.id, row["experiments"], row["axes"])
    row["nondeterminism"] = snapshot.rows(NONDETERMINISM, b=found.id, r=None)
    row["replays"] = snapshot.rows(REPLAYS, b=found.id)
    row["attempts"] = snapshot.rows(ATTEMPTS_OF_BATCH, b=found.id)
    row["sessions"] = snapshot.rows("SELECT * FROM sessions WHERE batch = $b ORDER BY lamport", b=found.id)
    return row


LAST_AROUND = """
SELECT arg_max(programs, lamport) AS programs, arg_max(environment, lamport) AS environment
FROM (SELECT programs, environment, lamport FROM sessions WHERE batch = $b UNION ALL
      SELECT programs, environment, lamport FROM executions WHERE batch = $b AND purpose = 'run')
"""
"""Programs and environment of a batch's last session or execution."""
NONDETERMINISM = """
SELECT run, executions, results, verdict, programs FROM nondeterminism
WHERE run = $r OR run IN (SELECT run FROM batch_runs WHERE batch = $b) ORDER BY run
"""
TOLD = "a.array_task, a.job, a.node, a.started, a.ended, a.runs, a.interrupted_runs, a.state, a.error"
ATTEMPTS_OF_BATCH = f"""
SELECT session, {TOLD} FROM attempts a WHERE batch = $b ORDER BY state = 'finished', array_task, started
"""  # noqa: S608 - of our own parts
"""Attempts at the elements of a batch on clusters; those that were cut off come first."""
ATTEMPTS_OF_RUN = f"""
WITH mine AS (SELECT attempt FROM executions WHERE run = $r AND (execution = $e OR $e IS NULL))
SELECT session, {TOLD}, attempt IN (SELECT attempt FROM mine) AS executed
FROM attempts a SEMI JOIN (SELECT session, array_task FROM attempts SEMI JOIN mine USING (attempt)) USING (session, array_task)
ORDER BY started
"""  # noqa: S608 - of our own parts
"""Attempts at the elements that executed a run, and whether each attempt executed this run."""
REPLAYS = "SELECT replay, started, kind, target, runs, verdict FROM replays WHERE batch = $b ORDER BY lamport"


def _source(snapshot: Snapshot, batch: str, tree: str | None) -> dict[str, Any] | None:
    rows: list[dict[str, Any]] = snapshot.rows(
        "SELECT s.* FROM sources s LEFT JOIN sessions n ON n.source = s.source AND n.batch = $b "
        "WHERE s.tree = $t ORDER BY n.lamport NULLS LAST LIMIT 1",
        b=batch,
        t=tree,
    )
    return rows[0] if rows else None


def _experiments(snapshot: Snapshot, batch: str, axes: Sequence[str]) -> list[dict[str, Any]]:
    """Return the experiments of a batch, with its axes in the order of its query and without the axes of other batches."""
    rows: list[dict[str, Any]] = snapshot.rows(
        "WITH tried AS (SELECT run, arg_max(status, lamport) AS last FROM executions WHERE purpose = 'run' GROUP BY run), "
        "good AS (SELECT ordinal, run, true AS good FROM effective WHERE batch = $b), "
        "counted AS (SELECT ordinal, count(*) AS runs, count(good) AS succeeded, "
        "count(*) FILTER (good IS NULL AND last <> 'ok') AS failed "
        "FROM (SELECT DISTINCT ordinal, run FROM batch_runs WHERE batch = $b) "
        "LEFT JOIN tried USING (run) LEFT JOIN good USING (ordinal, run) GROUP BY ordinal) "
        "SELECT ordinal, runs, succeeded, failed FROM counted ORDER BY ordinal",
        b=batch,
    )
    cells = snapshot.cells(batch)
    columns = ("ordinal", "experiment", *axes, "runs", "succeeded", "failed")
    return [{name: {**cells[row["ordinal"]], **row}[name] for name in columns} for row in rows if row["ordinal"] in cells]


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
SELECT reason, count(*) AS runs, arg_min({'run': run, 'ordinal': ordinal, 'number': number}, (ordinal, number)) AS example
FROM failed GROUP BY reason ORDER BY runs DESC, reason
"""


def _failures(
    snapshot: Snapshot, batch: str, experiments: Sequence[Mapping[str, Any]], axes: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the reasons why runs of a batch failed, most frequent first, with the number of runs and the first run of each."""
    values = {row["ordinal"]: {name: row[name] for name in axes} for row in experiments}
    return [
        {
            "reason": row["reason"],
            "runs": row["runs"],
            "run": row["example"]["run"],
            "number": row["example"]["number"],
            "values": values[row["example"]["ordinal"]],
        }
        for row in snapshot.rows(FAILURES, b=batch)
    ]


def _experiment(snapshot: Snapshot, found: Found) -> dict[str, Any]:
    [cell, *_] = [row for row in snapshot.cells(str(found.batch)).values() if row["experiment"] == found.id]
    [axes] = snapshot.sql("SELECT axes FROM batches WHERE batch = $b", b=found.batch).column("axes").to_pylist()
    row: dict[str, Any] = {name: cell[name] for name in ("experiment", "batch", "ordinal", *axes)}
    row["runs"] = snapshot.rows(
        "SELECT m.number, m.run, m.seed, count(e.execution) AS executions, "
        "CASE WHEN any_value(c.execution) IS NOT NULL THEN 'ok' "
        "WHEN arg_max(e.status, e.lamport) = 'ok' THEN 'stale' "
        "ELSE coalesce(arg_max(e.status, e.lamport), 'missing') END AS status, "
        "arg_max(e.reason, e.lamport) AS reason "
        "FROM (SELECT DISTINCT number, run, seed FROM batch_runs WHERE batch = $b AND ordinal = $o) m "
        "LEFT JOIN executions e USING (run) LEFT JOIN effective c ON c.run = m.run AND c.batch = $b AND c.ordinal = $o "
        "GROUP BY ALL ORDER BY m.number",
        b=found.batch,
        o=row["ordinal"],
    )
    return row


def _run(snapshot: Snapshot, found: Found) -> dict[str, Any]:
    [row] = snapshot.rows("SELECT * FROM runs WHERE run = $r", r=found.id)
    row = _without_nulls(row)
    [row["spec"]] = snapshot.rows("SELECT * FROM specs WHERE spec = $r", r=row["spec"])
    row["batches"] = [
        row[0] for row in snapshot.run("SELECT DISTINCT batch FROM batch_runs WHERE run = $r ORDER BY 1", {"r": found.id})
    ]
    row["executions"] = snapshot.rows("SELECT * EXCLUDE (run) FROM executions WHERE run = $r ORDER BY lamport", r=found.id)
    row["attempts"] = snapshot.rows(ATTEMPTS_OF_RUN, r=found.id, e=None)
    row["nondeterminism"] = snapshot.rows(NONDETERMINISM, b=None, r=found.id)
    row["verdicts"] = snapshot.rows(VERDICTS, r=found.id)
    files = recorded(snapshot, take(snapshot, found))
    row["files"] = [{"path": file.path, "kind": file.kind, "bytes": file.bytes, "sha256": file.sha256} for file in files]
    return row


VERDICTS = """
SELECT v.replay, r.started, v.path, v.verdict, v.reason FROM verdicts v JOIN replays r USING (replay)
WHERE v.run = $r ORDER BY r.lamport, v.path
"""


def _execution(snapshot: Snapshot, found: Found) -> dict[str, Any]:
    [row] = snapshot.rows("SELECT * FROM executions WHERE execution = $e", e=found.id)
    row = _without_nulls(row)
    row["attempts"] = snapshot.rows(ATTEMPTS_OF_RUN, r=row["run"], e=found.id)
    artifacts = snapshot.rows("SELECT * EXCLUDE (execution, run) FROM artifacts WHERE execution = $e", e=found.id)
    row["artifacts"] = sorted(artifacts, key=lambda artifact: natural(artifact["path"]))
    [spec] = snapshot.rows(RECIPE, r=row["run"])
    row["image"] = _image(snapshot, spec["image"])
    row["host_access"] = spec["host_access"] or []
    if (isolation := row.get("isolation")) is not None:
        rows = snapshot.rows("SELECT * FROM isolations WHERE isolation = $i", i=isolation)
        row["isolation"] = _isolation(rows[0]) if rows else {"isolation": isolation}
    row["programs"] = _programs(snapshot, row.get("programs"))
    row["environment"] = _environment(snapshot, row.get("environment"))
    return row


RECIPE = "SELECT r.image, r.host_access FROM batch_runs m JOIN specs r USING (spec) WHERE m.run = $r LIMIT 1"
ISOLATIONS = """
SELECT i.*, count(*) AS executions
FROM executions e SEMI JOIN (SELECT run FROM batch_runs WHERE batch = $b) USING (run) JOIN isolations i USING (isolation)
WHERE e.purpose = 'run' GROUP BY ALL ORDER BY max(e.lamport) DESC
"""
"""Isolations of the executions of a batch's runs, most recent first."""


def _image(snapshot: Snapshot, identity: str | None) -> dict[str, Any] | None:
    """Return the record of an image, with its JSON texts decoded."""
    rows = snapshot.rows("SELECT * FROM images WHERE image = $i", i=identity)
    if not rows:
        return {"image": identity} if identity else None
    image: dict[str, Any] = rows[0]
    return image | {name: json.loads(image[name]) for name in ("manifests", "labels", "variables", "packages")}


def _isolation(row: dict[str, Any]) -> dict[str, Any]:
    """Return the record of an isolation, with its JSON texts decoded, and the limits that were requested but not enforced."""
    from sierra.containers.session_containers import limits

    return row | {"mounts": json.loads(row["mounts"])} | limits(row)


def _programs(snapshot: Snapshot, identity: str | None) -> list[dict[str, Any]]:
    """Return the rows of one set of programs: programs first, then files, installed distributions and libraries.

    A replay's copy of a project's program, which no longer exists, is left out if the project's own is recorded too.
    """
    rows: list[dict[str, Any]] = snapshot.rows(
        "SELECT name, kind, version, path, sha256 FROM programs WHERE programs = $p "
        "ORDER BY list_position(['program', 'file', 'distributions', 'library'], kind), name, path",
        p=identity,
    )
    lasting = [row for row in rows if f"/{STORE}/{WORK}/" not in row["path"]]
    known = {row["name"] for row in lasting}
    return [row for row in rows if row in lasting or row["name"] not in known]


def _environment(snapshot: Snapshot, identity: str | None) -> dict[str, Any] | None:
    """Return the record of an environment, with its JSON texts and lists decoded."""
    rows = snapshot.rows("SELECT * FROM environments WHERE environment = $e", e=identity)
    if not rows:
        return None
    around: dict[str, Any] = rows[0]
    for name in ("limits", "variables"):
        around[name] = json.loads(around[name] or "{}")
    around["distributions"] = (around["distributions"] or "").splitlines()
    return around


def _without_nulls(row: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if value is not None}


Shower = Callable[[Snapshot, Found], dict[str, Any]]
SHOWN: Mapping[str, Shower] = {"batch": _batch, "experiment": _experiment, "run": _run, "execution": _execution}
