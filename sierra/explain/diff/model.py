"""Difference between two recorded objects, and its rank by the likelihood to affect results."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import TypeAlias

from sierra.util.json_types import Json
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import DIGITS, digits_apart, few, short_number

Compared: TypeAlias = "bool | int | float | str | datetime | Sequence[Compared] | Mapping[str, Compared] | None"
"""A value that is compared. JSON texts are compared by their parts."""

ORDER = (
    "query",
    "platform",
    "command",
    "image",
    "programs",
    "files",
    "source",
    "variables",
    "inputs",
    "inputs.as asked",
    "template",
    "rules",
    "seed",
    "inputs.the seed",
    "isolation.network",
    "isolation.engine",
    "isolation.limits_enforced",
    "isolation",
    "environment.container",
    "environment.variables",
    "environment.libc",
    "environment.gpus",
    "environment.cpu_flags",
    "environment.cpu",
    "environment.machine",
    "environment.os",
    "environment.modules",
    "environment.locale",
    "environment.limits",
    "environment.runner",
    "environment.sierra",
    "environment.python",
    "environment",
    "commit",
    "environment.memory",
    "environment.cores",
    "environment.kernel",
    "environment.host",
    "status",
    "results",
)
"""Order of kinds, some with a name, from most to least likely to change results; the results themselves are last."""
KINDS = tuple(dict.fromkeys(key.partition(".")[0] for key in ORDER))
ARROW = "→"
LONGEST = 100
"""Maximum number of characters of a value in a line."""
BEFORE = 20
"""Number of characters that are shown before the place where two long values differ."""
COUNTED = " differ"
"""The end of a line that only counts the parts that differ."""
MANY, SHOWN = 50, 6
"""The length up to which a list is shown, and the number of items that are shown of a longer one, such as of packages."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference with the old and the new value."""

    kind: str
    name: str
    """Name of the thing that differs: a variable, a program, a path in an input, a column."""
    line: str
    """Description in one line."""
    was: Compared = None
    now: Compared = None
    detailed: Sequence[str] | Callable[[], Iterable[str]] = ()
    """Details, for example a patch; or a function that finds them, if that takes time."""

    @property
    def details(self) -> tuple[str, ...]:
        """Return the details."""
        return tuple(self.detailed() if callable(self.detailed) else self.detailed)

    @property
    def whole(self) -> str:
        """The line; if it only counts the parts that differ, with them, for output without details."""
        return f"{self.line}: {few(self.details, SHOWN)}" if self.line.endswith(COUNTED) else self.line

    @property
    def rank(self) -> int:
        """Return the rank by likelihood to affect results; smaller is more likely."""
        key = f"{self.kind}.{self.name}"
        return ORDER.index(key if key in ORDER else self.kind)


@dataclass(frozen=True, slots=True)
class Note:
    """Note that is not a difference; `kind` names a kind that could not be compared completely."""

    text: str
    kind: str | None = None


def changed(kind: str, name: str, was: Compared, now: Compared, *, called: str = "") -> Iterator[Difference]:
    """Yield the difference between two values of one thing, if there is one; structured values are compared by their parts."""
    if was == now:
        return
    called = called or name
    old, new = _parsed(was), _parsed(now)
    parts = tuple(_parts(old, new))
    digits = digits_apart([old, new])
    pair = _pair(old, new, digits)
    line = "; ".join(parts) if len(parts) == 1 else f"{len(parts)}{COUNTED}" if parts else pair
    yield Difference(kind, name, f"{called}: {line}", was, now, parts if len(parts) > 1 else ())


def _pair(was: object, now: object, digits: int) -> str:
    """Return two values that differ; if they would look alike, from shortly before the first character that differs."""
    old, new = shown(was, digits), shown(now, digits)
    if old == new:
        old, new = ("nothing" if value is None else repr(value) for value in (was, now))
        alike = next((place for place, (one, other) in enumerate(zip(old, new, strict=False)) if one != other), 0)
        begin = max(0, alike - BEFORE)
        old, new = (f"{'…' * (begin > 0)}{text[begin : begin + LONGEST]}" for text in (old, new))
    return f"{old} {ARROW} {new}"


def shown(value: object, digits: int = DIGITS) -> str:
    """Return a value for a line."""
    match value:
        case None | "":
            return "nothing"
        case float():
            return short_number(value, digits)
        case list() | tuple():
            items = [shown(item) for item in value]
            return few(items, SHOWN if len(items) > MANY else MANY) or "nothing"
        case str():
            text = " ".join(value.split())
            return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
        case _:
            return str(value)


def _parts(was: Compared, now: Compared) -> Iterator[str]:
    """Yield the differing keys of two objects; for two long lists, the items that only one of them has."""
    match was, now:
        case dict(), dict():
            old, new = dict(flat(was)), dict(flat(now))
            for key in dict.fromkeys((*old, *new)):
                if old.get(key) != new.get(key):
                    digits = digits_apart([old.get(key), new.get(key)])
                    yield f"{key} {_pair(old.get(key), new.get(key), digits)}"
        case list(), list() if len(was) + len(now) > 6:
            more, less = ([item for item in a if item not in b] for a, b in ((now, was), (was, now)))
            items = [*(f"+{shown(item)}" for item in more), *(f"−{shown(item)}" for item in less)]
            if items:
                yield " ".join(items) if len(items) <= 12 else f"{len(more)} added and {len(less)} removed"


def flat(value: Compared, path: str = "") -> Iterator[tuple[str, Compared]]:
    """Yield an object's values by their paths, such as `outputs.swarm.file`."""
    if isinstance(value, Mapping) and (value or not path):
        for key, inner in value.items():
            yield from flat(inner, f"{path}.{key}" if path else str(key))
    else:
        yield path, value


def _parsed(value: Compared) -> Compared:
    """Return JSON text as the value that it encodes; the lines of a text, or the words of a long line, as a list."""
    if not isinstance(value, str):
        return value
    if value[:1] in ("{", "["):
        try:
            parsed: Json = json.loads(value)
        except ValueError:
            return value
        return parsed
    lines = value.splitlines()
    return lines if len(lines) > 1 else value.split() if value.count(" ") > 12 else value
