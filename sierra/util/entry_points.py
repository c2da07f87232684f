"""What can be named: shipped classes, and those that other packages add by entry points.

A table of shipped ones maps a name to `module:Class`, so that nothing is imported before it is asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any

from sierra.errors import ConfigError


def find(kind: str, shipped: Mapping[str, str], name: str) -> Any:
    """The class called `name` among the shipped ones, or in the entry points of the group `sierra.<kind>s`.

    `kind` is singular, as messages call it: platform, runner, engine. Raises ConfigError where there is none.
    """
    if name in shipped:
        module, _, attribute = shipped[name].partition(":")
        return getattr(import_module(module), attribute)
    for point in _entry_points(kind):
        if point.name == name:
            try:
                return point.load()
            except Exception as error:
                raise ConfigError(f"{kind} {name!r} ({point.value}) cannot be loaded: {_one_line(error)}") from error
    raise ConfigError(f"unknown {kind} {name!r}; known are {', '.join(names(kind, shipped))}")


def _one_line(error: Exception) -> str:
    """What somebody else's error says, with its kind."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def names(kind: str, shipped: Mapping[str, str]) -> tuple[str, ...]:
    """All names that `find` knows here, the shipped ones first."""
    return (*shipped, *sorted({point.name for point in _entry_points(kind)} - shipped.keys()))


def _entry_points(kind: str) -> Any:
    return _installed(tuple(sys.path)).select(group=f"sierra.{kind}s")


@cache
def _installed(path: tuple[str, ...]) -> Any:
    """All entry points of what is installed on `path`: to look through that takes 6 ms, and may be asked for at each plan."""
    from importlib.metadata import entry_points

    return entry_points()
