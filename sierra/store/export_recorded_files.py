"""Export of recorded files into a folder; existing files are never overwritten.

    FOLDER/<experiment>/<number>/input/<name>     input files
    FOLDER/<experiment>/<number>/output/<path>    output files
    FOLDER/<experiment>/<number>/stdout, stderr   logs

<experiment> is the first ten digits of the experiment's id. <number> is the number of the run in the experiment. Names come
from runs, perhaps from someone else's store. Therefore links below FOLDER are not followed, and paths that lead out of
FOLDER are refused. Each file appears complete or not at all.
"""

from __future__ import annotations

import contextlib
import errno
import fnmatch
import os
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO

from sierra.errors import Damaged, Missing, NotFound, SierraError, UsageError
from sierra.store.recorded_files import (
    INPUT_FOLDER,
    OUTPUT_FOLDER,
    ChosenExecution,
    Recorded,
    check_objects,
    contents,
    recorded,
    take,
)
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass

NAMED_AT_MOST = 8
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True, slots=True)
class Listing:
    """The runs that an id names, and their recorded files."""

    kind: str
    id: str
    runs: tuple[ChosenExecution, ...]
    files: tuple[Recorded, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of exporting one file."""

    file: Recorded
    path: str
    """The path relative to the folder."""
    identical: bool
    """True if the bytes are exactly the run's: a log may have been cut."""
    failure: str | None = None
    """The reason why the file was not written."""


def listing(store: Store, prefix: str, patterns: Sequence[str] = (), *, check: bool = True) -> Listing:
    """Return the recorded files of an execution, a run, an experiment or a batch, by a prefix of its id.

    `patterns` are paths as in the listing, the same paths without `input/` or `output/`, or globs (`*` also matches slashes).
    Raises NotFound for a pattern that matches nothing. Without `check`, the list may be wrong if the store is damaged:
    it is for `content` and `extract`, which verify what they write.
    """
    resolved = store.resolve(prefix)
    with store.snapshot() as snapshot:
        runs = take(snapshot, resolved)
        files = recorded(snapshot, runs, check=check)
    return Listing(resolved.kind, resolved.id, tuple(runs), tuple(_chosen(files, patterns)))


def content(store: Store, file: Recorded, target: IO[bytes]) -> bool:
    """Write one file's bytes to `target`. Return True if they are exactly the bytes that the run had.

    Raises Damaged if they differ from the record; `target` has some of them by then.
    """
    with store.snapshot() as snapshot:
        file_content = next(contents(snapshot, [file]))
        for piece in file_content.pieces:
            target.write(piece)
        if not file_content.identical:
            check_objects(snapshot)
        return bool(file_content.identical)


def extract(store: Store, listed: Listing, folder: Path) -> Iterator[Outcome]:
    """Write these files into a folder and yield the outcome of each one. The folder is created if necessary.

    Raises UsageError if the folder is within the store, Missing if it cannot be created or the disk is full, and
    Damaged at the end if a file may be another one because the store is damaged.
    """
    if folder.resolve().is_relative_to(store.paths.root.resolve()):
        raise UsageError(f"{folder} is in the store itself; use another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        root = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise Missing(f"{folder}: {error.strerror}; files cannot be written there") from error
    try:
        with store.snapshot() as snapshot:
            failed = doubtful = False
            for file_content in contents(snapshot, listed.files):
                path = target_path(file_content.file)
                if file_content.file.is_dropped:
                    yield Outcome(file_content.file, path, identical=False, failure=file_content.file.remark)
                    doubtful = True  # it may be another file in a damaged store
                    continue
                failure = None
                try:
                    with _Whole(root, path) as target:
                        for piece in file_content.pieces:
                            target.write(piece)
                except SierraError as error:
                    failure = str(error)
                except OSError as error:
                    if error.errno in NO_ROOM:
                        raise Missing(f"{folder}: {error.strerror}; files that were already written stay") from error
                    failure = f"cannot be written: {error.strerror or error}"
                yield Outcome(file_content.file, path, bool(file_content.identical), failure)
                failed, doubtful = failed or failure is not None, doubtful or not file_content.identical
            if doubtful and not failed:
                check_objects(snapshot)
    finally:
        os.close(root)


def target_path(file: Recorded) -> str:
    """Return the path of an exported file, relative to the folder."""
    return f"{short(file.taken.experiment)}/{file.taken.number}/{file.path}"


def _chosen(files: Sequence[Recorded], patterns: Sequence[str]) -> Iterator[Recorded]:
    unused = set(patterns)
    listed = unused & {file.path for file in files}
    named = unused & {_name(file.path) for file in files}
    for file in files:
        matching = [p for p in patterns if _matches(file.path, p, listed=p in listed, named=p in named)]
        unused.difference_update(matching)
        if matching or not patterns:
            yield file
    if unused:
        names = list(dict.fromkeys(file.path for file in files))
        shown = ", ".join(map(repr, names[:NAMED_AT_MOST])) + (", …" if len(names) > NAMED_AT_MOST else "")
        raise NotFound(f"no recorded file {min(unused)!r}; recorded files: {shown or 'none'}")


def _matches(path: str, pattern: str, *, listed: bool, named: bool) -> bool:
    """Check if a pattern selects a file. A pattern that equals some file's path or name is taken literally, not as a glob."""
    if listed or named:
        return pattern == (path if listed else _name(path))
    return any(fnmatch.fnmatchcase(name, pattern) for name in (path, _name(path)))


def _name(path: str) -> str:
    return path.removeprefix(INPUT_FOLDER).removeprefix(OUTPUT_FOLDER)


class _Whole:
    """A context manager for a new file below an open folder. The file appears when it is complete; links are not followed.

    Raises Damaged for a path that leads out of the folder, UsageError if the target exists.
    """

    def __init__(self, root: int, path: str) -> None:
        self._path = path
        self._folders = path.split("/")
        self._name = self._folders.pop()
        if any(part in ("", ".", "..") or "\0" in part for part in (*self._folders, self._name)):
            raise Damaged("its recorded path leads outside the folder")
        self._unfinished = f".sierra-{os.urandom(8).hex()}"
        self._root = root

    def __enter__(self) -> IO[bytes]:
        self._folder = self._below()
        try:
            if self._is_there():
                raise UsageError("a file or folder of that name exists already, and is not overwritten")
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
            self._file = os.fdopen(os.open(self._unfinished, flags, 0o666, dir_fd=self._folder), "wb")
        except BaseException:
            os.close(self._folder)
            raise
        return self._file

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._file.close()
            if error is None:
                self._appear()
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self._unfinished, dir_fd=self._folder)
            os.close(self._folder)

    def _below(self) -> int:
        """Create and open the target folder, one step at a time from the root; return its descriptor."""
        flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
        folder = os.dup(self._root)
        for name in self._folders:
            above = folder
            try:
                with contextlib.suppress(FileExistsError):
                    os.mkdir(name, dir_fd=above)
                if stat.S_ISLNK(os.stat(name, dir_fd=above, follow_symlinks=False).st_mode):
                    raise UsageError(f"{name!r} in its path is a symbolic link, and links are not followed")
                folder = os.open(name, flags, dir_fd=above)
            finally:
                os.close(above)
        return folder

    def _appear(self) -> None:
        """Give the file its final name if that is free. A hard link never replaces an existing file."""
        try:
            os.link(self._unfinished, self._name, src_dir_fd=self._folder, dst_dir_fd=self._folder)
        except FileExistsError:
            raise UsageError("a file or folder of that name exists already, and is not overwritten") from None
        except OSError:  # a file system without hard links
            if self._is_there():
                raise UsageError("a file or folder of that name exists already, and is not overwritten") from None
            os.rename(self._unfinished, self._name, src_dir_fd=self._folder, dst_dir_fd=self._folder)

    def _is_there(self) -> bool:
        try:
            os.stat(self._name, dir_fd=self._folder, follow_symlinks=False)
        except FileNotFoundError:
            return False
        return True
