"""The picture of the packages of `sierra/` in the documentation: `make pictures` draws it from the imports in the code.

    python -m tests.architecture

A package stands one row above the highest package that it imports; packages that import each other stand in one row. If A
imports B and C, and B imports C, the arrow from A to C is left out. The order in the rows is that of Sugiyama, Tagawa and Toda
(1981): an arrow that passes rows has a place in each of them, and each place moves to the mean of its neighbours' places.
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import mean

ROOT = Path(__file__).parents[1]
CODE = ROOT / "sierra"
PICTURE = ROOT / "docs" / "pictures" / "architecture.svg"

Graph = Mapping[str, frozenset[str]]
"""Names of packages, and of modules beside them, with those that each imports."""

WIDTH, BOX, ROW, MARGIN, GAP, PASSAGE = 640, 34, 56, 14, 26, 12
"""Sizes in pixels: of the picture, a box's height, a row's, the space around rows, between places, and for a passing arrow."""
SWEEPS = 8
HEAD = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="Helvetica, Arial, sans-serif" \
fill="#1a202c" text-anchor="middle" role="img">
<title>The packages of SIERRA, each above those that it imports</title>
<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="6" markerHeight="6" orient="auto">\
<path d="M0 0 L8 4 L0 8 z" fill="#718096"/></marker></defs>
<rect width="{width}" height="{height}" fill="#ffffff"/>
"""


def imports(code: Path = CODE) -> Graph:
    """Return what each package imports of the others; an import only for types counts like any other."""
    names = sorted(path.stem for path in code.iterdir() if _is_package(path))
    return {name: frozenset(_imported(code, name) & set(names) - {name}) for name in names}


def _is_package(path: Path) -> bool:
    return (path / "__init__.py").is_file() or (path.suffix == ".py" and path.stem != "__init__")


def _imported(code: Path, name: str) -> set[str]:
    files = sorted((code / name).rglob("*.py")) or [code / f"{name}.py"]
    return {word for file in files for word in _words(ast.parse(file.read_text("utf-8")))}


def _words(tree: ast.Module) -> Iterator[str]:
    """Yield the names right below `sierra` that a module imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            paths = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == "sierra":
            paths = [f"sierra.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            paths = [node.module or ""]
        else:
            continue
        yield from (path.split(".")[1] for path in paths if path.startswith("sierra."))


def reachable(graph: Graph) -> dict[str, set[str]]:
    """Return all that each package imports, directly or through others."""
    known = {name: set(below) for name, below in graph.items()}
    for middle in graph:
        for below in known.values():
            if middle in below:
                below |= known[middle]
    return known


def rows(graph: Graph) -> list[list[str]]:
    """Return the packages by rows, the lowest first."""
    known = reachable(graph)
    heights: dict[str, int] = {}

    def height(name: str) -> int:
        if name not in heights:
            circle = {other for other in known[name] if name in known[other]} | {name}
            under = {other for member in circle for other in graph[member]} - circle
            heights.update(dict.fromkeys(circle, 1 + max(map(height, under), default=-1)))
        return heights[name]

    top = max(map(height, graph))
    return [sorted(name for name in graph if heights[name] == row) for row in range(top + 1)]


def arrows(graph: Graph) -> list[tuple[str, str]]:
    """Return the imports that do not follow from others."""
    known = reachable(graph)
    return [
        (name, other)
        for name in sorted(graph)
        for other in sorted(graph[name])
        if not any(other in known[middle] and name not in known[middle] for middle in graph[name] - {other})
    ]


Route = tuple[str, ...]
"""The places of an arrow from row to row: the package, one place in each row that the arrow passes, the imported package."""


def routes(graph: Graph) -> list[Route]:
    """Return the route of each arrow from the top down. Places in passed rows have the names of both packages."""
    row = {name: number for number, names in enumerate(rows(graph)) for name in names}
    return [
        (name, *(f"{name} {other} {number}" for number in range(row[name] - 1, row[other], -1)), other)
        for name, other in arrows(graph)
        if row[name] != row[other]
    ]


def ordered(graph: Graph) -> list[list[str]]:
    """Return the places of each row from left to right, the lowest row first, with few crossings of arrows."""
    levels = [list(names) for names in rows(graph)]
    height = {name: number for number, names in enumerate(levels) for name in names}
    neighbours: dict[str, list[str]] = {}
    for route in routes(graph):
        for steps, place in enumerate(route[1:-1], 1):
            levels[height[route[0]] - steps].append(place)
        for upper, lower in pairwise(route):
            neighbours.setdefault(upper, []).append(lower)
            neighbours.setdefault(lower, []).append(upper)
    for sweep in range(SWEEPS):
        upwards = sweep % 2 == 0
        numbers = range(1, len(levels)) if upwards else range(len(levels) - 2, -1, -1)
        for number in numbers:
            beside = _positions(levels[number - 1 if upwards else number + 1])
            own = _positions(levels[number])
            levels[number].sort(key=lambda place: (_mean_of(neighbours.get(place, []), beside, own[place]), place))
    return levels


def _mean_of(names: Sequence[str], positions: Mapping[str, float], default: float) -> float:
    known = [positions[name] for name in names if name in positions]
    return round(mean(known), 3) if known else default


def _positions(level: Sequence[str]) -> dict[str, float]:
    """Return the middle of each place of a row, which stands in the middle of the picture."""
    widths = [PASSAGE if " " in place else 34 + 8 * len(place) for place in level]
    left = (WIDTH - sum(widths) - GAP * (len(widths) - 1)) / 2
    middles = {}
    for place, width in zip(level, widths, strict=True):
        middles[place] = left + width / 2
        left += width + GAP
    return middles


def picture(graph: Graph, layers: Mapping[str, int]) -> str:
    """Return the picture as SVG. `layers` has the floor of each package in the rules of imports."""
    levels = ordered(graph)
    height = 2 * MARGIN + ROW * (len(levels) - 1) + BOX
    points = {
        place: (x, height - MARGIN - BOX / 2 - ROW * number)
        for number, level in enumerate(levels)
        for place, x in _positions(level).items()
    }
    parts = [HEAD.format(width=WIDTH, height=height)]
    parts += [_arrow([points[place] for place in route]) for route in routes(graph)]
    parts += [_box(name, *points[name], layers[name]) for name in sorted(graph)]
    return "".join(parts) + "</svg>\n"


def _arrow(points: Sequence[tuple[float, float]]) -> str:
    path = f"M{points[0][0]:g} {points[0][1]:g}"
    for (x, y), (to_x, to_y) in pairwise(points):
        end = to_y - BOX / 2 - 2 if (to_x, to_y) == points[-1] else to_y
        bend = (end - y) / 2
        path += f" C{x:g} {y + bend:g} {to_x:g} {end - bend:g} {to_x:g} {end:g}"
    return f'<path d="{path}" stroke="#718096" stroke-width="1.2" marker-end="url(#tip)" fill="none"/>\n'


def _box(name: str, x: float, y: float, layer: int) -> str:
    width = 34 + 8 * len(name)
    left, top = x - width / 2, y - BOX / 2
    return (
        f'<rect x="{left:g}" y="{top:g}" width="{width}" height="{BOX}" rx="6" fill="#e6f0fa" stroke="#4a5568"/>\n'
        f'<text x="{x:g}" y="{y:g}" font-size="14" font-weight="bold">{name}</text>\n'
        f'<text x="{x:g}" y="{y + 13:g}" font-size="10">floor {layer}</text>\n'
    )


def floors() -> dict[str, int]:
    """Return the floor of each package in the contract that `make check` enforces, the lowest is 1."""
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]
    (layers,) = (contract["layers"] for contract in tool["importlinter"]["contracts"] if contract["id"] == "layers")
    names = [line.replace(":", "|").split("|") for line in reversed(layers)]
    return {name.strip(): number for number, line in enumerate(names, 1) for name in line}


def main() -> None:
    """Draw the picture of the code."""
    PICTURE.write_text(picture(imports(), floors()), "utf-8")
    print(f"{PICTURE.stat().st_size / 1000:5.1f} kB  {PICTURE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
