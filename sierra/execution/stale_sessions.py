"""Sessions whose executions used files that have changed since; their executions no longer count.

Some executions of a session are observed: the store has the files that they used, with their content. The other executions of
the session count only as long as these do, because they used the same programs.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Iterable, Mapping
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


class _Searched(NamedTuple):
    """An executed program, and the search path (PATH) of its session."""

    session: str
    path: str
    search: str | None


class _Used(NamedTuple):
    """A file that executions of a session used."""

    session: str
    path: str
    use: str
    sha256: str | None


USED = """
WITH used AS (
    SELECT DISTINCT e.session, o.files
    FROM observations o JOIN executions e USING (execution)
    WHERE e.programs = $programs AND e.purpose = 'run' AND e.run IN (SELECT run FROM batch_runs WHERE spec = $spec)
)
SELECT DISTINCT u.session, f.path, f.use, f.sha256
FROM used u JOIN files_read f USING (files)
WHERE (f.use = 'missed' OR (f.use IN ('executed', 'read', 'linked', 'link') AND f.sha256 IS NOT NULL))
AND (u.session, f.path) NOT IN (
    SELECT (e.session, w.path) FROM files_written w JOIN executions e USING (execution)
)
ORDER BY ALL
"""
"""Files that a session has changed itself are no inputs."""
SEARCHED = """
SELECT DISTINCT e.session, f.path, json_extract_string(v.variables, '$.PATH') AS search
FROM observations o JOIN executions e USING (execution) JOIN environments v USING (environment) JOIN files_read f USING (files)
WHERE f.use = 'executed' AND list_contains($sessions, e.session)
AND json_extract_string(v.variables, '$.PATH') IS DISTINCT FROM $now
"""


def find(plan: Plan, snapshot: Snapshot) -> dict[str, str]:
    """Return the sessions that executed runs of this plan with files that have changed, each with one of these files."""
    if not snapshot.holds("observations"):
        return {}
    rows = snapshot.select(_Used, USED, spec=plan.batch.spec_id, programs=plan.programs.id)
    if plan.checkout is not None:  # its files are those of the source, and not those in the project's folder
        rows = [row for row in rows if not row.path.startswith(PROJECT)]
    changed = _changed({(row.path, row.use, row.sha256) for row in rows}, folders(plan))
    stale: dict[str, str] = {}
    for row in rows:
        if (row.path, row.use, row.sha256) in changed:
            stale.setdefault(row.session, row.path)
    return {
        **_found_elsewhere(plan, snapshot, {row.session for row in rows}),
        **_libraries_elsewhere(rows, folders(plan)),
        **stale,
    }


def _libraries_elsewhere(rows: Iterable[_Used], named: Mapping[str, Path]) -> dict[str, str]:
    """Return the sessions with libraries that the loader's cache would now find elsewhere, each with one of these libraries."""
    cache, used = HashCache(), list(rows)
    cached = {row.session: row.sha256 for row in used if row.path == shared_libraries.CACHE}
    stale: dict[str, str] = {}
    for session in [one for one, sha256 in cached.items() if not is_same(shared_libraries.CACHE, "read", sha256, {}, cache)]:
        paths = (
            located(row.path, named) for row in used if row.session == session and row.use in ("executed", "read", "linked")
        )
        if path := shared_libraries.found_elsewhere(path for path in paths if path is not None):
            stale[session] = path
    return stale


def _found_elsewhere(plan: Plan, snapshot: Snapshot, sessions: Collection[str]) -> dict[str, str]:
    """Return the sessions with another search path that would now find another program, each with one of these programs."""
    if "PATH" in plan.batch.spec.environment:
        return {}
    now, named = os.environ.get("PATH", os.defpath), folders(plan)
    stale: dict[str, str] = {}
    for row in snapshot.select(_Searched, SEARCHED, sessions=sorted(sessions), now=now):
        here = located(row.path, named)
        if here is not None and found_elsewhere([here], row.search, now):
            stale.setdefault(row.session, row.path)
    return stale


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
