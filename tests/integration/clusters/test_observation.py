"""Runs on nodes of a cluster are observed as local ones are."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests import projects
from tests.batches import WAITING, Gated, ended, is_whole
from tests.clusters import Slurm

SIMULATOR = """\
import json, os, sys
here = os.path.dirname(os.path.realpath(sys.argv[0]))
data = open(os.path.join(here, "data", "map.txt")).read()
factor = open(os.environ["LIBRARY"] + "/factor").read()
os.path.exists(os.path.join(here, "plugin.so"))
os.listdir(os.path.join(here, "data"))
os.path.realpath(os.getcwd())
open(os.environ["LIBRARY"] + "/log", "a").write("x")
print("tick,value", *(f"{tick},{factor}" for tick in range(3)), sep="\\n", file=open("swarm.csv", "w"))
"""
"""A simulator that uses files of its project, also by an import, and a file elsewhere."""
CLUSTERS = """
[runners.slurm]
array_tasks = 2
[runners.pbs]
array_tasks = 2
"""
SETS = "SELECT DISTINCT files FROM observations"
FILES = "SELECT path, use, sha256, size FROM files_read ORDER BY ALL"


def made(folder: Path, observe: str = "first", more: str = CLUSTERS) -> Path:
    """Make a project whose runs are started by a script, and read files of the project and of a library beside it."""
    library = folder.with_name("library")
    library.mkdir(exist_ok=True)
    (library / "factor").write_text("1")
    config = projects.CONFIG.replace("python3 sim.py", "sh {project}/run.sh").replace(
        "runs = 2", f'runs = 2\nobserve = "{observe}"'
    )
    config += f'[environment]\nset = {{ LIBRARY = "{library}" }}\n{more}'
    root = projects.make(folder, config, simulator=SIMULATOR)
    (root / "run.sh").write_text('python3 "$(dirname "$0")/sim.py" "$1"\n')
    (root / "data").mkdir()
    (root / "data" / "map.txt").write_text("wall\n")
    return root


def run(root: Path, *words: str) -> dict[str, Any]:
    done = projects.quick(root, "run", "population_size=1,2", "--no-figures", "--json", *words)
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def sql(root: Path, statement: str) -> list[dict[str, Any]]:
    done = projects.quick(root, "sql", "--format", "json", statement)
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize(("observe", "count", "runner"), [("first", 2, "slurm"), ("all", 4, "slurm"), ("first", 2, "pbs")])
def test_runs_on_nodes_have_the_same_set_of_files_as_local_ones(
    tmp_path: Path, slurm: Slurm, require: Callable[..., str], observe: str, count: int, runner: str
) -> None:
    require("strace")
    if runner == "pbs":
        require("qsub")
    here, there = made(tmp_path / "here", observe), made(tmp_path / "there", observe)
    if observe == "all":
        projects.commit(here)
        projects.commit(there)
    run(here)
    run(there, "--on", runner)
    observations = sql(there, "SELECT method, reason, count(*) AS n FROM observations GROUP BY ALL")
    assert observations == [{"method": "strace", "reason": None, "n": count}]
    assert sql(there, FILES) == sql(here, FILES)
    assert {"path": "{project}/data/map.txt", "use": "read"} in sql(there, "SELECT path, use FROM files_read")
    assert sql(there, SETS) == sql(here, SETS)
    written = "SELECT path, use, count(*) AS n FROM files_written GROUP BY ALL"
    assert sql(there, written) == [{"path": f"{tmp_path}/library/log", "use": "written", "n": count}]
    assert projects.quick(there, "fsck").returncode == 0


def test_executions_on_a_cluster_count_while_the_files_that_they_used_are_unchanged(
    tmp_path: Path, slurm: Slurm, require: Callable[..., str]
) -> None:
    require("strace")
    root = made(tmp_path / "project")
    assert run(root, "--on", "slurm")["executed"] == 4
    assert run(root)["executed"] == 0, "they count for local runs too"
    factor = tmp_path / "library" / "factor"
    factor.write_text("2")
    assert run(root, "--on", "slurm")["executed"] == 4
    assert sql(root, "SELECT DISTINCT value FROM swarm") == [{"value": 2}]
    factor.write_text("1")
    assert run(root, "--on", "slurm")["executed"] == 0
    assert sql(root, "SELECT DISTINCT value FROM swarm") == [{"value": 1}]


@pytest.mark.nightly
def test_executions_on_a_cluster_count_for_another_source_if_they_did_not_use_what_differs(
    tmp_path: Path, slurm: Slurm, require: Callable[..., str]
) -> None:
    require("strace")
    root = made(tmp_path / "project", "all")
    (root / "unused.py").write_text("1")
    projects.commit(root)
    assert run(root, "--on", "slurm")["executed"] == 4
    [variables] = sql(root, "SELECT DISTINCT variables FROM environments JOIN executions USING (environment)")
    assert json.loads(variables["variables"])["PATH"] == os.environ["PATH"], "runs search for programs in it"
    (root / "unused.py").write_text("2")
    (root / "arena.xml").touch()
    summary = run(root)
    assert (summary["executed"], summary["reused"]) == (0, 4)
    (root / "data" / "map.txt").write_text("door\n")
    assert run(root, "--on", "slurm")["executed"] == 4


@pytest.mark.nightly
def test_a_node_without_strace_says_so(tmp_path: Path, slurm: Slurm) -> None:
    (tmp_path / "empty").mkdir()
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nPATH="{tmp_path}/empty" exec {sys.executable} "$@"\n')
    python.chmod(0o755)
    root = made(tmp_path / "project", more=f'[runners.slurm]\narray_tasks = 1\npython = "{python}"\n')
    assert run(root, "--on", "slurm")["executed"] == 4
    [found] = sql(root, "SELECT DISTINCT method, reason FROM observations")
    assert found["method"] == "maps"
    assert found["reason"].endswith("strace is not installed")


class Cached(Gated):
    """A project whose gate is in a cache that is left out, so that it is no input of runs."""

    @property
    def gate(self) -> Path:
        return gate_of(self.root)


def gate_of(root: Path) -> Path:
    folder = Path(os.environ["XDG_CACHE_HOME"], "fontconfig")
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"gate of {root.parent.name}"


@pytest.fixture
def gated(tmp_path: Path, slurm: Slurm, require: Callable[..., str]) -> Iterator[Gated]:
    require("strace")
    root = tmp_path / "project"
    made = Cached.make(root, slurm, simulator=WAITING.replace("{gate!r}", repr(str(gate_of(root)))))
    config = made.root / "sierra.toml"
    config.write_text(config.read_text().replace("runs = 2", 'runs = 2\nobserve = "all"'))
    yield made
    made.close()


def observed(gated: Gated) -> int:
    """Check that each run has a result, and what was observed is complete; return the number of observed runs."""
    is_whole(gated.project)
    assert sql(gated.root, "SELECT DISTINCT reason FROM observations") == [{"reason": None}]
    [found] = sql(gated.root, "SELECT count(*) AS n FROM observations")
    return int(found["n"])


@pytest.mark.nightly
def test_what_a_node_observed_is_recorded_by_the_process_that_takes_the_session_over(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_begun(3)
    asking.send_signal(signal.SIGKILL)
    ended(asking, -9)
    gated.open()
    ended(gated.ask())
    assert observed(gated) == 8
    assert len(sql(gated.root, SETS)) == 1


@pytest.mark.nightly
def test_runs_that_a_node_observed_when_it_lost_power_are_observed_again(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_told(3)
    node = gated.node()
    gated.slurm.power_cut(node)
    gated.slurm.declare_down(node)
    gated.open()
    gated.slurm.release_requeued()
    ended(asking)
    assert observed(gated) == 8


@pytest.mark.nightly
def test_runs_that_were_observed_when_their_array_task_was_requeued_are_observed_again(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_told(3)
    gated.slurm.command("scontrol", "requeue", f"{gated.job()}_0")
    gated.slurm.release_requeued()
    gated.open()
    ended(asking)
    assert observed(gated) == 8
