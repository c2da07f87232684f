"""Sessions whose executions used files that have changed since; their executions no longer count.

Some executions of a session are observed: the store has the files that they used, with their content. The other executions of
the session count only as long as these do, because they used the same programs.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from sierra.errors import Missing
from sierra.execution import commands, shared_libraries
from sierra.execution.resolve_plan import Plan
from sierra.execution.search_path import found_elsewhere
from sierra.provenance import pythons
from sierra.provenance.hash_cache import HashCache
from sierra.store.store import Snapshot
from sierra.util.text import few

NAMED = 3
PROJECT = "{project}/"
GPU = "{gpu}"
"""The name of the graphics processors among observed files: see `sierra.worker.file_trace`."""


class _Set(NamedTuple):
    """A set of files that observed executions of a session used."""

    session: str
    files: str
    environment: str
    checkout: bool
    """True if they were executed on a cluster, in a checkout of the source."""


class _File(NamedTuple):
    """One file of a set, as in the table `files_read`."""

    files: str
    path: str
    use: str
    sha256: str | None


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
FILES = """
SELECT DISTINCT files, path, use, sha256 FROM files_read
WHERE list_contains($sets, files)
AND (use = 'missed' OR (use IN ('executed', 'read', 'linked', 'link') AND sha256 IS NOT NULL)) ORDER BY ALL
"""
WRITTEN = """
SELECT DISTINCT e.session, w.path FROM files_written w JOIN all_judgements e ON e.execution = w.execution
WHERE list_contains($sessions, e.session)
"""
PATHS = """
SELECT environment, json_extract_string(variables, '$.PATH') AS search FROM environments
WHERE list_contains($environments, environment)
"""


def find(plan: Plan, snapshot: Snapshot) -> dict[str, str]:
    """Return the sessions that executed runs of this plan with files that have changed, each with one of these files."""
    if not snapshot.holds("observations"):
        return {}
    sets = snapshot.select(_Set, SETS, spec=plan.batch.spec_id, programs=plan.programs.id)
    files = snapshot.select(_File, FILES, sets=sorted({one.files for one in sets})) if sets else []
    named, used = folders(plan), _by_set(files)
    written = _written(snapshot, {one.session for one in sets}) if snapshot.holds("files_written") else set()
    changed = _changed({(file.path, file.use, file.sha256) for file in files}, named)
    elsewhere = _elsewhere(plan, snapshot, sets, used, named)
    stale: dict[str, str] = {}
    for one in sets:
        for file in used.get(one.files, ()):
            differs = (file.path, file.use, file.sha256) in changed and (one.session, file.path) not in written
            if differs and _counts(plan, one, file):
                stale.setdefault(one.session, file.path)
        if path := elsewhere.get((one.files, one.environment)):
            stale.setdefault(one.session, path)
    return stale


def _by_set(files: Iterable[_File]) -> dict[str, list[_File]]:
    found: dict[str, list[_File]] = {}
    for file in files:
        found.setdefault(file.files, []).append(file)
    return found


def _written(snapshot: Snapshot, sessions: Iterable[str]) -> set[tuple[str, str]]:
    """Return the files that these sessions have changed themselves, which are no inputs."""
    return {(row.session, row.path) for row in snapshot.select(_Written, WRITTEN, sessions=sorted(sessions))}


def _counts(plan: Plan, one: _Set, file: _File) -> bool:
    """Check whether the project's folder tells anything about a file: a checkout has only the files of the source."""
    if not file.path.startswith(PROJECT):
        return True
    return plan.checkout is None and not (one.checkout and file.use == "missed")


def _elsewhere(
    plan: Plan, snapshot: Snapshot, sets: Iterable[_Set], used: Mapping[str, Sequence[_File]], named: Mapping[str, Path]
) -> dict[tuple[str, str], str]:
    """Return the sets with a program or a library that would be found elsewhere now, by the environment of their executions."""
    now = os.environ.get("PATH", os.defpath)
    pairs = {(one.files, one.environment) for one in sets}
    others = sorted({environment for _, environment in pairs} - {plan.environment.environment})
    before: dict[str, str | None] = {}
    if others and "PATH" not in plan.batch.spec.environment:
        before = {row.environment: row.search for row in snapshot.select(_Search, PATHS, environments=others)}
    stale = {}
    for files, environment in pairs:
        mine = used.get(files, ())
        if path := _library_elsewhere(mine, named):
            stale[files, environment] = path
        executed = [here for file in mine if file.use == "executed" and (here := located(file.path, named)) is not None]
        if environment in before and (path := found_elsewhere(executed, before[environment], now)):
            stale[files, environment] = path
    return stale


def _library_elsewhere(files: Sequence[_File], named: Mapping[str, Path]) -> str | None:
    """Return a library that the loader's cache would now find elsewhere; None if there is none."""
    cached = next((file.sha256 for file in files if file.path == shared_libraries.CACHE), None)
    if cached is None or is_same(shared_libraries.CACHE, "read", cached, {}, HashCache()):
        return None
    paths = (located(file.path, named) for file in files if file.use in ("executed", "read", "linked"))
    return shared_libraries.found_elsewhere(path for path in paths if path is not None)


def recorded(snapshot: Snapshot) -> set[str]:
    """Return the sessions whose executions do not count in the batch of the last session."""
    if not snapshot.holds("stale_sessions"):
        return set()
    last = "SELECT stale FROM stale_sessions WHERE session = (SELECT arg_max(session, lamport) FROM sessions)"
    return set(snapshot.values(str, last))


def reason(stale: Mapping[str, str]) -> str:
    """Return the reason why executions of these sessions do not count."""
    return (
        f"earlier executions do not count, because files that they used have changed: {few(sorted(set(stale.values())), NAMED)}"
    )


def folders(plan: Plan) -> dict[str, Path]:
    """Return the folders that names of observed files refer to, by name."""
    named = {"project": plan.project.root.resolve(), "home": Path.home().resolve()}
    search = commands.declared(plan.batch.spec.environment, plan.project.root, plan.project.root)["PATH"]
    environment = pythons.environment(plan.programs, search)
    return {**named, "prefix": environment} if environment else named


def _changed(files: Iterable[tuple[str, str, str | None]], named: Mapping[str, Path]) -> set[tuple[str, str, str | None]]:
    """Return the files that have other content now, do not exist any more, or have come into existence."""
    cache = HashCache()
    changed = set()
    for path, use, sha256 in files:
        here = located(path, named)
        if path == shared_libraries.CACHE:
            continue
        if here is None or not is_same(
            here, use, sha256, named, cache
        ):  # None: in a virtual environment, and there is none now
            changed.add((path, use, sha256))
    cache.save()
    return changed


def is_same(here: str, use: str, sha256: str | None, named: Mapping[str, Path], cache: HashCache) -> bool:
    """Check whether a file that was executed or read has the same content, or one that was missed still does not exist.

    A link must lead to a file with the same content if the execution has read it, and to the same path otherwise.
    """
    if use == "missed":
        return not os.path.exists(here)  # noqa: PTH110 - for speed
    if use in ("linked", "link"):
        here = os.path.realpath(here)
    if use == "link":
        return hashlib.sha256(os.fsencode(name_of(here, named))).hexdigest() == sha256
    if here == GPU:
        from sierra.worker import file_trace

        return file_trace.graphics_sha256() == sha256
    try:
        return cache.counted(here) == sha256
    except Missing:
        return False


def name_of(path: str, named: Mapping[str, Path]) -> str:
    """Return the name of a path, the opposite of `located`: the deepest of the folders decides."""
    for name, folder in sorted(named.items(), key=lambda one: len(str(one[1])), reverse=True):
        if path == str(folder) or path.startswith(f"{folder}/"):
            return f"{{{name}}}{path.removeprefix(str(folder))}"
    return path


def located(path: str, named: Mapping[str, Path]) -> str | None:
    """Return where a file is on this machine; None if that is unknown."""
    if not path.startswith("{") or path == GPU:
        return path
    name, _, rest = path[1:].partition("}")
    return f"{named[name]}{rest}" if name in named else None
