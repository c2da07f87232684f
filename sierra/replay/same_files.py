"""Are the files that the recorded executions used the same now, in the restored source and outside it?

An execution that was completely observed answers for itself. For the others, those of their session answer as far as they can:
they may have used other files.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from sierra.execution import observed_sets, shared_libraries
from sierra.execution.current_files import is_same, located
from sierra.execution.unchanged_files import UsedFile, unchanged
from sierra.provenance.hash_cache import HashCache
from sierra.store.store import Snapshot, Store
from sierra.util.text import few

SHOWN = 5


@dataclass(frozen=True, slots=True)
class Current:
    """Where files are now."""

    folders: Mapping[str, Path]
    """Folders that names of files refer to."""
    search: str
    """The search path (PATH) of runs."""
    program: str
    """The program that the command starts."""


@dataclass(frozen=True, slots=True)
class UsedFiles:
    """The files that executions used, compared with those that are here."""

    executions: int
    observed: int
    """Number of executions that were observed from their beginning to their end."""
    compared: int
    """Number of compared files; 0 if no execution of their sessions was observed."""
    changed: tuple[str, ...]
    found: bool
    """True if programs and libraries are found where they were, and folders outside the project have the same names."""

    @property
    def same(self) -> bool | None:
        """True if all used files are the same, False if not; None if not all of them are known."""
        return False if self.changed else True if self.observed == self.executions and self.found else None

    @property
    def notes(self) -> Iterator[str]:
        """Yield a line that names the files that differ."""
        if self.changed:
            yield f"different files: these were used by the recorded executions and are not the same now: {self._shown}"

    @property
    def _shown(self) -> str:
        return few(self.changed, SHOWN)

    @property
    def words(self) -> str:
        """Return what is known about the files, as the end of a sentence about what is the same."""
        if self.same:
            return "and all files that the runs used, are the same"
        if not self.compared:
            return "and the programs, are the same; what was loaded was not recorded (observe in sierra.toml records it)"
        if self.observed == self.executions:
            return "and the files that runs read, are the same; but programs, libraries or other files may be found elsewhere"
        rest = (
            f"only {self.observed} of {self.executions} runs was observed" if self.observed else "these runs were not observed"
        )
        return f"and the files that observed runs used, are the same; {rest}: what else was loaded was not recorded"


OWN = """
SELECT count(DISTINCT execution) FROM observations WHERE reason IS NULL AND list_contains($e, execution)
"""
USED = """
WITH mine AS (SELECT execution, session FROM executions WHERE list_contains($e, execution)),
complete AS (
    SELECT o.execution, e.session, o.files FROM observations o JOIN executions e USING (execution)
    WHERE o.reason IS NULL AND e.purpose = 'run'
),
sets AS (
    SELECT files FROM complete SEMI JOIN mine USING (execution)
    UNION SELECT files FROM complete
    WHERE session IN (SELECT session FROM mine WHERE execution NOT IN (SELECT execution FROM complete))
)
SELECT DISTINCT f.files, f.path, f.use, f.sha256 FROM files_read f SEMI JOIN sets USING (files)
WHERE f.use <> 'listed'
AND f.path NOT IN (
    SELECT w.path FROM files_written w JOIN executions e USING (execution) WHERE e.session IN (SELECT session FROM mine)
)
ORDER BY ALL
"""
"""The sets of these executions; for those without one, the sets of their sessions. What they have written is no input."""


def compare(
    store: Store, executions: Collection[str], current: Current, known: Collection[str], *, declared: bool
) -> UsedFiles:
    """Return the comparison of the files that executions used with the current ones.

    `known` are paths that are compared elsewhere. `declared`: the search path is part of the specification.
    """
    with store.snapshot() as snapshot:
        [observed] = snapshot.values(int, OWN, e=sorted(executions))
        files = snapshot.select(UsedFile, USED, e=sorted(executions))
        cache, elsewhere = HashCache(), {os.path.realpath(path) for path in known}
        changed = [one.path for one in files if not _is_same(one, current.folders, elsewhere, cache)]
        cache.save()
        found = bool(files) and not changed and _are_found(snapshot, {one.files for one in files}, current, declared=declared)
    return UsedFiles(len(set(executions)), observed, len(files), tuple(dict.fromkeys(changed)), found)


def _are_found(snapshot: Snapshot, needed: Collection[str], current: Current, *, declared: bool) -> bool:
    """Check what the search for files depends on, except for the project's folders: only the source is restored."""
    snapshot.views.make(observed_sets.TABLES)
    snapshot.add_table("needed", files=sorted(needed))
    sets = observed_sets.file_sets(snapshot, current.folders, current.search, current.program, declared=declared)
    outside = (one for one in sets.used if one.use != "listed" or not one.path.startswith("{project}"))
    return unchanged(replace(sets, used=tuple(outside))) == set(needed)


def _is_same(file: UsedFile, folders: Mapping[str, Path], elsewhere: Collection[str], cache: HashCache) -> bool:
    here = located(file.path, folders)
    if file.path == shared_libraries.CACHE or (here is not None and os.path.realpath(here) in elsewhere):
        return True
    return here is not None and is_same(here, file.use, file.sha256, folders, cache)
