"""The videos of a batch that are recorded and still there, for the page to play."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sierra.deliverables.explorer.tickets import Made, Tickets
from sierra.store import deliverable_records
from sierra.store.store import Store
from sierra.util.hashing import sha256_file
from sierra.util.json_types import JsonView

KIND = "video"
TYPES = {".mp4": "video/mp4", ".webm": "video/webm", ".gif": "image/gif"}


def videos(store: Store, root: Path, batch: str, tickets: Tickets) -> list[JsonView]:
    """Return the recorded videos of a batch: of each, the address of the first file that is as it was recorded, or why not."""
    return [
        {"name": row.name, **_video(root, dict(zip(row.files, row.sha256s, strict=True)), tickets)}
        for row in deliverable_records.latest(store, batch)
        if row.kind == KIND
    ]


def _video(root: Path, files: dict[str, str], tickets: Tickets) -> dict[str, JsonView]:
    for name, path, kind in _known(root, files):
        if sha256_file(path) == files[name]:
            return {"file": name, "address": tickets.issue(Made(kind, path)), "picture": kind == "image/gif"}
    return {"file": ", ".join(files), "problem": "the file is not there, or is not the recorded one"}


def _known(root: Path, files: dict[str, str]) -> Iterator[tuple[str, Path, str]]:
    """Yield the name, the path and the media type of each file that is a video within the project."""
    for name in files:
        path, kind = (root / name).resolve(), TYPES.get(Path(name).suffix)
        if kind and path.is_file() and path.is_relative_to(root.resolve()):
            yield name, path, kind
