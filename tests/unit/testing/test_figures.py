"""The shipped kinds of figures fulfil their contract, and the suite notices kinds that do not."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import pytest

from sierra.config.field_types import RawTable
from sierra.config.plugin_registry import FIGURES
from sierra.model import Axis
from sierra.testing import figures as conformance
from tests import plugins

ONE = (Axis("size", (1, 2)),)
TWO = (*ONE, Axis("scenario", ("low", "high")))


def matrices(experiment: int, run: int, row: int) -> conformance.Row:
    return {"row": float(row // 4), "place": float(row % 4), "heat": conformance.numbers(experiment, run, row)["energy"]}


def guesses(experiment: int, run: int, row: int) -> conformance.Row:
    truth = (run + row // 2) % 2
    score = truth * 0.3 + float(conformance.numbers(experiment, run, row)["distance"] or 0) % 0.7
    return {"truth": "ab"[truth], "guess": "ab"[score > 0.5], "score": score, "loss": float((score > 0.5) != truth)}


def growth(experiment: int, run: int, row: int) -> conformance.Row:
    return {"energy": row * conformance.numbers(experiment, run, 0)["distance"] % 3.0}  # type: ignore[operator]


def links(experiment: int, run: int, row: int) -> conformance.Row:
    noise = float(conformance.numbers(experiment, run, row)["distance"] or 0)
    return {"source": f"robot {row}", "target": f"robot {int(noise * 100) % 7}", "weight": noise}


KINDS: dict[str, tuple[RawTable, conformance.Values, tuple[Axis, ...]]] = {
    "timeseries": ({}, conformance.numbers, ONE),
    "summary": ({}, conformance.numbers, TWO),
    "box": ({}, conformance.numbers, TWO),
    "violin": ({}, conformance.numbers, ONE),
    "heatmap": ({}, conformance.numbers, TWO),
    "stacked": ({"column": ("energy", "distance")}, conformance.numbers, ONE),
    "strip": ({}, conformance.numbers, TWO),
    "bar": ({}, conformance.numbers, TWO),
    "ecdf": ({}, conformance.numbers, TWO),
    "histogram": ({"bins": 12}, conformance.numbers, ONE),
    "ridge": ({}, conformance.numbers, TWO),
    "scatter": ({"column": ("energy", "distance"), "fit": "linear"}, conformance.numbers, TWO),
    "trajectories": ({"column": ("energy", "distance")}, conformance.numbers, ONE),
    "density": ({"column": ("energy", "distance")}, conformance.numbers, TWO),
    "matrix": ({"column": ("row", "place", "heat")}, matrices, TWO),
    "confusion": ({"column": ("truth", "guess")}, guesses, ONE),
    "roc": ({"column": ("truth", "score"), "positive": "b"}, guesses, TWO),
    "pr": ({"column": ("truth", "score"), "positive": "b"}, guesses, ONE),
    "risk_coverage": ({"column": ("loss", "score")}, guesses, TWO),
    "survival": ({"measure": "time_to", "threshold": 2.5}, growth, TWO),
    "critical_difference": ({"better": "low"}, growth, ONE),
    "network": ({"column": ("source", "target", "weight"), "at": "last"}, links, ONE),
    "embedding": ({"column": ("energy", "distance")}, conformance.numbers, TWO),
    "pareto": ({"column": ("energy", "distance"), "better": ("high", "low")}, conformance.numbers, TWO),
}


@pytest.mark.integration
@pytest.mark.parametrize("kind", FIGURES.shipped)
def test_each_shipped_kind_fulfils_the_contract(kind: str) -> None:
    conformance.check(kind, *KINDS[kind])


BROKEN = """
import random
from sierra.plugin import Needs, NoOptions, UsageError
class Broken:
    contract = 1
    Options = NoOptions
    uses = frozenset()
    def __init__(self, options): pass
    def needs(self, request): return Needs(("mean",))
    def notes(self, drawing): return ()
    def draw(self, drawing):
        from sierra.deliverables.figures import style
        figure = style.blank()
        (table,) = drawing.tables.values()
        figure.add_subplot().plot(style.column(table, "mean"))
        return figure
"""


@pytest.mark.integration
@pytest.mark.parametrize(
    ("claim", "old", "new", "complaint"),
    [
        ("loads_nothing_heavy", "import random", "import random, matplotlib", "imports matplotlib"),
        ("gives_the_same_bytes_again", 'style.column(table, "mean")', "[random.random()] * 2", "give other bytes"),
        ("gives_the_same_bytes_again", 'style.column(table, "mean")', "[1, 2]", "other data give the same figure"),
        ("draws_few_and_unequal_runs", "(table,) =", "raise UsageError('two\\nlines')\n        (table,) =", "is not one line"),
        (
            "keeps_text_within_the_figure",
            "return figure",
            "figure.text(1, 0.5, 'far'); return figure",
            "leaves the figure",
        ),
    ],
)
def test_the_suite_notices_a_kind_that_breaks_its_contract(
    claim: str, old: str, new: str, complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"broken_{sha256((claim + new).encode()).hexdigest()}"
    place = plugins.write(tmp_path, name, {"sierra.figures broken": "Broken"}, BROKEN.replace(old, new))
    monkeypatch.syspath_prepend(str(place))
    monkeypatch.setenv("PYTHONPATH", str(place))
    with pytest.raises(AssertionError, match=complaint):
        getattr(conformance, claim)(conformance.Trial("broken"))
