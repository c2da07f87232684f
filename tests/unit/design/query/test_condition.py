"""`--only` selects the experiments for which a condition on the variables holds, and refuses what could be a mistake."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.projects import CONFIG, make, quick, run, sql

QUERY = ("population_size.Log8", "noise=0,0.5")
GROUPS = CONFIG + '[scenarios.low]\nchanges = [{ set = "//arena/@size", value = "1" }]\n[scenarios.high]\nchanges = []\n'


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("condition") / "project", GROUPS)


def preview(folder: Path, *words: str) -> dict[str, Any]:
    done = quick(folder, "run", *words, "--dry-run", "--json")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize(
    ("condition", "experiments"),
    [
        ("population_size<=4", 6),
        ("population_size < 4", 4),
        ("population_size>=4 and noise=0.5", 2),
        ("population_size>1 and population_size<8 and noise!=0", 2),
        ("population_size=1,8", 4),
        ("population_size = 1, 8 and noise=5e-1", 2),
        ("population_size!=1,8", 4),
        ("noise>0", 4),
    ],
)
def test_a_condition_selects_experiments(project: Path, condition: str, experiments: int) -> None:
    found = preview(project, *QUERY, "--only", condition)
    assert (found["selected"], found["experiments"]) == (experiments, 8)
    assert (found["runs"], found["to_execute"]) == (2 * experiments, 2 * experiments)


def test_names_can_be_selected(project: Path) -> None:
    assert preview(project, "scenario=low,high", "--only", "scenario=low")["selected"] == 1
    assert preview(project, "scenario=low,high", "--only", "scenario!=low")["selected"] == 1


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ("size<=4", "this query does not vary 'size'; it varies population_size, noise"),
        ("nois=0", "this query does not vary 'nois'; did you mean 'noise'?"),
        ("population_size>8", "selects no experiment; population_size is 1, 2, 4, 8; noise is 0, 0.5"),
        ("population_size=3", "population_size is never 3; population_size is 1, 2, 4, 8"),
        ("noise!=0.4", "noise is never 0.4; noise is 0, 0.5"),
        ("population_size<2,4", "< takes one number; use = for a list of values"),
        ("population_size<low", "< compares numbers"),
        ("population_size", "'population_size' is not a comparison; use, for example"),
        ("population_size==4", "is not a comparison"),
        ("population_size<=4 or noise=0", "is not a comparison"),
        ("population_size<=4 and", "is not a comparison"),
        ("__import__('os').getpid()", "is not a comparison"),
        ("population_size=1_000", "1_000 is not in the number format of queries; use 1000"),
        ("", "'' is not a comparison"),
    ],
)
def test_a_wrong_condition_is_one_line_with_what_is_there(project: Path, condition: str, said: str) -> None:
    done = quick(project, "run", *QUERY, "--only", condition)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_name_is_not_compared_by_order(project: Path) -> None:
    done = quick(project, "run", "scenario=low,high", "--only", "scenario<low")
    assert "< compares numbers; scenario is low, high: use = or !=" in done.stderr


@pytest.mark.integration
def test_a_part_of_a_batch_has_the_same_ids_and_is_reused_by_the_rest(tmp_path: Path) -> None:
    folder = make(tmp_path / "project")
    part, messages = run(folder, "population_size.Log8", "--only", "population_size<=2")
    assert (part["experiments"], part["selected"], part["left_out"]) == (4, 2, 4)
    assert (part["executed"], part["missing"], part["failed"]) == (4, 4, 0)
    assert "figures and statistics of this batch lack 4 runs that this session has left out" in messages
    [listed] = json.loads(quick(folder, "ls", "--json").stdout)
    assert (listed["runs"], listed["missing"], listed["failed"]) == (8, 4, 0)
    whole, _ = run(folder, "population_size.Log8")
    assert whole["batch"] == part["batch"]
    assert (whole["executed"], whole["reused"], whole["selected"]) == (4, 4, None)


@pytest.mark.integration
def test_statistics_of_a_part_have_no_experiment_without_runs(tmp_path: Path) -> None:
    folder = make(tmp_path / "project")
    run(folder, "population_size=1,2,4", "--only", "population_size=4")
    done = quick(folder, "stats", "swarm", "coverage", "--json")
    assert [(row["population_size"], row["n"]) for row in json.loads(done.stdout)] == [(4, 2)]
    assert sql(folder, "SELECT DISTINCT population_size AS p FROM swarm") == [{"p": 4}]


@pytest.mark.nightly
def test_the_summary_names_the_part(tmp_path: Path) -> None:
    folder = make(tmp_path / "project")
    done = quick(folder, "run", "population_size.Log8", "--only", "population_size>4", "--no-figures")
    assert done.returncode == 0
    assert "1 of 4 experiments selected by --only\n8 runs: 2 executed, 0 reused, 6 left out\n" in done.stdout
    again = quick(folder, "run", "population_size.Log8", "--only", "population_size>4", "--no-figures")
    assert (again.returncode, "8 runs: 0 executed, 2 reused, 6 left out\n" in again.stdout) == (0, True)


@pytest.mark.integration
def test_runs_that_failed_outside_of_the_part_do_not_fail_it(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator="import sys\nsys.exit('count=\"1\"' in open(sys.argv[1]).read())\n")
    assert quick(folder, "run", "population_size=1,2", "--no-figures").returncode == 1
    assert quick(folder, "run", "population_size=1,2", "--only", "population_size=2", "--no-figures").returncode == 0
    assert quick(folder, "run", "population_size=1,2", "--only", "population_size=1", "--no-figures").returncode == 1


def test_the_preview_shows_only_the_part(project: Path) -> None:
    done = quick(project, "run", *QUERY, "--only", "population_size=8", "-n", "--explain")
    assert done.returncode == 0
    assert "2 of 8 experiments selected by --only\n" in done.stdout
    assert [line.split()[:2] for line in done.stdout.splitlines() if line.startswith("8 ")] == [["8", "0"], ["8", "0.5"]]
    assert "4 runs: new\n" in done.stdout


LABELS = (
    CONFIG
    + """
[controllers.crw]
label = "random walk"
changes = [{ set = "//swarm/@controller", value = "a" }]
[controllers.sar]
label = "search and rescue, fast"
changes = [{ set = "//swarm/@controller", value = "b" }]
[controllers.walk]
label = "sar"
changes = [{ set = "//swarm/@controller", value = "c" }]
"""
)


@pytest.mark.parametrize(
    ("condition", "selected"),
    [
        ("controller=random walk", 2),
        ("controller = random walk and population_size=1", 1),
        ("controller!=random walk,walk and population_size=1", 1),
        ("controller=crw , search and rescue, fast, walk", 6),
        ("controller=sar", 2),
        ("population_size=1 and controller=search and rescue, fast and population_size<2", 1),
    ],
)
def test_labels_stand_for_names(tmp_path: Path, condition: str, selected: int) -> None:
    folder = make(tmp_path / "project", LABELS)
    found = preview(folder, "controller=crw,sar,walk", "population_size=1,2", "--only", condition)
    assert (found["selected"], found["experiments"]) == (selected, 6)


def test_an_unknown_label_names_those_that_are_there(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", LABELS)
    done = quick(folder, "run", "controller=crw,walk", "--only", "controller=ballistic")
    assert done.returncode == 2
    assert "controller is never ballistic; controller is crw (random walk), walk (sar)" in done.stderr
