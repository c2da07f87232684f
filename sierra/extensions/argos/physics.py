"""Physics engines of ARGoS that share an arena: a grid of equal rectangles, each the area of one engine.

An engine's area is given by its corners, counter-clockwise, as the description of `dynamics2d` (`argos3 -q dynamics2d`) says.
Neighbours have the same numbers, rounded to micrometres, so that the areas cover the arena without gaps.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import pairwise
from xml.sax.saxutils import quoteattr

from sierra.design.query import ranges
from sierra.util.lazy_definitions import dataclass

MICROMETRE = Fraction(1, 10**6)


@dataclass(frozen=True, slots=True)
class Box:
    """The space that engines share: its lowest and its highest corner."""

    low: tuple[Fraction, Fraction, Fraction]
    high: tuple[Fraction, Fraction, Fraction]


@dataclass(frozen=True, slots=True)
class Engine:
    """The properties that all engines of an arena have."""

    tag: str
    iterations: str | None
    spatial_hash: tuple[str, str] | None
    """Size and number of the cells."""


def corners(count: int, space: Box) -> tuple[tuple[str, ...], ...]:
    """Return the corners of each engine's area as `x,y`, row by row."""
    columns, rows = _grid(count, space)
    xs, ys = _edges(space.low[0], space.high[0], columns), _edges(space.low[1], space.high[1], rows)
    return tuple(
        tuple(f"{x},{y}" for x, y in ((left, low), (right, low), (right, high), (left, high)))
        for low, high in pairwise(ys)
        for left, right in pairwise(xs)
    )


def elements(count: int, space: Box, engine: Engine) -> Iterator[str]:
    """Yield the XML of each engine."""
    top, bottom = ranges.plain(space.high[2]), ranges.plain(space.low[2])
    iterations = "" if engine.iterations is None else f" iterations={quoteattr(engine.iterations)}"
    cells = engine.spatial_hash
    hashed = f"<spatial_hash cell_size={quoteattr(cells[0])} cell_num={quoteattr(cells[1])}/>" if cells else ""
    for number, points in enumerate(corners(count, space)):
        sides = "".join(f'<vertex point="{point}"/>' for point in points)
        boundaries = f'<boundaries><top height="{top}"/><bottom height="{bottom}"/><sides>{sides}</sides></boundaries>'
        yield f'<{engine.tag} id="{engine.tag}_{number}"{iterations}>{hashed}{boundaries}</{engine.tag}>'


def _grid(count: int, space: Box) -> tuple[int, int]:
    """Return the numbers of columns and rows whose rectangles are closest to squares."""
    x, y = space.high[0] - space.low[0], space.high[1] - space.low[1]

    def elongation(columns: int) -> Fraction:
        ratio = (x / columns) / (y / (count // columns))
        return max(ratio, 1 / ratio)

    columns = min((n for n in range(1, count + 1) if count % n == 0), key=lambda n: (elongation(n), -n))
    return columns, count // columns


def _edges(low: Fraction, high: Fraction, count: int) -> list[str]:
    exact = (low + (high - low) * Fraction(n, count) for n in range(count + 1))
    return [ranges.plain(round(edge / MICROMETRE) * MICROMETRE) for edge in exact]
