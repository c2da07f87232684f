"""The project that a command, or a method of the Python interface, works on: the names of plug-ins in its files count.

Each method of `sierra.api.Project` and its nouns is within its project. Nothing is read or imported until a name is looked up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sierra.config.plugin_registry import Offers


class Plugins:
    """The plug-ins in files of a project that declares none."""

    def __init__(self, root: Path, refused: str = "") -> None:
        """`refused` is the reason why no Python code of this project is imported; "" if it may be."""
        self.root, self.refused = root, refused

    @property
    def offers(self) -> Offers:
        """Return them by group of entry points and name. Raises ConfigError for a name that something else has."""
        return {}

    def files(self, kinds: Iterable[str] = ()) -> Mapping[str, bytes]:
        """Return the files of plug-ins of these kinds, by default of all, and those that they import, by path.

        Their content is the one with which they are imported. Raises ConfigError, PluginError.
        """
        return {}


class _Context:
    """A context and the plug-ins in it, which are found once, when they are needed."""

    def __init__(self, key: object, find: Callable[[], Plugins]) -> None:
        self.key, self._find = key, find

    @cached_property
    def plugins(self) -> Plugins:
        return self._find()


_current: ContextVar[_Context | None] = ContextVar("_current", default=None)


@contextmanager
def within(key: object, find: Callable[[], Plugins]) -> Iterator[None]:
    """Let the names of these plug-ins count until the end of the context; one with the same key goes on."""
    current = _current.get()
    if current is not None and current.key == key:
        yield
        return
    before = _current.set(_Context(key, find))
    try:
        yield
    finally:
        _current.reset(before)


def plugins() -> Plugins | None:
    """Return the plug-ins whose names count here; None outside of any context."""
    current = _current.get()
    return current.plugins if current else None


class _Names(Plugins):
    """The plug-ins whose names the file of a project declares, before it is known which classes these are."""

    def __init__(self, table: object) -> None:
        super().__init__(Path())
        declared = table.get("plugins") if isinstance(table, Mapping) else None
        self._declared = declared if isinstance(declared, Mapping) else {}

    @property
    def offers(self) -> Offers:
        lists = {f"sierra.{key}": places for key, places in self._declared.items() if isinstance(places, list | tuple)}
        return {group: {str(place).partition(":")[2]: () for place in places} for group, places in lists.items()}


def declaring(table: object) -> AbstractContextManager[None]:
    """Return a context in which the names count that `[plugins]` in the table of a project declares; no class is imported."""
    return within(object(), lambda: _Names(table))
