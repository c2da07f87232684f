"""Each robot of a run gets ports of its own, in its command, inputs and variables, and a short path for temporary files."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import projects
from tests.support import robot_project
from tests.support.robot_fleet import Fleet

pytestmark = [pytest.mark.integration, pytest.mark.each_case]
PROGRAM = """\
import os, re, socket, sys
given = int(re.search('value="([0-9]+)"', open(sys.argv[1]).read())[1])
socket.create_server(("", given))
socket.socket(socket.AF_UNIX).bind(os.environ["TMPDIR"] + "/pymp-12345678-listener-12345678")
print("t,port,word,variable", f"0,{given},{sys.argv[2]},{os.environ['P']}", sep="\\n", file=open("swarm.csv", "w"))
"""


def test_each_robot_gets_ports_of_its_own(fleet: Fleet, tmp_path: Path) -> None:
    project = robot_project.make(fleet, tmp_path / "project")
    (project / "swarm.py").write_text(PROGRAM)
    config = (project / "sierra.toml").read_text().replace('swarm.py", "{seed}"]', 'swarm.py", "{input}", "{port}"]')
    config = config.replace("[variables.speed]", 'changes = [{ set = "//speed/@value", value = "{port}" }]\n[variables.speed]')
    config = config.replace('set = "//speed/@value"\n', 'set = "//other/@value"\n')
    (project / "experiment.xml").write_text('<e><speed value="1"/><other value="1"/></e>')
    (project / "sierra.toml").write_text(config + '[environment]\nset = { P = "{port2}" }\n')
    done = projects.quick(project, *robot_project.QUERY)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = projects.sql(project, "SELECT port, word, variable FROM swarm")
    assert len(rows) == 6
    given = projects.sql(project, "SELECT name FROM channels WHERE use = 'given'")
    assert sorted(row["name"] for row in given) == sorted(
        f"127.0.0.1:{row[name]}" for row in rows for name in ("port", "variable")
    )
    assert all(20_000 <= row["port"] == row["word"] != row["variable"] >= 20_000 for row in rows)
