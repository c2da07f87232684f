"""Figures of every kind with few and many categories, short, long and Chinese names, as wide as a column and as a page.

    python -m tests.gallery FOLDER [KIND...]

writes them as PNG files, and what is not fit for print.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from sierra.config.deliverable_tables import Comparison
from sierra.config.plugin_registry import FIGURES
from sierra.deliverables import comparison_figure
from sierra.deliverables.comparison import Compared
from sierra.deliverables.figures import drawing as figures
from sierra.deliverables.figures import style
from sierra.deliverables.figures.drawing import Drawing
from sierra.errors import SierraError
from sierra.model import Axis
from sierra.stats.comparison.model import Analysis, Pair, Pairing, Question
from sierra.testing.figures import Row, Trial
from tests.drawings import noise
from tests.print_faults import faults

COUNTS = (1, 4, 12, 40)
SIZES = ("acm-column", "acm-page")
"""8.5 cm and 17.8 cm."""
NAMES = {
    "short": ("alpha", "foraging", "dispersal", "flocking", "pso", "boids", "explorer", "levy", "random", "greedy"),
    "long": ("controller with pheromone trails and memory of", "greedy controller without communication, threshold"),
    "Chinese": ("基于信息素的群体控制器", "随机游走控制器"),
}
KEYS: Mapping[str, Mapping[str, Any]] = {
    "stacked": {"column": ("energy", "distance")},
    "scatter": {"column": ("energy", "distance")},
    "pareto": {"column": ("energy", "distance"), "better": ("high", "low")},
    "embedding": {"column": ("energy", "distance")},
    "trajectories": {"column": ("x", "y"), "robot": "robot"},
    "density": {"column": ("x", "y")},
    "matrix": {"column": ("place", "other", "energy")},
    "confusion": {"column": ("truth", "guess")},
    "roc": {"column": ("flag", "score"), "positive": "yes"},
    "pr": {"column": ("flag", "score"), "positive": "yes"},
    "risk_coverage": {"column": ("loss", "score")},
    "network": {"column": ("truth", "guess", "score")},
    "survival": {"measure": "time_to", "threshold": 3.0},
    "critical_difference": {"better": "low"},
}
"""The keys of kinds, besides `column` with one column."""
PAIRED = ("heatmap",)
"""The kinds that need two variables."""


def names(count: int, letters: str) -> tuple[str, ...]:
    known = NAMES[letters]
    return tuple(known[k] if k < len(known) and letters == "short" else f"{known[k % len(known)]} {k}" for k in range(count))


def row(experiment: int, run: int, row: int) -> Row:
    some, other = noise(experiment, run, row), noise(run, row, experiment, 3)
    return {
        "energy": 0.2 * experiment + row / 2 + some + 0.1,
        "distance": 3 + other * (1 + experiment % 4) + row,
        "x": 8 * some + row / 3,
        "y": 5 * other + row / 4,
        "robot": f"robot {run % 2}",
        "place": float(row % 4),
        "other": float(row // 4 + run % 3),
        "truth": ("searching", "homing", "avoiding")[(row + run) % 3],
        "guess": ("searching", "homing", "avoiding")[(row + run + (some > 0.6)) % 3],
        "flag": ("no", "yes")[row % 2],
        "score": some * 0.6 + 0.4 * (row % 2),
        "loss": other,
    }


def drawing(kind: str, axes: tuple[Axis, ...], size: str, **keys: Any) -> Drawing:
    """Return a drawing of generated data. Raises SierraError if the kind refuses these variables."""
    column = {"column": ("energy",), **KEYS.get(kind, {})}
    return Trial(kind, {**column, "size": size, **keys}, row, axes).drawing(runs=lambda _: 5)


def painted(shown: Drawing) -> Figure:
    """Return the complete figure. To be called under `style.applied`."""
    figures.check(shown)
    return figures.painted(figures.noted(shown))


def cases(kinds: tuple[str, ...]) -> Iterator[tuple[str, str, tuple[Axis, ...], dict[str, Any]]]:
    """Yield name, kind, variables and keys of each figure without its size."""
    second = Axis("noise", ("calm", "windy"))
    for kind in kinds:
        for count, letters in product(COUNTS, NAMES):
            axes = (Axis("controller", names(count, letters)), *([second] if kind in PAIRED else []))
            yield f"{kind}-{count}-{letters}", kind, axes, {}
        sizes = Axis("size", (1, 2, 4, 8), unit="robots"), Axis("controller", names(3, "short")), second
        yield f"{kind}-grid", kind, sizes[:2], {}
        yield f"{kind}-grid3", kind, sizes, {}
        yield f"{kind}-facet", kind, sizes, {} if kind == "network" else {"facet": "controller"}


def found(kind: str, axes: tuple[Axis, ...], size: str, folder: Path | None = None, name: str = "", **keys: Any) -> list[str]:
    """Draw a figure; return its faults. A refusal in one line is no fault."""
    try:
        shown = drawing(kind, axes, size, **keys)
        with style.applied(shown.figure):
            figure = painted(shown)
            if folder:
                figure.savefig(folder / f"{name}.png", dpi=300)
            return faults(figure)
    except SierraError as error:
        if folder:
            print(f"{name}: refused: {error}")
        return []


@contextmanager
def comparison(groups: tuple[str, ...], size: str) -> Iterator[Figure]:
    """Yield the figure of a comparison of groups with the first one, for three values of a variable with a long name."""
    pairs = tuple(
        Pair({"communication_range": reach}, groups[0], group, 9, 9, "", k - 2.0, k - 3.0, k - 1.0, 0.5, 0.01, 0.0)
        for reach in (0.25, 0.5, 1.0)
        for k, group in enumerate(groups[1:])
    )
    analysis = Analysis(groups, Question(), Pairing(paired=True, reason=""), pairs)
    asked = Comparison.model_validate({"size": size})
    compared = Compared("compared", {"0": "0"}, "swarm", "coverage", "mean", "m", analysis, text="", brief="", asked=asked)
    shown = comparison_figure.drawing_of(compared)
    with style.applied(shown.figure):
        yield comparison_figure.painted(compared, shown)[0]


def main(folder: str, *kinds: str) -> None:
    Path(folder).mkdir(parents=True, exist_ok=True)
    for (name, kind, axes, keys), size in product(cases(kinds or tuple(FIGURES.shipped)), SIZES):
        called = f"{name}-{size.partition('-')[2]}"
        lines = found(kind, axes, size, Path(folder), called, **keys)
        for line in lines:
            print(f"{called}: {line}")


if __name__ == "__main__":
    main(*sys.argv[1:])
