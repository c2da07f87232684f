"""Where runs execute: the Runner contract, and the door to find one by name.

Shipped: `local`. Others come as entry points of the group `sierra.runners`, each naming a class that fulfils `Runner`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from sierra import plugins
from sierra.model import Job, Result
from sierra.paths import SessionPaths

SHIPPED = {"local": "sierra.runners.local:Local"}


@dataclass(frozen=True, slots=True)
class Look:
    """What has happened since the last look."""

    results: tuple[Result, ...]
    running: int
    """Runs in flight now."""
    alive: bool
    """Whether more may come."""


class Runner(Protocol):
    """One place where runs execute. What it says of a run is only ever what the run's worker recorded."""

    name: str

    def __init__(self, slots: int) -> None:
        """`slots`: how many runs execute at a time."""
        ...

    def submit(self, jobs: Iterable[Job], session: SessionPaths) -> None:
        """Start executing. `jobs` is read as slots become free, perhaps in another thread; called once."""
        ...

    def look(self) -> Look:
        """What has happened; returns at once and may be called at any time after `submit`.

        Raises Missing where the runner itself cannot go on (a full disk, no worker).
        """
        ...

    def stop(self) -> None:
        """Start nothing more and end what runs; `look` tells the end of those too. May be called again."""
        ...


def find(name: str) -> Callable[[int], Runner]:
    """What makes the runner of that name, for a number of slots. Raises ConfigError where there is none."""
    made: Callable[[int], Runner] = plugins.find("runner", SHIPPED, name)
    return made
