"""Check whether figures, comparisons, reports and other deliverables that were made still follow from the store."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Collection, Mapping
from functools import cache, partial
from pathlib import Path
from typing import ClassVar

from sierra.config.deliverable_tables import Comparison, Figure, TableForPaper
from sierra.config.field_types import Table
from sierra.config.project_file import LoadedProject
from sierra.config.validate import options
from sierra.deliverables import comparison, comparison_figure, declared_tables, kinds, overlay, render
from sierra.deliverables.comparison import Compared
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.kinds import DeliverableKind
from sierra.deliverables.record import ORIGIN, Deliverable, hashes, other_version, parsing
from sierra.deliverables.report import recorded as reports
from sierra.deliverables.report.make import ReportSource
from sierra.deliverables.report.results import REPORT
from sierra.errors import ConfigError, DamagedFile, Missing, NotFound, SierraError
from sierra.stats.comparison.model import VERSION
from sierra.store import deliverable_records
from sierra.store.batch_data import BatchData
from sierra.store.row_types import DeliverableRow
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.util.hashing import sha256, short
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.regular_files import read_regular

Between = Callable[[str], Compared]
"""A function that makes a declared comparison of several batches, for the reports that show it."""
Kinds = Callable[[str], DeliverableKind | None]
"""A function that returns a kind of deliverables; None for one whose extension is not installed."""
LABELS = ("targets", "batches", "labels")
"""The keys of definitions with the names of several batches, which then are in the name of the files, too."""
NOT_SHOWN = ("formats", "query")
"""The keys of definitions and declarations that say which files are made, and of which batch; not what they show."""
FIND = "SELECT * FROM deliverables WHERE list_contains(sha256s, $sha256) ORDER BY lamport DESC, made DESC LIMIT 1"
CODE = regex(r"\S+\.py [0-9a-f]{32}")
"""A plug-in in a file of the project, with the hash of its code, as `made_by` has it."""
DRAW_AGAIN = "draw it again with: sierra figures"


@dataclass(frozen=True, slots=True)
class Checked:
    """A recorded deliverable, and the reason if it no longer follows from the store."""

    kind: str
    name: str
    files: tuple[str, ...]
    problem: str | None
    """The reason, in one line; None if it follows."""


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


def check(
    project: LoadedProject, store: Store, batch: str, between: Between | None = None, *, without: Collection[str] = ()
) -> list[Checked]:
    """Return whether each recorded deliverable of a batch still follows from the store, in the order of kinds and names.

    `without` are kinds that are not checked. If a deliverable was made in several formats at different times, it is there for
    each time. Files that were not made the last time count only if they still exist.
    """
    checked, last = [], None
    if all(row.kind in without for row in deliverable_records.latest(store, batch)):
        return []  # a frame of 100,000 runs takes long, and much memory
    with BatchData(store, batch) as frame:
        known = _kinds(between, cache(partial(Gallery, project, store, frame, only=frame.names)))
        for row in deliverable_records.latest(frame, batch):
            if row.kind in without:
                continue
            kept = row if last != (row.kind, row.name) else _existing(row, project.root)
            last = (row.kind, row.name)
            if kept.files:
                checked.append(Checked(row.kind, row.name, tuple(kept.files), _problem(project, store, known, kept)))
    return checked


def find(project: LoadedProject, store: Store, file: Path, between: Between | None = None) -> ShownDeliverable:
    """Return the record of a file, which is found by its content. Raises NotFound, or SierraError if it was changed."""
    with disk_errors(file):
        data = read_regular(file)
    rows = deliverable_records.rows(store, FIND, sha256=sha256(data))
    if rows:
        return ShownDeliverable(rows[0], _problem(project, store, _kinds(between), rows[0]))
    said = ORIGIN.search(data)
    if said is None:
        raise NotFound(f"{file} was not made by SIERRA, or was changed: it names no batch")
    version, batch, _ = (part.decode() for part in said.groups())
    raise SierraError(
        f"{file} says that SIERRA {version} made it from batch {short(batch)}, but no such file is recorded in this store: "
        "the file was changed, or it belongs to another store"
    )


def _kinds(between: Between | None, gallery: Callable[[], Gallery] | None = None) -> Kinds:
    """Return the kinds; `gallery` returns the data of the batch if they serve several figures."""

    def report(project: LoadedProject, store: Store, row: DeliverableRow) -> Deliverable:
        return reports.again(ReportSource(project, store, between), row)

    core = {
        render.KIND: DeliverableKind("figures", Figure, DRAW_AGAIN, partial(render.content, shared=gallery)),
        declared_tables.KIND: DeliverableKind("paper_tables", TableForPaper, DRAW_AGAIN, declared_tables.content),
        comparison.KIND: DeliverableKind(
            "comparisons", Comparison, comparison.AGAIN, comparison_figure.content, VERSION, _comparison
        ),
        REPORT: DeliverableKind("", None, reports.AGAIN, report),
        "numbers": DeliverableKind("numbers", None, "make it again with: sierra paper", _numbers),
    }
    return lambda kind: core.get(kind) or kinds.find(kind)


def _numbers(project: LoadedProject, store: Store, row: DeliverableRow) -> Deliverable:
    from sierra.deliverables.paper import bound_files
    from sierra.execution.batches_of_queries import BatchesOfQueries

    del row
    items = bound_files.items(BatchesOfQueries(project, store), "", {})
    return next(item.content for item in items if item.content.kind == bound_files.NUMBERS)


def _comparison(declared: Comparison) -> dict[str, JsonView]:
    declaration = declared.model_dump(mode="json")
    return {**declaration, "groups": declaration["groups"] if declaration["by"] else []}


def _as_declared(project: LoadedProject, kind: DeliverableKind, row: DeliverableRow) -> DeliverableRow:
    """Return a record with the declaration that `sierra.toml` has now; as it is, if there is none of this name."""
    with parsing(row.name):
        definition = json.loads(row.definition)
        labels = next((definition[key] for key in LABELS if key in definition), ())
        for name, declared in project.config.added(kind.table, {}).items():
            if row.name == (overlay.name_of(name, labels) if len(labels) > 1 else name):
                return row._replace(definition=json.dumps({**definition, row.kind: kind.recorded(declared)}))
    return row


def _existing(row: DeliverableRow, root: Path) -> DeliverableRow:
    """Return the record without files that were removed."""
    kept = [(file, sha256) for file, sha256 in zip(row.files, row.sha256s, strict=True) if (root / file).exists()]
    return row._replace(files=[file for file, _ in kept], sha256s=[sha256 for _, sha256 in kept])


def _problem(project: LoadedProject, store: Store, known: Kinds, row: DeliverableRow) -> str | None:
    """Return why a deliverable does not follow from the store any more, in one line; None if it follows."""
    for file, recorded, present in zip(row.files, row.sha256s, hashes(project.root, row), strict=True):
        if present is None:
            return f"{file} is missing"
        if present != recorded:
            return f"{file} is not the file that SIERRA made (SHA-256 {present[:10]} instead of {recorded[:10]})"
    kind = known(row.kind)
    if kind is None:
        return f"it can no longer be made: the extension that makes deliverables of kind {row.kind!r} is not installed"
    if other := other_version(row, kind.version, kind.remedy):
        return other
    try:
        now = kind.content(project, store, _as_declared(project, kind, row))
    except (DamagedFile, Missing):
        raise
    except SierraError as error:
        return f"it can no longer be made: {error}"
    changed = _changed(row, now, kind)
    return f"{changed}; {kind.remedy}" if changed else None


def _changed(row: DeliverableRow, now: Deliverable, kind: DeliverableKind) -> str:
    """Return what a deliverable would show otherwise now: its data, or any part of its definition; "" if nothing."""
    before = json.loads(row.definition)
    if now.data != row.data:
        others = "the store or sierra.toml has changed since" if kind.declaration is None else "the store has other data now"
        return _changed_model(before, now.definition) or others
    if changed_code := [text.partition(" ")[0] for text in now.made_by if CODE.fullmatch(text) and text not in row.made_by]:
        return f"{changed_code[0]} has changed since"
    definitions = before, json.loads(json.dumps(now.definition))
    parts = zip(*(_parts(row.kind, kind.declaration, definition) for definition in definitions), strict=True)
    changed = (name for old, new in parts for name in {**old, **new} if old.get(name) != new.get(name))
    differing = [name for name in dict.fromkeys(changed) if name not in NOT_SHOWN]
    return f"sierra.toml changes how it is made: it has another {' and another '.join(differing)} now" if differing else ""


def _parts(
    kind: str, model: type[Table] | None, definition: Mapping[str, JsonView]
) -> tuple[Mapping[str, JsonView], Mapping[str, JsonView]]:
    """Return a definition without its declaration, and the declaration with the defaults of its other keys.

    Only the labels of models are in it: their values are data, and another program may compute the same.
    """
    rest = {name: value for name, value in definition.items() if name != kind}
    if isinstance(models := rest.get("models"), Mapping):
        rest["models"] = {name: predicted.get("label") for name, predicted in models.items() if isinstance(predicted, Mapping)}
    declared = definition.get(kind)
    if model is None or not isinstance(declared, Mapping):
        return rest, {}
    with contextlib.suppress(ConfigError):
        declared = options(model, dict(declared), kind).model_dump(mode="json", by_alias=True)
    return rest, declared


def _changed_model(before: Mapping[str, JsonView], now: Mapping[str, JsonView]) -> str:
    """Return which model of a figure predicts other values now, or is not drawn as before; "" if all are as they were."""
    old, new = (models if isinstance(models := definition.get("models"), Mapping) else {} for definition in (before, now))
    for name in {**old, **new}:
        was, present = (models.get(name) for models in (old, new))
        if not isinstance(was, Mapping):
            return f"model {name!r} belongs to it now"
        if not isinstance(present, Mapping):
            return f"model {name!r} does not belong to it any more"
        if was.get("data") != present.get("data"):
            problem = present.get("problem")
            return f"model {name!r} fails now: {problem}" if problem else f"model {name!r} predicts other values now"
    return ""
