"""A worker's journal, read while it grows."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sierra.model import OutputFile, Result


@dataclass(frozen=True, slots=True)
class Started:
    """A program was started: its process id and, with it naming one process for ever, when it was born."""

    execution: str
    pid: int
    born: int | None


class Journal:
    """Reads on from where it stopped; a line that is cut short is not there yet."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def read(self) -> Iterator[Started | Result]:
        """All events since the last reading."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                data = file.read()
        except FileNotFoundError:
            return
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        for line in whole.splitlines():
            yield _event(json.loads(line))


def orphans(path: Path) -> list[int]:
    """Processes that a dead worker's journal says were started, that have no end there, and still live."""
    started: dict[str, Started] = {}
    for event in Journal(path).read():
        match event:
            case Started():
                started[event.execution] = event
            case Result():
                started.pop(event.execution, None)
    return [one.pid for one in started.values() if one.born is not None and born(one.pid) == one.born]


def born(pid: int) -> int | None:
    """When a process was started, in clock ticks since boot; None where there is none of that id."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return None
    return int(fields[19])


def marked(variable: str, values: set[str]) -> list[int]:
    """Processes of this user in whose environment `variable` has one of these values (Linux only)."""
    wanted = {f"{variable}={value}".encode() for value in values}
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            environment = (process / "environ").read_bytes()
        except OSError:
            continue
        if not wanted.isdisjoint(environment.split(b"\0")):
            found.append(int(process.name))
    return found


def _event(event: dict[str, Any]) -> Started | Result:
    kind = event.pop("event")
    if kind == "start":
        return Started(**event)
    event["outputs"] = tuple(OutputFile(**file) for file in event["outputs"])
    return Result(**event)
