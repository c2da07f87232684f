"""The files of a session that go to hosts, with the paths that they have there, and the result logs that come back."""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic_core import to_json

from sierra.errors import Damaged
from sierra.extensions.lab.agent.host_folder import Record
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import regex
from sierra.worker import result_log

LOG = regex(r"([0-9]{1,9})\.[A-Za-z0-9_.-]{1,300}\.pack")
LEVEL = 1
ENCODER = json.JSONEncoder(separators=(",", ":"))


class Paths:
    """Paths of this machine, and those of a host that take their place."""

    def __init__(self, paths: Mapping[str, str]) -> None:
        longest_first = "|".join(re.escape(path) for path in sorted(paths, key=len, reverse=True))
        self._paths = paths
        self._pattern = re.compile(rf"(?<![\w./-])({longest_first})(?![\w.-])")

    def there(self, value: JsonView) -> JsonView:
        """Return a value with all paths as they are on the host. Contents of files stay as they are."""
        match value:
            case str():
                return self._pattern.sub(lambda path: self._paths[path[1]], value)
            case Mapping():
                return {key: part if key == "files" else self.there(part) for key, part in value.items()}
            case list() | tuple():
                return [self.there(part) for part in value]
        return value


def settings(session: SessionPaths, paths: Paths) -> bytes:
    """Return the file with the settings of all elements for a host."""
    return to_json(paths.there(json.loads(session.element_settings.read_bytes())))


def records(session: SessionPaths, index: int) -> Iterator[Any]:
    """Yield the records in the file with the jobs of an element: see `sierra.worker.element_jobs`. Raises Damaged."""
    try:
        with gzip.open(session.jobs(index), "rb") as lines:
            yield from map(json.loads, lines)
    except (OSError, EOFError, ValueError) as error:
        raise Damaged(f"{session.jobs(index)}: cannot be read: {error}") from error


def common_job(session: SessionPaths, index: int) -> Mapping[str, JsonView]:
    """Return what all jobs of an element have in common. Raises Damaged."""
    for record in records(session, index):
        if "common" in record:
            common: Mapping[str, JsonView] = record["common"]
            return common
    raise Damaged(f"{session.jobs(index)}: contains no jobs")


def jobs(session: SessionPaths, index: int, paths: Paths) -> bytes:
    """Return the file with the jobs of an element for a host. Raises Damaged."""
    text = b"".join(ENCODER.encode(paths.there(record)).encode() + b"\n" for record in records(session, index))
    return gzip.compress(text, LEVEL, mtime=0)


def not_to_start(session: SessionPaths, index: int) -> bytes:
    """Return the list of an element's executions that must not be started: given up, or with a result on this machine."""
    given_up = session.given_up(index).read_bytes() if session.given_up(index).exists() else b""
    return given_up + b"".join(f"{execution}\n".encode() for execution in sorted(set(ended(session, index))))


def ended(session: SessionPaths, index: int) -> Iterator[str]:
    """Yield the executions of an element whose results are on this machine."""
    for path in session.results.glob(f"{index}.*.pack"):
        with path.open("rb") as file:
            for record, at, _ in result_log.records(file, 0):
                if record["event"] == "end" and result_log.is_sound(file, at, record["files"], lambda: None):
                    yield record["execution"]


class ResultLogs:
    """The copies of result logs on this machine, which grow by what hosts send."""

    def __init__(self, session: SessionPaths) -> None:
        self._folder = session.results
        self._sizes: dict[str, int] = {}

    def have(self) -> dict[str, int]:
        """Return the bytes that this machine has of each log. What a killed process has left incomplete is cut off."""
        for path in self._folder.glob("[0-9]*.pack"):
            if path.name not in self._sizes:
                self._sizes[path.name] = self._whole(path)
        return dict(self._sizes)

    def _whole(self, path: Path) -> int:
        """Cut a log off after its last complete record; return its size."""
        end = 0
        with disk_errors(self._folder), path.open("r+b") as file:
            for record, at, after in result_log.records(file, 0):
                if record["event"] == "end" and not result_log.is_sound(file, at, record["files"], lambda: None):
                    break
                end = after
            file.truncate(end)
        return end

    def add(self, name: str, at: int, data: bytes) -> None:
        """Append what a host has sent. Raises Missing if the disk is full, and Damaged for a part of another place."""
        if at != self._sizes.get(name, 0):
            raise Damaged(f"{name}: {len(data)} bytes come for byte {at}, and not for {self._sizes.get(name, 0)}")
        with (
            disk_errors(self._folder),
            os.fdopen(os.open(self._folder / name, os.O_CREAT | os.O_WRONLY | os.O_CLOEXEC, 0o666), "wb") as file,
        ):
            file.seek(at)  # an earlier attempt may have written a part
            file.write(data)
        self._sizes[name] = at + len(data)

    def cut(self, name: str, size: int) -> None:
        """Cut a log off, because its host has removed an incomplete record."""
        if size < self._sizes.get(name, 0):
            with contextlib.suppress(FileNotFoundError), disk_errors(self._folder):
                os.truncate(self._folder / name, size)
            self._sizes[name] = size


def index_of(event: Record) -> int:
    """Return the element of a result log that a host sends. Raises Damaged for a name of another file."""
    match = LOG.fullmatch(str(event.get("name")))
    if match is None:
        raise Damaged(f"a host sends a file with the name {str(event.get('name'))[:80]!r}, which is no result log")
    return int(match[1])
