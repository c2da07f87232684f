"""The messages of an agent (`sierra.extensions.robots.agent.robot_agent`), checked before anything of them is used or recorded.

A robot may have been taken over, and its agent may be another program. What its messages say may be wrong then, but each value
has its type, times and numbers are finite and fit into the store, and texts can be written. Nothing else is passed on.
"""

from __future__ import annotations

import base64
import json
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, InstanceOf, model_validator

Record = dict[str, Any]


def _writable(text: str) -> str:
    """Return a text in which bytes that are no text (surrogates) are shown by their numbers."""
    return text.encode("utf-8", "backslashreplace").decode()


def _decoded(text: object) -> bytes:
    """Return the bytes of a text in base64. Raises ValueError."""
    if not isinstance(text, str):
        raise ValueError("it is no text")
    return base64.b64decode(text)


Text = Annotated[str, AfterValidator(_writable)]
Raw = InstanceOf[str]
"""The name of a file or the value of a variable, which may have bytes that are no text."""
LATEST_NS = 1 << 62
"""The latest time of a clock in ns since 1970: in 2116."""
LONGEST_OFFSET_S = 7 * 24 * 3600
"""A limit on the seconds between local time and UTC, as in the values of TZ that POSIX allows."""
Moment = Annotated[float, Field(ge=0, le=LATEST_NS / 1e9)]
Amount = Annotated[float, Field(ge=0)]
Size = Annotated[int, Field(ge=0, lt=1 << 63)]
Software = dict[Text, Text | None]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)


class _Message(_Part):
    event: str
    id: int | None = None


class Facts(_Part):
    """See `sierra.worker.machine.facts`."""

    host: Text
    os: Text
    kernel: Text
    machine: Text
    cpu: Text
    cpu_flags: list[Text]
    memory: Size
    gpus: list[Text]
    libc: Text
    container: Text | None
    timezone: Text
    cores: Size
    limits: dict[Text, list[int | None]]


class _Leftover(_Part):
    """A run that an earlier agent has left."""

    attempt: Raw
    ended: Size
    """The number of processes that were alive."""
    report: dict[str, Any] | None
    """The report of that agent, perhaps of another version: see `as_report`."""
    who: dict[str, Any] | None
    """The driver of that agent, as in its `hello`."""
    execution: Text | None
    place: Size | None
    files: bool
    """True if the run has begun to leave files."""


class _Hello(_Message):
    folder: Text
    boot: Text
    address: Text | None
    facts: Facts
    utc_offset: Annotated[int, Field(gt=-LONGEST_OFFSET_S, lt=LONGEST_OFFSET_S)]
    software: Software
    home: Text
    variables: dict[Text, Raw]
    leftovers: list[_Leftover]


class _Checked(_Message):
    battery: Annotated[float, Field(ge=0, le=100)] | None
    disk: Size
    failed: list[Text]
    """A line for each check that has failed."""
    unread: dict[Text, Text]
    """Why values are missing, by their names."""
    firmware: Text | None = None
    calibration: Text | None = None
    software: Software | None = None


class _Clock(_Message):
    wall: Annotated[int, Field(ge=0, lt=LATEST_NS)]


class _Watched(_Message):
    """See `sierra.extensions.robots.agent.clock_watch.Course`."""

    uneven: Annotated[int, Field(ge=0, lt=LATEST_NS // 8)]
    moved: Annotated[int, Field(gt=-LATEST_NS, lt=LATEST_NS)]


class OutputFile(_Part):
    """See `sierra.worker.journal.OutputFile`."""

    path: Raw
    sha256: Text
    bytes: Size
    lines: Size
    ended: bool
    head: Text
    quotes: Size | None = None
    blank: Size | None = None
    alike: bool | None = None


class End(_Part):
    """See `sierra.worker.journal.End`."""

    run: Text
    execution: Text
    directory: Text
    host: Text
    slot: Size
    started: Moment
    ended: Moment
    exit_code: Annotated[int, Field(ge=0, le=255)] | None
    signal: Annotated[int, Field(ge=1, le=64)] | None
    user_s: Amount | None
    system_s: Amount | None
    max_rss_bytes: Size | None
    stopped: Literal["interrupted", "timeout", "memory", "cpu", "output"] | None
    error: Text | None
    outputs: list[OutputFile]
    left_out: list[Raw] = Field(default_factory=list)
    observed: bool = False
    delay_s: float = 0.0
    left_running: list[Text] = Field(default_factory=list)
    ports: list[Annotated[int, Field(ge=1, le=65535)]] = Field(default_factory=list)
    after_marker: Amount | None = None


class _Report(_Part):
    started: bool
    why: Text | None
    end: End | None
    problems: list[Text]
    moving: Text | None = None
    """Why the robot may still be moving: its last stop command has failed."""

    @model_validator(mode="after")
    def _has_a_reason(self) -> Self:
        if self.end is None and self.why is None and not self.problems:
            raise ValueError("the end has neither a report nor a reason")
        return self


class _Ended(_Report, _Message):
    attempt: Text


class _Started(_Message):
    attempt: Text


class _Refused(_Message):
    reason: Text
    about: Text = ""
    """The part of a `hello` that has failed: `lock`, `setup`, `stop` or `runs`; of a `pull`, `large`; empty for others."""


class _Late(_Message):
    by: float


class _Data(_Message):
    data: Annotated[bytes, BeforeValidator(_decoded)]


MODELS: dict[str, type[_Message]] = {
    "hello": _Hello,
    "checked": _Checked,
    "clock": _Clock,
    "watched": _Watched,
    "started": _Started,
    "ended": _Ended,
    "refused": _Refused,
    "late": _Late,
    "data": _Data,
    **dict.fromkeys(("armed", "gated", "removed", "beat", "watching", "pulled"), _Message),
}
"""The messages by their events."""


def read(line: str) -> Record:
    """Return the message in a line. Raises ValueError for a line that is none."""
    try:
        record = json.loads(line)
    except RecursionError as error:
        raise ValueError("a message has too many levels") from error
    model = MODELS.get(str(record.get("event"))) if isinstance(record, dict) else None
    if model is None:
        raise ValueError("a message is no event")
    return model.model_validate(record).model_dump(exclude_unset=True)


def as_report(report: Record | None) -> Record | None:
    """Return the report on the end of a run that an earlier agent has left; None if it is not one."""
    try:
        return None if report is None else _Report.model_validate(report).model_dump(exclude_unset=True)
    except ValueError:
        return None
