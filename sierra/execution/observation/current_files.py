"""Files that observed executions used, as they are on this machine now: where they are, and whether they are the same."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from sierra.errors import Missing
from sierra.provenance.hash_cache import HashCache
from sierra.util.fs import unescaped
from sierra.util.lazy_definitions import dataclass

GPU = "{gpu}"
"""The name of the graphics processors among observed files: see `sierra.worker.observed_record`."""


@dataclass(frozen=True, slots=True)
class Current:
    """The folders and names of the files that runs would use now."""

    folders: Mapping[str, Path]
    """Folders that names of files refer to, by name."""
    search: str
    """The search path (PATH) of runs."""
    declared: bool
    """True if the search path is part of the specification."""
    program: str
    """The program that the command starts."""
    words: str = ""
    """The command, the declared variables and the template, which may name modules of Python."""
    lacking: frozenset[str] = frozenset()
    """Files and folders of the project, relative to it, that no checkout has; they are in no listing."""
    is_source_only: bool = False
    """True if the project's folder has only the files of the source, so that its listings tell nothing."""


def is_same(here: str, use: str, sha256: str | None, named: Mapping[str, Path], cache: HashCache) -> bool:
    """Check whether a file that was executed or read has the same content, or one that was missed still does not exist.

    A link must lead to a file with the same content if the execution has read it, and to the same path otherwise.
    """
    if use == "missed":
        return not os.path.exists(here)  # noqa: PTH110 - for speed
    if use == "found":
        from sierra.worker.observed_record import sha256_of_kind

        return sha256_of_kind(here) == sha256
    if sha256 is None:
        return not os.access(here, os.R_OK)  # it could not be read when it was used, or it was changed then
    if use in ("linked", "link"):
        here = os.path.realpath(here)
    if use == "link":
        return hashlib.sha256(os.fsencode(name_of(here, named))).hexdigest() == sha256
    if here == GPU:
        from sierra.worker.observed_record import graphics_sha256

        return graphics_sha256() == sha256
    try:
        return os.path.isfile(here) and sha256 in _counted(here, cache)  # noqa: PTH113 - for speed
    except Missing:
        return False


def _counted(here: str, cache: HashCache) -> Iterator[str]:
    """Yield the SHA-256 of what counts of a file, and the one that an earlier version of SIERRA may have recorded."""
    yield cache.counted(here)
    yield cache.counted_before(here)


def name_of(path: str, named: Mapping[str, Path]) -> str:
    """Return the name of a path, the opposite of `located`: the deepest of the folders decides."""
    for name, folder in sorted(named.items(), key=lambda one: len(str(one[1])), reverse=True):
        if path == str(folder) or path.startswith(f"{folder}/"):
            return f"{{{name}}}{path.removeprefix(str(folder))}"
    return path


def located(path: str, named: Mapping[str, Path]) -> str | None:
    """Return where a file is on this machine; None if that is unknown."""
    if path.startswith("{") and path != GPU:
        name, _, rest = path[1:].partition("}")
        if name not in named:
            return None
        path = f"{named[name]}{rest}"
    return unescaped(path) if "\\x" in path and not os.path.lexists(path) else path
