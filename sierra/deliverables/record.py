"""Record deliverables: what each file shows, the hash of the data behind it, and the hash of the file.

A deliverable is recorded when it is made, unless its last record says the same. So the store knows which of its data a file
shows, and `check` can tell whether the file still follows from the store.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path

from sierra.errors import Damaged
from sierra.execution.sessions import Session
from sierra.store import deliverable_records, unfinished_files
from sierra.store.batch_data import BatchData
from sierra.store.lamport_clock import stamp
from sierra.store.row_types import DeliverableRow
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.util.fs import write_whole
from sierra.util.hashing import sha256_file
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.version import __version__


@dataclass(frozen=True, slots=True)
class Deliverable:
    """A deliverable: everything that its files depend on."""

    kind: str
    name: str
    batches: tuple[str, ...]
    definition: Mapping[str, JsonView]
    """The content and the look: also labels, units, notes and formats."""
    sql: str
    data: str
    """The hash of the data."""
    made_by: tuple[str, ...]
    """SIERRA and the libraries that make it, as name==version."""


class Recorder:
    """The records of a batch's deliverables. New ones are written to the store when it is closed."""

    def __init__(self, store: Store, root: Path, batch: str, frame: BatchData | None = None) -> None:
        """`frame`: a state of the store that is open already, to read the last records from."""
        self._store, self._root, self._batch = store, root, batch
        self._latest = deliverable_records.latest(frame or store, batch)
        self._new: list[DeliverableRow] = []

    def made(self, content: Deliverable) -> tuple[Path, ...] | None:
        """Return the files of a deliverable if they have been made from the same content and have not changed; else None."""
        for last in self._latest:
            same = (last.kind, last.name) == (content.kind, content.name)
            if same and self._row(content, last.files, last.sha256s).deliverable == last.deliverable:
                return tuple(self._root / file for file in last.files) if hashes(self._root, last) == last.sha256s else None
        return None

    def add(self, content: Deliverable, files: tuple[Path, ...]) -> None:
        """Record that these files were made, unless the last record says the same."""
        names = [file.relative_to(self._root).as_posix() for file in files]
        row = self._row(content, names, [sha256_file(file) for file in files])
        if all(last.deliverable != row.deliverable or last.files != row.files for last in self._latest):
            self._new.append(row)

    def close(self) -> None:
        """Write the new records. Raises Missing if the store cannot be written."""
        if not self._new:
            return
        session = Session(self._store.paths, logged=False)
        try:
            session.take_number()
            writer = self._store.writer(session.paths.segment, self._batch)
            position = stamp(session.number, session.id)
            writer.records(row._replace(lamport=position) for row in self._new)
            self._store.publish(writer)
        finally:
            session.close()
        self._new.clear()

    def _row(self, content: Deliverable, files: list[str], sha256s: list[str]) -> DeliverableRow:
        row = DeliverableRow(
            deliverable="",
            batch=self._batch,
            batches=list(content.batches),
            kind=content.kind,
            name=content.name,
            definition=defined(content),
            sql=content.sql,
            data=content.data,
            files=files,
            sha256s=sha256s,
            made_by=list(content.made_by),
            made=datetime.now(UTC),
            lamport=0,
        )
        return row._replace(deliverable=deliverable_records.deliverable_id(row))


def defined(content: Deliverable) -> str:
    """Return the definition of a deliverable as it is recorded."""
    return json.dumps(content.definition, ensure_ascii=False, sort_keys=True)


def marked_folder(mark: Path, content: str) -> Path:
    """Return the folder of a mark file, which is made unless it exists: with it, the folder does not count as source.

    Unfinished files that killed processes left there are removed.
    """
    if not mark.exists():
        with disk_errors(mark.parent):
            mark.parent.mkdir(parents=True, exist_ok=True)
            write_whole(mark, f"{content}\n".encode())
    for path in unfinished_files.unfinished_in(mark.parent):
        unfinished_files.remove(path)
    return mark.parent


ORIGIN = regex(rb"sierra (\S{1,40}) batch ([0-9a-f]{64}) data ([0-9a-f]{64})")
"""The line of `origin_of` in a file."""


def origin_of(batch: str, data: str, *others: str) -> str:
    """Return the line that every file of a deliverable contains, whatever its format; `data` is the hash of its data."""
    return " ".join([f"sierra {__version__} batch {batch} data {data}", *(f"with batch {other}" for other in others)])


@contextlib.contextmanager
def parsing(name: str) -> Iterator[None]:
    """Turn the errors of a definition that SIERRA does not write, but a stranger may have, into Damaged."""
    try:
        yield
    except (KeyError, TypeError, ValueError) as error:
        raise Damaged(f"the record of {name!r} has a definition that SIERRA does not write") from error


def other_version(row: DeliverableRow, version: int, remedy: str) -> str:
    """Return why a deliverable is not computed again: another version of the method made it; "" if this one did.

    Definitions have the version of the method that computes them; none is version 1.
    """
    with parsing(row.name):
        recorded = int({**json.loads(row.definition)}.get("version", 1))
    return (
        f"it is by version {recorded} of its method, and this SIERRA has version {version}; {remedy}"
        if recorded != version
        else ""
    )


def hashes(root: Path, row: DeliverableRow) -> list[str | None]:
    """Return the SHA-256 of each file of a deliverable; None for a file that cannot be read."""
    digests: list[str | None] = []
    for file in row.files:
        digests.append(None)
        with contextlib.suppress(OSError):
            digests[-1] = sha256_file(root / file)
    return digests
