"""What contains a run where it is executed: the Engine contract, and the door to find one by name.

Shipped: `none`. Others come as entry points of the group `sierra.engines`, each naming a class that fulfils `Engine`.

Engine and runner are independent: an engine turns a job's argv into the argv that starts it contained, and
nothing else in the program knows which engine it is.
"""

from __future__ import annotations

from typing import Protocol

from sierra import plugins

SHIPPED = {"none": "sierra.engines:Uncontained"}


class Engine(Protocol):
    """One way to contain a run."""

    name: str

    def image(self) -> str | None:
        """The content identity of the image, or None without one; part of a run's identity."""
        ...

    def argv(self, argv: tuple[str, ...]) -> tuple[str, ...]:
        """The command that starts `argv` contained. NUL stands for the run's folder, here as there."""
        ...


class Uncontained:
    """The engine `none`: the program runs as it is."""

    name = "none"

    def image(self) -> str | None:
        return None

    def argv(self, argv: tuple[str, ...]) -> tuple[str, ...]:
        return argv


def find(name: str) -> Engine:
    """The engine of that name. Raises ConfigError where there is none."""
    made: Engine = plugins.find("engine", SHIPPED, name)()
    return made
