"""The files of a project outside git, hashed like git would hash them.

A cache file in the store's folder keeps each file's hash with its times, size and inode, like git's index. Only files with
other values are read again. A file that was written less than two seconds before it was read is not cached: a second write
within the same tick of the file system's clock would not be visible. The clock of the file system is used, because this
machine's clock may differ. 50,000 files take 1.5 s the first time and 0.5 s afterwards.

A log of SIERRA's own output, or of another program, may grow between its listing and its recording. *What was hashed is
recorded*: the content of a file that was written just before is kept in memory (at most `KEPT_BYTES` in all), and of a file
that has only grown, the first bytes are read again.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from sierra.errors import Missing
from sierra.provenance.source.manifest import LINK, Entry, git_hash, is_blob, parts, read
from sierra.provenance.source.selection import PathSelection, check_size
from sierra.util.fs import read_sealed, write_whole
from sierra.util.hashing import sealed
from sierra.util.regular_files import open_regular, read_regular

LEFT_OUT = frozenset(
    (".git", ".hg", ".svn", "__pycache__", ".venv", "venv", "node_modules", ".mypy_cache", ".pytest_cache", ".ruff_cache")
)
"""Folders that never belong to the source of a project outside git."""
SETTLED_NS = 2_000_000_000
KEPT_BYTES = 1 << 24
"""Maximum size of all contents that a listing keeps."""
IGNORE_IT = "move it out of the project"

Memory = Mapping[bytes, bytes]
"""The cache by path: times, size and inode, then mode and hash."""
State = tuple[int, int, int, int] | None
"""Both times, the size and the inode of a file; None if there is no file."""


class ListedFile(NamedTuple):
    """A file as it was when it was listed."""

    state: State
    """For a link, the state of the file that it leads to."""
    content: bytes | None = None
    """The content that was hashed, if the file had just been written."""

    def hashed(self, content: bytes, blob: str) -> bytes | None:
        """Return the content with the hash `blob`, given the file's present content; None if it is lost."""
        if self.content is not None and is_blob(self.content, blob):
            return self.content
        grown_from = content[: self.state[2]] if self.state else content
        return next((bytes_then for bytes_then in (content, grown_from) if is_blob(bytes_then, blob)), None)


NOT_LISTED = ListedFile(None)


def state_of(path: bytes) -> State:
    """Return the state of a file, or of the file that a link leads to."""
    try:
        return _state(os.stat(path))  # noqa: PTH116 - for speed
    except OSError:
        return None


def entries(
    root: Path, chosen: PathSelection, large: int, memory: Path | None = None
) -> tuple[list[Entry], dict[bytes, ListedFile]]:
    """Return all files of the source, also as they were then, by path.

    Raises ConfigError for a file of more than `large` bytes, Missing if one is unreadable.
    """
    try:
        return _entries(root, chosen, large, memory)
    except OSError as error:
        raise Missing(f"cannot read {os.fsdecode(error.filename or root)}: {error.strerror}") from error


def contents(
    manifest: bytes, root: Path, known: Container[str], before: Mapping[bytes, ListedFile]
) -> Iterator[tuple[str, bytes]]:
    """Yield the git hash and content of each file that is not `known`; `before`: the files when they were listed.

    Raises Missing for a file that has changed since then, unless its content of that time is known.
    """
    for path, what in read(manifest).items():
        mode, blob = parts(what)
        file = root / os.fsdecode(path)
        if blob in known:
            continue
        listed = before.get(path, NOT_LISTED)
        try:
            present = os.fsencode(file.readlink()) if mode == LINK else read_regular(file)
        except OSError as error:
            if listed.content is None:
                raise Missing(f"cannot read {file}: {error.strerror}") from error
            present = listed.content
        content = listed.hashed(present, blob)
        if content is None:
            raise Missing(f"{file} changed while it was being recorded; run the command again")
        yield blob, content


def _entries(root: Path, chosen: PathSelection, large: int, memory: Path | None) -> tuple[list[Entry], dict[bytes, ListedFile]]:
    before = _remembered(memory)
    settled = _now(memory) - SETTLED_NS
    listing, after = [], {}
    listed: dict[bytes, ListedFile] = {}
    kept_bytes = 0
    for entry, path in _walk(root, chosen):
        status = entry.stat(follow_symlinks=False)
        seen = b"%d %d %d %d" % (status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino)
        is_settled = max(status.st_mtime_ns, status.st_ctime_ns) < settled
        state, kept = state_of(entry.path) if stat.S_ISLNK(status.st_mode) else _state(status), None
        known = before.get(path, b"")
        if known.startswith(seen + b" "):
            mode, blob = parts(known[len(seen) + 1 :])
        else:
            check_size(path, status.st_size, large, IGNORE_IT)
            mode, content = _read(entry, status)
            blob = git_hash(b"blob", content)
            if not is_settled and kept_bytes + len(content) <= KEPT_BYTES:
                kept, kept_bytes = content, kept_bytes + len(content)
        listing.append(Entry(mode, blob, path))
        listed[path] = ListedFile(state, kept)
        if is_settled:
            after[path] = b"%s %s %s" % (seen, mode.encode(), blob.encode())
    if memory is not None and after != before:
        with contextlib.suppress(OSError):  # without the cache, the next call is slower
            write_whole(memory, sealed(b"".join([b"%s\t%s\0" % (what, path) for path, what in after.items()])))
    return listing, listed


def _walk(root: Path, chosen: PathSelection) -> Iterator[tuple[os.DirEntry[bytes], bytes]]:
    pending = [(os.fsencode(root), b"")]
    while pending:
        folder, prefix = pending.pop()
        with os.scandir(folder) as inside:
            for entry in inside:
                path = prefix + entry.name
                if entry.is_dir(follow_symlinks=False):
                    if os.fsdecode(entry.name) not in LEFT_OUT and not chosen.never(path):
                        pending.append((entry.path, path + b"/"))
                elif not entry.name.endswith(b".pyc") and chosen(path) and (entry.is_symlink() or entry.is_file()):
                    yield entry, path


def _state(status: os.stat_result) -> State:
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino


def _read(entry: os.DirEntry[bytes], status: os.stat_result) -> tuple[str, bytes]:
    """Return the mode and the content of a file or link."""
    if stat.S_ISLNK(status.st_mode):
        return LINK, os.readlink(entry.path)  # noqa: PTH115 - bytes
    with open_regular(entry.path, buffering=0) as file:
        return "100755" if status.st_mode & 0o100 else "100644", file.read()


def _remembered(memory: Path | None) -> Memory:
    return {} if memory is None else read(read_sealed(memory))


def _now(memory: Path | None) -> int:
    """Return the file system's time in nanoseconds; 0 if it is unknown, so that nothing is cached."""
    if memory is None:
        return 0
    probe = memory.with_name(f"{memory.name}.{os.getpid()}")
    try:
        probe.touch()
        return probe.stat().st_mtime_ns
    except OSError:
        return 0
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
