"""Comparison of files that observed executions used with the files that are here now, as strictly as possible.

A new name in a listed folder is harmless only in two cases: it is prose in the project, and the execution has read no prose;
or it belongs to a distribution of Python that was installed since, and nothing that the execution has read names it, and no
word of its input or command.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from sierra.execution import shared_libraries
from sierra.execution.current_files import is_same, located
from sierra.execution.search_path import found_elsewhere
from sierra.provenance.hash_cache import HashCache
from sierra.provenance.source.plain_tree import LEFT_OUT
from sierra.provenance.source.prose import is_prose
from sierra.store.layout import CONFIG, FIGURES, LOCK, STORE

OWN = frozenset((STORE, LOCK, CONFIG, FIGURES, *LEFT_OUT))
"""Names in the project's folder that no run needs."""
PROJECT = "{project}"
PACKAGES = re.compile(r".*/(?:site|dist)-packages")
METADATA = re.compile(r".*\.(?:dist|egg)-info")
STARTED = re.compile(r".*\.(?:pth|egg-link)|(?:site|user)customize.*")
"""Files in a folder of packages that Python executes when it starts."""
STANDARD = re.compile(r".*/lib(?:64)?/python3[^/]*/(?!(?:site|dist)-packages/).*\.py")
"""Python's own library."""


class UsedFile(NamedTuple):
    """One file of a set, as in the table `files_read`."""

    files: str
    path: str
    use: str
    sha256: str | None


@dataclass(frozen=True, slots=True)
class FileSets:
    """Sets of used files, and the names in the folders that were listed."""

    used: tuple[UsedFile, ...]
    listings: Mapping[str, frozenset[str]]
    """Names by the SHA-256 of a listing."""
    written: frozenset[str]
    """Files that the executions have written themselves; they are in no listing."""
    folders: Mapping[str, Path]
    """Folders that names refer to."""
    searched: Mapping[str, frozenset[str | None]]
    """The search paths of the executions, by set; None for an unknown one."""
    search: str
    """The search path (PATH) of runs now."""
    program: str
    """The program that the command starts now."""
    words: str = ""
    """The command, the declared variables and the template, which may name modules."""
    lacking: frozenset[str] = frozenset()
    """Files and folders of the project, relative to it, that no checkout has; they are in no listing."""

    def programs(self, files: str) -> list[str]:
        """Return where the executed programs of a set are now: as they were called, and their real paths."""
        real = {here for path in _paths(files, self, ("executed",)) if (here := located(path, self.folders)) is not None}
        links = (located(path, self.folders) for path in _paths(files, self, ("link", "linked")))
        return sorted(real | {here for here in links if here is not None and os.path.realpath(here) in real})

    def missed(self, files: str) -> list[str]:
        """Return the paths that executions with this set looked for and did not find."""
        return [here for path in _paths(files, self, ("missed",)) if (here := located(path, self.folders)) is not None]


def unchanged(sets: FileSets) -> set[str]:
    """Return the sets in which every file has the same content, and nothing that was missed has come."""
    known = {one.files for one in sets.used} - changes(sets).keys()
    return {files for files in known if _are_programs_found(files, sets)}


def changes(sets: FileSets) -> dict[str, list[UsedFile]]:
    """Return the files of each set that have changed; sets without any are left out.

    Not compared is whether the search path finds the same programs.
    """
    changed: dict[str, list[UsedFile]] = {}
    cache = HashCache()
    same: dict[tuple[str, str, str | None], bool] = {}
    for one in sets.used:
        key = one[1:]
        if one.use == "listed":
            is_alike = _is_listing_same(one, sets)
        else:
            if key not in same:
                same[key] = _is_same(one, sets.folders, cache)
            is_alike = same[key]
        if not is_alike:
            changed.setdefault(one.files, []).append(one)
    cache.save()
    for one in sets.used:
        if one.path == shared_libraries.CACHE and (path := _library_elsewhere(one, sets, cache)):
            changed.setdefault(one.files, []).append(one._replace(path=path))
    return changed


def _is_same(one: UsedFile, folders: Mapping[str, Path], cache: HashCache) -> bool:
    here = located(one.path, folders)
    if here is None:
        return False
    if one.path == shared_libraries.CACHE:
        return True
    return is_same(here, one.use, one.sha256, folders, cache)


def _are_programs_found(files: str, sets: FileSets) -> bool:
    """Check whether the command starts one of the executed files, and the search path finds the same ones as before."""
    programs, missed = sets.programs(files), sets.missed(files)
    if os.path.realpath(sets.program) not in map(os.path.realpath, programs):
        return False
    return all(found_elsewhere(programs, missed, before, sets.search) is None for before in sets.searched.get(files, {None}))


def _library_elsewhere(cached: UsedFile, sets: FileSets, cache: HashCache) -> str | None:
    """Return a library that the loader's cache would now find elsewhere; None if there is none."""
    if is_same(shared_libraries.CACHE, "read", cached.sha256, {}, cache):
        return None
    used = (located(path, sets.folders) for path in _paths(cached.files, sets, ("read", "executed", "linked", "link")))
    return shared_libraries.found_elsewhere(here for here in used if here is not None)


def _is_listing_same(one: UsedFile, sets: FileSets) -> bool:
    """Check whether a listed folder has the same names, or other names that could not have had an effect."""
    here = located(one.path, sets.folders)
    before = sets.listings.get(one.sha256 or "")
    if here is None or before is None:
        return False
    try:
        names = {_shown(name) for name in os.listdir(here)}  # noqa: PTH208 - names are needed
    except OSError:
        return False
    mine = {path.rpartition("/")[2] for path in sets.written if path.rpartition("/")[0] == one.path}
    differing = (names ^ before) - mine - {"__pycache__"}
    differing = {name for name in differing if f"{one.path}/{name}".removeprefix(PROJECT + "/") not in sets.lacking}
    if not differing:
        return True
    if one.path == PROJECT or one.path.startswith(PROJECT + "/"):
        return _are_prose(one, differing, sets)
    if PACKAGES.fullmatch(one.path) and differing <= names:
        return _are_unused_packages(one, differing, sets)
    return False


def _shown(name: str) -> str:
    """Return a name as the store has it: escapes replace bytes that are not UTF-8."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _are_prose(one: UsedFile, names: Iterable[str], sets: FileSets) -> bool:
    """Check whether names in a folder of the project are those of prose, and the run has read no prose."""
    folder = one.path.removeprefix(PROJECT).lstrip("/")
    if not folder:
        names = set(names) - OWN
    if not all(is_prose(os.fsencode(f"{folder}/{name}" if folder else name)) for name in names):
        return False
    own = (path.removeprefix(PROJECT + "/") for path in _paths(one.files, sets, ("read", "executed")))
    return not any(is_prose(os.fsencode(path)) for path in own if not path.startswith("{"))


def _are_unused_packages(one: UsedFile, names: Iterable[str], sets: FileSets) -> bool:
    """Check whether new names in a folder of packages are modules that nothing has tried to import.

    A program that has looked at the metadata of distributions may search for plug-ins, so every distribution has an effect.
    """
    new = [name for name in names if not METADATA.fullmatch(name)]
    if any(map(STARTED.fullmatch, new)):
        return False
    used = list(_paths(one.files, sets, ("read", "executed")))
    if any(METADATA.match(path) for path in used):
        return False
    modules = sorted({name.partition(".")[0] for name in new} - {""})
    if any(re.search(rf"(?<!\w){re.escape(module)}(?!\w)", sets.words) for module in modules):
        return False
    return not any(_mentions(file, modules) for file in _located(used, sets))


def _paths(files: str, sets: FileSets, uses: tuple[str, ...] = ()) -> Iterator[str]:
    for other in sets.used:
        if other.files == files and (not uses or other.use in uses):
            yield other.path


def _located(paths: Iterable[str], sets: FileSets) -> Iterator[str]:
    for path in paths:
        if (here := located(path, sets.folders)) is not None:
            yield here


def _mentions(file: str, modules: Iterable[str]) -> bool:
    """Check whether a file contains one of these names as a word. In Python's own library, only imports count."""
    try:
        content = Path(file).read_bytes()
    except OSError:
        return True
    either = b"|".join(re.escape(os.fsencode(module)) for module in modules)
    if STANDARD.fullmatch(file):
        imported = rb"^[^\n#]*\bimport\b[^\n]*\b(?:%s)\b|^[^\n#]*\bfrom[ \t]+(?:%s)\b|[\"'](?:%s)[\"'.]" % (
            either,
            either,
            either,
        )
        return re.search(imported, content, re.MULTILINE) is not None
    return re.search(rb"(?<!\w)(?:%s)(?!\w)" % either, content) is not None
