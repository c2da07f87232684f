"""What attempts at elements have recorded, read while it grows: see `sierra.worker.array_task` for the format."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

from sierra.errors import Damaged
from sierra.model import OutputFile, Result
from sierra.runners.journal import Stalled
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT
from sierra.store.segments import disk_errors
from sierra.worker import array_task

CHUNK = 1 << 20


@dataclass(frozen=True, slots=True)
class Attempt:
    """The first record: where and with what an attempt began. Fields as in the event `attempt`."""

    attempt: str
    session: str
    element: int
    job: str
    """The task, as its scheduler calls it: `12_3`, `12[3].server`; empty without one."""
    node: str
    started: float
    """By the node's clock, in seconds since the epoch; so are all times here."""
    slots: int
    """Runs that execute at a time: those that were asked for, but no more than there are cores to be used."""
    cpus: int
    """Cores that were allotted."""
    memory: int | None
    gpus: str | None
    allocation: Mapping[str, str]
    facts: Mapping[str, Any]
    variables: Mapping[str, str]
    python: str
    clock: float
    """Seconds that the node's clock is ahead of the shared file system's."""


@dataclass(frozen=True, slots=True)
class Started:
    """A run has begun."""

    execution: str
    time: float
    alone: bool = False
    """Whether it has the element for itself."""


@dataclass(frozen=True, slots=True)
class Ended:
    """A run has ended, and its files are in the pack."""

    result: Result
    """Without a directory."""
    files: tuple[tuple[str, int, str], ...]
    """Path, size and SHA-256 of each, in the order of the payload."""
    at: int
    """Where in the pack the payload begins."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """The attempt could not go on."""

    reason: str
    full: bool = False
    """Whether a disk had no room: no run is to blame."""


@dataclass(frozen=True, slots=True)
class Finished:
    """All that was missing of the element has been executed."""

    time: float


@dataclass(frozen=True, slots=True)
class Requeued:
    """The attempt asked its scheduler to be begun anew, before its time is over."""

    time: float
    refused: str | None = None
    """Why the scheduler does not do that."""


Event = Attempt | Requeued | Started | Stalled | Ended | Trouble | Finished


class Pack:
    """One attempt's file, read on from where reading stopped."""

    def __init__(self, path: Path) -> None:
        """`path` is named `INDEX.ATTEMPT.pack`, or `probe.ATTEMPT.pack`."""
        self.path = path
        name, _, self.attempt = path.name.removesuffix(".pack").partition(".")
        self.element = int(name) if name.isdigit() else None
        """None for a probe."""
        self._offset = 0

    def read(self) -> Iterator[Event]:
        """All whole records since the last reading; payloads are passed over, not read.

        Nothing after a damaged record is told of; on a network file system its bytes are perhaps not there yet, and the next
        reading tells of it. Raises OSError where the file can't be read, Damaged where it was written in another format.
        """
        with self.path.open("rb") as file:
            for record, at, after in array_task.records(file, self._offset):
                try:
                    event = self._event(record, at)
                except (TypeError, ValueError, LookupError) as error:
                    raise Damaged(f"{self.path}: has a record of another version of SIERRA; read it with that one") from error
                self._offset = after
                if event is not None:
                    yield event

    def _event(self, record: Mapping[str, Any], at: int) -> Event | None:
        fields = dict(record)
        match fields.pop("event"):
            case "attempt":
                return Attempt(**fields)
            case "start":
                return Started(**fields)
            case "requeue":
                return Requeued(**fields)
            case "stalled":
                return Stalled(**fields)
            case "end":
                return self._ended(fields, at)
            case "trouble":
                return Trouble(**fields)
            case "finished":
                return Finished(**fields)
            case _:
                return None

    def _ended(self, fields: dict[str, Any], at: int) -> Ended:
        files = tuple((path, size, sha256) for path, size, sha256 in fields.pop("files"))
        fields["outputs"] = tuple(OutputFile(**file) for file in fields["outputs"])
        fields["left_out"] = tuple(fields.get("left_out", ()))
        if not {(f"{RUN_OUTPUT}/{file.path}", file.bytes, file.sha256) for file in fields["outputs"]} <= set(files):
            raise ValueError("it tells of outputs that are not in it")
        del fields["size"]
        return Ended(Result(directory="", attempt=self.attempt, **fields), files, at)

    def extract(self, ended: Ended, folder: Path) -> Result:
        """Write a run's files to a folder; the result with that directory.

        There is no more in it than was packed: no log that is empty, and no folder where the run has left nothing. Raises
        Damaged where the bytes are not those that were recorded (on a network file system, perhaps not yet) or a path leads
        elsewhere, Missing where there is no room; no folder is left then.
        """
        if ended.files:
            folder.mkdir()
            try:
                with disk_errors(folder):
                    self._extract(ended, folder)
            except BaseException:
                shutil.rmtree(folder, ignore_errors=True)
                raise
        return replace(ended.result, directory=str(folder))

    def _extract(self, ended: Ended, folder: Path) -> None:
        with self.path.open("rb") as pack:
            pack.seek(ended.at)
            for path, size, sha256 in ended.files:
                if _copied(pack, self._place(folder, path), size) != sha256:
                    raise Damaged(f"{self.path}: {path!r} of run {ended.result.run} is not as it was recorded")

    def _place(self, folder: Path, path: str) -> Path:
        """Where a file goes; its folder is made."""
        parts = path.split("/")
        within = path in (RUN_STDOUT, RUN_STDERR) or (parts[0] == RUN_OUTPUT and len(parts) > 1)
        if not within or "\0" in path or not {"", ".", ".."}.isdisjoint(parts):
            raise Damaged(f"{self.path}: {path!r} does not lie in a run's folder")
        place = Path(folder, os.fsdecode(path.encode("utf-8", "surrogateescape")))
        place.parent.mkdir(parents=True, exist_ok=True)
        return place


def _copied(pack: BinaryIO, place: Path, size: int) -> str:
    """Copy so many bytes; the SHA-256 of those that there were."""
    digest = hashlib.sha256()
    with place.open("wb") as file:
        while size and (chunk := pack.read(min(size, CHUNK))):
            digest.update(chunk)
            file.write(chunk)
            size -= len(chunk)
    return digest.hexdigest()
