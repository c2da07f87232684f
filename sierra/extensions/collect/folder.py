"""The folder that `sierra run --inputs` wrote, once another system has executed its runs. Nothing in it is trusted.

A file is read only if neither it nor a folder above it is a link, and if it is a regular file. `ended.json` in a run's folder
says how the run has ended. `execute.sh` writes it, and so may any other program:

    format    1
    run       the run's id, as in manifest.csv
    status    exit status as a shell has it: 128 + N if the signal N ended the program
    started   seconds since the epoch; also `ended`
    host      host name; `system`, `release` and `machine` are those of `uname`, `cores` is the number of cores
"""

from __future__ import annotations

import errno
import json
import math
import os
import signal
import stat
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from sierra.execution.write_inputs import ENDED
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT
from sierra.util.hashing import sha256
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass
from sierra.worker.errors import explain

FORMAT = 1
MOST_BYTES = 1 << 16
"""The size of an `ended.json`, at most."""
LONGEST = 256
"""The number of characters of a fact, at most."""
AHEAD_S = 3600.0
"""The seconds that a clock elsewhere may be ahead of this machine's."""
FACTS = ("host", "system", "release", "machine")
SIGNALS = frozenset(map(int, signal.valid_signals()))
OF_SIGNALS = 128


class Refused(Exception):
    """A run cannot be collected; the message says why."""


@dataclass(frozen=True, slots=True)
class Ended:
    """The record of the end of a run."""

    run: str
    status: int
    started: float
    """Seconds since the epoch."""
    ended: float
    facts: Mapping[str, str]
    """The facts about the machine that `FACTS` lists; unknown ones are empty."""
    cores: int
    """The number of cores; 0 if it is unknown."""
    sha256: str
    """The SHA-256 of the file."""

    def outcome(self, statuses: Collection[int]) -> tuple[int | None, int | None]:
        """Return the exit status and the signal, of which one is None. `statuses` are exit statuses that have a meaning."""
        number = self.status - OF_SIGNALS
        return (None, number) if number in SIGNALS and self.status not in statuses else (self.status, None)


@contextmanager
def opened(root: Path, name: str) -> Iterator[int]:
    """Open a folder below `root`; no part of its name may be a link. Raises OSError."""
    folder = os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for part in PurePosixPath(name).parts:
            outer, folder = folder, os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
            os.close(outer)
        yield folder
    finally:
        os.close(folder)


def open_file(folder: int, name: str) -> BinaryIO:
    """Open a regular file in an open folder; links, pipes and devices are errors. Raises OSError."""
    descriptor = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EOPNOTSUPP, "it is not a regular file", name)
    return os.fdopen(descriptor, "rb")


def read(root: Path, name: str, most: int) -> bytes:
    """Return the content of a file below `root`, and of a larger one only one byte more than `most`. Raises OSError."""
    path = PurePosixPath(name)
    with opened(root, str(path.parent)) as folder, open_file(folder, path.name) as file:
        return file.read(most + 1)


def files_left(root: Path, run: str) -> Iterator[tuple[str, BinaryIO | None]]:
    """Yield the paths of all entries below the folder for outputs of a run, each with the open file; None if it is not a file.

    Each file is closed when the next one is requested. Raises Refused if they cannot be read.
    """
    try:
        with opened(root, f"{run}/{RUN_OUTPUT}") as top:
            for path, folders, names, folder in os.fwalk(".", onerror=_raise, follow_symlinks=False, dir_fd=top):
                inner = [name for name in folders if not _is_link(name, folder)]
                yield from ((os.path.normpath(f"{path}/{name}"), None) for name in sorted(set(folders) - set(inner)))
                folders[:] = sorted(inner)
                for name in sorted(names):
                    relative = os.path.normpath(f"{path}/{name}")
                    if not stat.S_ISREG(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode):
                        yield relative, None
                        continue
                    with open_file(folder, name) as file:
                        yield relative, file
    except (OSError, RecursionError) as error:
        raise Refused(f"its outputs cannot be read: {explain(error)}") from error


def logs_left(root: Path, run: str) -> Iterator[tuple[str, BinaryIO]]:
    """Yield the names of the logs of a run, each with the open file, as `files_left`. Raises Refused if one cannot be read."""
    for name in (RUN_STDOUT, RUN_STDERR):
        try:
            with opened(root, run) as folder, open_file(folder, name) as file:
                yield name, file
        except FileNotFoundError:
            pass
        except OSError as error:
            raise Refused(f"{name} cannot be read: {error.strerror}") from error


def _raise(error: OSError) -> None:
    raise error


def _is_link(name: str, folder: int) -> bool:
    return stat.S_ISLNK(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode)


def has_ended(root: Path, run: str) -> bool:
    """Check whether something says that the run in this folder has ended."""
    return os.path.lexists(root / run / ENDED)


def read_ended(root: Path, run: str) -> Ended:
    """Return the record of the end of the run in this folder. Raises Refused."""
    try:
        data = read(root, f"{run}/{ENDED}", MOST_BYTES)
    except OSError as error:
        raise Refused(f"{ENDED} cannot be read: {error.strerror}") from error
    if len(data) > MOST_BYTES:
        raise Refused(f"{ENDED} is larger than {MOST_BYTES} bytes")
    try:
        record = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise Refused(f"{ENDED} is not JSON: it is damaged or incomplete") from error
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise Refused(f'{ENDED} needs "format": {FORMAT}')
    return _checked(record, sha256(data))


def _checked(record: Mapping[str, JsonView], digest: str) -> Ended:
    run, status = record.get("run"), record.get("status")
    if not isinstance(run, str):
        raise Refused(f'{ENDED} needs "run", the id of the run')
    if not isinstance(status, int) or isinstance(status, bool) or not 0 <= status <= 255:
        raise Refused(f'{ENDED} needs "status", an exit status from 0 to 255')
    started, ended = (_seconds(record, name) for name in ("started", "ended"))
    if ended < started:
        raise Refused(f'{ENDED}: "ended" is before "started"')
    if ended > time.time() + AHEAD_S:
        raise Refused(f'{ENDED}: "ended" is in the future')
    cores = record.get("cores")
    if not isinstance(cores, int) or isinstance(cores, bool) or not 0 < cores < 1 << 31:
        cores = 0
    return Ended(run, status, started, ended, {name: _fact(record, name) for name in FACTS}, cores, digest)


def _seconds(record: Mapping[str, JsonView], name: str) -> float:
    value = record.get(name)
    try:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0:
            return float(value)
    except OverflowError:  # an integer that is too large for a float
        pass
    raise Refused(f'{ENDED} needs "{name}", in seconds since the epoch')


def _fact(record: Mapping[str, JsonView], name: str) -> str:
    value = record.get(name, "")
    if not isinstance(value, str) or len(value) > LONGEST or not (value.isprintable()):
        raise Refused(f'{ENDED}: "{name}" should be a text of at most {LONGEST} printable characters')
    return value
