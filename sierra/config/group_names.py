"""The names of controllers and scenarios: dots, categories, and patterns with parameters.

A declared name may contain parameters: `LowBlockCount.{x}x{y}` stands for `LowBlockCount.10x5`, `LowBlockCount.8x8`, … In its
changes, `{x}` and `{y}` are these numbers. A number is written without leading zeros and exponents, so that each value has one
spelling. Parameters must be separated by more than digits and dots, so that a name can be read in one way only.

If `depth0` and `depth0.CRW` are declared, `depth0` is a category: its changes come before those of `depth0.CRW`, and it cannot
be chosen itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache

from sierra.model import Value
from sierra.util.lazy_definitions import dataclass, regex

_PARAMETER = r"\{[A-Za-z_][A-Za-z0-9_]*\}"
_WORD = rf"(?:[A-Za-z0-9_]|{_PARAMETER})"
GROUP_NAME = rf"^[A-Za-z_]{_WORD}*(?:[.-]{_WORD}+)*$"
"""Names that may be declared. They cannot begin with a dot or a hyphen, and contain no character that paths or XML lack."""
_SPLIT = regex(r"\{([A-Za-z_][A-Za-z0-9_]*)\}")
_NUMBER = r"((?:0|[1-9][0-9]{0,8})(?:\.[0-9]{1,9})?)"
_GIVEN = ("controller", "scenario", "seed", "run", "value")
"""Names that expressions already have, and so no parameters can."""


@dataclass(frozen=True, slots=True)
class Resolved:
    """A chosen name: the declared names whose changes apply, in order, and the values of parameters."""

    declared: tuple[str, ...]
    parameters: Mapping[str, Value]


def parameters(declared: str) -> tuple[str, ...]:
    """Return the names of the parameters in a declared name."""
    return tuple(_SPLIT.findall(declared))


def complaint(declared: str) -> str | None:
    """Return what is wrong with the parameters of a declared name; None if nothing is."""
    literals, names = _SPLIT.split(declared)[::2], parameters(declared)
    if len(set(names)) < len(names):
        return f"{declared!r} has a parameter twice; use each once"
    if given := next((name for name in names if name in _GIVEN), None):
        return f"{declared!r}: {{{given}}} already has a meaning; use another name"
    if any(not re.search(r"[^0-9.]", between) for between in literals[1:-1]):
        return f"{declared!r} can be read in several ways; separate parameters by letters, as in {{x}}x{{y}}"
    return None


def is_category(name: str, declared: Iterable[str]) -> bool:
    """Return True if other names begin with this name and a dot."""
    return any(other.startswith(f"{name}.") for other in declared)


def resolve(name: str, declared: Iterable[str]) -> tuple[Resolved, ...]:
    """Return what a chosen name stands for: one result, none if no declaration fits, several if it is ambiguous."""
    names = tuple(declared)
    if name in names and not parameters(name):
        return (Resolved(_with_categories(name, names), {}),)
    matches = ((form, _pattern(form).fullmatch(name)) for form in names if parameters(form))
    return tuple(
        Resolved(_with_categories(form, names), dict(zip(parameters(form), map(_value, match.groups()), strict=True)))
        for form, match in matches
        if match
    )


def _with_categories(name: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return a declared name after the categories that contain it, the widest first."""
    parts = name.split(".")
    above = (".".join(parts[:count]) for count in range(1, len(parts)))
    return (*(one for one in above if one in names), name)


@lru_cache(maxsize=1024)
def _pattern(declared: str) -> re.Pattern[str]:
    return re.compile(_NUMBER.join(map(re.escape, _SPLIT.split(declared)[::2])))


def _value(text: str) -> Value:
    return float(text) if "." in text else int(text)
