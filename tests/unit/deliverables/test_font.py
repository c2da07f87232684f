"""The small font of figures gives the same pictures as the complete one."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sierra.deliverables.figures import font, style


def pixels(text: str, *family: str) -> bytes:
    with style.applied():
        figure = Figure(figsize=(2, 0.4))
        canvas = FigureCanvasAgg(figure)
        figure.text(0.02, 0.3, text, family=list(family))
        canvas.draw()
        return np.asarray(canvas.buffer_rgba()).tobytes()


@pytest.mark.parametrize("text", ["AVA Ty 0.95 – µ²", "Größe ≥ λ₁ → Яшка", "שלום AV"])
def test_texts_look_as_in_the_complete_font_also_with_letters_of_it_only(text: str) -> None:
    small = pixels(text, font.FAMILY, "DejaVu Sans")
    assert small == pixels(text, "DejaVu Sans")
    assert small != pixels("", "DejaVu Sans")


def test_the_file_is_what_the_module_makes_of_the_complete_font() -> None:
    assert font.made() == font.FILE.read_bytes(), "python -m sierra.deliverables.figures.font writes it again"
