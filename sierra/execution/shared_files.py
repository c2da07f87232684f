"""Files of the project that lie beside the inputs in the folders of all runs: `files` in `sierra.toml`.

They have the same paths there as in the project. Their names, contents and executability are part of the run specification.
The store has each content once. A session copies them to a folder of its own, from the project if they are unchanged there,
and else from the store. The worker copies them from there to the folder of each run, so that no run can change those of
another; see `sierra.worker.shared_files`.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from sierra.config.project_file import Project
from sierra.errors import ConfigError, Damaged, Missing, NotFound
from sierra.provenance.hash_cache import HashCache
from sierra.store.layout import RUN_NAMES, STORE
from sierra.store.objects import Objects
from sierra.store.row_types import SharedFileRow
from sierra.store.store import Snapshot, Store
from sierra.util.fs import inside
from sierra.util.hashing import digest, sha256_file
from sierra.util.regular_files import open_regular
from sierra.util.text import one_line
from sierra.worker.shared_files import BESIDE_NS

LEFT_OUT = (STORE, ".git", "__pycache__")
CHUNK = 1 << 20


def find(project: Project, root: Path) -> tuple[SharedFileRow, ...]:
    """Return the files that `files` names now, without templates, in the order of their names. Raises ConfigError, Missing."""
    templates = {os.path.normpath(path) for path in project.template_paths}
    digests = HashCache()
    rows_by_name: dict[str, SharedFileRow] = {}
    for pattern in project.files:
        before = len(rows_by_name)
        names = [name for path in _below(root, pattern) if (name := str(path.relative_to(root))) not in templates]
        rows_by_name.update((name, _row(root, name, digests)) for name in names if name not in rows_by_name)
        if not names and len(rows_by_name) == before:
            folder = re.sub(r"/?[^/]*\{.*", "", pattern) or "."
            filled = f"; all runs get the same files: name the folder {folder!r} here, and {{run}}/{pattern} in the command"
            raise ConfigError(f"files: {pattern!r} matches no file of the project{filled if '{' in pattern else ''}")
    digests.save()
    rows = [rows_by_name[name] for name in sorted(rows_by_name)]
    identity = shared_id(rows)
    return tuple(row._replace(shared=identity) for row in rows)


def _below(root: Path, pattern: str) -> Iterator[Path]:
    """Yield the files that a path or a glob names, and those in folders that it names. Raises ConfigError for a link."""
    pattern = os.path.normpath(pattern)
    paths = sorted(root.glob(pattern)) if any(sign in pattern for sign in "*?[") else [root / pattern]
    for path in paths:
        relative = path.relative_to(root)
        if any((root / part).is_symlink() for part in (relative, *relative.parents)):
            raise ConfigError(f"files: {one_line(str(relative))} is a link, or in one; name the files themselves")
        if path.is_dir():
            for file in sorted(path.rglob("*")):
                if not set(LEFT_OUT).isdisjoint(file.relative_to(root).parts):
                    continue
                if file.is_symlink():
                    raise ConfigError(f"files: {one_line(str(file.relative_to(root)))} is a link; name the files themselves")
                if not file.is_dir():
                    yield file
        elif path.exists():
            yield path


def _row(root: Path, name: str, digests: HashCache) -> SharedFileRow:
    try:
        name.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"files: the name {one_line(name)} is not UTF-8; rename the file") from None
    status = (root / name).stat()
    if not stat.S_ISREG(status.st_mode):
        raise ConfigError(f"files: {one_line(name)} is not a file")
    if (first := name.split("/")[0]) in RUN_NAMES:
        raise ConfigError(
            f"files: {one_line(name)}: the folder of a run has its own {first!r}; move the file to another folder"
        )
    executable = bool(status.st_mode & stat.S_IXUSR)
    return SharedFileRow("", name, digests.of(str(root / name)), status.st_size, executable)


def shared_id(rows: Iterable[SharedFileRow]) -> str:
    """Return the id of a set of shared files."""
    return digest("shared files", {"files": sorted([row.name, row.sha256, row.executable] for row in rows)})


def keep(rows: Sequence[SharedFileRow], root: Path, objects: Objects, known: Iterable[str]) -> None:
    """Add the contents that the store does not know. Raises Missing for a file that has changed since it was hashed."""
    there = set(known)
    for row in rows:
        if row.sha256 not in there:
            path = root / row.name
            if sha256_file(path) != row.sha256:
                raise Missing(f"files: {row.name} has changed meanwhile; run the command again")
            objects.add_file(path, row.sha256, row.size)


def stored(rows: Sequence[SharedFileRow], snapshot: Snapshot) -> set[str]:
    """Return the SHA-256 of those files whose content the store has."""
    return set(snapshot.kept_sizes(row.sha256 for row in rows)) if rows else set()


def recorded(store: Store, shared: str) -> list[SharedFileRow]:
    """Return the recorded files of a set. Raises Damaged."""
    rows = store.select(SharedFileRow, "SELECT * FROM shared_files WHERE shared = $s ORDER BY name", s=shared)
    if shared_id(rows) != shared:
        raise Damaged(f"the list of the files {shared[:10]} beside the inputs of runs is damaged")
    return rows


def make(rows: Sequence[SharedFileRow], folder: Path, root: Path, store: Store) -> None:
    """Copy the files to a session's folder, unless it exists. Raises Damaged or NotFound if one is not in the store either."""
    if folder.exists():
        return
    part = folder.with_name(folder.name + ".part")
    part.mkdir(exist_ok=True)
    for row in rows:
        path = inside(part, row.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        if not _copied(root / row.name, path, row.sha256):
            try:
                path.write_bytes(store.object(row.sha256))
            except NotFound as error:
                raise Damaged(f"{row.name}, a file beside the inputs of runs, is not in the store") from error
        path.chmod(0o555 if row.executable else 0o444)
        os.utime(path, ns=(BESIDE_NS, BESIDE_NS))
    part.rename(folder)


def _copied(path: Path, to: Path, sha256: str) -> bool:
    """Copy a file of the project if it has this content; return whether it had it."""
    found = hashlib.sha256()
    with suppress(OSError):
        with open_regular(path) as file, to.open("wb") as copy:
            while chunk := file.read(CHUNK):
                found.update(chunk)
                copy.write(chunk)
        return found.hexdigest() == sha256
    return False
