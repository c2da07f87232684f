"""Drawings of kinds of figures in tests: their panels, and why they cannot be drawn."""

from __future__ import annotations

import math
from typing import Any

import pytest

from sierra.deliverables.figures import style
from sierra.deliverables.figures.drawing import Drawing, check, noted, painted
from sierra.errors import SierraError


def plot(drawing: Drawing) -> Any:
    """Return the first panel of a figure."""
    with style.applied(drawing.figure):
        return painted(drawing).axes[0]


def refusal(drawing: Drawing) -> str:
    """Return the message why a figure cannot be drawn."""
    with pytest.raises(SierraError) as error:
        _draw(drawing)
    return str(error.value)


def _draw(drawing: Drawing) -> None:
    check(drawing)
    noted(drawing)
    plot(drawing)


def noise(*places: int) -> float:
    """Return a number from 0 to 1 that looks random but is always the same."""
    return math.modf(abs(math.sin(sum(12.9898 * (k + 1) * place for k, place in enumerate(places))) * 43758.5453))[0]
