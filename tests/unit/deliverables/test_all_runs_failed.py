"""A batch of which all runs failed says so, with the first reason, wherever its outputs are wanted."""

from __future__ import annotations

from pathlib import Path

import pytest

import sierra
from tests import projects

DECLARED = """
[figures.covered]
kind = "timeseries"
table = "swarm"
column = "coverage"
[figures.summed]
kind = "summary"
column = "coverage"
[claims.some]
says = "Robots cover something."
paper = "Fig. 1"
query = "population_size=1,2"
runs = 2
sql = "SELECT avg(coverage) > 0 AS holds FROM swarm"
"""
WHY = "all 4 runs failed: exit status 7"


@pytest.fixture(scope="module")
def failed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a project and its batch, of which all runs failed."""
    root = projects.make(tmp_path_factory.mktemp("failed") / "p", projects.CONFIG + DECLARED, simulator="raise SystemExit(7)\n")
    return root, sierra.open(root).run("population_size=1,2", runs=2, figures=False).batch


@pytest.mark.integration
@pytest.mark.parametrize("words", [("figures",), ("report",)])
def test_figures_and_reports_of_a_failed_batch_have_one_note(failed: tuple[Path, str], words: tuple[str, ...]) -> None:
    root, batch = failed
    done = projects.quick(root, *words, batch)
    assert done.returncode == 0
    assert done.stderr == f"note: {WHY}\n"


@pytest.mark.parametrize(
    "words",
    [
        ("figures", "{batch}", "summed"),
        ("stats", "swarm", "coverage", "--batch", "{batch}"),
        ("compare", "{batch}", "--by", "population_size", "--column", "coverage"),
    ],
)
def test_commands_that_need_outputs_are_refused_with_the_first_reason(failed: tuple[Path, str], words: tuple[str, ...]) -> None:
    root, batch = failed
    done = projects.quick(root, *(word.format(batch=batch) for word in words))
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert WHY in done.stderr


def test_a_claim_about_a_failed_batch_names_the_reason(failed: tuple[Path, str]) -> None:
    done = projects.quick(failed[0], "claims")
    assert done.returncode == 1
    assert WHY in done.stdout


@pytest.mark.integration
def test_a_batch_of_which_a_run_is_missing_says_how_many_failed(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p", simulator="raise SystemExit(7)\n")
    assert projects.quick(root, "run", "population_size=1,2", "--only", "population_size=2", "--no-figures").returncode == 1
    done = projects.quick(root, "stats", "swarm", "coverage")
    assert "no run was successful, and 2 of 4 failed: exit status 7" in done.stderr
