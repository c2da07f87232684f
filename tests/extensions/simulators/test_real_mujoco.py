"""MuJoCo, which a Python program imports: changes of its version and of its library are noticed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import projects
from tests.extensions.simulators.changes import LOCKS, Edit, project
from tests.projects import values
from tests.simulators import Environment, Install

pytestmark = pytest.mark.nightly
SWARM = """\
<mujoco>
  <custom><numeric name="seed" data="0"/></custom>
  <worldbody>
    <geom type="plane" size="3 3 .1"/>
    <replicate count="3" offset="0.2 0 0">
      <body name="robot" pos="0 0 0.12">
        <joint name="x" type="slide" axis="1 0 0" damping="2"/>
        <joint name="y" type="slide" axis="0 1 0" damping="2"/>
        <geom type="cylinder" size="0.12 0.1" mass="1"/>
      </body>
    </replicate>
  </worldbody>
  <actuator><motor name="fx" joint="x"/><motor name="fy" joint="y"/></actuator>
</mujoco>
"""
WALK = """\
import random, sys
import mujoco
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
rng = random.Random(int(model.numeric("seed").data[0]))
with open("swarm.csv", "w") as file:
    print("tick,x,version", file=file)
    for tick in range(20):
        data.ctrl[:] = [rng.uniform(-1, 1) for _ in range(model.nu)]
        mujoco.mj_step(model, data, nstep=10)
        print(tick, float(data.qpos.sum()), mujoco.__version__, sep=",", file=file)
"""
SIZES = "size=2,3"


@pytest.fixture
def mujoco(installed: Install) -> Iterator[Environment]:
    """Yield an environment with a version of MuJoCo; the version is the same again when the test ends."""
    environment = installed(LOCKS / "mujoco.txt")
    yield environment
    assert environment.install(LOCKS / "mujoco.txt") == ""


@pytest.fixture
def swarm(tmp_path: Path, mujoco: Environment) -> Path:
    command = f"{mujoco.bin}/python walk.py {{input}}"
    root = project(tmp_path / "project", command, SWARM, seed="//numeric[@name='seed']/@data", size="//replicate/@count")
    (root / "walk.py").write_text(WALK)
    return root


def test_another_version_of_mujoco_is_named_and_executes_all_runs_again(swarm: Path, mujoco: Environment) -> None:
    batch = projects.run(swarm, SIZES)[0]["batch"]
    versions = "SELECT DISTINCT version FROM swarm JOIN effective USING (execution)"
    assert values(swarm, versions) == {"3.17.0"}
    assert mujoco.install(LOCKS / "mujoco-older.txt") == ""
    replayed = projects.quick(swarm, "replay", batch[:10])
    said = replayed.stdout + replayed.stderr
    assert (replayed.returncode, "mujoco 3.17.0 recorded, 3.12.0 found" in said, "chance" in said) == (1, True, False)
    summary, said = projects.run(swarm, SIZES)
    assert (summary["executed"], "mujoco 3.17.0 recorded, 3.12.0 found" in said) == (4, True)
    assert values(swarm, versions) == {"3.12.0"}
    assert mujoco.install(LOCKS / "mujoco.txt") == ""
    summary, _ = projects.run(swarm, SIZES)
    assert (summary["executed"], summary["reused"]) == (0, 4)
    assert values(swarm, versions) == {"3.17.0"}
    assert projects.quick(swarm, "replay", batch[:10]).returncode == 0


def test_a_changed_byte_in_the_library_of_mujoco_is_named(swarm: Path, mujoco: Environment, edit: Edit) -> None:
    """The byte comes after all that is loaded, so the results are the same."""
    [library] = mujoco.site.glob("mujoco/libmujoco.so*")
    before = library.read_bytes()
    batch = projects.run(swarm, SIZES)[0]["batch"]
    edit(library, before + b"\0")
    replayed = projects.quick(swarm, "replay", batch[:10])
    said = replayed.stdout + replayed.stderr
    assert (replayed.returncode, library.name in said, "chance" in said) == (0, True, False)
    summary, said = projects.run(swarm, SIZES)
    assert (summary["executed"], library.name in said) == (4, True)
    library.write_bytes(before)
    summary, _ = projects.run(swarm, SIZES)
    assert (summary["executed"], summary["reused"]) == (0, 4)
