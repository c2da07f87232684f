"""Captions beside figures have the text of the small print, and are recorded with the figure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import sierra
from sierra.deliverables.figures import drawing as figures
from sierra.deliverables.figures.captions import caption
from sierra.deliverables.record import ORIGIN, origin_of
from sierra.testing.figures import Trial
from tests import projects
from tests.tiers import of_extension
from tests.unit.deliverables.test_figures import NAMES, SIZES, drawing


def test_a_caption_says_what_is_shown_n_the_interval_and_the_footnote() -> None:
    shown = drawing("timeseries", (SIZES, NAMES), footnote="after Smith")
    assert caption(shown) == (
        "Energy [J] over time [s], by population size [robots], scenario. Mean, 95 % CI, n = 8–10; 2 of 40 runs missing. "
        "after Smith."
    )
    assert caption(replace(drawing("summary", title="How far?"), note="")) == "How far?"
    timed = drawing("bar", (), measure="time_to", threshold=3.0)
    assert caption(timed).startswith("Time until energy ≥ 3 [s]. Mean, 95 % CI")


@pytest.mark.parametrize(
    ("kind", "columns", "words"),
    [
        ("density", ("energy", "distance"), "Energy, distance, by size. Part of all rows in each cell, n = 6."),
        *of_extension(
            "figures",
            ("pareto", ("energy", "distance"), "Final energy, final distance, by size. Mean, 95 % CI (Student's t), n = 6."),
        ),
    ],
)
def test_captions_of_several_columns_name_them_all(kind: str, columns: tuple[str, ...], words: str) -> None:
    assert caption(Trial(kind, {"column": columns}).drawing()) == words


def test_the_files_have_the_complete_small_print_and_no_special_character_of_latex(tmp_path: Path) -> None:
    shown = drawing("summary", title="50 % of $x_1$", log_y=True)
    *_, txt, tex = figures.draw(shown, tmp_path)
    text, origin = txt.read_text().split("\n\n")
    assert text == f"50 % of $x_1$. M{figures.noted(shown).note[1:]}."
    assert origin == f"{origin_of(shown.batch, shown.data)}\n"
    lines = tex.read_text().splitlines()
    assert lines[0].startswith(r"\caption{50 \% of \$x\_1\$. Mean, 95 \% CI, n = 8–10")
    assert lines[1:] == [r"\label{fig:summary}", f"% {origin.strip()}"]
    assert ORIGIN.search(tex.read_bytes())


@pytest.mark.integration
def test_captions_are_recorded_checked_and_found_by_their_content(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "project")
    assert projects.quick(folder, "run", "population_size=1,2").returncode == 0
    txt = next(folder.glob("figures/*/swarm_coverage_summary.txt"))
    (files,) = (
        sierra.open(folder).sql("SELECT files FROM deliverables WHERE name = 'swarm_coverage_summary'").column(0).to_pylist()
    )
    assert [Path(file).suffix for file in files] == [".png", ".pdf", ".svg", ".txt", ".tex"]
    assert "swarm_coverage_summary" in projects.quick(folder, "show", str(txt)).stdout
    txt.write_text(txt.read_text().replace("n = 2", "n = 200"))
    done = projects.quick(folder, "figures", "--check")
    assert done.returncode == 1
    assert f"{txt.name} is not the file that SIERRA made" in done.stdout + done.stderr
    assert "the file was changed" in projects.quick(folder, "show", str(txt)).stderr
