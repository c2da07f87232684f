"""Executions that count for runs of a plan although the source or the programs differ: no file that they used has changed.

Such an execution was observed from its beginning to its end, and it has asked no daemon and no other machine, which may have
read files for it. Its run has the command, input and seed of the run in the plan; only the source may be another one.
Everything that it executed, read, listed, found or missed is still the same.

An execution that was not observed never counts for another source, because nobody knows what it has read. It counts with
other installed distributions of Python, and with other names of the same programs, if all observed executions of its
experiment, in its session, still count.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from sierra.execution import row_queries
from sierra.execution.observation import file_sets, plan_files
from sierra.execution.observation.current_files import Current
from sierra.execution.observation.unchanged_files import unchanged
from sierra.execution.plan import Plan, context
from sierra.model import RunSpec
from sierra.provenance import source
from sierra.provenance.dependency_model import Kind, Programs
from sierra.store.row_types import UnusedChangeRow
from sierra.store.store import Snapshot, Store
from sierra.util.text import counted, few

NAMED = 3
MOST_CHANGES = 1000
"""Maximum number of unused changes that are recorded for one specification and one list of programs."""


@dataclass(frozen=True, slots=True)
class Reusable:
    """An execution that counts for a run of a plan."""

    execution: str
    spec: str
    """The specification of the run that was executed."""
    programs: str


class _Candidate(NamedTuple):
    run: str
    execution: str
    files: str
    spec: str
    programs: str


class _Inheriting(NamedTuple):
    run: str
    execution: str
    programs: str
    sets: list[str]


CANDIDATES = """
WITH kin AS (
    SELECT spec FROM specs WHERE platform = $platform AND command = $command
    AND around IS NOT DISTINCT FROM $around AND variables = $variables AND image IS NULL
    AND host_access = $host_access AND files = $files AND coalesce(shared_files, '') = $shared_files
),
same AS (
    SELECT DISTINCT s.run, m.run AS executed, m.spec
    FROM sought s JOIN batch_runs m
    ON m.seed = s.seed AND m.input = s.input AND array_to_string(m.other_inputs, ' ') = s.other_inputs
    SEMI JOIN kin ON kin.spec = m.spec
    UNION SELECT s.run, e.run, $spec FROM sought s JOIN reused_executions r USING (run) JOIN executions e USING (execution)
)
SELECT s.run, e.execution, o.files, s.spec, e.programs
FROM same s JOIN executions e ON e.run = s.executed JOIN observations o ON o.execution = e.execution
ANTI JOIN imported_sessions i ON i.session = e.session
WHERE e.status = 'ok' AND e.purpose = 'run' AND e.ingest_rules = $ingest_rules AND o.reason IS NULL AND len(o.notes) = 0
ORDER BY s.run, s.spec = $spec, e.lamport
"""
"""The last row of each run is the best: an execution of the same run if there is one, and the last of several. The batch of an
execution that was reused before may have been removed.
"""
INHERITING = """
WITH mine AS (
    SELECT s.run, e.execution, e.session, e.programs, e.lamport, m.batch, m.ordinal
    FROM sought s JOIN executions e USING (run) JOIN batch_runs m ON m.batch = e.batch AND m.run = e.run
    ANTI JOIN imported_sessions i ON i.session = e.session
    WHERE e.status = 'ok' AND e.purpose = 'run' AND e.ingest_rules = $ingest_rules AND e.programs <> $programs
    AND e.execution NOT IN (SELECT execution FROM observations WHERE reason IS NULL AND len(notes) = 0)
),
sets AS (
    SELECT e.session, m.batch, m.ordinal, list(DISTINCT o.files ORDER BY o.files) AS sets
    FROM observations o JOIN executions e USING (execution) JOIN batch_runs m ON m.batch = e.batch AND m.run = e.run
    WHERE e.purpose = 'run' GROUP BY ALL HAVING max(len(o.notes)) = 0 AND count(o.reason) = 0
)
SELECT m.run, m.execution, m.programs, s.sets FROM mine m JOIN sets s USING (session, batch, ordinal) ORDER BY m.run, m.lamport
"""
"""Executions that were not observed, with the sets of files of the observed ones of their experiments and sessions."""
TABLES = (
    "batch_runs",
    "reused_executions",
    "specs",
    "executions",
    "imported_sessions",
    "observations",
    "programs",
)


def find(plan: Plan, snapshot: Snapshot, runs: Collection[str]) -> dict[str, Reusable]:
    """Return the executions that count for these runs of the plan, by run."""
    if not runs or plan.image is not None or plan.checkout is not None or plan.batch.spec.robots is not None:
        return {}  # an image covers the programs; neither a checkout nor a robot has the current files here
    if not snapshot.holds("observations"):
        return {}
    snapshot.views.make(TABLES)
    wanted = set(runs)
    sought = [run for run in {run.id: run for run in plan.batch.runs}.values() if run.id in wanted]
    digests = [[digest for _, digest in run.inputs] for run in sought]
    snapshot.add_table(
        "sought",
        run=(run.id for run in sought),
        seed=(run.seed for run in sought),
        input=(first for first, *_ in digests),
        other_inputs=(" ".join(others) for _, *others in digests),
    )
    names = [name for name, _ in sought[0].inputs]
    rows = snapshot.select(
        _Candidate,
        CANDIDATES,
        spec=plan.batch.spec_id,
        files=names,
        ingest_rules=context(plan).ingest_rules,
        **_kin(plan.batch.spec),
    )
    current = plan_files.current(plan)
    same = _unchanged(current, snapshot, {row.files for row in rows})
    found = {row.run: Reusable(row.execution, row.spec, row.programs) for row in rows if row.files in same}
    return found if len(found) == len(sought) else {**_inherited(plan, current, snapshot), **found}


def _inherited(plan: Plan, current: Current, snapshot: Snapshot) -> dict[str, Reusable]:
    """Return executions of the sought runs that were not observed, and that count because those of their session do."""
    rows = _inheriting(plan, snapshot)
    same = _unchanged(current, snapshot, {files for row in rows for files in row.sets})
    return {row.run: Reusable(row.execution, plan.batch.spec_id, row.programs) for row in rows if same.issuperset(row.sets)}


def _unchanged(current: Current, snapshot: Snapshot, sets: Collection[str]) -> set[str]:
    """Return those of these sets that have not changed."""
    if not sets:
        return set()
    return unchanged(file_sets.load(snapshot, sets), current)


def _inheriting(plan: Plan, snapshot: Snapshot) -> list[_Inheriting]:
    """Return executions of the sought runs that were not observed, with programs that differ only in Python's distributions."""
    rows = snapshot.select(_Inheriting, INHERITING, ingest_rules=context(plan).ingest_rules, programs=plan.programs.id)
    now = _without_distributions(plan.programs)
    alike = {
        programs
        for programs in {row.programs for row in rows}
        if _without_distributions(_recorded_programs(snapshot, programs)) == now
    }
    return [row for row in rows if row.programs in alike]


def _recorded_programs(snapshot: Snapshot, programs: str) -> Programs:
    return Programs(tuple(row.program() for row in row_queries.programs(snapshot, [programs])))


def _without_distributions(programs: Programs) -> set[tuple[str, str]]:
    """Return kinds and contents. Names do not count: the observed executions show under which ones the files were used."""
    return {(one.kind, one.sha256) for one in programs.all if one.kind != Kind.DISTRIBUTIONS}


def _kin(spec: RunSpec) -> dict[str, str | list[str] | None]:
    """Return the parts of a specification that must be equal."""
    return {
        "platform": spec.platform,
        "command": list(spec.command),
        "around": json.dumps(spec.around.preimage()) if spec.around else None,
        "variables": json.dumps(dict(spec.environment), sort_keys=True),
        "host_access": list(spec.host_access),
        "shared_files": spec.shared_files or "",
    }


def recorded(snapshot: Snapshot) -> dict[str, str]:
    """Return the executions that the last session of the store reused in this way, by run."""
    if not snapshot.holds("reused_executions"):
        return {}
    snapshot.views.make(("reused_executions", "sessions"))
    last = "SELECT run, execution FROM reused_executions WHERE session = (SELECT arg_max(session, lamport) FROM sessions)"
    return dict(snapshot.run(last))


SOURCE_FILES = """
SELECT any_value(files) FROM sources WHERE tree = (SELECT source FROM specs WHERE spec = $spec)
"""


def unused_changes(plan: Plan, store: Store, session: str, found: Iterable[Reusable]) -> Iterator[UnusedChangeRow]:
    """Yield the files and programs that differ between reused executions and the plan, which the executions did not use."""
    for spec, programs in sorted({(one.spec, one.programs) for one in found}):
        names: list[str] = []
        if spec != plan.batch.spec_id and plan.source is not None:
            [files] = store.values(str, SOURCE_FILES, spec=spec) or [""]
            before = store.object(files) if files else b""
            names += [f"{{project}}/{path}" for path in source.changed(before, plan.source.manifest)]
        if programs != plan.programs.id:
            with store.snapshot() as snapshot:
                names += _recorded_programs(snapshot, programs).unlike(plan.programs)
        for name in names[:MOST_CHANGES]:
            yield UnusedChangeRow(session, spec, programs, name)


def reason(store: Store, session: str, runs: int) -> str:
    """Return why a session reuses this many runs although the source or the programs differ."""
    names = store.values(str, "SELECT DISTINCT name FROM unused_changes WHERE session = $s ORDER BY 1", s=session)
    if not names:
        return f"{counted(runs, 'run')} reused, because their programs only have other names now"
    return f"{counted(runs, 'run')} reused, because the executions did not use what has changed: {few(names, NAMED)}"
