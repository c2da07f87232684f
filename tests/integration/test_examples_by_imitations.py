"""The examples for NetLogo and Webots: their inputs are what the manuals require, and batches of them give figures.

These simulators cannot be installed here. Small programs stand for them. They read the same inputs and write the same files, as
the manuals describe them: NetLogo's guide to BehaviorSpace, and Webots' pages on world files and on supervisors.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest
from lxml import etree

from tests import projects

NETLOGO = """\
import csv, random, sys, time
import xml.etree.ElementTree as tree

options = dict(zip(sys.argv[1::2], sys.argv[2::2], strict=True))
assert "to setup" in open(options["--model"]).read()
[experiment] = [one for one in tree.parse(options["--setup-file"]).getroot() if one.get("name") == options["--experiment"]]
values = {one.get("variable"): one.find("value").get("value") for one in experiment.findall("enumeratedValueSet")}
chance = random.Random(int(values["random-seed"]))
with open(options["--table"], "w", newline="") as file:
    rows = csv.writer(file, quoting=csv.QUOTE_ALL)
    rows.writerow(["BehaviorSpace results (NetLogo 6.4.0)", "Table version 2.0"])
    rows.writerow([options["--model"]])
    rows.writerow([options["--experiment"]])
    rows.writerow([time.time()])
    rows.writerow(["min-pxcor", "max-pxcor", "min-pycor", "max-pycor"])
    rows.writerow([-16, 16, -16, 16])
    rows.writerow(["[run number]", *values, "[step]", *(one.text for one in experiment.findall("metric"))])
    share = 1 / int(values["people"])
    for step in range(int(experiment.find("timeLimit").get("steps")) + 1):
        rows.writerow([1, *values.values(), step, share])
        share = min(1, share * (1 + float(values["infectiousness"]) * chance.random()))
"""
WEBOTS = """\
import os, re, runpy, sys, types
from pathlib import Path

assert sys.argv[1:-1] == ["--mode=fast", "--batch", "--minimize", "--no-rendering", "--stdout", "--stderr"], sys.argv
world = Path(sys.argv[-1])
text = world.read_text()
assert text.startswith("#VRML_SIM R") and "supervisor TRUE" in text
name = re.search(r'controller "(.*)"', text)[1]
words = re.findall(r'"(.*)"', re.search(r"controllerArgs \\[(.*?)\\]", text, re.DOTALL)[1])
step = int(re.search(r"basicTimeStep (\\d+)", text)[1])
defined = re.findall(r"DEF (\\w+)", text)


class Node:
    place, velocity = [0.0, 0.0, 0.1], [0.0] * 6

    def setVelocity(self, velocity):
        assert len(velocity) == 6
        self.velocity = velocity

    def getPosition(self):
        return self.place


class Supervisor:
    time = 0.0

    def getBasicTimeStep(self):
        return float(step)

    def getFromDef(self, name):
        assert name in defined
        self.node = Node()
        return self.node

    def getTime(self):
        return self.time

    def step(self, duration):
        self.time += duration / 1000
        self.node.place = [one + speed * duration / 1000 for one, speed in zip(self.node.place, self.node.velocity)]
        return 0

    def simulationQuit(self, status):
        self.status = status


controller = types.ModuleType("controller")
controller.Supervisor = Supervisor
sys.modules["controller"] = controller
folder = world.parent.parent / "controllers" / name
os.chdir(folder)
sys.argv = [name, *words]
runpy.run_path(str(folder / f"{name}.py"))
"""
IN_ORDER = ("setup", "go", "final", "timeLimit", "exitCondition", "metric", "runMetricsCondition", "enumeratedValueSet")
"""Elements of an experiment, in the order that the format of BehaviorSpace requires."""


def started(folder: Path, example: str, program: str, script: str, patch: pytest.MonkeyPatch) -> Path:
    """Return a copy of an example; a script stands for its simulator."""
    (folder / "bin").mkdir()
    (folder / "bin" / program).write_text(f"#!{sys.executable}\n{script}")
    (folder / "bin" / program).chmod(0o755)
    patch.setenv("PATH", f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}")
    done = projects.quick(folder, "init", "--example", example, "demo")
    assert done.returncode == 0, done.stderr
    return folder / "demo"


def batch(root: Path, *query: str) -> str:
    """Execute a query with figures; return the batch."""
    done = projects.quick(root, "run", *query)
    assert done.returncode == 0, done.stderr
    assert len(list((root / "figures").glob("*/*.png"))) == 1
    return str(projects.sql(root, "SELECT batch FROM batches")[0]["batch"])


@pytest.mark.nightly
def test_the_example_of_netlogo_is_a_valid_experiment_and_gives_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = started(tmp_path, "netlogo", "netlogo-headless.sh", NETLOGO, monkeypatch)
    [experiment] = etree.parse(root / "epidemic.xml").getroot()
    parts = [str(part.tag) for part in experiment]
    assert parts == sorted(parts, key=IN_ORDER.index)
    assert set(experiment.attrib) <= {"name", "repetitions", "sequentialRunOrder", "runMetricsEveryStep"}
    sections = (root / "epidemic.nlogo").read_text().split("@#$#@#$#@\n")
    assert (len(sections), sections[4]) == (12, "NetLogo 6.4.0\n")
    sliders = re.findall(r"SLIDER\n(?:\d+\n){4}(.*)\n\1\n", sections[1])
    assert sliders == ["people", "infectiousness"]
    varied = [part.get("variable") for part in experiment.findall("enumeratedValueSet")]
    assert varied == ["random-seed", *sliders]
    made = batch(root, "people=50,200", "--runs", "2")
    rows = 'SELECT people, count(*) AS n, max("[step]") AS last FROM epidemic GROUP BY ALL ORDER BY ALL'
    assert projects.sql(root, rows) == [{"people": 50, "n": 402, "last": 200}, {"people": 200, "n": 402, "last": 200}]
    replayed = projects.quick(root, "replay", made)
    assert "equal (4 runs: 4 equal)" in replayed.stdout, replayed.stdout + replayed.stderr


@pytest.mark.nightly
def test_the_example_of_webots_changes_only_its_placeholders_and_gives_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = started(tmp_path, "webots", "webots", WEBOTS, monkeypatch)
    world = (root / "worlds" / "roll.wbt").read_text()
    assert all(world.count(left) == world.count(right) for left, right in ("{}", "[]"))
    made = batch(root, "speed=0.5,2", "--runs", "2")
    [run, *_] = projects.sql(root, "SELECT run, seed FROM runs WHERE speed = 2 ORDER BY run")
    recorded = projects.quick(root, "files", str(run["run"]), "input/worlds/input.wbt").stdout
    expected = world.replace("{{speed}}", "2").replace("{{seed}}", str(run["seed"]))
    assert re.sub(r"sierraFolder\w+Output", "{{output}}", recorded) == expected
    distances = projects.sql(root, "SELECT max(x) AS far FROM roll GROUP BY speed ORDER BY speed")
    assert [round(row["far"], 1) for row in distances] == [2.5, 10.0]
    assert len(projects.sql(root, "SELECT DISTINCT y FROM roll WHERE time BETWEEN 1 AND 1.01")) == 4
    replayed = projects.quick(root, "replay", made)
    assert "identical (4 runs: 4 identical)" in replayed.stdout, replayed.stdout + replayed.stderr
    pushed = root / "controllers" / "push" / "push.py"
    pushed.write_text(pushed.read_text().replace("speed / 10", "speed / 5"))
    assert projects.run(root, "speed=0.5,2", "--runs", "2")[0]["executed"] == 4
