"""Values, several templates and files beside inputs: in containers and on nodes of a real cluster, and replayed from there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests import containers, projects
from tests.clusters import Slurm

pytestmark = pytest.mark.real
SCRIPT = """\
read speed < "$(dirname "$1")/../conf/speed"
echo tick,count,speed,noise > out.csv
echo 0,$2,$speed,$NOISE >> out.csv
"""
CONFIG = """\
templates = { world = "sim/world.xml", params = "sim/params.json" }
command = "sh sim.sh {input.world} {population_size} {seed}"
files = ["conf"]
runs = 1
[source]
paths = ["sim.sh"]
[variables]
population_size = {}
noise = { environment = "NOISE", set = "params:/noise" }
"""


def make(folder: Path, more: str) -> Path:
    projects.make(folder, CONFIG + more)
    (folder / "sim.sh").write_text(SCRIPT)
    for name, content in (("sim/world.xml", "<a/>"), ("sim/params.json", '{"noise": 0}'), ("conf/speed", "0.5\n")):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(content)
    return folder


def check(root: Path, *words: str) -> None:
    summary, _ = projects.run(root, "population_size=1,2", "noise=0.25", *words)
    rows = projects.sql(root, "SELECT count, speed, noise FROM out ORDER BY count")
    assert [tuple(row.values()) for row in rows] == [(1, 0.5, 0.25), (2, 0.5, 0.25)]
    (root / "conf" / "speed").write_text("7\n")
    done = projects.quick(root, "replay", summary["batch"])
    assert "2 identical" in done.stdout, done.stderr
    assert projects.quick(root, "fsck").returncode == 0


def test_on_nodes(tmp_path: Path, slurm: Slurm) -> None:
    check(make(tmp_path / "p", "[runners.slurm]\narray_tasks = 2\nattempts = 1\n"), "--on", "slurm")


@pytest.mark.parametrize("isolation", ["run", "worker"])
def test_in_containers(tmp_path: Path, isolation: str, require: Callable[..., str]) -> None:
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    require("Debian's python3, as /usr/bin/python3", there=containers.PYTHON.exists())
    require("podman")
    image = containers.busybox(tmp_path) if isolation == "run" else containers.python(tmp_path)
    root = make(tmp_path / "p", f'[container]\nimage = "{image}"\nisolation = "{isolation}"\n')
    pinned = projects.quick(root, "image", "pin")
    assert pinned.returncode == 0, pinned.stderr
    check(root)
