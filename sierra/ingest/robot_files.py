"""Files of runs on robots: each robot's outputs are in a folder that is named by its place.

`{robot}` at the beginning of an output's `file` stands for that folder, and becomes the column `robot`. If the files have a
column of that name, `{place}` may be there instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from sierra.config.output_tables import Output
from sierra.model import BASE, Result
from sierra.util.lazy_definitions import regex

OF_ROBOT = "{robot}"
COLUMN = "robot"
FOLDERS = (OF_ROBOT + "/", "{place}/")
"""The beginnings of an output's `file` that stand for the folder of each robot."""
_DIRECT = regex(r"([0-9]{1,9})/[^/]+")


def place_of(path: str) -> int | None:
    """Return the place of the robot that wrote a file directly into its folder; None for any other file."""
    found = _DIRECT.fullmatch(path)
    return int(found[1]) if found else None


def own(output: Output) -> str:
    """Return the path of an output in the folder of a robot."""
    path = output.file.removeprefix("./")
    return path.partition("/")[2] if path.startswith(FOLDERS) else path


def of_name(column: str, file: str) -> str:
    """Return what a column from the name of a file is, and how to give it another name, for messages."""
    if column != COLUMN or "/" not in file:
        return "that is a number in its name; use another name in braces"
    own = file.partition("/")[2]
    return f'that is the place of the robot that wrote it; declare it with file = "{{place}}/{own}"'


def lacking(output: Output, paths: Iterable[str], robots: Mapping[int, str]) -> int | None:
    """Return the place of the first robot that did not write an output that all robots write; None if all did.

    The base station need not write it.
    """
    if not output.file.removeprefix("./").startswith(FOLDERS):
        return None
    wrote = {numbers[0] for path in paths if (numbers := output.ticks_of(path)) is not None}
    return next((place for place in sorted(robots) if place != BASE and place not in wrote), None)


def named(place: int, robots: Mapping[int, str]) -> str:
    """Return a robot for messages: `robot 2 (tb3-07)`."""
    name = "the base station" if place == BASE else f"robot {place}"
    return f"{name} ({robots[place]})" if robots.get(place) else name


def markers(marker: str, result: Result) -> tuple[str, ...]:
    """Return the paths of the files that must exist in the output folder: a marker of each robot, or the one that is named."""
    if not result.robots or place_of(marker) is not None:
        return (marker,)
    return tuple(f"{place}/{marker}" for place in sorted(result.robots) if place != BASE)
