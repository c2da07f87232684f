"""The example `paper`: one command makes all that its LaTeX includes, and LaTeX makes a PDF of it."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import projects


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper") / "example"
    made = projects.quick(folder.parent, "init", "--example", "paper", str(folder))
    assert made.returncode == 0, made.stderr
    assert made.stdout.splitlines()[-1].endswith("sierra paper")
    projects.commit(folder)
    done = projects.quick(folder, "paper")
    assert done.returncode == 0, done.stderr
    return folder


def test_everything_that_the_paper_includes_is_there(example: Path) -> None:
    text = (example / "paper" / "paper.tex").read_text()
    included = [f"{name}.tex" for name in re.findall(r"\\input\{(sierra/[^}]+)\}", text)]
    included += [f"sierra/figures/{name}.pdf" for name in re.findall(r"\\includegraphics\{([^}]+)\}", text)]
    assert len(included) == 9
    assert [name for name in included if not (example / "paper" / name).is_file()] == []
    macros = (example / "paper" / "sierra" / "numbers.tex").read_text()
    used = set(re.findall(r"\\(sierra[a-z]+)", text))
    assert used <= set(re.findall(r"\\newcommand\{\\([a-z]+)\}\{[^}]", macros))
    assert projects.quick(example, "paper", "--check").returncode == 0
    claims = projects.quick(example, "claims")
    assert claims.returncode == 0, claims.stdout
    table = (example / "paper" / "sierra" / "tables" / "coverage.tex").read_text()
    assert "random walk" in table, "tables show labels, as figures do"


@pytest.mark.nightly
def test_latex_makes_a_pdf(example: Path, require: Callable[..., str]) -> None:
    words = [require("pdflatex"), "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    for _ in range(2):  # references
        done = subprocess.run(
            words, cwd=example / "paper", capture_output=True, text=True, errors="replace", check=False, timeout=300
        )
        assert done.returncode == 0, done.stdout[-3000:]
    assert "undefined" not in done.stdout
    assert (example / "paper" / "paper.pdf").stat().st_size > 20_000
