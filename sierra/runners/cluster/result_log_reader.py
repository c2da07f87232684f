"""Reader of the result logs (packs) that attempts at elements write, while they grow.

See `sierra.worker.array_task` for the format.
"""

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
from sierra.runners.journal_reader import Stalled
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT
from sierra.store.segments import disk_errors
from sierra.worker import array_task

CHUNK = 1 << 20


@dataclass(frozen=True, slots=True)
class Attempt:
    """The first record: where and with what an attempt began. The fields are those of the event `attempt`."""

    attempt: str
    session: str
    element: int
    job: str
    """The task's id in its scheduler, for example `12_3` or `12[3].server`; empty without a scheduler."""
    node: str
    started: float
    """By the node's clock, in seconds since the epoch, like all times in this module."""
    slots: int
    """Number of runs that execute at a time: the requested number, but at most the number of usable cores."""
    cpus: int
    """Number of allocated cores."""
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
    """The start of a run."""

    execution: str
    time: float
    alone: bool = False
    """True if the run has the element for itself."""


@dataclass(frozen=True, slots=True)
class Ended:
    """The end of a run whose files are in the result log."""

    result: Result
    """The result, without a directory."""
    files: tuple[tuple[str, int, str], ...]
    """Path, size and SHA-256 of each file, in the order of the payload."""
    at: int
    """Offset of the payload in the file."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """The reason why the attempt could not go on."""

    reason: str
    full: bool = False
    """True if a disk was full, so that no run is the cause."""


@dataclass(frozen=True, slots=True)
class Finished:
    """The end of an attempt that has executed all missing runs of its element."""

    time: float


@dataclass(frozen=True, slots=True)
class Requeued:
    """The attempt's request to its scheduler to start the task again, because its time is nearly over."""

    time: float
    refused: str | None = None
    """The reason why the scheduler refuses; None if it does not."""


Event = Attempt | Requeued | Started | Stalled | Ended | Trouble | Finished


class Pack:
    """One attempt's file. Each reading continues where the last one stopped."""

    def __init__(self, path: Path) -> None:
        """Open the result log at `path`, named `INDEX.ATTEMPT.pack` or `probe.ATTEMPT.pack`."""
        self.path = path
        name, _, self.attempt = path.name.removesuffix(".pack").partition(".")
        self.element = int(name) if name.isdigit() else None
        """None for a preflight job."""
        self._offset = 0

    def read(self) -> Iterator[Event]:
        """Yield all complete records since the last reading. Payloads are skipped.

        Reading stops at a damaged record: on a network file system, its bytes may not have arrived yet, and the next reading
        tries again. Raises OSError if the file cannot be read, and Damaged if it was written in another format.
        """
        with self.path.open("rb") as file:
            for record, at, after in array_task.records(file, self._offset):
                try:
                    event = self._event(record, at)
                except (TypeError, ValueError, LookupError) as error:
                    raise Damaged(f"{self.path}: contains a record of another version of SIERRA; use that version") from error
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
            raise ValueError("the record lists outputs that it does not contain")
        del fields["size"]
        return Ended(Result(directory="", attempt=self.attempt, **fields), files, at)

    def extract(self, ended: Ended, folder: Path) -> Result:
        """Write a run's files to a folder, and return the result with that directory.

        Only recorded files are written: an empty log has no file, and a run that left nothing has no folder. Raises Damaged if
        the bytes do not match their record (on a network file system, they may not have arrived yet) or if a path leads out of
        the folder. Raises Missing if the disk is full. No folder is left then.
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
                    raise Damaged(f"{self.path}: {path!r} of run {ended.result.run} does not match its record")

    def _place(self, folder: Path, path: str) -> Path:
        """Return the path for a file, and create its folder."""
        parts = path.split("/")
        within = path in (RUN_STDOUT, RUN_STDERR) or (parts[0] == RUN_OUTPUT and len(parts) > 1)
        if not within or "\0" in path or not {"", ".", ".."}.isdisjoint(parts):
            raise Damaged(f"{self.path}: {path!r} is not in a run's folder")
        place = Path(folder, os.fsdecode(path.encode("utf-8", "surrogateescape")))
        place.parent.mkdir(parents=True, exist_ok=True)
        return place


def _copied(pack: BinaryIO, place: Path, size: int) -> str:
    """Copy `size` bytes, or fewer if the file ends; return the SHA-256 of the copied bytes."""
    digest = hashlib.sha256()
    with place.open("wb") as file:
        while size and (chunk := pack.read(min(size, CHUNK))):
            digest.update(chunk)
            file.write(chunk)
            size -= len(chunk)
    return digest.hexdigest()
