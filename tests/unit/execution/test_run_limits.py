"""Limits that depend on the variables of a query, and cores that a run holds."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import sierra
from sierra.model import Limits
from tests import projects

WAITS = (
    projects.SIMULATOR
    + """
import time
began = time.monotonic_ns()
time.sleep(0.3)
with open("times.csv", "w") as file:
    print("began,ended", file=file)
    print(began, time.monotonic_ns(), sep=",", file=file)
"""
)
TIMES = '[outputs.swarm]\nfile = "swarm.csv"\n[outputs.times]\nfile = "times.csv"\nvolatile = ["began", "ended"]\n'


def with_limits(folder: Path, limits: str, *, simulator: str = projects.SIMULATOR, more: str = "") -> Path:
    return projects.make(folder, f"{projects.CONFIG}[limits]\n{limits}\n{more}", simulator=simulator)


def test_each_experiment_has_the_limits_of_its_variables(tmp_path: Path) -> None:
    limits = 'wall = "{population_size * 10}"\nmemory = "{population_size * 1.5} MiB"\noutput = "{population_size} kB"\n'
    limits += 'cpu = 7\ncores = "{population_size / 64 + 1}"\ngpus = "{min(1, population_size / 128)}"'
    plan = sierra.open(with_limits(tmp_path, limits)).plan("population_size=32,128")
    mib = 1 << 20
    few = Limits(320.0, 7.0, 48 * mib, 32_000, gpus=0.25, cores=2)
    many = Limits(1280.0, 7.0, 192 * mib, 128_000, gpus=1.0, cores=3)
    assert (plan.limits.of(0), plan.limits.of(1)) == (few, many)
    assert plan.limits.most == many
    assert (plan.limits.of_containers.memory_bytes, plan.limits.of_containers.wall_s) == (None, 1280.0)


def test_limits_with_the_same_value_everywhere_are_like_plain_ones(tmp_path: Path) -> None:
    plan = sierra.open(with_limits(tmp_path, 'memory = "{max(4, population_size)} MiB"')).plan("population_size=1,2")
    assert plan.limits.of(0) is plan.limits.of(1) is plan.limits.most is plan.limits.of_containers


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (
            'wall = "{size}"',
            "[limits] wall = '{size}': {size} has no value, because the query varies population_size; add size",
        ),
        ('wall = "{population_size"', "[limits] wall = '{population_size': '{population_size' has an unmatched brace"),
        ('wall = "{population_size - 8}"', "[limits]: wall should be greater than 0, not 0"),
        ('wall = "{population_size} s"', "[limits] wall: '8 s' should be a number"),
        ('memory = "{population_size} apples"', "[limits]: memory: '8 apples' is not a size; use one such as 500 MB"),
        ('memory = "{-population_size} MB"', "[limits]: memory: '-8 MB' is not a size"),
        ('gpus = "{population_size / 5}"', "[limits]: gpus: 1.6 should be a whole number of GPUs"),
        ('cores = "{population_size / 0}"', "has no value: division by zero"),
        ('cores = "{noise}"', "add noise to the query, or give a number"),
        ("cores = 0", "limits.cores should be greater than 0, not 0"),
        ('wall = "long"', 'limits.wall should be a number, not "long"'),
    ],
)
def test_limits_without_a_valid_value_are_refused_before_anything_is_executed(
    tmp_path: Path, limits: str, message: str
) -> None:
    refused = projects.quick(with_limits(tmp_path, limits), "run", "population_size=8")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert message in refused.stderr
    assert len(refused.stderr.strip().splitlines()) == 1
    assert not (tmp_path / ".sierra" / "store" / "format").exists()


def test_a_limit_ends_only_the_runs_whose_limit_it_is_also_in_replays(tmp_path: Path) -> None:
    simulator = projects.SIMULATOR + "\nimport time\ntime.sleep(30 if count == 1 else 0)\n"
    folder = with_limits(tmp_path, 'wall = "{population_size * 60 - 59.6}"', simulator=simulator)
    assert projects.quick(folder, "run", "population_size=1,2").returncode == 1
    query = "SELECT population_size, status FROM executions JOIN batch_runs USING (batch, run)"
    query += " JOIN experiments USING (batch, ordinal)"
    statuses = sorted((row["population_size"], row["status"]) for row in projects.sql(folder, query))
    assert statuses == [(1, "timeout")] * 2 + [(2, "ok")] * 2
    [batch] = projects.values(folder, "SELECT batch FROM batches")
    replayed = projects.quick(folder, "replay", str(batch))
    assert replayed.returncode == 0, replayed.stderr


def together(folder: Path) -> int:
    """Return the most runs that executed at a time."""
    rows = projects.sql(folder, "SELECT began, ended FROM times")
    return max(sum(other["began"] <= row["began"] < other["ended"] for other in rows) for row in rows)


@pytest.mark.parametrize(("cores", "most"), [("2", 1), ("5", 1), ('"{population_size / 4 + 0.5}"', 2)])
def test_as_many_runs_execute_at_a_time_as_cores_suffice_for(tmp_path: Path, cores: str, most: int) -> None:
    folder = with_limits(tmp_path, f"cores = {cores}", simulator=WAITS, more=TIMES)
    projects.run(folder, "population_size=1,2", "--runs", "2", "-j", "2")
    assert together(folder) == most


def test_a_run_that_holds_all_cores_is_not_passed_by_others(tmp_path: Path) -> None:
    folder = with_limits(tmp_path, 'cores = "{population_size}"', simulator=WAITS, more=TIMES)
    projects.run(folder, "population_size=1,2", "--runs", "3", "-j", "2")
    rows = projects.sql(folder, "SELECT population_size, began, ended FROM times")
    whole = [row for row in rows if row["population_size"] == 2]
    assert all(
        row["ended"] <= other["began"] or other["ended"] <= row["began"] for row in whole for other in rows if row != other
    )


def test_a_package_has_the_limits_of_each_experiment(tmp_path: Path) -> None:
    about = '[package]\ntitle = "x"\nauthors = [{ name = "A B" }]\nlicense = "MIT"\n'
    folder = with_limits(tmp_path / "p", 'wall = "{population_size * 60}"\nmemory = "1 GiB"', more=about)
    projects.run(folder, "population_size=1,2")
    packed = projects.quick(folder, "package", "-o", str(tmp_path / "x.zip"))
    assert packed.returncode == 0, packed.stderr
    with zipfile.ZipFile(tmp_path / "x.zip") as package:
        package.extractall(tmp_path / "x")
    [execution] = (tmp_path / "x").rglob("execution")
    [batch] = json.loads((execution / "plan.json").read_bytes())["batches"]
    lines = [json.loads(line) for line in next(execution.glob("*.jsonl")).read_text().splitlines()]
    assert (batch["limits"]["wall_s"], batch["limits"]["memory_bytes"]) == (120, 1 << 30)
    assert {line["experiment"]: line.get("limits") for line in lines} == {0: {"wall_s": 60}, 1: None}
    repeated = subprocess.run(
        [sys.executable, "reproduce.py", "--execute", "--yes"],
        cwd=execution.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (repeated.returncode, "4 of 4" in repeated.stdout or "4 runs" in repeated.stdout) == (0, True), repeated
