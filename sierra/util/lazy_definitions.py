"""Dataclasses and regular expressions that are completed when they are first used.

A command imports many more of them than it uses. For each dataclass, the standard library generates and compiles up to seven
methods; in Python 3.11, this took more than a tenth of the time of a small command.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from dataclasses import field as field
from dataclasses import replace as replace
from threading import RLock
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass

    regex = re.compile
else:

    def dataclass(*, slots: bool, frozen: bool = False, eq: bool = True) -> Callable[[type], type]:
        """Return the decorator of the standard library with these options; `slots` must be true."""
        made_by = dataclasses.dataclass(slots=slots, frozen=frozen, eq=eq)
        return lambda original: _postponed(original, made_by)

    class regex:
        """A regular expression with all attributes of a compiled one; each stays here once somebody has asked for it."""

        def __init__(self, pattern: str | bytes, flags: int = 0) -> None:
            self.pattern = pattern
            self._flags = flags

        def __getattr__(self, name: str) -> object:
            if name.startswith("__"):
                raise AttributeError(name)
            value = getattr(re.compile(self.pattern, self._flags), name)
            setattr(self, name, value)
            return value


FIELDS = "__dataclass_fields__"
"""The attribute by which the standard library knows a dataclass."""
GENERATED = (
    *(FIELDS, "__dataclass_params__", "__delattr__", "__eq__", "__getstate__", "__hash__", "__init__", "__match_args__"),
    *("__replace__", "__repr__", "__setattr__"),
)
"""The attributes that the standard library adds to a class."""
LATE = ("__setstate__",)
"""The attributes that a class has until it is complete, unless the standard library adds them."""
_lock = RLock()


def _postponed(original: type, made_by: Callable[[type], type]) -> type:
    """Return a class with slots, which gets its other attributes when an instance is made, or when its fields are asked for."""
    names = [name for name, kind in original.__annotations__.items() if not kind.startswith("ClassVar")]
    held = {name for base in original.__mro__[1:] for name in getattr(base, "__slots__", ())}
    left = {name: value for name, value in vars(original).items() if name not in (*names, "__dict__", "__weakref__")}
    left["__slots__"] = tuple(name for name in names if name not in held)

    class Late:
        """An attribute of the class that is known when the class is complete."""

        def __init__(self, value: Callable[[], object]) -> None:
            self._value = value

        def __get__(self, instance: object, owner: type) -> object:
            if owner is not lazy and self._value is signature:  # a class that inherits from this one has its own
                raise AttributeError
            complete()
            return self._value()

    def first(self: Any, *arguments: object, **named: object) -> None:
        complete()
        lazy.__init__(self, *arguments, **named)  # type: ignore[misc]

    def restore(self: Any, state: Any) -> None:
        """Give a copy that another process has sent its values."""
        complete()
        if isinstance(state, tuple):  # of a class without a method of its own
            for name, value in state[1].items():
                setattr(self, name, value)
        else:
            self.__setstate__(state)

    def complete() -> None:
        with _lock:
            if vars(lazy)["__init__"] is first:
                whole = vars(made_by(original))
                for name in (*LATE, *GENERATED):
                    if name in whole:
                        setattr(lazy, name, whole[name])
                    elif name in LATE:
                        delattr(lazy, name)

    def signature() -> object:
        import inspect

        whole = inspect.signature(lazy.__init__)  # type: ignore[misc]
        return whole.replace(parameters=list(whole.parameters.values())[1:])

    left |= {"__init__": first, "__setstate__": restore}
    left |= {FIELDS: Late(lambda: vars(lazy)[FIELDS]), "__signature__": Late(signature)}
    lazy = type(original)(original.__name__, original.__bases__, left)
    lazy.__qualname__ = original.__qualname__
    return lazy
