"""What contains a run where it is executed: the Engine contract. `none` is the only one so far.

Engine and runner are independent: an engine turns a job's argv into the argv that starts it contained, and
nothing else in the program knows which engine it is.
"""

from __future__ import annotations

from typing import Protocol

from sierra.errors import ConfigError


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
    if name == "none":
        return Uncontained()
    raise ConfigError(f"unknown engine {name!r}; known are none")
