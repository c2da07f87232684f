"""The example's driver shows the expected effects, is deterministic, and reports errors in one line."""

from __future__ import annotations

import csv
import io
import math
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from lxml import etree

EXAMPLE = Path(__file__).parents[3] / "sierra" / "setup" / "examples" / "swarm"
TOML = tomllib.loads((EXAMPLE / "sierra.toml").read_text("utf-8"))
TEMPLATE = (EXAMPLE / "template.xml").read_text("utf-8")
SEEDS = (11, 12)


@pytest.fixture(autouse=True)
def _mujoco(require: Callable[..., str]) -> None:
    require("mujoco", there=find_spec("mujoco") is not None)


def made(seed: int = 1, controller: str = "random_walk", scenario: str = "open", **variables: float) -> bytes:
    """Return an input as sierra.toml defines it: its XPaths and changes, applied to its template."""
    root = etree.fromstring(TEMPLATE.encode())
    values = {TOML["seed"]: seed} | {TOML["variables"][name]["set"]: value for name, value in variables.items()}
    groups = (TOML["controllers"][controller], TOML["scenarios"][scenario])
    changes: list[dict[str, Any]] = [change for group in groups for change in group.get("changes", [])]
    for change in changes + [{"set": path, "value": value} for path, value in values.items()]:
        if "add" in change:
            root.xpath(change["add"])[0].append(etree.fromstring(change["xml"]))
        else:
            [attribute] = root.xpath(change["set"])
            attribute.getparent().set(attribute.attrname, str(change["value"]))
    return bytes(etree.tostring(root))


def execute(folder: Path, xml: bytes, **environment: str) -> subprocess.CompletedProcess[str]:
    (folder / "input.xml").write_bytes(xml)
    argv = [sys.executable, str(EXAMPLE / "swarm.py"), "input.xml", "out"]
    return subprocess.run(argv, cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True, check=False)


@cache
def outputs(xml: bytes, threads: int = 1) -> tuple[str, str]:
    """Return swarm.csv and poses.csv, written by a separate process."""
    with TemporaryDirectory() as folder:
        done = execute(Path(folder), xml, OMP_NUM_THREADS=str(threads))
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
        assert sorted(path.name for path in Path(folder).iterdir()) == ["input.xml", "out"]
        out = Path(folder, "out")
        assert sorted(path.name for path in out.iterdir()) == ["poses.csv", "swarm.csv"]
        return (out / "swarm.csv").read_text(), (out / "poses.csv").read_text()


def table(text: str) -> list[dict[str, float]]:
    return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(io.StringIO(text))]


def final(column: str, **asked: Any) -> float:
    """Return the mean of a column's last value over some seeds."""
    return mean(table(outputs(made(seed, **asked))[0])[-1][column] for seed in SEEDS)


@pytest.mark.integration
def test_the_same_input_gives_the_same_bytes() -> None:
    asked = made(controller="pheromone", scenario="cluttered", population_size=8)
    assert outputs(asked, threads=1) == outputs(asked, threads=2)


@pytest.mark.integration
def test_another_seed_gives_another_run() -> None:
    assert outputs(made(SEEDS[0], population_size=2)) != outputs(made(SEEDS[1], population_size=2))


def test_a_row_is_written_per_tick_and_a_pose_per_robot_and_second() -> None:
    swarm, poses = (table(text) for text in outputs(made(SEEDS[0], population_size=2)))
    assert [row["clock"] for row in swarm] == [tick / 5 for tick in range(1, 301)]
    assert [(row["clock"], row["robot"]) for row in poses] == [(s, r) for s in range(1, 61) for r in (0, 1)]
    for column in ("coverage", "contacts", "energy"):
        values = [row[column] for row in swarm]
        assert values == sorted(values)


@pytest.mark.nightly
def test_more_robots_cover_more_and_collide_more() -> None:
    coverage = [final("coverage", population_size=size) for size in (1, 2, 4, 8)]
    assert all(more > 1.2 * fewer for fewer, more in pairwise(coverage))
    contacts = [final("contacts", population_size=size) for size in (1, 4, 8)]
    assert contacts[0] == 0 < contacts[1] < contacts[2]


@pytest.mark.nightly
def test_pheromone_covers_more_than_a_random_walk() -> None:
    asked = {"population_size": 8}
    assert final("coverage", controller="pheromone", **asked) > 1.15 * final("coverage", **asked)


@pytest.mark.nightly
def test_clutter_reduces_coverage() -> None:
    asked = {"population_size": 8, "controller": "pheromone"}
    assert final("coverage", scenario="cluttered", **asked) < 0.95 * final("coverage", **asked)


@pytest.mark.nightly
def test_many_robots_start_apart_and_never_leave_the_arena() -> None:
    crowd = made(population_size=64, scenario="cluttered", max_speed=0)
    places = [(row["x"], row["y"]) for row in table(outputs(crowd)[1])[:64]]
    assert min(math.dist(a, b) for i, a in enumerate(places) for b in places[:i]) > 0.24
    hurry = table(outputs(made(population_size=8, scenario="cluttered", max_speed=3))[1])
    assert all(max(abs(row["x"]), abs(row["y"])) < 3 for row in hurry)


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("</mujoco>", "", "XML parse error"),
        ('name="seed"', 'name="sead"', "Invalid name 'seed'"),
        ('count="4"', 'count="0"', "one robot or more"),
        ('data="random_walk"', 'data="levy"', "no controller 'levy'; use random_walk or pheromone"),
        ('name="ticks_per_second" data="5"', 'name="ticks_per_second" data="7"', "not a whole number of timesteps"),
        ('name="max_speed" data="0.4"', 'name="max_speed" data="9"', "go through walls"),
    ],
)
def test_invalid_input_is_reported_in_one_line(tmp_path: Path, right: str, wrong: str, said: str) -> None:
    assert right in TEMPLATE
    done = execute(tmp_path, TEMPLATE.replace(right, wrong).encode())
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert said in done.stderr
    assert done.stderr.startswith("input.xml: ")
