"""One difference between two recorded things, and how likely its kind is to matter for results."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

ORDER = (
    "query",
    "platform",
    "command",
    "image",
    "programs",
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
"""Kinds, some with the name of what differs, by how likely they are to change results; the results themselves stand last."""
KINDS = tuple(dict.fromkeys(key.partition(".")[0] for key in ORDER))
ARROW = "→"
LONGEST = 100
"""Characters of a value that a line shows."""


@dataclass(frozen=True, slots=True)
class Difference:
    """What was, and what is."""

    kind: str
    name: str
    """What of that kind: a variable, a program, a path in an input, a column."""
    line: str
    """In one line."""
    was: Any = None
    now: Any = None
    details: tuple[str, ...] = ()
    """What else is to be said of it, a patch say."""

    @property
    def rank(self) -> int:
        """How likely it is to matter, the likelier the smaller."""
        key = f"{self.kind}.{self.name}"
        return ORDER.index(key if key in ORDER else self.kind)


@dataclass(frozen=True, slots=True)
class Note:
    """What is to be said and is no difference; with a `kind`, that not all of that could be compared."""

    text: str
    kind: str | None = None


def changed(kind: str, name: str, was: Any, now: Any, *, called: str = "") -> Iterator[Difference]:
    """The one difference, if there is any, between two values of one thing; it is told by its parts where it has such."""
    if was == now:
        return
    called = called or name
    old, new = _parsed(was), _parsed(now)
    parts = tuple(_parts(old, new))
    line = "; ".join(parts) if len(parts) == 1 else f"{len(parts)} differ" if parts else f"{shown(old)} {ARROW} {shown(new)}"
    yield Difference(kind, name, f"{called}: {line}", was, now, parts if len(parts) > 1 else ())


def shown(value: Any) -> str:
    """A value as a line has it."""
    match value:
        case None | "":
            return "nothing"
        case float():
            return f"{value:.6g}"
        case list() | tuple():
            return ", ".join(map(shown, value)) or "nothing"
        case str():
            text = " ".join(value.split())
            return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
        case _:
            return str(value)


def _parts(was: Any, now: Any) -> Iterator[str]:
    """What differs in objects, by their keys; in long lists, what only one of them has."""
    match was, now:
        case dict(), dict():
            old, new = dict(flat(was)), dict(flat(now))
            for key in dict.fromkeys((*old, *new)):
                if old.get(key) != new.get(key):
                    yield f"{key} {shown(old.get(key))} {ARROW} {shown(new.get(key))}"
        case list(), list() if len(was) + len(now) > 6:
            more, less = ([one for one in a if one not in b] for a, b in ((now, was), (was, now)))
            told = [*(f"+{shown(one)}" for one in more), *(f"−{shown(one)}" for one in less)]
            if told:
                yield " ".join(told) if len(told) <= 12 else f"{len(more)} more and {len(less)} less than there were"


def flat(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """An object's values by the paths to them, `outputs.swarm.file`."""
    if isinstance(value, Mapping) and (value or not path):
        for key, inner in value.items():
            yield from flat(inner, f"{path}.{key}" if path else str(key))
    else:
        yield path, value


def _parsed(value: Any) -> Any:
    """JSON in a text as what it is; lines of a text, and words of a long one, as a list."""
    if not isinstance(value, str):
        return value
    if value[:1] in ("{", "["):
        try:
            return json.loads(value)
        except ValueError:
            return value
    lines = value.splitlines()
    return lines if len(lines) > 1 else value.split() if value.count(" ") > 12 else value
