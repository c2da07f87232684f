"""The folder of a paper: its files are written if their content changes, and checked by `provenance.json`.

`provenance.json` has for each file its SHA-256, the deliverable, its batches and the hash of its data, and for each query its
batch with the commit of its code. It names no host and no time, so the same runs give the same bytes. A file that is not as
`provenance.json` says was edited by somebody: it is neither replaced nor removed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from pydantic import Field

from sierra.config.field_types import Table
from sierra.config.validate import options
from sierra.errors import Damaged, Missing
from sierra.store.layout import PROVENANCE
from sierra.store.segments import disk_errors
from sierra.util.fs import inside, write_whole
from sierra.util.hashing import sha256, sha256_file
from sierra.util.lazy_definitions import dataclass
from sierra.util.regular_files import read_regular

VERSION = 1


class PaperFile(Table):
    """One file of a paper."""

    sha256: str = Field(description="SHA-256 of the file")
    kind: str = Field(description="kind of the deliverable: `figure`, `table` or `comparison`")
    name: str = Field(description="name of the deliverable")
    batches: tuple[str, ...] = Field(description="the batches that it shows")
    data: str = Field(description="hash of the values that it shows")
    definition: str = Field(description="hash of how it is made: labels, units, notes and keys of `sierra.toml`")


class PaperQuery(Table):
    """One query of a paper."""

    batch: str = Field(description="id of its batch")
    commit: str | None = Field(None, description="the commit of the code with which the batch was requested first")


class Provenance(Table):
    """`provenance.json`."""

    version: int = Field(VERSION, description="version of this file's format")
    queries: Mapping[str, PaperQuery] = Field(default_factory=dict, description="queries as they are declared")
    files: Mapping[str, PaperFile] = Field(default_factory=dict, description="files by path")


@dataclass(frozen=True, slots=True)
class Written:
    """The files of a paper after they were written."""

    changed: tuple[Path, ...]
    unchanged: int
    removed: tuple[Path, ...]
    edited: tuple[Path, ...]
    """Files that somebody edited; they are as they were."""


def read(folder: Path) -> Provenance | None:
    """Return the provenance of a folder; None if there is none. Raises Damaged for one that SIERRA does not write."""
    file = folder / PROVENANCE
    if not file.exists():
        return None
    with disk_errors(file):
        data = read_regular(file)
    try:
        content = json.loads(data)
        found = options(Provenance, content, str(file)) if isinstance(content, dict) else None
    except (ValueError, RecursionError) as error:
        raise Damaged(f"{file}: not JSON: {error}") from error
    if found is None or found.version != VERSION:
        raise Damaged(f"{file} is not of format {VERSION}; remove the folder, and make it again with: sierra paper")
    return found


def write(folder: Path, provenance: Provenance, contents: Mapping[str, bytes]) -> Written:
    """Write the files whose content has changed, and remove those that SIERRA wrote and that the provenance no longer has.

    `contents`: the files that were made; the others of the provenance stay as they are. Raises Missing if the folder cannot be
    written.
    """
    before = read(folder) or Provenance()
    edited = {name for name in contents if _is_edited(folder, name, before, contents[name])}
    changed, removed = [], []
    with disk_errors(folder):
        for name, content in contents.items():
            path = inside(folder, name)
            if name in edited or _sha256(path) == sha256(content):
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            changed.append(write_whole(path, content))
        for name, file in before.files.items():
            path = inside(folder, name)
            if name not in provenance.files and _sha256(path) == file.sha256:
                path.unlink()
                removed.append(path)
        text = json.dumps(provenance.model_dump(mode="json"), indent=1, sort_keys=True, ensure_ascii=False) + "\n"
        if _sha256(folder / PROVENANCE) != sha256(text.encode()):
            folder.mkdir(parents=True, exist_ok=True)
            changed.append(write_whole(folder / PROVENANCE, text.encode()))
    unchanged = len(provenance.files) - len(edited) - sum(path.name != PROVENANCE for path in changed)
    return Written(tuple(changed), unchanged, tuple(removed), tuple(folder / name for name in sorted(edited)))


def _is_edited(folder: Path, name: str, before: Provenance, content: bytes) -> bool:
    """Check if there is a file of this name that SIERRA did not write."""
    found = _sha256(inside(folder, name))
    known = before.files[name].sha256 if name in before.files else None
    return found is not None and found not in (known, sha256(content))


def faults(folder: Path, provenance: Provenance) -> Iterator[tuple[str, str]]:
    """Yield each file that is missing, or that is not the one that SIERRA wrote, and what is wrong with it."""
    for name, file in provenance.files.items():
        found = _sha256(inside(folder, name))
        if found is None:
            yield name, "is missing"
        elif found != file.sha256:
            yield name, "was edited: it is not the file that SIERRA wrote"


def _sha256(path: Path) -> str | None:
    """Return the SHA-256 of a file; None if there is none. Raises Missing if it cannot be read."""
    try:
        return sha256_file(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise Missing(f"{path}: cannot be read: {error.strerror}") from error
