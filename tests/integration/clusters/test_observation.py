"""Runs on nodes of a cluster are observed as local ones are."""

from __future__ import annotations

import json
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests import pbs, projects
from tests.batches import Gated, ended
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
FILES = "SELECT path, use, sha256, size FROM files_read ORDER BY ALL"


def made(folder: Path, observe: str = "first", more: str = CLUSTERS) -> Path:
    """Make a project whose runs are started by a script, and read files of the project and of a library beside it."""
    library = folder.with_name("library")
    library.mkdir(exist_ok=True)
    (library / "factor").write_text("1")
    config = projects.CONFIG.replace("python3 sim.py", "sh {project}/run.sh").replace("runs = 2", f'runs = 2\nobserve = "{observe}"')
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


@pytest.mark.parametrize(("observe", "count"), [("first", 1), ("all", 4)])
def test_runs_on_nodes_have_the_same_set_of_files_as_local_ones(
    tmp_path: Path, slurm: Slurm, require: Callable[..., str], observe: str, count: int
) -> None:
    require("strace")
    here, there = made(tmp_path / "here", observe), made(tmp_path / "there", observe)
    run(here)
    run(there, "--on", "slurm")
    observations = sql(there, "SELECT method, reason, count(*) AS n FROM observations GROUP BY ALL")
    assert observations == [{"method": "strace", "reason": None, "n": count}]
    a,b = sql(here, FILES), sql(there, FILES)
    for x in a:
        if x not in b: print("here", x)
    for x in b:
        if x not in a: print("there", x)
    assert sql(there, FILES) == sql(here, FILES)
    sets = "SELECT DISTINCT files FROM observations"
    assert sql(there, sets) == sql(here, sets)
    written = "SELECT path, use, count(*) AS n FROM files_written GROUP BY ALL"
    assert sql(there, written) == [{"path": f"{tmp_path}/library/log", "use": "written", "n": count}]
