"""The robots of a run and their inputs, as an input file of the run: `sierra_robots.json`.

    {"robots": [{"group": "robot", "place": 1}, {"files": {"input.xml": "<e/>"}, "group": "leader", "place": 2}]}

It lists all places in their order, the base station (0) first. The other input files of the run are those of its first robot;
`files` are those of a robot that differ from them, as text, or as `{"base64": "…"}` if they are not UTF-8. Thus the number of
robots, their groups and all their inputs are part of the run's identity, they are recorded, and a replay uses those that are
recorded.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence

from sierra.config.robots_table import BASE, RobotsTable
from sierra.errors import ConfigError, Damaged, QueryError
from sierra.model import BASE as BASE_PLACE
from sierra.model import Value
from sierra.templates.base import Files
from sierra.util.hashing import canonical
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass

FILE = "sierra_robots.json"
"""The name of the input file."""
VALUE = "robot"
"""The name of the place in expressions."""
AT_MOST = 1000
"""The largest number of robots in a run."""


@dataclass(frozen=True, slots=True)
class Place:
    """A place in a run on robots."""

    number: int
    """1, 2, …; the base station has `sierra.model.BASE`."""
    group: str


def places(table: RobotsTable, values: Mapping[str, Value]) -> tuple[Place, ...]:
    """Return the places of a run with these values, the base station first.

    Raises QueryError if the number of robots is not a whole number from 1 to `AT_MOST`, or if it is the value of a variable
    that the query does not vary.
    """
    count = _count(table, values)
    base = (Place(BASE_PLACE, BASE),) if table.base else ()
    return (*base, *(Place(number, table.group(number)) for number in range(1, count + 1)))


def _count(table: RobotsTable, values: Mapping[str, Value]) -> int:
    count = table.count
    if isinstance(count, str):
        if count not in values:
            raise QueryError(
                f"[robots] count is the value of {count!r}, which the query does not vary; add {count}=… to the query, "
                "or write a number"
            )
        value = values[count]
        if isinstance(value, str) or value != int(value):
            raise QueryError(f"[robots] count: {count} is {value!r}, but a run takes a whole number of robots")
        count = int(value)
    if not 1 <= count <= AT_MOST:
        raise QueryError(f"[robots] count is {count}; a run takes 1 to {AT_MOST} robots")
    return count


def inputs(several: Sequence[Place], made: Callable[[Place], Files]) -> Files:
    """Return the input files of a run: those of its first robot, and the file that lists all robots.

    `made` returns the input files of one place. Raises ConfigError if not all places have files of the same names.
    """
    main = made(next(place for place in several if place.number != BASE_PLACE))
    listed = [_listed(place, made(place), dict(main)) for place in several]
    return (*main, (FILE, canonical({"robots": listed})))


def _listed(place: Place, files: Files, main: Mapping[str, bytes]) -> Mapping[str, JsonView]:
    if odd := main.keys() ^ {name for name, _ in files}:
        raise ConfigError(f"the robots of a run need input files of the same names; {min(odd)} is not there for all")
    own = {name: _text(content) for name, content in files if main.get(name) != content}
    return {"place": place.number, "group": place.group, **({"files": own} if own else {})}


def _text(content: bytes) -> JsonView:
    try:
        return content.decode()
    except UnicodeDecodeError:
        return {"base64": base64.b64encode(content).decode()}


def read(files: Files) -> tuple[tuple[Place, Files], ...]:
    """Return the places in the input files of a run, with the input files of each. Raises Damaged."""
    content = next((content for name, content in files if name == FILE), None)
    if content is None:
        raise Damaged(f"the run has no input file {FILE}, so its robots are unknown")
    main = tuple(file for file in files if file[0] != FILE)
    try:
        return tuple(_read(one, main) for one in json.loads(content)["robots"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise Damaged(f"{FILE}: these are not the robots of a run: {content[:60]!r}") from error


def _read(one: Mapping[str, JsonView], main: Files) -> tuple[Place, Files]:
    number, group, own = one["place"], one["group"], one.get("files", {})
    if not (isinstance(number, int) and isinstance(group, str) and isinstance(own, dict)):
        raise TypeError
    files = {name: _bytes(text) for name, text in own.items()}
    return Place(number, group), tuple((name, files.get(name, content)) for name, content in main)


def _bytes(text: JsonView) -> bytes:
    if isinstance(text, Mapping):
        return base64.b64decode(str(text["base64"]), validate=True)
    if not isinstance(text, str):
        raise TypeError
    return text.encode()
