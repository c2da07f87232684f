"""Record deliverables: what each file shows, the hash of the data behind it, and the hash of the file.

A deliverable is recorded when it is made, unless its last record says the same. So the store knows which of its data a file
shows, and `checked` can tell whether the file still follows from the store.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import ClassVar

from sierra.config.deliverable_tables import Comparison, Figure, TableForPaper
from sierra.config.field_types import Table
from sierra.config.validate import options
from sierra.deliverables import kinds
from sierra.errors import ConfigError, Damaged, DamagedFile, Missing, NotFound, SierraError
from sierra.execution.sessions import Session
from sierra.stats.comparison.model import VERSION
from sierra.store import deliverable_records, unfinished_files
from sierra.store.deliverable_records import Source
from sierra.store.lamport_clock import stamp
from sierra.store.row_types import DeliverableRow
from sierra.store.samples import Frame
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.util.fs import write_whole
from sierra.util.hashing import sha256, sha256_file, short
from sierra.util.json_types import JsonView
from sierra.util.regular_files import read_regular
from sierra.util.version import __version__


@dataclass(frozen=True, slots=True)
class Content:
    """The content of a deliverable: everything that its files depend on."""

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

    def __init__(self, store: Store, root: Path, batch: str, frame: Frame | None = None) -> None:
        """`frame`: a state of the store that is open already, to read the last records from."""
        self._store, self._root, self._batch = store, root, batch
        self._latest = deliverable_records.latest(frame or store, batch)
        self._new: list[DeliverableRow] = []

    def made(self, content: Content) -> tuple[Path, ...] | None:
        """Return the files of a deliverable if they have been made from the same content and have not changed; else None."""
        for last in self._latest:
            same = (last.kind, last.name) == (content.kind, content.name)
            if same and self._row(content, last.files, last.sha256s).deliverable == last.deliverable:
                return tuple(self._root / file for file in last.files) if _hashes(self._root, last) == last.sha256s else None
        return None

    def add(self, content: Content, files: tuple[Path, ...]) -> None:
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

    def _row(self, content: Content, files: list[str], sha256s: list[str]) -> DeliverableRow:
        row = DeliverableRow(
            deliverable="",
            batch=self._batch,
            batches=list(content.batches),
            kind=content.kind,
            name=content.name,
            definition=json.dumps(content.definition, ensure_ascii=False, sort_keys=True),
            sql=content.sql,
            data=content.data,
            files=files,
            sha256s=sha256s,
            made_by=list(content.made_by),
            made=datetime.now(UTC),
            lamport=0,
        )
        return row._replace(deliverable=deliverable_records.deliverable_id(row))


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


ORIGIN = re.compile(rb"sierra (\S{1,40}) batch ([0-9a-f]{64}) data ([0-9a-f]{64})")
"""The line of `origin_of` in a file."""
FIND = "SELECT * FROM deliverables WHERE list_contains(sha256s, $sha256) ORDER BY lamport DESC, made DESC LIMIT 1"


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


@dataclass(frozen=True, slots=True)
class Checked:
    """A recorded deliverable, and the reason if it no longer follows from the store."""

    kind: str
    name: str
    files: tuple[str, ...]
    problem: str | None
    """The reason, in one line; None if it follows."""


REMEDIES = {
    "report": "write it again with: sierra report",
    "comparison": "draw it again with: sierra compare",
}
"""The advice for a deliverable that does not follow from the store any more, by its kind."""
DRAW_AGAIN = "draw it again with: sierra figures"
"""The same for all other kinds."""
DECLARATIONS: Mapping[str, type[Table]] = {
    "figure": Figure,
    "table": TableForPaper,
    "comparison": Comparison,
}
"""The models of the declarations, by kind of deliverable; a definition has the declaration under the name of the kind."""
VERSIONS: Mapping[str, int] = {"comparison": VERSION}
"""The versions of how deliverables are computed, by kind; definitions have them as `version`, and none is version 1."""
FORMATS = "formats"
"""The key of definitions and declarations that says which files are made, and not what they show."""


def checked(
    store: Source, root: Path, batch: str, again: Callable[[DeliverableRow], Content], without: Collection[str] = ()
) -> Iterator[Checked]:
    """Yield each recorded deliverable of a batch with its state; `again` computes its content from the store as it is now.

    `without` are kinds that are not checked. If a deliverable was made in several formats at different times, it is yielded
    for each time. Files that were not made the last time count only if they still exist.
    """
    last = None
    for row in deliverable_records.latest(store, batch):
        if row.kind in without:
            continue
        kept = row if last != (row.kind, row.name) else _existing(row, root)
        last = (row.kind, row.name)
        if kept.files:
            yield Checked(row.kind, row.name, tuple(kept.files), _problem(kept, root, again))


def _existing(row: DeliverableRow, root: Path) -> DeliverableRow:
    """Return the record without files that were removed."""
    kept = [(file, sha256) for file, sha256 in zip(row.files, row.sha256s, strict=True) if (root / file).exists()]
    return row._replace(files=[file for file, _ in kept], sha256s=[sha256 for _, sha256 in kept])


@dataclass(frozen=True, slots=True)
class ShownDeliverable:
    """The record of a file that SIERRA made, and whether the file still follows from the store."""

    kind: ClassVar[str] = "deliverable"
    row: DeliverableRow
    problem: str | None

    def as_dict(self) -> dict[str, object]:
        row = {**self.row._asdict(), "definition": json.loads(self.row.definition)}
        row["deliverable_kind"] = row.pop("kind")
        return {"kind": self.kind, **row, "problem": self.problem}


def find(store: Store, root: Path, file: Path, again: Callable[[DeliverableRow], Content]) -> ShownDeliverable:
    """Return the record of a file, which is found by its content. Raises NotFound, or SierraError if it was changed."""
    with disk_errors(file):
        data = read_regular(file)
    rows = deliverable_records.rows(store, FIND, sha256=sha256(data))
    if rows:
        return ShownDeliverable(rows[0], _problem(rows[0], root, again))
    said = ORIGIN.search(data)
    if said is None:
        raise NotFound(f"{file} was not made by SIERRA, or was changed: it names no batch")
    version, batch, _ = (part.decode() for part in said.groups())
    raise SierraError(
        f"{file} says that SIERRA {version} made it from batch {short(batch)}, but no such file is recorded in this store: "
        "the file was changed, or it belongs to another store"
    )


def other_version(row: DeliverableRow) -> str:
    """Return why a deliverable is not computed again: another version of the method made it; "" if this one did."""
    with parsing(row.name):
        made = int({**json.loads(row.definition)}.get("version", 1))
    if made == (now := VERSIONS.get(row.kind, 1)):
        return ""
    return f"it is by version {made} of its method, and this SIERRA has version {now}; {REMEDIES.get(row.kind, DRAW_AGAIN)}"


def _problem(row: DeliverableRow, root: Path, again: Callable[[DeliverableRow], Content]) -> str | None:
    for file, recorded, found in zip(row.files, row.sha256s, _hashes(root, row), strict=True):
        if found is None:
            return f"{file} is missing"
        if found != recorded:
            return f"{file} is not the file that SIERRA made (SHA-256 {found[:10]} instead of {recorded[:10]})"
    if other := other_version(row):
        return other
    try:
        now = again(row)
    except (DamagedFile, Missing):
        raise
    except SierraError as error:
        return f"it can no longer be made: {error}"
    changed = _changed(row, now)
    added = kinds.find(row.kind)
    remedy = added.remedy if added else REMEDIES.get(row.kind, DRAW_AGAIN)
    return f"{changed}; {remedy}" if changed else None


def _changed(row: DeliverableRow, now: Content) -> str:
    """Return what a deliverable would show otherwise now: its data, or any part of its definition; "" if nothing."""
    before = json.loads(row.definition)
    if now.data != row.data:
        others = "the store or sierra.toml has changed since" if row.kind == "report" else "the store has other data now"
        return _changed_model(before, now.definition) or others
    parts = zip(_parts(row.kind, before), _parts(row.kind, json.loads(json.dumps(now.definition))), strict=True)
    changed = (name for old, new in parts for name in {**old, **new} if old.get(name) != new.get(name))
    differing = [name for name in dict.fromkeys(changed) if name != FORMATS]
    return f"sierra.toml changes how it is made: it has another {' and another '.join(differing)} now" if differing else ""


def _parts(kind: str, definition: Mapping[str, JsonView]) -> tuple[Mapping[str, JsonView], Mapping[str, JsonView]]:
    """Return a definition without its declaration, and the declaration with the defaults of its other keys.

    Only the labels of models are in it: their values are data, and another program may compute the same.
    """
    rest = {name: value for name, value in definition.items() if name != kind}
    if isinstance(models := rest.get("models"), Mapping):
        rest["models"] = {name: one.get("label") for name, one in models.items() if isinstance(one, Mapping)}
    declared = definition.get(kind)
    added = kinds.find(kind)
    model = added.declaration if added else DECLARATIONS.get(kind)
    if model is None or not isinstance(declared, Mapping):
        return rest, {}
    with contextlib.suppress(ConfigError):
        declared = options(model, dict(declared), kind).model_dump(mode="json", by_alias=True)
    return rest, declared


def _changed_model(before: Mapping[str, JsonView], now: Mapping[str, JsonView]) -> str:
    """Return which model of a figure predicts other values now, or is not drawn as before; "" if all are as they were."""
    old, new = (found if isinstance(found := one.get("models"), Mapping) else {} for one in (before, now))
    for name in {**old, **new}:
        was, found = (one.get(name) for one in (old, new))
        if not isinstance(was, Mapping):
            return f"model {name!r} belongs to it now"
        if not isinstance(found, Mapping):
            return f"model {name!r} does not belong to it any more"
        if was.get("data") != found.get("data"):
            problem = found.get("problem")
            return f"model {name!r} fails now: {problem}" if problem else f"model {name!r} predicts other values now"
    return ""


def _hashes(root: Path, row: DeliverableRow) -> list[str | None]:
    """Return the SHA-256 of each file of a deliverable; None for a file that cannot be read."""
    found: list[str | None] = []
    for file in row.files:
        found.append(None)
        with contextlib.suppress(OSError):
            found[-1] = sha256_file(root / file)
    return found
