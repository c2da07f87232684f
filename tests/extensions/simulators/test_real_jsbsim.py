"""JSBSim, a console script that reads aircraft from its package."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import projects
from tests.extensions.simulators.changes import LOCKS, Edit, project
from tests.projects import values
from tests.simulators import Environment, Install

pytestmark = pytest.mark.nightly
FLIGHT = """\
<runscript name="climb">
  <use aircraft="c172x" initialize="reset01"/>
  <run start="0" end="2" dt="0.01">
    <property value="0"> simulation/randomseed </property>
    <event name="throttle">
      <condition>simulation/sim-time-sec ge 0.2</condition>
      <set name="fcs/throttle-cmd-norm" value="0.5"/>
    </event>
  </run>
  <output name="flight.csv" type="CSV" rate="10"><property>position/h-sl-ft</property></output>
</runscript>
"""
HEIGHTS = "size=0.1,0.9"


FLY = """\
import sys
import jsbsim
executive = jsbsim.FGFDMExec(None)
executive.load_script(sys.argv[1])
executive.disable_output()
executive.run_ic()
with open("heights.csv", "w") as file:
    print("tick,height", file=file)
    for tick in range(50):
        executive.run()
        print(tick, executive["position/h-sl-ft"], sep=",", file=file)
"""


@pytest.fixture
def jsbsim(installed: Install) -> Environment:
    return installed(LOCKS / "jsbsim.txt")


@pytest.fixture(params=["first", "all"])
def flight(tmp_path: Path, jsbsim: Environment, request: pytest.FixtureRequest) -> Path:
    command = f"{jsbsim.bin}/jsbsim --root={jsbsim.site}/jsbsim --script={{input}} --outputpath={{output}}"
    return project(
        tmp_path / "project", command, FLIGHT, seed="//run/property/@value", size="//event/set/@value", observe=request.param
    )


def test_jsbsim_is_named_once_although_a_version_spells_it_otherwise(tmp_path: Path, jsbsim: Environment) -> None:
    """The older distribution calls itself `JSBSim`, the newer one `jsbsim`."""
    command = f"{jsbsim.bin}/python fly.py {{input}}"
    root = project(tmp_path / "project", command, FLIGHT, seed="//run/property/@value", size="//event/set/@value")
    (root / "fly.py").write_text(FLY)
    try:
        assert jsbsim.install(LOCKS / "jsbsim-older.txt") == ""
        projects.run(root, HEIGHTS)
    finally:
        assert jsbsim.install(LOCKS / "jsbsim.txt") == ""
    [recorded] = projects.sql(root, "SELECT execution, distributions FROM observations LIMIT 1")
    assert [name for name in recorded["distributions"] if "jsbsim" in name.lower()] == ["jsbsim==1.2.1"]
    shown = json.loads(projects.quick(root, "show", recorded["execution"], "--json").stdout)
    assert json.dumps(shown["observation"]).lower().count("jsbsim") == 1
    summary, said = projects.run(root, HEIGHTS)
    assert (summary["executed"], "jsbsim 1.2.1 recorded, 1.3.3 found" in said, said.lower().count("jsbsim")) == (4, True, 1)


def test_a_package_that_jsbsim_does_not_use_executes_nothing_again(flight: Path, jsbsim: Environment) -> None:
    """Each experiment has an observed run."""
    projects.run(flight, HEIGHTS)
    assert jsbsim.install(LOCKS / "unused.txt") == ""
    try:
        summary, said = projects.run(flight, HEIGHTS)
    finally:
        jsbsim.pip("uninstall", "--yes", "zipp")
    assert (summary["executed"], summary["reused"]) == (0, 4)
    assert "4 runs reused, because the executions did not use what has changed: python3: installed distributions" in said


def test_an_edited_aircraft_of_jsbsim_is_named_and_executes_all_runs_again(
    flight: Path, jsbsim: Environment, edit: Edit
) -> None:
    batch = projects.run(flight, HEIGHTS)[0]["batch"]
    heights = 'SELECT "/fdm/jsbsim/position/h-sl-ft" FROM flight JOIN effective USING (execution)'
    before = values(flight, heights)
    aircraft = jsbsim.site / "jsbsim" / "aircraft" / "c172x" / "c172x.xml"
    original = aircraft.read_bytes()
    edit(aircraft, original.replace(b'<wingarea unit="FT2"> 174.0', b'<wingarea unit="FT2"> 150.0'))
    replayed = projects.quick(flight, "replay", batch[:10])
    said = replayed.stdout + replayed.stderr
    assert (replayed.returncode, "aircraft/c172x/c172x.xml" in said, "chance" in said) == (1, True, False)
    summary, said = projects.run(flight, HEIGHTS)
    assert (summary["executed"], "aircraft/c172x/c172x.xml" in said) == (4, True)
    assert values(flight, heights) != before
    aircraft.write_bytes(original)
    assert projects.run(flight, HEIGHTS)[0]["executed"] == 0
    assert values(flight, heights) == before


def test_runs_of_jsbsim_that_write_into_the_installed_package_fail(tmp_path: Path, jsbsim: Environment) -> None:
    command = f"{jsbsim.bin}/jsbsim --root={jsbsim.site}/jsbsim --script={{input}}"
    root = project(tmp_path / "project", command, FLIGHT, seed="//run/property/@value", size="//event/set/@value")
    try:
        done = projects.quick(root, "run", HEIGHTS, "--no-figures")
    finally:
        for file in jsbsim.site.glob("jsbsim/*.csv"):
            file.unlink()
    assert (done.returncode, "jsbsim/flight.csv" in done.stderr) == (1, True)
    assert values(root, "SELECT status FROM executions") == {"failed"}
    assert all("jsbsim/flight.csv" in str(reason) for reason in values(root, "SELECT reason FROM executions"))
