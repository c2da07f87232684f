"""Comparison of files that observed executions used with the files that are here now, as strictly as possible.

Also: programs and shared libraries that would now be found elsewhere than an observed execution found them.

Programs are found by the search path (PATH), libraries by the loader's cache (/etc/ld.so.cache). The cache changes whenever any
library is installed, so its content says nothing. What counts is where it finds each library.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping

from sierra.execution.observation.current_files import Current, is_same, located
from sierra.execution.observation.file_sets import FileSets, UsedFile, located_paths
from sierra.execution.observation.listed_folders import ListedFolders
from sierra.provenance.hash_cache import HashCache
from sierra.util import bounded_program
from sierra.util.lazy_definitions import dataclass, regex

CACHE = "/etc/ld.so.cache"
LINE = regex(r"\s*(\S+) \((.*)\) => (.*)")
LIMIT_S = 30


class LoaderCache:
    """The libraries that the loader's cache finds now; it is read when it is needed first."""

    def __init__(self) -> None:
        self._known: dict[str, dict[str, str]] | None = None
        """Paths by name and architecture."""
        self._unknown = False
        self._folders: set[str] = set()

    def found_elsewhere(self, used: Iterable[str]) -> str | None:
        """Return a used library in a folder of the cache that the cache would now find in another file; None if none.

        If the cache cannot be read, it could be any: return the cache itself.
        """
        known = self._read()
        if self._unknown:
            return CACHE
        for path in used:
            folder, name = os.path.split(path)
            if folder not in self._folders or name not in known:
                continue
            if os.path.realpath(path) not in map(os.path.realpath, known[name].values()):
                return path
        return None

    def _read(self) -> Mapping[str, Mapping[str, str]]:
        if self._known is None:
            self._known = {}
            cached = _cached()
            self._unknown = cached is None
            for name, architecture, path in cached or ():
                self._known.setdefault(name, {}).setdefault(architecture, path)
                self._folders.add(os.path.dirname(path))  # noqa: PTH120 - for speed
        return self._known


def _cached() -> list[tuple[str, str, str]] | None:
    """Return the entries of the loader's cache, in its order: name, architecture, path. The first of several is found.

    None if there is a cache that cannot be read.
    """
    if not os.path.exists(CACHE):  # noqa: PTH110 - for speed
        return []
    program = shutil.which("ldconfig", path=f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin")
    try:
        done = bounded_program.execute([program, "-p"], cwd="/", wall=LIMIT_S) if program else None
    except OSError:
        return None
    if done is None or done.status != 0:
        return None
    return [(match[1], match[2], match[3]) for match in map(LINE.fullmatch, os.fsdecode(done.output).splitlines()) if match]


def found_elsewhere(executed: Iterable[str], missed: Iterable[str], before: str | None, now: str) -> str | None:
    """Return a program that was found on the search path `before`, or missed there, and that `now` would find elsewhere.

    None if there is none. `executed` are files and the links to them; those that were executed by their whole path are not
    searched for. If `before` is unknown, every file that either path could have found counts as found elsewhere, unless `now`
    finds just this file.
    """
    if before == now:
        return None
    for path in executed:
        name = os.path.basename(path)  # noqa: PTH119 - for speed
        if (before is None or _is(path, shutil.which(name, path=before))) and not _is(path, shutil.which(name, path=now)):
            return path
    folders = set((before or "").split(os.pathsep))
    for path in missed:
        folder, name = os.path.split(path)
        if folder in folders and shutil.which(name, path=before) is None and (path_now := shutil.which(name, path=now)):
            return path_now
    return None


def _is(path: str, found: str | None) -> bool:
    return found is not None and os.path.realpath(found) == os.path.realpath(path)


FOUND_ELSEWHERE = "found elsewhere"
"""The use of a library that the loader would now find in another file. The store has no such use."""
LOADED = ("read", "executed", "linked", "link")


@dataclass(frozen=True, slots=True)
class Changes:
    """Files that have changed, by the set of files that they belong to; sets without any are left out."""

    counting: Mapping[str, list[UsedFile]]
    harmless: Mapping[str, list[UsedFile]]
    """Files outside the project whose change could have had no effect on executions that used just these files."""


def unchanged(sets: FileSets, current: Current) -> set[str]:
    """Return the sets in which every file has the same content, nothing that was missed has come, and programs are found."""
    return set(sets.names) - changes(sets, current).keys() - with_other_programs(sets, current)


def changes(sets: FileSets, current: Current) -> Mapping[str, list[UsedFile]]:
    """Return the files of each set whose change counts, as `compare` does."""
    return compare(sets, current).counting


def compare(sets: FileSets, current: Current) -> Changes:
    """Return the files of each set that have changed. Not compared is whether the search path finds the same programs."""
    cache = HashCache()
    folders = ListedFolders(sets, current)
    changed, doubtful = [], []
    for used_file in sets.files:
        if used_file.use == "listed":
            if folders.is_changed(used_file):
                doubtful.append(used_file)
        elif used_file.path == CACHE:
            if not is_same(used_file.path, "read", used_file.sha256, {}, cache):
                doubtful.append(used_file)
        elif not _is_same(used_file, current, cache):
            changed.append(used_file)
    cache.save()
    counting, harmless = sets.having(changed), dict[str, list[UsedFile]]()
    for name, file, counts in _changed_for(sets, current, folders, doubtful):
        if counts or not file.is_in_project:
            (counting if counts else harmless).setdefault(name, []).append(file)
    return Changes(counting, harmless)


def _changed_for(
    sets: FileSets, current: Current, folders: ListedFolders, doubtful: Collection[UsedFile]
) -> Iterator[tuple[str, UsedFile, bool]]:
    """Yield the sets with these files, and whether a change of the file counts, which depends on the other files of the set."""
    loader = LoaderCache()
    having = sets.having(doubtful)
    members = sets.members(having)
    for name, files in having.items():
        for file in files:
            if file.use == "listed":
                yield name, file, not folders.is_harmless(file, members[name])
            elif path := loader.found_elsewhere(located_paths(members[name], current, *LOADED)):
                yield name, file if path == file.path else UsedFile(path, FOUND_ELSEWHERE, None), True
            else:
                yield name, file, False


def _is_same(one: UsedFile, current: Current, cache: HashCache) -> bool:
    here = located(one.path, current.folders)
    return here is not None and is_same(here, one.use, one.sha256, current.folders, cache)


def with_other_programs(sets: FileSets, current: Current) -> set[str]:
    """Return the sets without the program that the command starts now, and those of which the search path finds others."""
    program = os.path.realpath(current.program)
    executed = (file for file in sets.files if file.use == "executed")
    started = [file for file in executed if program in map(os.path.realpath, located_paths([file], current, "executed"))]
    others = set(sets.names) - sets.having(started).keys()
    if current.declared:
        return others
    searched = sets.searched()
    before = {name: searched.get(name, {None}) for name in sets.names - others}
    differing = {name: paths for name, paths in before.items() if paths != {current.search}}
    return others | found_differently(sets, current, differing).keys()


def found_differently(sets: FileSets, current: Current, before: Mapping[str, Collection[str | None]]) -> dict[str, str]:
    """Return the sets of which a program is found elsewhere by the current search path than by any `before`, each with one."""
    differing: dict[str, str] = {}
    known: dict[tuple[tuple[str, ...], tuple[str, ...], str | None], str | None] = {}
    for name, files in sets.members(before).items():
        programs, missed = tuple(_programs(files, current)), tuple(located_paths(files, current, "missed"))
        for path in before[name]:
            key = (programs, missed, path)
            if key not in known:
                known[key] = found_elsewhere(programs, missed, path, current.search)
            if other := known[key]:
                differing.setdefault(name, other)
    return differing


def _programs(files: Collection[UsedFile], current: Current) -> list[str]:
    """Return where the executed programs of a set are now: as they were called, and their real paths."""
    real = set(located_paths(files, current, "executed"))
    links = located_paths(files, current, "link", "linked")
    return sorted(real | {here for here in links if os.path.realpath(here) in real})
