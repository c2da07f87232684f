"""Names that came into folders which observed executions have listed, or that left them.

A new name is harmless only in two cases: it is prose in the project, and the execution has read no prose; or it belongs to a
distribution of Python that was installed since, and nothing that the execution has read names it, and no word of its input or
command.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable

from sierra.execution.observation.current_files import Current, located
from sierra.execution.observation.file_sets import FileSets, UsedFile, located_paths
from sierra.provenance.source.plain_tree import LEFT_OUT
from sierra.provenance.source.prose import is_prose
from sierra.store.layout import CONFIG, FIGURES, LOCK, PAPER, STORE
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.regular_files import read_regular

OWN = frozenset((STORE, LOCK, CONFIG, FIGURES, PAPER.partition("/")[0], *LEFT_OUT))
"""Names in the project's folder that no run needs."""
PROJECT = "{project}"
PACKAGES = regex(r".*/(?:site|dist)-packages")
METADATA = regex(r".*\.(?:dist|egg)-info")
STARTED = regex(r".*\.(?:pth|egg-link)|(?:site|user)customize.*")
"""Files in a folder of packages that Python executes when it starts."""
STANDARD = regex(r".*/lib(?:64)?/python3[^/]*/(?!(?:site|dist)-packages/).*\.py")
"""Python's own library."""
PROGRAMS = "{prefix}/bin"
OF_TOOLS = regex(r"(?i:(?:de)?activate(?:_this)?(?:\.\w+)?|pydoc\.bat)|python(?:\d(?:\.\d+)?t?)?")
"""Names in that folder that depend on the tool that made the environment: scripts for shells, and links to Python."""


@dataclass(frozen=True, slots=True)
class _Difference:
    new: frozenset[str]
    gone: frozenset[str]


class ListedFolders:
    """The folders that sets of files list, compared with those that are here now."""

    def __init__(self, sets: FileSets, current: Current) -> None:
        self._sets = sets
        self._current = current
        self._differences: dict[UsedFile, _Difference | None] = {}
        """For folders that have changed; None if their names are unknown."""
        self._mentions: dict[tuple[str, tuple[str, ...]], bool] = {}

    def is_changed(self, one: UsedFile) -> bool:
        """Check whether a folder has other names than it had, apart from those that SIERRA or the executions made."""
        if self._current.is_source_only and one.path.startswith(PROJECT):
            return False
        difference = self._difference(one)
        if difference is None or difference.new or difference.gone:
            self._differences[one] = difference
            return True
        return False

    def is_harmless(self, one: UsedFile, files: Collection[UsedFile]) -> bool:
        """Check whether the difference of a changed folder could have had no effect on executions that used these files."""
        difference = self._differences[one]
        if difference is None:
            return False
        if one.path == PROJECT or one.path.startswith(PROJECT + "/"):
            return _are_prose(one, difference.new | difference.gone, files)
        if PACKAGES.fullmatch(one.path) and not difference.gone:
            return self._are_unused_packages(difference.new, files)
        return False

    def _difference(self, folder: UsedFile) -> _Difference | None:
        here = located(folder.path, self._current.folders)
        before = self._sets.listings.get(folder.sha256 or "")
        if here is None or before is None:
            return None
        try:
            now = {_shown(name) for name in os.listdir(here)}  # noqa: PTH208 - names are needed
        except OSError:
            return None
        mine = {path.rpartition("/")[2] for path in self._sets.written if path.rpartition("/")[0] == folder.path}
        own = mine | {"__pycache__"}
        return _Difference(self._counting(folder, now - before - own), self._counting(folder, before - now - own))

    def _counting(self, one: UsedFile, names: Iterable[str]) -> frozenset[str]:
        inside = one.path + "/"
        if one.path == PROGRAMS:
            names = (name for name in names if not OF_TOOLS.fullmatch(name))
        return frozenset(name for name in names if (inside + name).removeprefix(PROJECT + "/") not in self._current.lacking)

    def _are_unused_packages(self, names: Iterable[str], files: Collection[UsedFile]) -> bool:
        """Check whether new names in a folder of packages are modules that nothing has tried to import.

        A program that has looked at the metadata of distributions may search for plug-ins, so every distribution has an effect.
        """
        new = [name for name in names if not METADATA.fullmatch(name)]
        if any(map(STARTED.fullmatch, new)):
            return False
        if any(METADATA.match(file.path) for file in files if file.use in ("read", "executed")):
            return False
        modules = tuple(sorted({name.partition(".")[0] for name in new} - {""}))
        if any(re.search(rf"(?<!\w){re.escape(module)}(?!\w)", self._current.words) for module in modules):
            return False
        used = located_paths(files, self._current, "read", "executed")
        return not any(self._is_mentioned(file, modules) for file in used)

    def _is_mentioned(self, file: str, names: tuple[str, ...]) -> bool:
        key = (file, names)
        if key not in self._mentions:
            self._mentions[key] = _mentions(file, names)
        return self._mentions[key]


def _shown(name: str) -> str:
    """Return a name as the store has it: escapes replace bytes that are not UTF-8."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _are_prose(one: UsedFile, names: Iterable[str], files: Iterable[UsedFile]) -> bool:
    """Check whether names in a folder of the project are those of prose, and the run has read no prose."""
    folder = one.path.removeprefix(PROJECT).lstrip("/")
    if not folder:
        names = set(names) - OWN
    if not all(is_prose(os.fsencode(f"{folder}/{name}" if folder else name)) for name in names):
        return False
    own = (file.path.removeprefix(PROJECT + "/") for file in files if file.use in ("read", "executed"))
    return not any(is_prose(os.fsencode(path)) for path in own if not path.startswith("{"))


def _mentions(file: str, modules: Iterable[str]) -> bool:
    """Check whether a file contains one of these names as a word. In Python's own library, only imports count."""
    try:
        content = read_regular(file)
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
