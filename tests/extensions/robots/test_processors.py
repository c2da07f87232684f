"""Robots with different processors, over real sshd: each executes its own product, and nothing starts without one."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests import projects
from tests.support import elf
from tests.support.robot_fleet import Fleet

pytestmark = pytest.mark.integration
HERE = os.uname().machine
CONFIG = """\
template = "arena.xml"
command = "bin/{{arch}}/go {{robot}}"
seed = "//random/@seed"
runs = 1
[variables]
population_size = "//swarm/@count"
[robots]
count = "population_size"
[build]
command = "sh compile.sh {{arch}}"
produces = "bin/{{arch}}/go"
arch = {processors}
[outputs.made]
file = "made.csv"
[runners.robots]
fleet = {{ {fleet} }}
link_options = {{ ssh_config = "{config}" }}
disk_min = 1000000
stop = []
"""
COMPILER = """\
mkdir -p bin/$1
printf '#!/bin/sh\\nprintf "made_for\\\\n%s\\\\n" > made.csv\\n' $1 > bin/$1/go
chmod +x bin/$1/go
"""
PRODUCTS = "SELECT place, machine, made_for FROM robots r JOIN made m USING (execution) WHERE m.robot = place ORDER BY place"


def configure(root: Path, fleet: Fleet, processors: list[str]) -> None:
    members = ", ".join(f'{name} = {{ host = "{name}" }}' for name in fleet.names[:2])
    config = CONFIG.format(fleet=members, config=fleet.ssh_config, processors=processors)
    (root / "sierra.toml").write_text(config)


@pytest.mark.nightly
@pytest.mark.skipif(HERE != "x86_64", reason="its kernel imitates no other processor")
def test_each_robot_executes_the_product_for_its_processor(fleet: Fleet, tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", "")
    configure(root, fleet, [HERE, "i686"])
    (root / "compile.sh").write_text(COMPILER)
    (root / ".gitignore").write_text("bin\n")
    projects.commit(root)
    fleet.set_machine("rb2", "i686")
    words = ("run", "population_size=2", "--on", "robots", "--no-figures")
    done = projects.quick(root, *words)
    assert done.returncode == 0, done.stderr
    assert projects.sql(root, PRODUCTS) == [
        {"place": 1, "machine": HERE, "made_for": HERE},
        {"place": 2, "machine": "i686", "made_for": "i686"},
    ]
    [run] = projects.sql(root, "FROM runs")
    fleet.set_machine("rb2", "")
    replayed = projects.quick(root, "replay", run["run"], "--on", "robots")
    assert "different processor at place 2: was i686, is now x86_64" in replayed.stderr
    assert "different machine" not in replayed.stderr
    assert replayed.returncode == 1, "the output says for which processor the program was made"
    captured = projects.quick(root, "capture", run["run"])
    assert (captured.returncode, "on robots, which cannot repeat a run for frames" in captured.stderr) == (2, True)
    fleet.set_machine("rb2", "i686")

    configure(root, fleet, [HERE])
    missing = projects.quick(root, *words)
    assert missing.returncode == 3
    assert missing.stderr.splitlines()[-1] == (
        f"sierra: rb2 is i686, but the code has no bin/i686/go; it is there for {HERE}; "
        'add "i686" to arch in [build], or add the file'
    )

    elf.write(root / "foreign")
    (root / "compile.sh").write_text("mkdir -p bin/$1; cp foreign bin/$1/go\n")
    configure(root, fleet, [HERE, "i686"])
    foreign = projects.quick(root, *words)
    assert foreign.returncode == 3
    assert f"rb1 is {HERE}, but bin/{HERE}/go is a program for aarch64" in foreign.stderr.splitlines()[-1]
    assert projects.sql(root, "SELECT run FROM executions WHERE purpose = 'run'") == [{"run": run["run"]}]
