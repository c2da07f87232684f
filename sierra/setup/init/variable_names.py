"""Names for the numbers of a template, and the number that is the count of robots."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping

from sierra.design.experiments import GROUPED
from sierra.errors import QueryError
from sierra.query import grammar
from sierra.setup.init.answers import SHOWN
from sierra.templates.base import Template

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
NUMBER = re.compile(r"[+-]?\d+(\.\d+)?")
CROWDS = frozenset(
    ["population", "robots", "agents", "swarm", "individuals", "vehicles", "drones", "boids", "ants", "particles"]
)
COUNTS = frozenset(["quantity", "count", "number", "num", "n", "amount"])
BESIDE = frozenset(["size", "of", "total", "model"])
GENERIC = frozenset(["value", "val", "default", "data"])
SELDOM = frozenset(["id", "name", "version", "port", "threads"])


def numbers(template: Template) -> dict[str, str]:
    """Return the paths that select one number, with the number."""
    return {path: value.strip() for path, value in template.attributes() if NUMBER.fullmatch(value.strip())}


def seeds(numbers: Iterable[str]) -> tuple[str, ...]:
    """Return the paths of numbers that are called a seed."""
    return tuple(path for path in numbers if any(word.endswith("seed") for word in _words(_called(path)[0])))


def named(numbers: Mapping[str, str], known: Collection[str]) -> dict[str, str]:
    """Return possible variables by name.

    The number of robots comes first, as population_size, unless `known` already has a criterion for it.
    """
    robots = None if known else _counting(numbers)
    found = {"population_size": robots} if robots else {}
    for path in numbers:
        short, element = _called(path)
        proposed = (re.sub(r"\W", "_", name, flags=re.ASCII) for name in (short, f"{element}_{short}"))
        name = next((name for name in proposed if not mistaken(name, {*found, *known})), None)
        if name and path != robots and short.lower() not in SELDOM and len(found) <= SHOWN:
            found[name] = path
    return found


def mistaken(name: str, known: Iterable[str]) -> str | None:
    """Return why queries or the store cannot have a name, and what would be right; None if they can."""
    if not NAME.fullmatch(name):
        return "this is not a name of letters, digits and _; use a name such as my_name"
    if name in GROUPED:
        return f"this name has another meaning in queries; use another name, such as my_{name}"
    if name.lower() in {other.lower() for other in known}:
        return "this name is used already; use another name"
    try:
        grammar.parse_all([f"{name}=1"])
    except QueryError as error:
        return str(error).rpartition(": ")[2]
    return None


def _counting(numbers: Mapping[str, str]) -> str | None:
    """Return the path that most likely selects the number of robots; None if no path does."""
    counts = [
        (path, set(_words(short)), set(_words(element)))
        for path, value in numbers.items()
        for short, element in [_called(path)]
        if value.isdigit() and set(_words(short)) <= CROWDS | COUNTS | BESIDE
    ]
    likely = [path for path, words, around in counts if (words | around) & CROWDS]
    return next(iter([*likely, *(path for path, words, _ in counts if words & COUNTS)]), None)


def _called(path: str) -> tuple[str, str]:
    """Return a name for what a path selects, and its element: for `//param[@name='speed']/@value`, the name is speed."""
    element, _, attribute = path.rpartition("/@") if "/@" in path else (path, "", "")
    named = re.search(r"\[(?:@\w+|local-name\(\))='(.+)'\]$", element)
    label = named[1] if named else re.split("[/:]", element)[-1]
    attribute = attribute.rpartition(":")[2]
    return (label if not attribute or attribute.lower() in GENERIC else attribute), label


def _words(name: str) -> list[str]:
    """Return the words of a name: `numRobots` and `num_robots` are num, robots."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]
