"""Sessions whose executions used files that have changed since; their executions no longer count.

Some executions of a session are observed: the store has the files that they used, with their content. The other executions of
the session count only as long as these do, because they used the same programs. If a file of another experiment has changed, an
execution may still count by what its own experiment used: see `sierra.execution.observation.reusable_executions`.

An experiment of which no run was observed completely may have used other files than observed runs. Its executions count only
as long as no file outside the project that these used has changed at all, even if the change is harmless to them.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Set
from typing import NamedTuple

from sierra.execution.observation import file_sets, plan_files
from sierra.execution.observation.current_files import Current
from sierra.execution.observation.file_sets import PROJECT, FileSets, UsedFile
from sierra.execution.observation.unchanged_files import FOUND_ELSEWHERE, compare, found_differently
from sierra.execution.plan import Plan
from sierra.provenance import source
from sierra.store.store import Snapshot
from sierra.util.text import counted, few

NAMED = 3
HARMLESS = "harmless"
"""Use of a file whose change is harmless to the observed executions, but perhaps not to those that were not observed."""


class _Set(NamedTuple):
    """A set of files that observed executions of a session used."""

    session: str
    files: str
    environment: str
    checkout: bool
    """True if they were executed on a cluster, in a checkout of the source."""


class _Written(NamedTuple):
    session: str
    path: str


class _Search(NamedTuple):
    environment: str
    search: str | None


SETS = """
SELECT DISTINCT e.session, o.files, e.environment, e.attempt IS NOT NULL AS checkout
FROM observations o JOIN all_judgements e ON e.execution = o.execution
WHERE e.programs = $programs AND e.purpose = 'run' AND (e.batch IN (SELECT batch FROM batches WHERE spec = $spec)
    OR e.batch NOT IN (SELECT batch FROM batches))
ORDER BY ALL
"""
WRITTEN = """
SELECT DISTINCT e.session, w.path FROM files_written w JOIN all_judgements e ON e.execution = w.execution
WHERE list_contains($sessions, e.session)
"""
OBSERVED = """
SELECT DISTINCT e.session, m.batch, m.ordinal
FROM observations o JOIN executions e USING (execution) JOIN batch_runs m ON m.batch = e.batch AND m.run = e.run
WHERE o.reason IS NULL AND e.status IN ('ok', 'accepted') AND e.purpose = 'run'
"""
"""Experiments of which a session observed a successful run completely. A reader may append a condition on `e.session`."""
UNOBSERVED = f"""
SELECT DISTINCT e.session FROM all_judgements e LEFT JOIN batch_runs m ON m.batch = e.batch AND m.run = e.run
ANTI JOIN ({OBSERVED}) o ON o.session = e.session AND o.batch = m.batch AND o.ordinal = m.ordinal
WHERE list_contains($sessions, e.session) AND e.programs = $programs AND e.status IN ('ok', 'accepted') AND e.purpose = 'run'
"""  # noqa: S608 - of our own parts
PATHS = """
SELECT environment, json_extract_string(variables, '$.PATH') AS search FROM environments
WHERE list_contains($environments, environment)
"""


def find(plan: Plan, snapshot: Snapshot) -> dict[str, UsedFile]:
    """Return the sessions that executed runs of this plan with files that have changed, each with one of these files."""
    return find_with_sets(plan, snapshot)[0]


def find_with_sets(plan: Plan, snapshot: Snapshot) -> tuple[dict[str, UsedFile], frozenset[str]]:
    """Return these sessions, and the sets of files that have changed."""
    if plan.batch.spec.robots is not None or not snapshot.holds("observations"):
        return {}, frozenset()  # the files of robots are not here
    sets = snapshot.select(_Set, SETS, spec=plan.batch.spec_id, programs=plan.programs.id)
    if not sets:
        return {}, frozenset()
    file_sets_used, current = file_sets.load(snapshot, {group.files for group in sets}), plan_files.current(plan)
    written = _written(snapshot, {group.session for group in sets}) if snapshot.holds("files_written") else set()
    compared = compare(file_sets_used, current)
    elsewhere = _elsewhere(plan, snapshot, sets, file_sets_used, current)
    committed = source.paths(plan.source.manifest) if plan.source else None
    stale: dict[str, UsedFile] = {}
    other: set[str] = set()
    for group in sets:
        files = compared.counting.get(group.files, ())
        changed = [f for f in files if (group.session, f.path) not in written and _counts(plan, group, f, committed)]
        if path := elsewhere.get((group.files, group.environment)):
            changed.append(UsedFile(path, FOUND_ELSEWHERE, None))
        if changed:
            stale.setdefault(group.session, changed[0])
            other.add(group.files)
    others = {
        group.session: compared.harmless[group.files][0]._replace(use=HARMLESS)
        for group in sets
        if group.files in compared.harmless
    }
    unobserved = _unobserved(plan, snapshot, others.keys() - stale.keys())
    return {**stale, **{session: others[session] for session in unobserved}}, frozenset(other)


def _unobserved(plan: Plan, snapshot: Snapshot, sessions: Collection[str]) -> set[str]:
    """Return those of these sessions with executions of an experiment of which they observed no run completely."""
    if not sessions:
        return set()
    snapshot.views.make(("executions", "batch_runs"))
    return set(snapshot.values(str, UNOBSERVED, sessions=sorted(sessions), programs=plan.programs.id))


def _written(snapshot: Snapshot, sessions: Iterable[str]) -> set[tuple[str, str]]:
    """Return the files that these sessions have changed themselves, which are no inputs."""
    return {(row.session, row.path) for row in snapshot.select(_Written, WRITTEN, sessions=sorted(sessions))}


def _counts(plan: Plan, used_set: _Set, file: UsedFile, committed: Set[bytes] | None) -> bool:
    """Check whether the project's folder tells anything about a file: a checkout has only the files of the source.

    `committed` are these files; None for a recorded batch.
    """
    if not file.is_in_project:
        return True
    if plan.checkout is not None:
        own = committed is None or os.fsencode(file.path.removeprefix(f"{PROJECT}/")) in committed
        return file.use in ("read", "executed") and not own
    return not (used_set.checkout and file.use in ("missed", "found", "listed"))


def _elsewhere(
    plan: Plan, snapshot: Snapshot, sets: Iterable[_Set], file_sets_used: FileSets, current: Current
) -> dict[tuple[str, str], str]:
    """Return the sets with a program that the search path finds elsewhere now, by the environment of their executions."""
    by_environment: dict[str, set[str]] = {}
    for used_set in sets:
        by_environment.setdefault(used_set.environment, set()).add(used_set.files)
    others = sorted(by_environment.keys() - {plan.environment.environment})
    if not others or current.declared:
        return {}
    stale = {}
    for environment, search in snapshot.select(_Search, PATHS, environments=others):
        if search != current.search:
            differing = found_differently(file_sets_used, current, dict.fromkeys(by_environment[environment], (search,)))
            stale.update({(name, environment): path for name, path in differing.items()})
    return stale


def recorded(snapshot: Snapshot) -> set[str]:
    """Return the sessions whose executions do not count in the batch of the last session."""
    if not snapshot.holds("stale_sessions"):
        return set()
    last = "SELECT stale FROM stale_sessions WHERE session = (SELECT arg_max(session, lamport) FROM sessions)"
    return set(snapshot.values(str, last))


DIFFERENCES = {
    "missed": "new",
    "found": "its kind, size or rights",
    "listed": "its names",
    "link": "it leads elsewhere",
    FOUND_ELSEWHERE: "found first now",
}
"""The differences of files of which the content was not compared, by their use."""


def reason(stale: Mapping[str, UsedFile]) -> str:
    """Return the reason why executions of these sessions do not count. Only other bytes are called a changed file."""
    files = sorted(set(stale.values()), key=lambda file: (file.path, file.use))
    unknown = [file for file in files if file.sha256 is None and file.use not in (*DIFFERENCES, HARMLESS)]
    known = list(dict.fromkeys(_described(file) for file in files if file not in unknown and file.use != HARMLESS))
    causes = [f"files that they used have changed: {few(known, NAMED)}"] if known else []
    if unknown:
        causes.append(f"it is not known with which content they used {_names(unknown)}")
    if harmless := [file for file in files if file.use == HARMLESS]:
        causes.append(f"it was not observed whether they used what has changed: {_names(harmless)}")
    return f"earlier executions do not count, because {'; and '.join(causes)}"


def certain(stale: Mapping[str, UsedFile]) -> dict[str, UsedFile]:
    """Return the sessions whose observed executions used what has changed."""
    return {session: file for session, file in stale.items() if file.use != HARMLESS}


def _names(files: Iterable[UsedFile]) -> str:
    return few(list(dict.fromkeys(file.path for file in files)), NAMED)


def _described(file: UsedFile) -> str:
    return f"{file.path} ({DIFFERENCES[file.use]})" if file.use in DIFFERENCES else file.path


def unobserved_reason(runs: int, stale: Mapping[str, UsedFile]) -> str:
    """Return the reason why so many runs execute again although it is not known that they used a file that has changed."""
    names = f": {_names(sorted(set(stale.values()), key=lambda file: file.path))}" if stale else ""
    return (
        f"{counted(runs, 'run')} execute again because their experiments were not observed: "
        f"nobody knows whether they used what has changed{names}"
    )
