"""List of all batches, with their state and with what distinguishes batches of one query."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from datetime import datetime
from typing import NamedTuple

from sierra.errors import Damaged
from sierra.execution import sessions
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass


@dataclass(frozen=True, slots=True)
class OnCluster:
    """A session that was submitted to a cluster for a batch, and that is not closed yet."""

    session: str
    runner: str
    jobs: tuple[str, ...]
    array_tasks: int
    runs: int
    since: datetime


@dataclass(frozen=True, slots=True)
class ListedBatch:
    """A batch in the list of batches."""

    batch: str
    created: datetime
    query: str
    controller: str | None
    """Controller of the whole batch; None if it is an axis. `scenario` likewise."""
    scenario: str | None
    targets: Sequence[str]
    """Targets that it was requested for."""
    experiments: int
    runs: int
    submitted: datetime | None
    failed: int | None
    """Number of runs that were executed and have no successful execution."""
    missing: int | None
    """Number of runs that were not executed."""
    overrides: Sequence[str]
    """Changes that were set for all runs."""
    changed: Sequence[str]
    """Other differences from the previous batch with the same query, controller, scenario and overrides."""
    clusters: Sequence[OnCluster]
    """For their state, see `sierra.execution.cluster_status`."""
    nondeterministic: int
    """Number of runs whose output changed when they were executed again with the same programs, apart from outputs that the
    project declares to be volatile or within tolerance."""
    looks: Sequence[LookOfStudy] = ()
    """Looks of sequential studies at this batch."""
    package: str | None = None
    """The imported package whose executions count in this batch; None if executions that were made here count."""


class _Batch(NamedTuple):
    """A batch with its last session, and with the settings in which batches of one query can differ."""

    batch: str
    created: datetime
    query: str
    controller: str | None
    scenario: str | None
    targets: list[str] | None
    experiments: int
    runs: int
    axes: list[str]
    overrides: list[str]
    base_seed: int
    template_sha256: str
    source: str | None
    image: str | None
    command: list[str] | None
    variables: str | None
    host_access: list[str] | None
    around: str | None
    robots: str | None
    submitted: datetime | None
    failed: int | None
    missing: int | None
    doubted: bool
    repeated: bool
    package: str | None


BATCHES = """
WITH last AS (
    SELECT batch, max(lamport) AS lamport, arg_max(ended, lamport) AS submitted, arg_max(failed, lamport) AS failed,
           arg_max(missing, lamport) AS missing, arg_max(query, lamport) AS query, sum(reexecuted) AS reexecuted,
           list(DISTINCT target ORDER BY target) FILTER (target IS NOT NULL) AS targets
    FROM sessions GROUP BY batch
)
SELECT b.batch, b.created, coalesce(l.query, b.query) AS query, b.controller, b.scenario, l.targets, b.experiments, b.runs,
       b.axes, b.overrides, b.base_seed, b.template_sha256, s.source, s.image, s.command, s.variables, s.host_access, s.around,
       s.robots,
       l.submitted, l.failed, l.missing, b.batch IN (
           SELECT m.batch FROM findings f JOIN all_judgements e ON e.judgement = f.execution JOIN batch_runs m ON m.run = e.run
           UNION ALL SELECT m.batch FROM trials t JOIN executions e USING (execution) JOIN batch_runs m ON m.run = e.run
       ) AS doubted, coalesce(l.reexecuted, 0) > 0 OR b.batch IN (SELECT batch FROM replays) AS repeated,
       o.packages[1] AS package
FROM batches b LEFT JOIN last l USING (batch) LEFT JOIN origins o USING (batch) LEFT JOIN specs s USING (spec)
ORDER BY coalesce(l.lamport, b.lamport), b.batch
"""


class _Counts(NamedTuple):
    batch: str
    succeeded: int
    failed: int


COUNTS = """
WITH members_of AS (SELECT DISTINCT batch, run FROM batch_runs WHERE list_contains($batches, batch)),
tried AS (SELECT run, arg_max(status, lamport) AS last FROM executions WHERE purpose = 'run' GROUP BY run),
good AS (SELECT DISTINCT batch, run, true AS good FROM effective WHERE list_contains($batches, batch))
SELECT batch, count(good) AS succeeded,
       count(*) FILTER (good IS NULL AND last NOT IN ('ok', 'accepted')) AS failed
FROM members_of LEFT JOIN tried USING (run) LEFT JOIN good USING (batch, run) GROUP BY batch
"""


class _Unlike(NamedTuple):
    batch: str
    runs: int


UNLIKE = """
SELECT m.batch, count(DISTINCT m.run) AS runs FROM nondeterminism n JOIN batch_runs m USING (run)
WHERE list_contains($batches, m.batch) AND (n.verdict IS NULL OR n.verdict = 'different') GROUP BY m.batch
"""


LOOKS = "SELECT DISTINCT batch, study, number FROM looks ORDER BY study, number"


class LookOfStudy(NamedTuple):
    """A look of a sequential study at a batch."""

    batch: str
    study: str
    number: int
    """The look's number in the study's schedule, from 1."""


def batches(store: Store) -> list[ListedBatch]:
    """Return all batches, ordered by their last session.

    If the last session left no run failed or missing, they are not counted again, unless records were rewritten since, because
    executions may have been removed.
    """
    with store.snapshot() as snapshot:
        rewritten = snapshot.listing.rewritten
        rows = snapshot.select(_Batch, BATCHES)
        uncertain = [row.batch for row in rows if row.doubted or rewritten or row.failed != 0 or row.missing != 0]
        counts = {row.batch: row for row in snapshot.select(_Counts, COUNTS, batches=uncertain)} if uncertain else {}
        repeated = [row.batch for row in rows if row.repeated]
        unlike = dict(snapshot.select(_Unlike, UNLIKE, batches=repeated)) if repeated else {}
        looks = snapshot.select(LookOfStudy, LOOKS) if snapshot.holds("looks") else []
    clusters = on_clusters(store)
    before: dict[tuple[str | None, ...], _Batch] = {}
    listed = []
    for row in rows:
        controller, scenario = whole(row.axes, row.controller, row.scenario)
        named = (row.query, controller, scenario, *row.overrides, None, *(row.targets or ()))
        count = counts.get(row.batch)
        listed.append(
            ListedBatch(
                batch=row.batch,
                created=row.created,
                query=row.query,
                controller=controller,
                scenario=scenario,
                targets=row.targets or [],
                experiments=row.experiments,
                runs=row.runs,
                submitted=row.submitted,
                failed=count.failed if count else row.failed,
                missing=row.runs - count.succeeded - count.failed if count else row.missing,
                overrides=row.overrides,
                changed=_changed(before[named], row) if named in before else [],
                clusters=clusters.get(row.batch, []),
                nondeterministic=unlike.get(row.batch, 0),
                looks=[look for look in looks if look.batch == row.batch],
                package=row.package,
            )
        )
        before[named] = row
    return listed


DIFFERENCES = {
    "runs": "runs",
    "base_seed": "base seed",
    "template_sha256": "template",
    "source": "code",
    "image": "image",
    "command": "command",
    "around": "services, before or after",
    "robots": "commands of robots",
    "variables": "environment",
    "host_access": "host access",
}
"""Names for people of the settings in which batches of one query can differ."""
ELSE = "settings"
"""Name for all other differences: changes that `sierra.toml` makes to the template."""


def _changed(before: _Batch, now: _Batch) -> list[str]:
    return [text for name, text in DIFFERENCES.items() if getattr(before, name) != getattr(now, name)] or [ELSE]


def whole(axes: Sequence[str], controller: str | None, scenario: str | None) -> tuple[str | None, str | None]:
    """Return the controller and the scenario of a whole batch; None for one that is an axis of the batch."""
    return None if "controller" in axes else controller, None if "scenario" in axes else scenario


def on_clusters(store: Store) -> dict[str, list[OnCluster]]:
    """Return the sessions that are on clusters, by batch, as far as this machine knows them."""
    by_batch: dict[str, list[OnCluster]] = {}
    for paths in sessions.submitted(store.paths):
        from sierra.execution.cluster_status import submitted  # most projects have nothing on a cluster

        with contextlib.suppress(Damaged):  # it belongs to another version of SIERRA, which must continue it
            if row := submitted(paths):
                session = OnCluster(row.session, row.runner, row.jobs, row.array_tasks, row.runs, row.since)
                by_batch.setdefault(row.batch, []).append(session)
    return by_batch
