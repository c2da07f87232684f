"""A worker's journal, read while it grows."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sierra.model import OutputFile, Result
from sierra.util.hashing import short

AT_ONCE = 1 << 20


@dataclass(frozen=True, slots=True)
class Started:
    """A program was started: its process id and, with it naming one process for ever, when it was born."""

    execution: str
    pid: int
    born: int | None


@dataclass(frozen=True, slots=True)
class Stalled:
    """All processes of a run are stopped by a signal."""

    run: str
    execution: str
    pid: int
    since: float
    """In seconds since the epoch."""

    def told(self, where: str = "") -> str:
        """Say it to the user; `where` is the node, as in ` on n1`."""
        when = time.strftime("%H:%M:%S", time.localtime(self.since))
        cure = f"kill -CONT {self.pid}{where} continues it, and wall in [limits] ends such runs"
        return f"run {short(self.run)} makes no progress: a signal stopped its processes{where} at {when}; {cure}"


Event = Started | Stalled | Result


class Journal:
    """Reads on from where it stopped. A line that is cut short is not there yet, one that is damaged never was."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def skip(self) -> None:
        """Leave out all that is there now."""
        with contextlib.suppress(FileNotFoundError):
            self._offset = self._path.stat().st_size

    def read(self) -> Iterator[Event]:
        """All events since the last reading."""
        while lines := self._lines():
            yield from filter(None, map(_event, lines))

    def some(self) -> tuple[list[Event], bool]:
        """The next events, at most a MiB of them; and whether there was anything, so that there may be more."""
        lines = self._lines()
        return list(filter(None, map(_event, lines))), bool(lines)

    def _lines(self) -> list[bytes]:
        """The next whole lines: of a MiB, or one that is longer."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                data = file.read(AT_ONCE)
                while b"\n" not in data and (more := file.read(AT_ONCE)):
                    data += more
        except FileNotFoundError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        return whole.splitlines()


def _event(line: bytes) -> Event | None:
    try:
        event: dict[str, Any] = json.loads(line)
        kind = event.pop("event")
        if kind == "start":
            return Started(**event)
        if kind == "stalled":
            return Stalled(**event)
        event["outputs"] = tuple(OutputFile(**file) for file in event["outputs"])
        event["left_out"] = tuple(event.get("left_out", ()))
        return Result(**event)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
