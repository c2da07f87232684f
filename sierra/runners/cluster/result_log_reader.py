"""Reader of the result logs (packs) that attempts at elements write, while they grow.

See `sierra.worker.result_log` for the format.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from sierra.errors import Damaged
from sierra.model import Result
from sierra.runners.journal_reader import Stalled, made, result_of
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT
from sierra.store.segments import disk_errors
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.regular_files import open_regular
from sierra.worker import result_log
from sierra.worker.layout import OBSERVED

if TYPE_CHECKING:
    from sierra.worker.result_log import Other, Packed

CHUNK = 1 << 20
NOTHING = (0, hashlib.sha256().hexdigest())
"""The size and the SHA-256 of an empty log, which has no file."""


@dataclass(frozen=True, slots=True)
class Ended:
    """The end of a run whose files are in the result log."""

    result: Result
    """The result, without a directory."""
    files: tuple[tuple[str, int, str], ...]
    """Path, size and SHA-256 of each file, in the order of the payload."""
    at: int
    """Offset of the payload in the file."""

    def copy(self) -> Result:
        """Return the result with the digest of standard output, for a copy of a run, whose files are not extracted."""
        printed = ((size, sha256) for path, size, sha256 in self.files if path == RUN_STDOUT)
        return replace(self.result, printed=next(printed, NOTHING))


Event = result_log.Record | Stalled | Ended
KINDS: dict[str, Callable[..., Event]] = {**{event: kind for kind, event in result_log.EVENTS.items()}, "stalled": Stalled}


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
        with open_regular(self.path) as file:
            for record, at, after in result_log.records(file, self._offset):
                try:
                    event = self._event(record, at)
                except (TypeError, ValueError, LookupError) as error:
                    raise Damaged(f"{self.path}: contains a record of another version of SIERRA; use that version") from error
                self._offset = after
                if event is not None:
                    yield event

    def _event(self, record: Packed | Other, at: int) -> Event | None:
        if record["event"] == "end":
            return self._ended(record, at)
        kind = KINDS.get(record["event"])
        return made(kind, record) if kind else None

    def _ended(self, record: Packed, at: int) -> Ended:
        files = tuple((path, size, sha256) for path, size, sha256 in record["files"])
        result = result_of(record, directory="", attempt=self.attempt)
        if not {(f"{RUN_OUTPUT}/{file.path}", file.bytes, file.sha256) for file in result.outputs} <= set(files):
            raise ValueError("the record lists outputs that it does not contain")
        if result.observed and OBSERVED not in {path for path, _, _ in files}:
            raise ValueError("the record lacks the files that the run used")
        return Ended(result, files, at)

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
        with open_regular(self.path) as pack:
            pack.seek(ended.at)
            for path, size, sha256 in ended.files:
                if _copied(pack, self._place(folder, path), size) != sha256:
                    raise Damaged(f"{self.path}: {path!r} of run {ended.result.run} does not match its record")

    def _place(self, folder: Path, path: str) -> Path:
        """Return the path for a file, and create its folder."""
        parts = path.split("/")
        within = path in (RUN_STDOUT, RUN_STDERR, OBSERVED) or (parts[0] == RUN_OUTPUT and len(parts) > 1)
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
