"""Videos in a report: those that are small are played in the page, all are named.

A film may have several files, one for each format. The page has at most one of them: the first of `FORMATS` that is small
enough, and that is the recorded file by its SHA-256. A GIF would play for ever, so that readers unfold it to play it.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

from pydantic import BaseModel, ValidationError

from sierra.deliverables.report.parts import auto, details
from sierra.errors import Damaged
from sierra.store.row_types import DeliverableRow
from sierra.util.fs import inside
from sierra.util.hashing import sha256
from sierra.util.html_elements import Markup, element

FORMATS = {".mp4": "video/mp4", ".webm": "video/webm", ".gif": "image/gif"}
"""The types of the formats that a page can have, in the order in which they are preferred."""
LARGEST, IN_ALL = 2 << 20, 6 << 20
"""The largest size in bytes of a video in a page, and of all videos together."""
Read = Callable[[str, int], bytes | None]
"""A function that returns the content of a deliverable's file; None if there is none. Raises TooLarge above this many bytes."""


class TooLarge(Exception):
    """A file has more bytes than wanted."""


def from_project(root: Path) -> Read:
    """Return a function that reads files of a project by their names in records; none outside of it, also not by a link."""

    def read(name: str, most: int) -> bytes | None:
        try:
            file = inside(root, name)
            if not file.is_file():
                return None
            if file.stat().st_size > most:
                raise TooLarge(name)
            return file.read_bytes()
        except (OSError, Damaged):
            return None

    return read


class _Titled(BaseModel):
    title: str = ""


class _Definition(BaseModel):
    """The part of a definition that says what its files show."""

    files: dict[str, _Titled] = {}


class Films:
    """The videos that a page plays."""

    def __init__(self, read: Read) -> None:
        self._read = read
        self._left = IN_ALL

    def players(self, row: DeliverableRow) -> Iterator[Markup]:
        """Yield an element for each film of a deliverable of which a file is small enough."""
        hashes = dict(zip(row.files, row.sha256s, strict=True))
        caption = captions(row)
        for name, files in by_name(row.files).items():
            for file in files:
                if (data := self._taken(file, hashes[file])) is not None:
                    yield _player(caption(name), FORMATS[PurePosixPath(file).suffix], data)
                    break

    def _taken(self, file: str, recorded: str) -> bytes | None:
        """Return the content of a file if the page has room for it, and it is the recorded one."""
        try:
            data = self._read(file, min(LARGEST, self._left))
        except TooLarge:
            return None
        if data is None or sha256(data) != recorded:
            return None
        self._left -= len(data)
        return data


def by_name(files: Sequence[str]) -> Mapping[str, Sequence[str]]:
    """Return the playable files of each film, the preferred one first, by their name without ending."""
    playable: dict[str, list[str]] = {}
    for suffix in FORMATS:
        for file in files:
            if PurePosixPath(file).suffix == suffix:
                playable.setdefault(PurePosixPath(file).stem, []).append(file)
    return dict(sorted(playable.items()))


def captions(row: DeliverableRow) -> Callable[[str], str]:
    """Return a function that returns the caption of a film: its name, and the titles that its frames have.

    A stranger may have written the definition; then a caption is only the name.
    """
    try:
        definition = _Definition.model_validate_json(row.definition)
        whole = _Titled.model_validate(json.loads(row.definition).get(row.kind, {}))
    except ValidationError:
        definition, whole = _Definition(), _Titled()

    def caption(name: str) -> str:
        titles = ", ".join(filter(None, (whole.title, definition.files.get(name, _Titled()).title)))
        return f"{name}: {titles}" if titles else name

    return caption


def _player(caption: str, kind: str, data: bytes) -> Markup:
    address = f"data:{kind};base64,{base64.b64encode(data).decode()}"
    if kind.startswith("image/"):
        shown = details("Play the GIF; close it to stop", element("img", src=address, alt=f"Moving picture. {caption}"))
    else:
        label = f"Video. {caption}"
        shown = element("video", src=address, controls=True, loop=True, muted=True, preload="metadata", aria_label=label)
    return element("figure", shown, element("figcaption", auto(caption)), class_="film")
