"""Executions that count for runs of a plan although the source or the programs differ: no file that they used has changed.

Such an execution was observed from its beginning to its end, and it has asked no daemon and no other machine, which may have
read files for it. Its run has the command, input and seed of the run in the plan; only the source may be another one.
Everything that it executed, read, listed, found or missed is still the same.

An execution that was not observed never counts for another source, because nobody knows what it has read. Observed executions
of its session with its experiment or its seed stand for it: if they still count, then it counts although a file of another
experiment has changed, with other installed distributions of Python, with other files in folders of libraries, and with other
names of the same programs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Set
from typing import NamedTuple

from sierra.execution import row_queries
from sierra.execution.observation import file_sets, plan_files
from sierra.execution.observation.current_files import Current
from sierra.execution.observation.file_sets import UsedFile
from sierra.execution.observation.unchanged_files import unchanged
from sierra.execution.plan import Plan, context
from sierra.provenance import referenced_files, source
from sierra.provenance.dependency_model import Kind, Programs
from sierra.store import spec_rows
from sierra.store.row_types import UnusedChangeRow
from sierra.store.store import Snapshot, Store
from sierra.util.lazy_definitions import dataclass
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
    observed: bool
    """True if a run of its experiment was observed completely."""
    complete: bool
    """True if all observed executions that stand for it were observed completely, and asked no daemon."""
    sets: list[str]
    """The sets of files that these executions used."""


KIN = ("platform", "command", "around", "variables", "host_access", "files", "shared_files")
"""The columns of a specification that must be equal."""
CANDIDATES = """
WITH kin AS (
    SELECT spec FROM specs WHERE platform = $platform AND command = $command
    AND around IS NOT DISTINCT FROM $around AND variables = $variables AND image IS NULL
    AND host_access = $host_access AND files = $files AND shared_files IS NOT DISTINCT FROM $shared_files
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
WHERE e.status IN ('ok', 'accepted') AND e.purpose = 'run' AND e.ingest_rules = $ingest_rules
    AND o.reason IS NULL AND len(o.notes) = 0
ORDER BY s.run, s.spec = $spec, e.lamport
"""
"""The last row of each run is the best: an execution of the same run if there is one, and the last of several. The batch of an
execution that was reused before may have been removed.
"""
INHERITING = """
WITH mine AS (
    SELECT s.run, e.execution, e.session, e.programs, e.lamport, m.batch, m.ordinal, m.seed
    FROM sought s JOIN executions e USING (run) JOIN batch_runs m ON m.batch = e.batch AND m.run = e.run
    ANTI JOIN imported_sessions i ON i.session = e.session
    WHERE e.status IN ('ok', 'accepted') AND e.purpose = 'run' AND e.ingest_rules = $ingest_rules
    AND (e.programs <> $programs AND NOT $own OR list_contains($stale, e.session) AND e.programs = $programs)
    AND ($own OR e.execution NOT IN (SELECT execution FROM observations WHERE reason IS NULL AND len(notes) = 0))
),
seen AS (
    SELECT e.session, m.batch, m.ordinal, m.seed, o.files, o.reason IS NULL AND e.status IN ('ok', 'accepted') AS good,
           o.reason IS NULL AND len(o.notes) = 0 AS complete
    FROM observations o JOIN executions e USING (execution) JOIN batch_runs m ON m.batch = e.batch AND m.run = e.run
    WHERE e.purpose = 'run'
),
same_experiment AS (
    SELECT session, batch, ordinal, bool_or(good) AS observed, bool_and(complete) AS complete, list(DISTINCT files) AS sets
    FROM seen GROUP BY ALL
),
same_seed AS (
    SELECT session, batch, seed, bool_and(complete) AS complete, list(DISTINCT files) AS sets FROM seen GROUP BY ALL
)
SELECT m.run, m.execution, m.programs, o.files IS NOT NULL OR coalesce(x.observed, false) AS observed,
       o.files IS NOT NULL OR coalesce(x.complete, false) AND coalesce(s.complete, true) AS complete,
       CASE WHEN o.files IS NOT NULL THEN [o.files]
            ELSE list_sort(list_distinct(list_concat(coalesce(x.sets, []), coalesce(s.sets, [])))) END AS sets
FROM mine m LEFT JOIN same_experiment x USING (session, batch, ordinal) LEFT JOIN same_seed s USING (session, batch, seed)
LEFT JOIN (SELECT execution, files FROM observations WHERE reason IS NULL AND len(notes) = 0) o USING (execution)
ORDER BY m.run, m.lamport
"""
"""Executions that were not observed, with the sets of files of the observed ones of their sessions that stand for them.

With $own, only executions of stale sessions, also observed ones, which stand for themselves.
"""
TABLES = (
    "batch_runs",
    "reused_executions",
    "specs",
    "executions",
    "imported_sessions",
    "observations",
    "programs",
)


def find(
    plan: Plan, snapshot: Snapshot, runs: Collection[str], stale: Collection[str], other: Set[str]
) -> tuple[dict[str, Reusable], frozenset[str]]:
    """Return the executions that count for these runs of the plan, by run; and the runs of experiments that were not observed.

    `stale` are the sessions whose executions do not count of themselves, `other` the sets of files of them that have changed.
    """
    nothing: tuple[dict[str, Reusable], frozenset[str]] = ({}, frozenset())
    if not runs or plan.image is not None or plan.batch.spec.robots is not None or not snapshot.holds("observations"):
        return nothing  # an image covers the programs, and a robot does not have the current files here
    if plan.checkout is not None and not stale:
        return nothing
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
    if any(service.shared for service in plan.batch.spec.around.services):
        stale = ()  # such a service may have read a file for any run, whichever run was observed then
    if plan.checkout is not None:  # it does not have the current files, so that nothing else can be compared
        return _inherited(plan, snapshot, stale, lambda sets: sets - other)
    row = spec_rows.of_batch(plan.batch)
    kin = {name: getattr(row, name) for name in KIN}
    rows = snapshot.select(_Candidate, CANDIDATES, spec=row.spec, ingest_rules=context(plan).ingest_rules, **kin)
    rows = _by_same_plugins(plan, snapshot, rows)
    current = plan_files.current(plan)
    same = _unchanged(current, snapshot, {row.files for row in rows})
    reusable = {row.run: Reusable(row.execution, row.spec, row.programs) for row in rows if row.files in same}
    if len(reusable) == len(sought):
        return reusable, frozenset()
    inherited, unobserved = _inherited(plan, snapshot, stale, lambda sets: _unchanged(current, snapshot, sets))
    return {**inherited, **reusable}, unobserved - reusable.keys()


def _inherited(
    plan: Plan, snapshot: Snapshot, stale: Collection[str], unchanged_of: Callable[[set[str]], Set[str]]
) -> tuple[dict[str, Reusable], frozenset[str]]:
    """Return executions of the sought runs that were not observed, and that count because others that stand for them do.

    Return also the runs for which no execution stands.
    """
    rows = _inheriting(plan, snapshot, stale)
    complete = [row for row in rows if row.observed and row.complete]
    same = unchanged_of({files for row in complete for files in row.sets})
    reusable = {row.run: Reusable(row.execution, plan.batch.spec_id, row.programs) for row in complete if same >= set(row.sets)}
    observed = {row.run for row in rows if row.observed}
    return reusable, frozenset({row.run for row in rows} - observed)


def _unchanged(current: Current, snapshot: Snapshot, sets: Collection[str]) -> set[str]:
    """Return those of these sets that have not changed."""
    if not sets:
        return set()
    return unchanged(file_sets.load(snapshot, sets), current)


def _inheriting(plan: Plan, snapshot: Snapshot, stale: Collection[str]) -> list[_Inheriting]:
    """Return executions of the sought runs that were not observed, with programs that differ only in what few runs load."""
    own = plan.checkout is not None
    rules, identity = context(plan).ingest_rules, plan.programs.id
    rows = snapshot.select(_Inheriting, INHERITING, ingest_rules=rules, programs=identity, stale=sorted(stale), own=own)
    now = _certain(plan, plan.programs)
    alike = {
        programs
        for programs in {row.programs for row in rows}
        if not _certain(plan, _recorded_programs(snapshot, programs)).unlike(now)
    }
    return [row for row in rows if row.programs in alike]


def _by_same_plugins(plan: Plan, snapshot: Snapshot, rows: list[_Candidate]) -> list[_Candidate]:
    """Return the executions whose inputs were made by the plug-ins of the project as they are: no execution reads these."""
    if not plan.plugins:
        return rows
    digests = {
        programs: {one.name: one.sha256 for one in _recorded_programs(snapshot, programs).all}
        for programs in {row.programs for row in rows}
    }
    same = {programs for programs, recorded in digests.items() if plan.plugins.items() <= recorded.items()}
    return [row for row in rows if row.programs in same]


def _recorded_programs(snapshot: Snapshot, programs: str) -> Programs:
    return Programs(tuple(row.program() for row in row_queries.programs(snapshot, [programs])))


def _certain(plan: Plan, programs: Programs) -> Programs:
    """Return the programs and files that all runs use, and not what is only there to be loaded."""
    variables = plan.batch.spec.environment
    return Programs(
        tuple(
            program
            for program in programs.all
            if program.kind != Kind.DISTRIBUTIONS
            and not (program.kind == Kind.FILE and referenced_files.is_in_library_folder(program.name, variables))
        )
    )


def recorded(snapshot: Snapshot) -> dict[str, str]:
    """Return the executions that the last session of the store reused in this way, by run."""
    if not snapshot.holds("reused_executions"):
        return {}
    snapshot.views.make(("reused_executions", "sessions"))
    last = "SELECT run, execution FROM reused_executions WHERE session = (SELECT arg_max(session, lamport) FROM sessions)"
    return dict(snapshot.run(last))


SOURCE_FILES = """
SELECT files FROM sources WHERE tree = (SELECT source FROM specs WHERE spec = $spec) ORDER BY files LIMIT 1
"""


def unused_changes(
    plan: Plan, store: Store, session: str, reusable: Iterable[Reusable], stale: Mapping[str, UsedFile]
) -> Iterator[UnusedChangeRow]:
    """Yield the files and programs that differ between reused executions and the plan, which the executions did not use.

    `stale`: the sessions whose executions do not count of themselves, each with a file that has changed.
    """
    for spec, programs in sorted({(execution.spec, execution.programs) for execution in reusable}):
        names: list[str] = []
        if spec != plan.batch.spec_id and plan.source is not None:
            [files] = store.values(str, SOURCE_FILES, spec=spec) or [""]
            before = store.object(files) if files else b""
            names += [f"{{project}}/{path}" for path in source.changed(before, plan.source.manifest)]
        if programs != plan.programs.id:
            with store.snapshot() as snapshot:
                names += _recorded_programs(snapshot, programs).unlike(plan.programs)
        if not names:
            names += sorted({file.path for file in stale.values()})
        for name in names[:MOST_CHANGES]:
            yield UnusedChangeRow(session, spec, programs, name)


def reason(store: Store, session: str, runs: int) -> str:
    """Return why a session reuses this many runs although the source or the programs differ."""
    names = store.values(str, "SELECT DISTINCT name FROM unused_changes WHERE session = $s ORDER BY 1", s=session)
    if not names:
        return f"{counted(runs, 'run')} reused, because their programs only have other names now"
    return f"{counted(runs, 'run')} reused, because the executions did not use what has changed: {few(names, NAMED)}"
