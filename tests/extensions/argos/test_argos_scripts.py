"""Scripts of Lua controllers in ARGoS; a program that opens them as ARGoS does stands for it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests import projects

ARGOS = """\
#!/usr/bin/env python3
import re, sys
import xml.etree.ElementTree as tree

root = tree.parse(sys.argv[sys.argv.index("-c") + 1]).getroot()
with open("walk.csv", "w") as file:
    print("tick,speed", file=file)
    for number, params in enumerate(root.iter("params")):
        print(number, re.search("SPEED = (.*)", open(params.get("script")).read())[1], sep=",", file=file)
"""
TEMPLATE = """\
<?xml version="1.0"?>
<argos-configuration>
  <framework><experiment length="10" ticks_per_second="10" random_seed="1"/></framework>
  <controllers>
    <lua_controller id="walk"><actuators/><sensors/><params script="lua/walk.lua"/></lua_controller>
    <lua_controller id="stay"><actuators/><sensors/><params script="./lua/stay.lua"/></lua_controller>
  </controllers>
  <arena size="4,4,2">
    <distribute><entity quantity="1"><foot-bot id="fb"><controller config="walk"/></foot-bot></entity></distribute>
  </arena>
</argos-configuration>
"""
CONFIG = """\
template = "experiments/walk.argos"
platform = "argos"
files = ["lua"]
runs = 1
[source]
paths = ["loops.cpp"]
[variables]
second = { changes = [{ set = "(//lua_controller/params/@script)[2]", value = "../lua/{second}.lua" }] }
"""
SPEEDS = "SELECT speed FROM walk JOIN effective USING (execution) ORDER BY tick"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a project with two Lua controllers."""
    for folder in ("bin", "project/lua", "project/experiments"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "bin" / "argos3").write_text(ARGOS)
    (tmp_path / "bin" / "argos3").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    root = tmp_path / "project"
    (root / "experiments" / "walk.argos").write_text(TEMPLATE)
    (root / "loops.cpp").write_text("// the source of the loop functions\n")
    for name, speed in (("walk", 5), ("stay", 0), ("run", 9)):
        (root / "lua" / f"{name}.lua").write_text(f"SPEED = {speed}\n")
    (root / "sierra.toml").write_text(CONFIG)
    return root


def configure(root: Path, before: str, after: str) -> None:
    assert before in CONFIG
    (root / "sierra.toml").write_text(CONFIG.replace(before, after))


@pytest.mark.integration
def test_runs_find_the_scripts_that_the_template_and_a_query_name(root: Path) -> None:
    projects.run(root, "population_size=1")
    assert [row["speed"] for row in projects.sql(root, SPEEDS)] == [5, 0]
    projects.run(root, "second=run")
    assert projects.sql(root, "SELECT max(speed) AS most FROM walk WHERE second = 'run'") == [{"most": 9}]


@pytest.mark.integration
def test_an_edited_script_is_the_reason_for_new_runs_and_replays_use_the_recorded_one(root: Path) -> None:
    before = projects.run(root, "population_size=1")[0]["batch"]
    (root / "lua" / "walk.lua").write_text("SPEED = 7\n")
    told = projects.quick(root, "run", "population_size=1", "--explain", "--dry-run").stdout
    assert "file beside the inputs: lua/walk.lua has changed" in told
    after = projects.run(root, "population_size=1")[0]
    assert (after["executed"], after["batch"] != before) == (1, True)
    differences = projects.quick(root, "diff", before, after["batch"])
    assert (differences.returncode, "lua/walk.lua has changed" in differences.stdout) == (1, True)
    assert "identical (1 run: 1 identical)" in projects.quick(root, "replay", before).stdout


@pytest.mark.parametrize("files", ["", 'files = ["lua/stay.lua"]\n', 'files = ["lua/st*.lua"]\n'])
def test_a_script_without_a_copy_beside_the_input_is_refused(root: Path, files: str) -> None:
    configure(root, 'files = ["lua"]\n', files)
    done = projects.quick(root, "run", "population_size=1", "--dry-run")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert (
        "the script 'lua/walk.lua' of a Lua controller is not beside the inputs of runs; add it: files = [\"lua/walk.lua\"]"
        in done.stderr
    )


def test_a_path_that_runs_do_not_find_is_refused(root: Path) -> None:
    configure(root, '"../lua/{second}.lua"', '"lua/{second}.lua"')
    done = projects.quick(root, "run", "second=run", "--dry-run")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "runs do not find the script 'lua/run.lua' of a Lua controller; set it to '../lua/run.lua'" in done.stderr


@pytest.mark.nightly
def test_a_script_in_the_folder_of_the_project_needs_no_copy(root: Path) -> None:
    configure(root, 'files = ["lua"]\n', 'changes = [{ set = "//params/@script", value = "{project}/lua/run.lua" }]\n')
    projects.run(root, "population_size=1")
    assert [row["speed"] for row in projects.sql(root, SPEEDS)] == [9, 9]
