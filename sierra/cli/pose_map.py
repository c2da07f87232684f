"""Map of start poses, drawn with characters, for the person who places robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sierra.model import Area, Pose

COLUMNS, ROWS = 48, 16
"""The largest size of the map in characters, without its frame."""
ASPECT = 2.0
"""The height of a character, as a multiple of its width."""
LEAST_M = 0.5
"""The extent of the map in a direction in which all poses are the same, in m."""
ARROWS, PLAIN_ARROWS = "→↗↑↖←↙↓↘", ">/^\\</v\\"
"""Headings in steps of 45 degrees, counterclockwise from the direction of x."""
SEVERAL = "*"


def draw(
    poses: Sequence[Pose], area: Area | None = None, names: Mapping[int, str] | None = None, *, plain: bool = False
) -> list[str]:
    """Return the lines of a map and a list of the poses. With `plain`, only ASCII characters are used.

    Robots are numbered from 1; the arrow behind a number is the heading. `*` stands for several robots. The map shows `area`,
    and also poses outside of it. `names` are those of robots, by number.
    """
    corners = map(Pose, *area) if area else ()
    (left, right), (low, high) = map(_extent, Area.around([*corners, *poses]) or Area((0, 0), (0, 0)))
    step = max((right - left) / (COLUMNS - 4), (high - low) / ASPECT / (ROWS - 1))
    columns, rows = round((right - left) / step) + 4, round((high - low) / step / ASPECT) + 1
    cells = [[" "] * columns for _ in range(rows)]
    for number, pose in enumerate(poses, 1):
        row = cells[rows - 1 - round((pose.y - low) / step / ASPECT)]
        at = round((pose.x - left) / step)
        text = f"{number}{_arrow(pose.heading, plain=plain)}"
        if any(row[place] != " " for place in range(at, min(at + len(text), columns))):
            text = SEVERAL
        for place, character in enumerate(text, at):
            if place < columns:
                row[place] = character
    edge = f"+{'-' * columns}+"
    scale = f"x: {left:g} to {right:g} m (to the right), y: {low:g} to {high:g} m (up)"
    degrees = " degrees" if plain else "°"
    return [edge, *(f"|{''.join(row)}|" for row in cells), edge, scale, *_listed(poses, names or {}, degrees)]


def numbered(number: int, names: Mapping[int, str]) -> str:
    """Return the number of a robot with its name, if it is known."""
    return f"{number} ({names[number]})" if number in names else str(number)


def _listed(poses: Sequence[Pose], names: Mapping[int, str], degrees: str) -> list[str]:
    """Return a line for each pose."""
    heading = [f", heading {pose.heading:g}{degrees}" if pose.heading is not None else "" for pose in poses]
    return [
        f"  {numbered(number, names)}: x {pose.x:g} m, y {pose.y:g} m{heading[number - 1]}"
        for number, pose in enumerate(poses, 1)
    ]


def _extent(limits: tuple[float, float]) -> tuple[float, float]:
    """Return the range that the map shows."""
    low, high = limits
    missing = 0.0 if high > low else LEAST_M / 2
    return low - missing, high + missing


def _arrow(heading: float | None, *, plain: bool) -> str:
    if heading is None:
        return ""
    return (PLAIN_ARROWS if plain else ARROWS)[round(heading / 45) % 8]
