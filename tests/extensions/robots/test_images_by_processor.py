"""Robots with different processors in containers, over real sshd: each executes the image for its own."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import containers, projects
from tests.support.robot_fleet import Fleet

HERE = os.uname().machine
pytestmark = [
    pytest.mark.integration,
    pytest.mark.real,
    pytest.mark.skipif(HERE != "x86_64", reason="its kernel imitates no other processor"),
]
CONFIG = """\
template = "arena.xml"
command = "sh robot.sh {{robot}} {{arch}}"
seed = "//random/@seed"
runs = 1
[variables]
population_size = "//swarm/@count"
[robots]
count = "population_size"
[outputs.made]
file = "made.csv"
[container]
image = "busybox-{{arch}}.tar"
[runners.robots]
fleet = {{ {fleet} }}
link_options = {{ ssh_config = "{config}" }}
disk_min = 1000000
stop = []
"""
ROBOT = 'printf "made_for,named\\n%s,%s\\n" "$MADE_FOR" "$2" > made.csv\n'
MADE = """
SELECT place, machine, made_for, named, g.name AS image
FROM robots r JOIN made m USING (execution) JOIN isolations i USING (isolation) JOIN images g USING (image)
JOIN executions e USING (execution) WHERE m.robot = place AND e.purpose = 'run' ORDER BY place
"""


@pytest.fixture
def root(fleet: Fleet, tmp_path: Path, require: Callable[..., str]) -> Path:
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    for engine in ("apptainer", "podman"):
        require(engine)
    members = ", ".join(f'{name} = {{ host = "{name}" }}' for name in fleet.names[:2])
    root = projects.make(tmp_path / "project", CONFIG.format(fleet=members, config=fleet.ssh_config))
    (root / "robot.sh").write_text(ROBOT)
    image(root, HERE)
    return root


def image(root: Path, processor: str, text: str = "") -> None:
    containers.busybox(root, processor, MADE_FOR=text or processor)


@pytest.mark.nightly
def test_each_robot_executes_the_image_for_its_processor(root: Path, fleet: Fleet) -> None:
    run = ("run", "population_size=2", "--on", "robots", "--no-figures", "--engine", "apptainer")
    fleet.set_machine("rb2", "i686")
    assert projects.quick(root, "image", "pin").returncode == 0
    missing = projects.quick(root, *run)
    assert missing.returncode == 3
    assert missing.stderr.splitlines()[-1] == (
        "sierra: rb2: no image for i686: busybox-i686.tar is not pinned; add it, and run: sierra image pin busybox-i686.tar"
    )
    assert not any((fleet.robots[name].home / ".cache/sierra-robot/images").exists() for name in fleet.names)

    image(root, "i686")
    pinned = projects.quick(root, "image", "pin", "--json")
    assert [one["architecture"] for one in json.loads(pinned.stdout)] == ["amd64", "386"]
    done = projects.quick(root, *run)
    assert done.returncode == 0, done.stderr
    assert projects.sql(root, MADE) == [
        {"place": place, "machine": one, "made_for": one, "named": one, "image": f"busybox-{one}.tar"}
        for place, one in ((1, HERE), (2, "i686"))
    ]
    [run_id] = [row["run"] for row in projects.sql(root, "FROM runs WHERE status = 'ok'")]
    replayed = projects.quick(root, "replay", run_id, "--on", "robots", "--engine", "podman")
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr

    (root / f"busybox-{HERE}.tar").rename(root / "away.tar")
    gone = projects.quick(root, *run, "--runs", "2")
    assert gone.returncode == 3, gone.stderr
    assert gone.stderr.splitlines()[-1].startswith(f"sierra: rb1: {root}/busybox-{HERE}.tar cannot be read: ")
    (root / "away.tar").rename(root / f"busybox-{HERE}.tar")
    assert "1 run: 0 executed, 1 reused" in projects.quick(root, *run).stdout, "it is the same run again"

    image(root, "i686", "other")
    assert projects.quick(root, "image", "pin").returncode == 0
    why = projects.quick(root, *run, "--dry-run", "--explain")
    assert "images by processor: i686 was sha256:" in why.stdout + why.stderr
    assert projects.quick(root, "fsck").returncode == 0
