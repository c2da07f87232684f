"""Runs on nodes get ports of their own there, in commands, inputs and variables."""

from __future__ import annotations

from pathlib import Path

from tests import projects
from tests.clusters import Slurm

SIMULATOR = """\
import os, re, sys
given = re.search("<noise>(.*)</noise>", open(sys.argv[1]).read())[1]
print("tick,value,word,variable", f"0,{given},{sys.argv[2]},{os.environ['P']}", sep="\\n", file=open("swarm.csv", "w"))
"""
MORE = """
[environment]
set = { P = "{port2}" }
[runners.slurm]
array_tasks = 2
"""


def test_runs_on_nodes_get_ports_of_their_own(tmp_path: Path, slurm: Slurm) -> None:
    config = projects.CONFIG.replace("sim.py {input}", "sim.py {input} {port}").replace(
        "runs = 2", 'runs = 2\nchanges = [{ set = "//noise", value = "{port}" }]'
    )
    root = projects.make(tmp_path / "project", config + MORE, simulator=SIMULATOR)
    done = projects.quick(root, "run", "population_size=1,2", "--no-figures", "--on", "slurm")
    assert done.returncode == 0, done.stdout + done.stderr
    rows = projects.sql(root, "SELECT value, word, variable FROM swarm")
    assert len(rows) == 4
    assert all(20_000 <= row["value"] == row["word"] != row["variable"] >= 20_000 for row in rows)
