"""SUMO, which reads several files and writes beside its configuration."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import projects
from tests.extensions.simulators.changes import LOCKS, project
from tests.projects import values
from tests.simulators import Install

pytestmark = pytest.mark.nightly
NODES = """\
<nodes>
  <node id="e" x="80" y="0"/><node id="n" x="0" y="80"/><node id="w" x="-80" y="0"/><node id="s" x="0" y="-80"/>
</nodes>
"""
EDGES = """\
<edges>
  <edge id="q0" from="e" to="n" numLanes="1" speed="14"/><edge id="q1" from="n" to="w" numLanes="1" speed="14"/>
  <edge id="q2" from="w" to="s" numLanes="1" speed="14"/><edge id="q3" from="s" to="e" numLanes="1" speed="14"/>
</edges>
"""
TYPES = '<additional><vType id="car" maxSpeed="{speed}" speedFactor="1"/></additional>\n'
ROUTES = """\
<routes>
  <include href="{types}"/>
  <route id="ring" edges="q0 q1 q2 q3" repeat="100"/>
  <flow id="cars" type="car" route="ring" begin="0" end="10" number="{number}" departPos="random_free"/>
</routes>
"""
TRAFFIC = """\
<configuration>
  <time><begin value="0"/><end value="60"/></time>
  <random_number><seed value="0"/></random_number>
  <processing><max-num-vehicles value="8"/></processing>
  <output><summary-output value="{summary}"/></output>
  <report><no-step-log value="true"/></report>
</configuration>
"""
SIZES = "size=2,3"
FASTEST = 'SELECT max(s."step_meanSpeed") AS v FROM summary s JOIN effective USING (execution)'


@pytest.fixture
def traffic(tmp_path: Path, installed: Install, require: Callable[..., str]) -> Path:
    """A project of SUMO; its types of vehicles are outside the project, and only the routes name them."""
    sumo = installed(LOCKS / "sumo.txt")
    works = subprocess.run([sumo.bin / "sumo", "--version"], check=False, capture_output=True).returncode == 0
    require("the system's libraries that SUMO needs", there=works)
    command = f"{sumo.bin}/sumo -c {{input}} -n {{project}}/ring.net.xml -r {{project}}/ring.rou.xml"
    root = project(
        tmp_path / "project",
        command,
        TRAFFIC.format(summary="summary.csv"),
        seed="//seed/@value",
        size="//max-num-vehicles/@value",
    )
    (tmp_path / "nodes.xml").write_text(NODES)
    (tmp_path / "edges.xml").write_text(EDGES)
    (tmp_path / "types.xml").write_text(TYPES.format(speed=10))
    (root / "ring.rou.xml").write_text(ROUTES.format(types=tmp_path / "types.xml", number=4))
    files = ("-n", tmp_path / "nodes.xml", "-e", tmp_path / "edges.xml", "-o", root / "ring.net.xml")
    subprocess.run([sumo.bin / "netconvert", *files], check=True, capture_output=True)
    return root


def corrected(root: Path) -> Path:
    """Let SUMO write into the working directory of the run."""
    (root / "template.xml").write_text(TRAFFIC.format(summary="output/summary.csv"))
    return root


def test_runs_of_sumo_that_write_beside_their_configuration_fail(traffic: Path) -> None:
    done = projects.quick(traffic, "run", SIZES, "--no-figures")
    assert (done.returncode, "{run}/summary.csv" in done.stderr) == (1, True)
    reasons = values(traffic, "SELECT reason FROM executions")
    assert reasons == {"left no file in its working directory, but wrote {run}/summary.csv"}


def test_what_the_message_proposes_gives_tables_of_sumo(traffic: Path) -> None:
    done = projects.quick(traffic, "run", SIZES, "--no-figures")
    assert "call it output/summary.csv in the template" in done.stderr
    summary, _ = projects.run(corrected(traffic), SIZES)
    assert (summary["executed"], summary["failed"]) == (4, 0)
    counted = "SELECT count(*) AS n FROM summary GROUP BY execution"
    assert [row["n"] for row in projects.sql(traffic, counted)] == [60] * 4


def test_the_files_that_sumo_reads_are_recorded(traffic: Path) -> None:
    projects.run(corrected(traffic), SIZES)
    read = {str(path) for path in values(traffic, "SELECT path FROM files_read WHERE use = 'read'")}
    assert {"{project}/ring.net.xml", "{project}/ring.rou.xml", str(traffic.parent / "types.xml")} <= read
    assert values(traffic, "SELECT reason FROM observations") == {None}


def test_edited_routes_of_sumo_execute_all_runs_again(traffic: Path) -> None:
    projects.run(corrected(traffic), SIZES)
    (traffic / "ring.rou.xml").write_text(ROUTES.format(types=traffic.parent / "types.xml", number=2))
    summary, said = projects.run(traffic, SIZES)
    assert (summary["executed"], "ring.rou.xml" in said) == (4, True)
    inserted = "SELECT max(s.step_inserted) AS n FROM summary s JOIN effective e USING (execution) WHERE e.batch = "
    assert values(traffic, f"{inserted}'{summary['batch']}'") == {2}


def test_edited_vehicles_that_only_the_routes_name_execute_all_runs_again(traffic: Path) -> None:
    projects.run(corrected(traffic), SIZES)
    [fast] = values(traffic, FASTEST)
    (traffic.parent / "types.xml").write_text(TYPES.format(speed=5))
    summary, said = projects.run(traffic, SIZES)
    assert (summary["executed"], "types.xml" in said) == (4, True)
    assert (fast, values(traffic, FASTEST)) == (10, {5})
    (traffic.parent / "types.xml").write_text(TYPES.format(speed=10))
    assert projects.run(traffic, SIZES)[0]["executed"] == 0
