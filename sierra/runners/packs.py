"""What attempts at elements have recorded, read while it grows: see `sierra.runners.element` for the format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sierra.model import Result


@dataclass(frozen=True, slots=True)
class Attempt:
    """The first record: where and with what an attempt began. Fields as in the event `attempt`."""

    attempt: str
    session: str
    element: int
    job: str
    node: str
    started: float
    """By the node's clock, in seconds since the epoch; so are all times here."""
    cpus: int
    memory: int | None
    gpus: str | None
    allocation: Mapping[str, str]
    facts: Mapping[str, Any]
    variables: Mapping[str, str]
    python: str


@dataclass(frozen=True, slots=True)
class Started:
    """A run has begun."""

    execution: str
    time: float


@dataclass(frozen=True, slots=True)
class Ended:
    """A run has ended, and its files are in the pack."""

    result: Result
    """Without a directory."""
    files: tuple[tuple[str, int, str], ...]
    """Path, size and SHA-256 of each, in the order of the payload."""
    at: int
    """Where in the pack the payload begins."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """The attempt could not go on."""

    reason: str


@dataclass(frozen=True, slots=True)
class Finished:
    """All that was missing of the element has been executed."""

    time: float


Event = Attempt | Started | Ended | Trouble | Finished


class Pack:
    """One attempt's file, read on from where reading stopped."""

    def __init__(self, path: Path) -> None:
        """`path` is named `INDEX.ATTEMPT.pack`."""
        self.path = path
        name = path.name.removesuffix(".pack")
        self.element, self.attempt = int(name.partition(".")[0]), name.partition(".")[2]

    def read(self) -> Iterator[Event]:
        """All whole records since the last reading; payloads are passed over, not read. A damaged record ends it for good."""
        raise NotImplementedError

    def extract(self, ended: Ended, folder: Path) -> Result:
        """Write a run's files to a folder, which is made; the result with that directory.

        Raises Damaged where the bytes are not those that were recorded: on a network file system, perhaps not yet.
        """
        raise NotImplementedError
