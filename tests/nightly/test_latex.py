"""Figures as drawing commands for LaTeX are what a real LaTeX takes."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.deliverables.paper_tables import OUTSIDE_TEXT, SPECIAL
from sierra.model import Axis
from sierra.testing.figures import Trial
from tests.unit.testing.test_figures import KINDS

pytestmark = pytest.mark.real

DOCUMENT = r"""\documentclass{article}
\usepackage{pgf}
\begin{document}
\input{figure.pgf}
\end{document}
"""


def compiled(pdflatex: str, picture: bytes, folder: Path) -> str:
    """Return the output of LaTeX for a document with the picture."""
    (folder / "figure.pgf").write_bytes(picture)
    (folder / "paper.tex").write_text(DOCUMENT)
    words = [pdflatex, "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, errors="replace", check=False, timeout=300)
    assert done.returncode == 0, done.stdout[-2000:]
    return done.stdout


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_of_figure_can_be_included(require: Callable[..., str], tmp_path: Path, kind: str) -> None:
    keys, values, axes = KINDS[kind]
    trial = Trial(kind, keys, values, axes)
    assert "Output written on paper.pdf (1 page" in compiled(
        require("pdflatex"), trial.drawn(trial.drawing(), ("pgf",))["pgf"], tmp_path
    )


def test_text_can_have_all_characters_that_are_special_or_known(require: Callable[..., str], tmp_path: Path) -> None:
    text = "".join((*SPECIAL, *OUTSIDE_TEXT, " · … – é ½ ’"))
    trial = Trial("summary", {"title": text, "ylabel": text[:30], "xlabel": text[30:]}, axes=(Axis("a_b", (1, 1000)),))
    compiled(require("pdflatex"), trial.drawn(trial.drawing(log_y=True), ("pgf",))["pgf"], tmp_path)
