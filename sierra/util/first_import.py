"""Load a module in another way when this process imports it for the first time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

Load = Callable[[ModuleType], None]


def load_with(name: str, load: Callable[[ModuleType, Load], None]) -> None:
    """Have a module loaded by this function, which gets the module and the loader's own function, unless it is loaded."""
    if name not in sys.modules and not any(isinstance(finder, _Finder) and finder.name == name for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder(name, load))


class _Finder:
    """A finder of one module."""

    def __init__(self, name: str, load: Callable[[ModuleType, Load], None]) -> None:
        self.name = name
        self._load = load

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != self.name:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module
            spec.loader.exec_module = lambda module: self._load(module, load)  # type: ignore[method-assign]
        return spec
