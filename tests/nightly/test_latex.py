"""Figures as drawing commands and tables for papers are what a real LaTeX takes; tables fit a column."""

from __future__ import annotations

import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from sierra.deliverables.paper_tables import OUTSIDE_TEXT, SPECIAL
from sierra.model import Axis
from sierra.testing.figures import Trial
from tests import projects
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
    return typeset(pdflatex, DOCUMENT, folder)


def typeset(pdflatex: str, document: str, folder: Path) -> str:
    """Return the output of LaTeX for a document in a folder."""
    (folder / "paper.tex").write_text(document)
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


TABLES = r"""
[paper_tables.means]
column = "coverage"
caption = "Coverage of the arena."
label = "tab:means"

[paper_tables.sizes]
column = "coverage"
across = "population_size"
caption = "Coverage by size ($\\pm$ is half the interval)."
headers = { noise = "$\\sigma$" }
latex = true

[paper_tables.two]
column = "coverage"
statistics = ["mean", "median"]
experiments = "noise=0.1"
"""
CLASSES = {"IEEEtran": "conference", "acmart": "sigconf,nonacm"}


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with tables, and comparisons with their texts."""
    root = projects.make(tmp_path_factory.mktemp("tables") / "project", projects.CONFIG + TABLES)
    project = sierra.open(root)
    batch = project.run("population_size=1,2,4", "noise=0.1,0.5", runs=8).batch
    for by in ("population_size", "noise", "population_size,noise"):
        compared = project.comparisons.make(batch, by=by.split(","), column="coverage")
        text = project.comparisons.text(compared, "latex", caption="Differences of coverage")
        (root / "figures" / batch[:10] / f"by_{by.replace(',', '_and_')}.tex").write_text(text)
    return root / "figures" / batch[:10]


@pytest.mark.parametrize("name", CLASSES)
def test_tables_and_texts_fit_a_column(require: Callable[..., str], tables: Path, tmp_path: Path, name: str) -> None:
    names = [*tomllib.loads(TABLES)["paper_tables"], *(path.stem for path in sorted(tables.glob("by_*.tex")))]
    inputs = "\n\n".join(rf"\input{{{tables / one}}}" for one in names)
    text = rf"""\documentclass[{CLASSES[name]}]{{{name}}}
\usepackage{{booktabs}}
\begin{{document}}
\author{{A}}\title{{B}}\maketitle
{inputs}
\end{{document}}
"""
    said = typeset(require("pdflatex"), text, tmp_path)
    assert "Overfull \\hbox" not in said
