"""Records of what executions did with files, from what the worker observed."""

from __future__ import annotations

import os
import posixpath
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import NotRequired, TypedDict, cast

from sierra.model import Result
from sierra.store.row_types import ChannelRow, FileReadRow, FileWrittenRow, ListingRow, ObservationRow
from sierra.util.fs import read_record
from sierra.util.hashing import digest
from sierra.util.lazy_definitions import dataclass
from sierra.worker.layout import OBSERVED

WRITTEN = "written"
CONTINUED = "it continued from a checkpoint, and the execution that wrote it may have used other files"


class _Observed(TypedDict):
    """The worker's file: see `sierra.worker.observed_record.as_record`."""

    method: str
    reason: str | None
    notes: list[str]
    distributions: list[str]
    files: list[tuple[str, str, str | None, int | None]]
    listings: NotRequired[dict[str, list[str]]]
    """Sessions that an older version of SIERRA began have none."""
    channels: NotRequired[list[tuple[str, str]]]
    """None of a session that an older version of SIERRA began."""
    written: list[tuple[str, str]]
    digests: NotRequired[dict[str, list[int | str]]]


@dataclass(frozen=True, slots=True)
class Observed:
    """The records of one observed execution."""

    observation: ObservationRow
    read: tuple[FileReadRow, ...]
    listings: tuple[ListingRow, ...]
    written: tuple[FileWrittenRow, ...]
    channels: tuple[ChannelRow, ...]
    digests: Mapping[str, list[int | str]]
    """Hashes of files by the worker, as `HashCache.learn` accepts them; empty if they are of another machine."""

    def concerned(self, changed: Collection[str]) -> bool:
        """Check whether the execution may have used one of these files, or that is unknown.

        If a listed folder has the name of a changed file, the execution has seen the name that was there before.
        """
        if self.observation.reason is not None:
            return True
        if not ({row.path for row in self.read} | {row.path for row in self.written}).isdisjoint(changed):
            return True
        names = {row.sha256: frozenset(row.names) for row in self.listings}
        listed = {row.path: names.get(row.sha256 or "", frozenset()) for row in self.read if row.use == "listed"}
        return any(
            posixpath.basename(path) not in listed[folder] for path in changed if (folder := posixpath.dirname(path)) in listed
        )


def observed(result: Result) -> Observed | None:
    """Return the records of an execution; None if it was not observed."""
    record = _record(result)
    if record is None:
        return None
    files = [(recorded_name(name), use, sha256, size) for name, use, sha256, size in record["files"]]
    identity = file_set(files)
    lists = (list(map(recorded_name, texts)) for texts in (record["notes"], record["distributions"]))
    reason = record["reason"] or (CONTINUED if result.resumed else None)
    return Observed(
        ObservationRow(result.execution, identity, record["method"], reason, *lists),
        tuple(FileReadRow(identity, *file) for file in files),
        tuple(ListingRow(sha256, list(map(recorded_name, names))) for sha256, names in record.get("listings", {}).items()),
        tuple(FileWrittenRow(result.execution, recorded_name(name), use) for name, use in record["written"]),
        tuple(ChannelRow(result.execution, recorded_name(name), use) for name, use in record.get("channels", ())),
        record.get("digests", {}) if result.host == os.uname().nodename else {},
    )


def _record(result: Result) -> _Observed | None:
    """Return what the worker observed; None if it observed nothing, or the folder of an interrupted run is gone."""
    record = Path(result.directory, OBSERVED)
    return cast("_Observed", read_record(record)) if result.observed and record.is_file() else None


def file_set(files: Iterable[tuple[str, str, str | None, int | None]]) -> str:
    """Return the id of a set of files: a hash of their names, uses and SHA-256."""
    return digest("files", {"files": sorted({(name, use, sha256 or "") for name, use, sha256, _ in files})})


def written(result: Result) -> tuple[str, ...]:
    """Return the names of all files that an execution is known to have written, but not among its outputs."""
    own = tuple(map(recorded_name, result.elsewhere))
    record = _record(result)
    if record is None:
        return own
    return (*own, *(recorded_name(name) for name, use in record["written"] if use == WRITTEN))


def recorded_name(name: str) -> str:
    """Return a name in which escapes replace bytes that are not UTF-8."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
