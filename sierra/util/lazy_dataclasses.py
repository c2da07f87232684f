"""Dataclasses with slots whose methods are generated when the first instance is made.

A command imports many more of these classes than it makes instances of. The standard library generates and compiles up to
seven methods for each class as it is imported: in Python 3.11, more than a tenth of the time of a small command.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from threading import RLock
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:

    def dataclass(*, slots: bool, frozen: bool = False, eq: bool = True) -> Callable[[type], type]:
        """Return the decorator of the standard library with these options; without slots, nothing is postponed."""
        made_by = dataclasses.dataclass(slots=slots, frozen=frozen, eq=eq)
        return lambda original: _postponed(original, made_by)


FIELDS = "__dataclass_fields__"
"""The attribute by which the standard library knows a dataclass."""
GENERATED = (
    *(FIELDS, "__dataclass_params__", "__delattr__", "__eq__", "__getstate__", "__hash__", "__init__", "__match_args__"),
    *("__replace__", "__repr__", "__setattr__", "__setstate__"),
)
"""The attributes that the standard library adds to a class."""
_lock = RLock()


def _postponed(original: type, made_by: Callable[[type], type]) -> type:
    """Return a class with slots that gets its other attributes when an instance is made, or when its fields are asked for."""
    names = [name for name, kind in original.__annotations__.items() if not kind.startswith("ClassVar")]
    held = {name for base in original.__mro__[1:] for name in getattr(base, "__slots__", ())}
    left = {name: value for name, value in vars(original).items() if name not in (*names, "__dict__", "__weakref__")}
    left["__slots__"] = tuple(name for name in names if name not in held)

    class Fields:
        def __get__(self, instance: object, owner: type) -> object:
            complete()
            return vars(made)[FIELDS]

    def first(self: Any, *arguments: object, **named: object) -> None:
        complete()
        made.__init__(self, *arguments, **named)  # type: ignore[misc]

    def complete() -> None:
        with _lock:
            if vars(made)["__init__"] is first:
                whole = vars(made_by(original))
                for name in GENERATED:
                    if name in whole:
                        setattr(made, name, whole[name])

    left |= {"__init__": first, FIELDS: Fields()}
    made = type(original)(original.__name__, original.__bases__, left)
    made.__qualname__ = original.__qualname__
    return made
