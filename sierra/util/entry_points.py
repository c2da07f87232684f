"""Classes that are found by name: those shipped with SIERRA, and those that other packages add by entry points.

A table of the shipped classes maps a name to `module:Class`, so that a module is imported only when it is needed.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any

from sierra.errors import ConfigError


def find(kind: str, shipped: Mapping[str, str], name: str) -> Any:
    """Return the class called `name`, from the shipped ones or from the entry points of the group `sierra.<kind>s`.

    `kind` is the singular word that messages use: platform, runner, engine. Raises ConfigError if there is no such class, or if
    it cannot be loaded.
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
    """Return the type and message of an error of another package in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def names(kind: str, shipped: Mapping[str, str]) -> tuple[str, ...]:
    """Return all names that `find` knows, the shipped ones first."""
    return (*shipped, *sorted({point.name for point in _entry_points(kind)} - shipped.keys()))


def _entry_points(kind: str) -> Any:
    return _installed(tuple(sys.path)).select(group=f"sierra.{kind}s")


@cache
def _installed(path: tuple[str, ...]) -> Any:
    """Return all entry points of the packages installed on `path`.

    The result is cached: a search takes 6 ms, and a plan may need it.
    """
    from importlib.metadata import entry_points

    return entry_points()
