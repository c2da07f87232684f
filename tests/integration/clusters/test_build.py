"""Products for runs on a real SLURM are built on the submitting machine, and copied to the nodes."""

from __future__ import annotations

import socket
from pathlib import Path

import sierra
from tests import projects
from tests.clusters import Slurm

CONFIG = """\
template = "arena.xml"
command = "build/sim {input} {seed}"
runs = 2
[variables]
population_size = "//swarm/@count"
[build]
command = "sh compile.sh"
produces = ["build/sim"]
[runners.slurm]
array_tasks = 2
"""
FILES = {
    "sim.sh": "#!/bin/sh\nprintf 't,v\\n1,1\\n2,4\\n' > swarm.csv\n",
    "compile.sh": "mkdir -p build && cp sim.sh build/sim && chmod +x build/sim\n",
    "arena.xml": projects.TEMPLATE,
    "sierra.toml": CONFIG,
    ".gitignore": "build/\n",
}


def test_products_are_built_where_the_batch_is_submitted(tmp_path: Path, slurm: Slurm) -> None:
    root = tmp_path / "project"
    root.mkdir()
    for name, text in FILES.items():
        (root / name).write_text(text)
    projects.commit(root)
    done = projects.sierra(root, "run", "population_size=1,2", "--on", "slurm", "--no-figures")
    assert done.returncode == 0, done.stderr
    project = sierra.open(root)
    builds = project.sql("SELECT b.host, s.build = b.build AS used, s.runner FROM builds b, sessions s").to_pylist()
    assert builds == [{"host": socket.gethostname(), "used": True, "runner": "slurm"}]
    assert project.sql("SELECT count(*) AS n FROM executions WHERE status = 'ok'").to_pylist() == [{"n": 4}]
    done = projects.sierra(root, "replay", project.batches[-1].batch, "--on", "slurm")
    assert "identical (4 runs: 4 identical; built from source: build/sim)" in done.stdout, done.stderr
