"""The journal of a worker: its events, one line of JSON each.

They are appended to FOLDER/journal.jsonl, or to another file: `start` (process id and its start time, so that an orphan can be
recognised), `ready`, `stalled` and `end` (sierra.model.Result). An incomplete line counts as not written.

`started` is the clock's time just before the program was started. For a run that waited for its moment, it is the wall-clock
time of that moment plus the elapsed time by a monotonic clock. `ended` is `started` plus the elapsed time. So changes to the
system clock have no effect: no run has a negative duration, or a duration below its CPU time.
"""

from __future__ import annotations

import errno
import json
import os
import threading
from typing import TYPE_CHECKING, Callable, TypedDict, Union

from sierra.worker.files import CHUNK, write_all

if TYPE_CHECKING:
    from typing import Literal, NotRequired


class OutputFile(TypedDict):
    """A file that a run has left: see `sierra.model.OutputFile`."""

    path: str
    sha256: str
    bytes: int
    lines: int
    ended: bool
    head: str
    quotes: NotRequired[int]
    blank: NotRequired[int]
    alike: NotRequired[bool]


class Usage(TypedDict):
    """The resources that a run has used; None if this is unknown."""

    user_s: float | None
    system_s: float | None
    max_rss_bytes: int | None


UNUSED: Usage = {"user_s": 0.0, "system_s": 0.0, "max_rss_bytes": 0}


class Remains(TypedDict):
    """The outputs of a run that has ended, and why they are incomplete."""

    stopped: str | None
    outputs: list[OutputFile]
    error: str | None
    left_out: NotRequired[list[str]]
    elsewhere: NotRequired[list[str]]
    spare: NotRequired[bool]
    observed: NotRequired[bool]
    delay_s: NotRequired[float]
    left_running: NotRequired[list[str]]
    ports: NotRequired[list[int]]
    after_marker: NotRequired[float]
    gpus: NotRequired[list[str]]
    gpu_limit: NotRequired[float | None]
    gpu_s: NotRequired[float | None]
    gpu_memory_bytes: NotRequired[int | None]
    resumed: NotRequired[bool]


class Start(TypedDict):
    """The event that a run has begun."""

    event: Literal["start"]
    execution: str
    pid: int
    born: int | None


class Ready(TypedDict):
    """The event that a run is prepared, and waits for its moment."""

    event: Literal["ready"]
    execution: str


class Stalled(TypedDict):
    """The event that all processes of a run are stopped, or that it has not got its checkpoint (`unkept`: the reason)."""

    event: Literal["stalled"]
    run: str
    execution: str
    pid: int
    since: float
    unkept: NotRequired[str]


class Outcome(Usage, Remains):
    """The end of a run: see `sierra.model.Result`."""

    run: str
    execution: str
    started: float
    ended: float
    exit_code: int | None
    signal: int | None
    host: str
    slot: int


class End(Outcome):
    """The event that a run has ended."""

    event: Literal["end"]
    directory: str


Event = Union[Start, Ready, Stalled, End]
READY, BEGUN, ENDING, GONE, OVER = "r", "b", "e", "g", "o"
"""The states of a run that a worker announces at once: prepared, begun, told to end or ended, without a process, reported."""
Announce = Callable[[str], None]


class Journal:
    """A file to which lines are appended, each of them completely or not at all."""

    def __init__(self, path: str | None) -> None:
        """Open the file, or use standard output for `None`, which another process reads through a pipe."""
        flags = os.O_CREAT | os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC
        self._file = os.dup(1) if path is None else os.open(path, flags, 0o666)
        self._piped = path is None
        self._lock = threading.Lock()

    def write(self, event: Event, seal: str | None = None) -> None:
        line = json.dumps({**event, "seal": seal} if seal else event, separators=(",", ":")).encode() + b"\n"
        with self._lock:
            if self._piped:
                write_all(self._file, b"\n" + line)  # another process may have begun a line
                return
            written = os.write(self._file, line)
            if written != len(line):
                os.ftruncate(self._file, os.fstat(self._file).st_size - written)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "journal.jsonl")

    def close(self) -> None:
        os.close(self._file)


class GrowingJournal:
    """The events of a journal that another process writes, read while it grows."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._file: int | None = None
        self._offset = 0

    def read(self) -> list[Event]:
        """Return the next events. An incomplete line counts as not written, and may be removed."""
        if self._file is None:
            try:
                self._file = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
            except FileNotFoundError:
                return []
        data = more = os.pread(self._file, CHUNK, self._offset)
        while more and b"\n" not in data:
            more = os.pread(self._file, CHUNK, self._offset + len(data))
            data += more
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        return [json.loads(line) for line in whole.splitlines()]


def no_outputs(error: str | None, stopped: str | None = None) -> Remains:
    return {"stopped": stopped, "outputs": [], "error": error}
