"""The folder of a paper: its files are written if their content changes, and checked by `provenance.json`.

`provenance.json` has for each file its SHA-256, the deliverable, its batches and the hash of its data, and for each query its
batch with the tree of its code. It names no host and no time, so the same runs give the same bytes. A file that is not as
`provenance.json` says was edited by somebody: it is neither replaced nor removed. Before any file is written, `unfinished` gets
the hashes of those that will be, so that files of a killed process are known.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from pydantic import Field

from sierra.config.field_types import Table
from sierra.config.validate import options
from sierra.errors import Damaged, Missing, UsageError
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
    made_by: tuple[str, ...] = Field((), description="SIERRA and the libraries that made it, as name==version")


class PaperQuery(Table):
    """One query of a paper."""

    batch: str = Field(description="id of its batch")
    source: str | None = Field(None, description="the tree of the code, as an SWHID; null if the runs have no source")


class PaperClaim(Table):
    """One claim of a paper: one that a figure, a table or a number of the paper shows."""

    claim: str = Field(description="hash of the claim's normal form")
    registered: str = Field(description="`planned` or `exploratory`")


class Provenance(Table):
    """`provenance.json`."""

    version: int = Field(VERSION, description="version of this file's format")
    queries: Mapping[str, PaperQuery] = Field(default_factory=dict, description="queries as they are declared")
    claims: Mapping[str, PaperClaim] = Field(default_factory=dict, description="claims by name; left out if there are none")
    files: Mapping[str, PaperFile] = Field(default_factory=dict, description="files by path")
    unfinished: Mapping[str, str] = Field(default_factory=dict, description="SHA-256 of files that are being written")


@dataclass(frozen=True, slots=True)
class Written:
    """The files of a paper after they were written."""

    changed: tuple[Path, ...]
    unchanged: int
    removed: tuple[Path, ...]
    edited: tuple[Path, ...]
    """Files that somebody edited; they are as they were."""
    claims: Mapping[str, str]
    """For each claim of the paper: `planned` or `exploratory`."""


def read(folder: Path) -> Provenance | None:
    """Return the provenance of a folder; None if there is none. Raises Damaged for one that SIERRA does not write."""
    file = folder / PROVENANCE
    if not file.exists():
        return None
    with disk_errors(file):
        data = read_regular(file)
    try:
        content = json.loads(data)
        provenance = options(Provenance, content, str(file)) if isinstance(content, dict) else None
    except (ValueError, RecursionError) as error:
        raise Damaged(f"{file}: not JSON: {error}") from error
    if provenance is None or not isinstance(content, dict) or content.get("version") != VERSION:
        raise Damaged(f"{file} is not of format {VERSION}: another version of SIERRA wrote it, or it is no file of SIERRA's")
    return provenance


def check(folder: Path, root: Path, shown: str) -> None:
    """Check that a folder in the project `root` can be that of a paper: it has no files but those of `provenance.json`.

    Raises UsageError, and Damaged for a `provenance.json` that SIERRA does not write. `shown` is the folder in messages.
    """
    if folder.resolve() != root.resolve() / shown:
        raise UsageError(f"[paper] folder: {shown} is a symbolic link, or behind one; name a folder of the project")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"[paper] folder: {shown} is a file; name a folder")
    provenance = read(folder) or Provenance()
    known = {PROVENANCE, *provenance.files, *provenance.unfinished}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or (not path.is_dir() and name not in known and not path.name.startswith(".")):
            raise UsageError(
                f"{shown}/{name} is not a file of `sierra paper`, whose folder has no others: move it, or name another folder"
            )


def write(folder: Path, before: Provenance, provenance: Provenance, contents: Mapping[str, bytes]) -> Written:
    """Write the files whose content has changed, and remove those that SIERRA wrote and that the provenance no longer has.

    `before`: the provenance that the folder has; empty if it has none. `contents`: the files that were made; the others of the
    provenance stay as they are. Raises Missing if the folder cannot be written.
    """
    hashes = {name: _sha256(inside(folder, name)) for name in {*before.files, *before.unfinished, *contents}}
    own = {name: {before.unfinished.get(name)} for name in hashes}
    for name, file in before.files.items():
        own[name].add(file.sha256)
    wanted = {name: sha256(content) for name, content in contents.items()}
    edited = {name for name, digest in hashes.items() if digest not in (None, wanted.get(name), *own[name])}
    changing = [name for name in contents if name not in edited and hashes[name] != wanted[name]]
    gone = [name for name in hashes if name not in provenance.files and name not in edited and hashes[name] is not None]
    with disk_errors(folder):
        if changing or gone:
            begun = before.model_copy(update={"unfinished": {**before.unfinished, **{name: wanted[name] for name in changing}}})
            _write_provenance(folder, begun)
        changed = []
        for name in changing:
            path = inside(folder, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            changed.append(write_whole(path, contents[name]))
        for name in gone:
            inside(folder, name).unlink()
        if _write_provenance(folder, provenance) and provenance != before:
            changed.append(folder / PROVENANCE)
    unchanged = len(provenance.files.keys() - {*changing} - edited)
    return Written(
        tuple(changed),
        unchanged,
        tuple(folder / name for name in gone),
        tuple(folder / name for name in sorted(edited)),
        {name: claim.registered for name, claim in provenance.claims.items()},
    )


def _write_provenance(folder: Path, provenance: Provenance) -> bool:
    """Write `provenance.json`, unless it is so already; return whether it was written."""
    content = provenance.model_dump(
        mode="json", exclude={name for name in ("claims", "unfinished") if not getattr(provenance, name)}
    )
    text = json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    if _sha256(folder / PROVENANCE) == sha256(text.encode()):
        return False
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / PROVENANCE, text.encode())
    return True


def faults(folder: Path, provenance: Provenance) -> Iterator[tuple[str, str]]:
    """Yield each file that is missing, or that is not the one that SIERRA wrote, and what is wrong with it."""
    for name, file in provenance.files.items():
        digest = _sha256(inside(folder, name))
        if digest is None:
            yield name, "is missing"
        elif digest != file.sha256:
            yield name, "was edited: it is not the file that SIERRA wrote"


def _sha256(path: Path) -> str | None:
    """Return the SHA-256 of a file; None if there is none. Raises Missing if it cannot be read."""
    try:
        return sha256_file(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise Missing(f"{path}: cannot be read: {error.strerror}") from error
