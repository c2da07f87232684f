"""The outputs that a run has left: their hashes and counts, or why they cannot be read.

Outputs are counted, and read, by their apparent size: the size of a file with holes is its length.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import re
import shutil
from typing import Callable, Iterable, Iterator

from sierra.worker.errors import explain
from sierra.worker.files import CHUNK, HEAD_BYTES, entries_of, is_folder, remove, size_of, size_of_file, unlock
from sierra.worker.job import Limits
from sierra.worker.journal import OutputFile, Remains
from sierra.worker.layout import FOLDERS, LOGS, OBSERVED

EMPTY_LINE = re.compile(rb"(?<=\n)\r?\n")
MOST_NAMED = 10  # entries that a run leaves and that are neither files nor folders


class GivenUp(Exception):
    """The worker stops, and no longer reads the outputs of a run."""


def collect_outputs(
    folder: str,
    inputs: Iterable[str],
    limits: Limits,
    stopped: str | None,
    check_stop: Callable[[], None],
    spare: bool = False,
) -> Remains:
    """Return why a run was stopped (as far as its files show it), and its outputs or why they cannot be read.

    Folders that are no longer needed are removed, unless the run's folder is spare. The outputs of an interrupted run are not
    read, and neither are outputs beyond the limit. `check_stop` is called for each chunk that is read; it may raise GivenUp.
    """
    allowed = limits.get("output_bytes")
    outputs: list[OutputFile] = []
    other_entries: list[str] = []
    elsewhere: list[str] = []
    error = None
    try:
        if is_folder(folder):  # a run may have put a link here, which may lead to other people's files: do not touch it
            unlock(folder, 0o700)
            elsewhere = [] if spare else list(itertools.islice(written_elsewhere(folder, inputs), MOST_NAMED))
            for name in () if spare else ("home", "tmp"):
                remove(os.path.join(folder, name))
            files, other_entries = list_files(os.path.join(folder, "output"))
            if stopped is None and allowed is not None and size_of(folder) > allowed:
                stopped = "output"
            if stopped == "output" and allowed is not None:
                files = list(limited_to(files, allowed))
            outputs = list(described(files, check_stop)) if stopped != "interrupted" else []
    except GivenUp:
        stopped = "interrupted"
    except (OSError, RecursionError) as trouble:
        error = "its outputs cannot be read: " + explain(trouble)
    remains: Remains = {"stopped": stopped, "outputs": outputs, "error": error}
    if other_entries:
        remains["left_out"] = other_entries[:MOST_NAMED]
    if elsewhere:
        remains["elsewhere"] = elsewhere
    return remains


def written_elsewhere(folder: str, inputs: Iterable[str]) -> Iterator[str]:
    """Yield the files with content that a run has left in its folder, but not in `output`: beside its input, and in `home`.

    Hidden ones are left out: programs keep their settings and caches there.
    """
    own = {*inputs, *FOLDERS, *LOGS, OBSERVED}
    beside, home = entries_of(folder) - own, entries_of(os.path.join(folder, "home"))
    pending = [*(os.path.join("home", name) for name in sorted(home, reverse=True)), *sorted(beside, reverse=True)]
    while pending:
        name = pending.pop()
        path = os.path.join(folder, name)
        if name in own or os.path.basename(name).startswith("."):
            continue
        if is_folder(path):
            pending += [os.path.join(name, entry) for entry in sorted(entries_of(path), reverse=True)]
        elif not os.path.islink(path) and os.path.isfile(path) and size_of_file(path):
            yield name


def list_files(root: str) -> tuple[list[tuple[str, str]], list[str]]:
    """Return the regular files below `root` (path, and path relative to it) and all other entries but folders, sorted."""
    files, other_entries = [], []
    pending = [root] if is_folder(root) else []
    while pending:
        folder = pending.pop()
        unlock(folder, 0o700)
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    pending.append(entry.path)
                elif entry.is_file(follow_symlinks=False):
                    files.append((entry.path, os.path.relpath(entry.path, root)))
                else:
                    other_entries.append(os.path.relpath(entry.path, root))
    return sorted(files), sorted(other_entries)


def limited_to(files: Iterable[tuple[str, str]], most: int) -> Iterator[tuple[str, str]]:
    """Yield the files whose total size is at most `most` bytes, in order. A file that exceeds the rest is skipped."""
    for path, name in files:
        size = size_of_file(path)
        if size <= most:
            most -= size
            yield path, name


def described(files: Iterable[tuple[str, str]], check_stop: Callable[[], None]) -> Iterator[OutputFile]:
    """Yield the description of each file, with its hash. Makes a file readable if necessary."""
    for path, name in files:
        if os.lstat(path).st_nlink > 1:
            separate(path)
        try:
            yield describe(path, name, check_stop)
        except PermissionError:
            unlock(path, 0o400)
            yield describe(path, name, check_stop)


def separate(path: str) -> None:
    """Replace a file that has other names by a copy: who changes the file under another name would change this one."""
    unlock(path, 0o400)
    copy = os.path.join(os.path.dirname(path), "." + os.urandom(16).hex())
    shutil.copyfile(path, copy)
    shutil.copymode(path, copy)
    os.replace(copy, path)


def hashed(path: str | int) -> tuple[int, str]:
    """Return the size and the SHA-256 of a file."""
    size, digest = 0, hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        for chunk in iter(lambda: file.read(CHUNK), b""):
            digest.update(chunk)
            size += len(chunk)
    return size, digest.hexdigest()


def describe(path: str, name: str, check_stop: Callable[[], None] = lambda: None) -> OutputFile:
    """Return the description of a file. Calls `check_stop` for each chunk."""
    counts = Counts()
    check_stop()
    with open(path, "rb", buffering=0) as file:
        for chunk in iter(lambda: file.read(CHUNK), b""):
            check_stop()
            counts.add(chunk)
    return counts.report(name)


class Counts:
    """The hash of a file, fed in pieces, and its bytes, lines and quotes, from which the number of a table's rows follows.

    A file with a NUL in its first piece is not text: only its bytes and line feeds are counted, which is faster.
    """

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self._text = True
        self._head = b""
        self._size = self._lines = self._returns = self._pairs = self._quotes = self._blank = 0
        self._before = b"\n"  # the last two bytes; the beginning of a file is the beginning of a line

    def add(self, chunk: bytes) -> None:
        self._digest.update(chunk)
        if not self._size:
            self._head = chunk[:HEAD_BYTES].split(b"\n", 1)[0]
            self._text = b"\0" not in chunk
        self._size += len(chunk)
        self._lines += chunk.count(b"\n")
        if self._text:
            self._add_text(chunk)
        self._before = (self._before + chunk[-2:])[-2:]

    def _add_text(self, chunk: bytes) -> None:
        self._quotes += chunk.count(b'"')
        text = self._before + chunk
        returns = chunk.count(b"\r")
        if returns or self._before.endswith(b"\r"):
            self._returns += returns
            self._pairs += chunk.count(b"\r\n") + (self._before[-1:] + chunk[:1] == b"\r\n")
        if b"\n\n" in text or b"\n\r\n" in text:
            self._blank += sum(match.end() > len(self._before) for match in EMPTY_LINE.finditer(text))

    def report(self, name: str) -> OutputFile:
        file: OutputFile = {
            "path": name,
            "sha256": self._digest.hexdigest(),
            "bytes": self._size,
            "lines": self._lines,
            "ended": self._before.endswith(b"\n"),
            "head": self._head.decode("utf-8", "replace"),
        }
        if self._text:
            file["quotes"], file["blank"] = self._quotes, self._blank
            file["alike"] = self._returns == 0 or self._returns == self._pairs == self._lines
        return file
