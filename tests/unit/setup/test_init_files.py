"""`sierra init` finds the files that a configuration names: those to change are templates, and others lie beside the inputs."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.projects import quick

ROBOT = "seed: 3\nmesh: ../maps/arm.stl\ncontroller: gains.json\ncount: 4\nlog: old.csv\n"
MODEL = """\
import json, os, sys
robot = dict(line.strip().split(": ") for line in open(sys.argv[1]))
here = os.path.dirname(sys.argv[1])
open(os.path.join(here, robot["mesh"]))
gain = json.load(open(os.path.join(here, robot["controller"])))["gain"]
with open("swarm.csv", "w") as file:
    print("tick,x", 0, int(robot["count"]) * gain + int(robot["seed"]), sep="\\n0,", file=file)
"""
COMMAND = "python3 model.py conf/robot.yaml"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    contents = {
        "model.py": MODEL,
        "conf/robot.yaml": ROBOT,
        "conf/gains.json": '{"gain": 0.5}\n',
        "conf/old.csv": "tick,x\n0,9\n",
        "maps/arm.stl": "solid arm\n",
    }
    for name, content in contents.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)
    return tmp_path


def settings(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "sierra.toml").read_text())


@pytest.mark.nightly
def test_named_files_are_further_templates_or_lie_beside_the_inputs(folder: Path) -> None:
    done = quick(folder, "init", "--json", "--command", COMMAND)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["tried"]["status"], said["next"]) == ("ok", "sierra run population_size.Log8 -n")
    assert settings(folder) == {
        "templates": {"robot": "conf/robot.yaml", "gains": "conf/gains.json"},
        "files": ["maps/arm.stl"],
        "command": "python3 model.py {input.robot}",
        "seed": "robot://seed",
        "runs": 10,
        "variables": {"population_size": "robot://count"},
    }
    assert '# gain = "gains://gain"\n' in (folder / "sierra.toml").read_text()


@pytest.mark.integration
def test_what_is_written_for_several_templates_runs(folder: Path) -> None:
    assert quick(folder, "init", "-y", "--no-try", "--command", COMMAND).returncode == 0
    ran = quick(folder, "run", "population_size=1,2", "--runs", "2", "--no-figures", "--json")
    assert json.loads(ran.stdout)["failed"] == 0, ran.stderr
    found = json.loads(quick(folder, "sql", "--json", "SELECT count(DISTINCT x) AS n FROM swarm WHERE x > 0").stdout)
    assert found == [{"n": 4}]


def test_the_file_that_names_the_others_is_the_template(folder: Path) -> None:
    (folder / "scene.sdf").write_text('<sdf seed="1"><include><uri>arm.xml</uri></include><count>3</count></sdf>')
    (folder / "arm.xml").write_text('<arm length="2"><mesh file="maps/arm.stl"/></arm>')
    (folder / "model.py").write_text("import sys\n")
    assert quick(folder, "init", "-y", "--no-try").returncode == 0
    found = settings(folder)
    assert found["templates"] == {"scene": "scene.sdf", "arm": "arm.xml"}
    assert (found["files"], found["seed"]) == (["maps/arm.stl"], "scene://sdf/@seed")


def test_several_templates_in_a_command_are_all_generated(folder: Path) -> None:
    (folder / "world.xml").write_text('<world count="5"/>')
    command = "python3 model.py --world=world.xml conf/gains.json --steps 9 --seed 4"
    assert quick(folder, "init", "-y", "--no-try", "--command", command).returncode == 0
    found = settings(folder)
    assert found["templates"] == {"world": "world.xml", "gains": "conf/gains.json"}
    assert found["command"] == "python3 model.py --world={input.world} {input.gains} --steps 9 --seed {seed}"
    assert '# steps = { argument = "--steps {value}" }' in (folder / "sierra.toml").read_text()


def test_a_template_that_names_only_data_stays_alone(folder: Path) -> None:
    (folder / "conf" / "robot.yaml").write_text(ROBOT.replace("gains.json", "none"))
    assert quick(folder, "init", "-y", "--no-try", "--command", COMMAND).returncode == 0
    found = settings(folder)
    assert (found["template"], found["files"]) == ("conf/robot.yaml", ["maps/arm.stl"])
    assert found["command"] == "python3 model.py {input}"


@pytest.mark.integration
def test_a_file_that_the_tried_run_lacks_is_declared_and_the_run_tried_again(folder: Path) -> None:
    (folder / "model.py").write_text(MODEL + "open(os.path.join(here, '..', 'noise.dat'))\n")
    (folder / "noise.dat").write_text("1\n")
    done = quick(folder, "init", "-y", "--command", COMMAND)
    assert done.returncode == 0, done.stderr
    assert 'the run lacked noise.dat; trying again with files = ["maps/arm.stl", "noise.dat"]\n' in done.stdout
    assert settings(folder)["files"] == ["maps/arm.stl", "noise.dat"]


@pytest.mark.integration
def test_a_run_that_fails_for_another_reason_leaves_a_file_to_correct(folder: Path) -> None:
    (folder / "model.py").write_text(MODEL + "open('noise.dat')\n")  # a run cannot find it in its working directory
    (folder / "noise.dat").write_text("1\n")
    done = quick(folder, "init", "-y", "--command", COMMAND)
    assert done.returncode == 1
    assert "failed: exit status 1; its standard error is .sierra/try/run/stderr (correct sierra.toml" in done.stderr
    assert settings(folder)["files"] == ["maps/arm.stl"]


def test_names_of_templates_differ_and_are_no_prefixes_of_xml(tmp_path: Path) -> None:
    (tmp_path / "sim.py").write_text("import sys\n")
    (tmp_path / "a.world").write_text('<w xmlns:world="urn:w" n="1"><world:include>a.xml</world:include></w>')
    (tmp_path / "a.xml").write_text('<b n="2"/>')
    assert quick(tmp_path, "init", "-y", "--no-try", "--template", "a.world").returncode == 0
    assert settings(tmp_path)["templates"] == {"a": "a.world", "xml": "a.xml"}
    assert quick(tmp_path, "run", "montecarlo.C1", "-n").returncode == 0


def test_a_file_with_the_values_and_the_seed_in_its_name_is_read_in_each_run(tmp_path: Path) -> None:
    program = """
import os, sys
robots, speed, seed = sys.argv[1:]
os.mkdir("results")
with open(f"results/n{robots}_v{float(speed)}_s{seed}.csv", "w") as file:
    file.write(f"time,food\\n0,0\\n1,{int(robots) + int(seed) % 7}\\n")
"""
    (tmp_path / "forage.py").write_text(program)
    done = quick(tmp_path, "init", "--yes", "--command", "python3 forage.py {robots} {speed} {seed}")
    assert done.returncode == 0, done.stderr
    outputs = tomllib.loads((tmp_path / "sierra.toml").read_text())["outputs"]
    assert [keys["file"] for keys in outputs.values()] == ["results/n*_v*_s*.csv"]
    done = quick(tmp_path, "run", "robots=2,3", "speed=0.5", "--runs", "2", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
