"""Reader of a worker's journal while it grows."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from sierra.model import LateFiles, OutputFile, Result
from sierra.util.hashing import short
from sierra.util.json_types import JsonView, RecordValue
from sierra.util.lazy_definitions import dataclass
from sierra.util.regular_files import open_regular
from sierra.util.text import one_line

if TYPE_CHECKING:
    from sierra.worker.journal import Outcome

AT_ONCE = 1 << 20


@dataclass(frozen=True, slots=True)
class Started:
    """The start of a program. Its process id and its time of birth together identify one process for ever."""

    execution: str
    pid: int
    born: int | None


@dataclass(frozen=True, slots=True)
class Stalled:
    """A run all of whose processes are stopped by a signal, or that has not got its checkpoint."""

    run: str
    execution: str
    pid: int
    since: float
    """Time in seconds since the epoch."""
    unkept: str = ""
    """The reason why it has not got its checkpoint."""

    def message(self, where: str = "") -> str:
        """Return the message for the user; `where` is the node, for example ` on n1`."""
        if self.unkept:
            reason = one_line(self.unkept)
            return f"run {short(self.run)} began without its checkpoint{where}, and what it saves there is not kept: {reason}"
        when = time.strftime("%H:%M:%S", time.localtime(self.since))
        cure = f"continue it with kill -CONT {self.pid}{where}, or set wall in [limits] to end such runs"
        return f"run {short(self.run)} makes no progress: a signal stopped its processes{where} at {when}; {cure}"


@dataclass(frozen=True, slots=True)
class Row:
    """A row to record with a result that follows: a table's name and the row. A runner on robots writes it."""

    table: str
    row: Mapping[str, RecordValue]


Event = Started | Stalled | Row | LateFiles | Result
Made = TypeVar("Made")


class Journal:
    """A worker's journal. Each reading continues where the last one stopped. A damaged line is ignored."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def skip(self) -> None:
        """Skip everything that is there now."""
        with contextlib.suppress(FileNotFoundError):
            self._offset = self._path.stat().st_size

    def read(self) -> Iterator[Event]:
        """Yield all events since the last reading."""
        while lines := self._lines():
            yield from filter(None, map(_event, lines))

    def some(self) -> tuple[list[Event], bool]:
        """Return the next events, at most a MiB of them, and whether anything was read. If so, there may be more."""
        lines = self._lines()
        return list(filter(None, map(_event, lines))), bool(lines)

    def _lines(self) -> list[bytes]:
        """Return the next complete lines: a MiB of them, or one line that is longer."""
        try:
            with open_regular(self._path) as file:
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
        event = json.loads(line)
        match event["event"]:
            case "start":
                return made(Started, event)
            case "stalled":
                return made(Stalled, event)
            case "late":
                return made(LateFiles, event)
            case "row":
                return Row(event["table"], {name: _moment(name, value) for name, value in event["row"].items()})
            case _:
                return result_of(event)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _moment(name: str, value: JsonView) -> RecordValue:
    """Return a value of a row; the times of `robots` are texts in a journal."""
    return datetime.fromisoformat(value) if name in ("started", "ended") and isinstance(value, str) else value


def made(kind: Callable[..., Made], record: Mapping[str, object], **more: object) -> Made:
    """Return an object from the fields of a record, with the fields `more`. Raises TypeError if these are not its fields.

    The record's event, and what describes its payload, are not among them.
    """
    return kind(**{name: value for name, value in {**record, **more}.items() if name not in ("event", "files", "size")})


def result_of(record: Outcome, **more: object) -> Result:
    """Return the result that a record of the event `end` contains. Raises TypeError and KeyError for another record."""
    outputs = tuple(OutputFile(**file) for file in record["outputs"])
    elsewhere = tuple(f"{{run}}/{name}" for name in record.get("elsewhere", ()))
    robots = {int(place): name for place, name in cast("Mapping[str, Any]", record).get("robots", {}).items()}
    lists = {
        name: tuple(cast("Mapping[str, Any]", record).get(name, ())) for name in ("left_out", "left_running", "ports", "gpus")
    }
    return made(Result, record, outputs=outputs, elsewhere=elsewhere, robots=robots, **lists, **more)
