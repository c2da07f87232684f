"""The bundled example, end to end: a real simulator, from the query to the figures, through the command line."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from matplotlib.image import imread

import sierra
from sierra.config import project_file
from tests import projects

ENDINGS = ("png", "pdf", "svg", "txt", "tex")
EXAMPLE = Path(sierra.__file__).parent / "setup" / "examples" / "swarm"


def sierra_(*arguments: str, cwd: Path) -> str:
    done = projects.sierra(cwd, *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def quick_(*arguments: str, cwd: Path) -> str:
    done = projects.quick(cwd, *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return a copy of the example after one query, and the output of that query."""
    folder = tmp_path_factory.mktemp("demo") / "swarm"
    sierra_("init", "--example", "swarm", str(folder), cwd=folder.parent)
    return folder, json.loads(sierra_("run", "population_size=1,4", "--runs", "3", "--json", cwd=folder))


@pytest.fixture(autouse=True)
def _mujoco(require: Any) -> None:
    from importlib.util import find_spec

    require("mujoco", there=find_spec("mujoco") is not None)


def test_the_example_is_a_valid_project() -> None:
    project = project_file.parse(tomllib.loads((EXAMPLE / "sierra.toml").read_text()), "swarm")
    assert {"random_walk", "pheromone"} <= project.controllers.keys()
    assert {"open", "cluttered"} <= project.scenarios.keys()
    assert "scalability" in project.queries


def test_every_run_is_executed_successfully(demo: tuple[Path, dict[str, Any]]) -> None:
    _, answer = demo
    assert {name: answer[name] for name in ("experiments", "runs", "executed", "reused", "failed")} == {
        "experiments": 2,
        "runs": 6,
        "executed": 6,
        "reused": 0,
        "failed": 0,
    }


def test_coverage_grows_with_the_population(demo: tuple[Path, dict[str, Any]]) -> None:
    rows = sierra.open(demo[0]).sql(
        "SELECT population_size, avg(coverage) AS mean, count(DISTINCT run) AS runs "
        "FROM swarm WHERE clock = 60 GROUP BY ALL ORDER BY 1"
    )
    one, four = rows.to_pylist()
    assert (one["runs"], four["runs"]) == (3, 3)
    assert four["mean"] > 2 * one["mean"]


def test_figures_are_drawn_in_three_formats_beside_their_captions(demo: tuple[Path, dict[str, Any]]) -> None:
    _, answer = demo
    files = [Path(path) for path in answer["figures"]]
    assert {path.name for path in files if path.stem == "coverage"} == {f"coverage.{ending}" for ending in ENDINGS}
    assert all(path.stat().st_size > (1000 if path.suffix in (".png", ".pdf", ".svg") else 50) for path in files)


def test_figures_that_are_drawn_again_are_byte_identical(demo: tuple[Path, dict[str, Any]]) -> None:
    folder, answer = demo
    before = {path: Path(path).read_bytes() for path in answer["figures"]}
    again = json.loads(quick_("figures", answer["batch"][:12], "--json", cwd=folder))
    assert {path: Path(path).read_bytes() for path in again} == before


@pytest.mark.nightly
def test_the_report_of_the_example_is_small(demo: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    folder, answer = demo
    quick_("report", answer["batch"][:12], "--to", str(tmp_path / "report.html"), cwd=folder)
    assert (tmp_path / "report.html").stat().st_size < 1_000_000


def test_repeating_the_query_executes_no_runs(demo: tuple[Path, dict[str, Any]]) -> None:
    folder, answer = demo
    again = json.loads(quick_("run", "population_size=1,4", "--runs", "3", "--json", "--no-figures", cwd=folder))
    assert (again["batch"], again["executed"], again["reused"]) == (answer["batch"], 0, 6)


def test_more_runs_per_experiment_execute_only_the_new_runs(demo: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = demo
    more = json.loads(quick_("run", "population_size=1,4", "--runs", "4", "--json", "--no-figures", cwd=folder))
    assert (more["executed"], more["reused"]) == (2, 6)


def test_two_variables_give_all_combinations(demo: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = demo
    asked = ("run", "controller=random_walk,pheromone", "population_size=1,4", "--runs", "1", "--json")
    answer = json.loads(quick_(*asked, cwd=folder))
    assert (answer["experiments"], answer["runs"]) == (4, 4)
    rows = sierra.open(folder).sql(
        "SELECT controller, population_size, count(DISTINCT run) AS runs FROM swarm WHERE controller IS NOT NULL GROUP BY ALL"
    )
    assert {(row["controller"], row["population_size"]) for row in rows.to_pylist()} == {
        ("random_walk", 1),
        ("random_walk", 4),
        ("pheromone", 1),
        ("pheromone", 4),
    }


def test_twenty_runs_replay_identically_after_changes_of_the_code(tmp_path: Path) -> None:
    folder = tmp_path / "swarm"
    quick_("init", "--example", "swarm", str(folder), cwd=tmp_path)
    projects.commit(folder)
    query = ("run", "population_size=1,2", "--runs", "10", "--set", "/mujoco/custom/numeric[@name='duration']/@data=6")
    first = json.loads(quick_(*query, "--json", "--no-figures", cwd=folder))["batch"]
    replayed = json.loads(quick_("replay", first, "--json", cwd=folder))
    assert (replayed["verdict"], replayed["counts"]) == ("identical", {"identical": 20})
    code = (folder / "swarm.py").read_text()
    batches = {first}
    for sight, committed in (("1.5", True), ("2.5", False)):
        (folder / "swarm.py").write_text(code.replace("SIGHT = 1.0", f"SIGHT = {sight}"))
        if committed:
            projects.commit(folder, "change a constant")
        batches.add(json.loads(quick_(*query, "-n", "--json", cwd=folder))["batch"])
        again = json.loads(quick_("replay", first, "--runs", "2", "--json", cwd=folder))
        assert (again["verdict"], again["runs"]) == ("identical", 4)
    assert len(batches) == 3


def test_frames_of_the_arena_are_captured(tmp_path: Path, require: Any) -> None:
    """The robots are seen by the camera above, and the rendered execution is the measured one."""
    from ctypes.util import find_library

    require("EGL", there=find_library("EGL") is not None)
    folder = tmp_path / "swarm"
    quick_("init", "--example", "swarm", str(folder), cwd=tmp_path)
    template = folder / "template.xml"
    template.write_text(template.read_text().replace('"duration" data="60"', '"duration" data="2"'))
    quick_("run", "population_size=3", "--runs", "1", "--no-figures", cwd=folder)
    answer = json.loads(quick_("capture", "--json", cwd=folder))
    [made] = answer["made"]
    assert (made["verdict"], made["frames"], made["ticks_per_second"]) == ("identical", 5, 5)
    quick_("files", made["execution"], "--to", str(tmp_path / "files"), cwd=folder)
    [last] = (tmp_path / "files").rglob("frames/10.png")
    pixels = imread(last)
    assert pixels.shape == (480, 480, 3)
    assert (pixels[..., 2] > pixels[..., 0] + 0.2).any()
