"""Runs use a virtual environment of Python; the environment is made again in another folder, moved, or changed."""

from __future__ import annotations

import json
import shutil
import sys
import venv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests import projects
from tests.tiers import at_night

SCRIPT = """\
#!{0}/bin/python3
# -*- coding: utf-8 -*-
import sys
from swarms import simulate
simulate(sys.argv[1])
"""
PACKAGE = """\
FACTOR = 1
def simulate(arena):
    with open("swarm.csv", "w") as file:
        print("tick,value", *(f"{tick},{FACTOR}" for tick in range(3)), sep="\\n", file=file)
"""
METADATA = "Metadata-Version: 2.1\nName: Swarms\nVersion: 1.5\n"
CONSOLE_SCRIPT = "a console script"
COMMANDS = {CONSOLE_SCRIPT: "swarms {input}", "a wrapper": "sh run.sh {input}", "python": "python3 -m swarms.run {input}"}


def install(folder: Path) -> Path:
    """Make a virtual environment with a distribution; return its site-packages."""
    venv.create(folder, with_pip=False)
    [site] = folder.glob("lib/python3*/site-packages")
    files = {"swarms/__init__.py": PACKAGE, "swarms/run.py": SCRIPT.partition("\n")[2]}
    record = [f"{name},sha256=x,{len(text)}" for name, text in files.items()]
    files["swarms-1.5.dist-info/METADATA"] = METADATA
    files["swarms-1.5.dist-info/RECORD"] = "\n".join([*record, "../../../bin/swarms,sha256=x,1", ""])
    for name, text in files.items():
        (site / name).parent.mkdir(exist_ok=True)
        (site / name).write_text(text)
    (folder / "bin" / "swarms").write_text(SCRIPT.format(folder))
    (folder / "bin" / "swarms").chmod(0o755)
    return site


@pytest.fixture(params=[CONSOLE_SCRIPT, *at_night(set(COMMANDS) - {CONSOLE_SCRIPT})])
def root(request: pytest.FixtureRequest, tmp_path: Path, require: Callable[..., str]) -> Path:
    require("strace")
    config = (
        projects.CONFIG.replace("python3 sim.py {input}", COMMANDS[request.param]) + "[outputs.swarm]\nfile = 'swarm.csv'\n"
    )
    root = projects.make(tmp_path / "project", config.replace("runs = 2", 'runs = 2\nobserve = "first"'))
    (root / "run.sh").write_text('exec swarms "$1"\n')
    install(tmp_path / "one")
    return root


def run(root: Path, environment: str, *words: str) -> dict[str, Any]:
    path = f"{root.parent / environment}/bin:/usr/bin:/bin"
    done = projects.sierra(root, "run", "population_size=1,2", "--no-figures", "--json", *words, environment={"PATH": path})
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def sql(root: Path, statement: str) -> list[dict[str, Any]]:
    done = projects.quick(root, "sql", "--format", "json", statement)
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("root", COMMANDS, indirect=True)
def test_the_same_environment_in_another_folder_reuses_all_runs(root: Path) -> None:
    assert run(root, "one")["executed"] == 4
    install(root.parent / "two" / "deeper")
    assert run(root, "two/deeper")["executed"] == 0
    shutil.rmtree(root.parent / "one")
    assert run(root, "two/deeper")["executed"] == 0


@pytest.mark.nightly
def test_the_same_environment_in_another_folder_has_the_same_set_of_files(root: Path) -> None:
    run(root, "one")
    install(root.parent / "two" / "deeper")
    assert run(root, "two/deeper", "--set", "noise=0.3")["executed"] == 4
    assert sql(root, "SELECT count(DISTINCT files) AS sets FROM observations") == [{"sets": 1}]
    machine = f"{root.parent}/%"
    assert sql(root, f"SELECT path FROM files_read WHERE path LIKE '{machine}'") == []


@pytest.mark.nightly
def test_the_distributions_that_an_execution_used_are_recorded(root: Path) -> None:
    unused = root.parent / "one" / "bin" / "unused"
    unused.write_text("")
    run(root, "one")
    assert sql(root, "SELECT DISTINCT distributions FROM observations") == [{"distributions": ["swarms==1.5"]}]


def test_a_changed_package_executes_all_runs_again(root: Path) -> None:
    run(root, "one")
    site = install(root.parent / "two")
    (site / "swarms" / "__init__.py").write_text(PACKAGE.replace("FACTOR = 1", "FACTOR = 2"))
    assert run(root, "two")["executed"] == 4
    assert sql(root, "SELECT DISTINCT value FROM swarm JOIN effective USING (execution)") == [{"value": 2}]


@pytest.mark.nightly
def test_a_script_with_another_first_line_executes_all_runs_again(root: Path) -> None:
    run(root, "one")
    script = root.parent / "one" / "bin" / "swarms"
    script.write_text(script.read_text().replace("python3\n", "python3 -I\n"))
    used = "python3" not in (root / "sierra.toml").read_text()
    assert run(root, "one")["executed"] == (4 if used else 0)


@pytest.mark.nightly
def test_runs_without_the_environment_execute_again_or_fail(root: Path) -> None:
    run(root, "one")
    shutil.rmtree(root.parent / "one")
    path = f"{Path(sys.base_prefix, 'bin')}:/usr/bin:/bin"
    done = projects.sierra(root, "run", "population_size=1,2", "--no-figures", "--json", environment={"PATH": path})
    assert done.returncode != 0
