"""The platform `jsbsim`: the inputs that it generates; JSBSim itself is not needed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import sierra.extensions.simulators
from sierra.config import project_file
from sierra.design.platforms import base
from sierra.errors import TemplateError
from sierra.extensions.simulators.jsbsim import DRIVER, Jsbsim
from sierra.templates import several
from sierra.testing import platforms
from tests import projects
from tests.simulator_inputs import SEED, inputs

SCRIPT = """\
<runscript>
  <use aircraft="c172x" initialize="reset01"/>
  <run start="0" end="2" dt="0.01">
    <event name="wind"><condition>simulation/sim-time-sec ge 1</condition><set name="a/b" value="1"/></event>
  </run>
  <output name="heights.csv" type="CSV" rate="10"><property>position/h-sl-ft</property></output>
</runscript>
"""
CONFIG = 'template = "climb.xml"\nplatform = "jsbsim"\nvariables.wind = "//set/@value"\n'


def make(folder: Path, more: str = "", script: str = SCRIPT) -> Path:
    """Write a project of JSBSim."""
    folder.mkdir()
    (folder / "climb.xml").write_text(script)
    (folder / "sierra.toml").write_text(CONFIG + more)
    return folder


def command(root: Path) -> str:
    project = project_file.load(root).config
    return " ".join(base.find("jsbsim", project).command())


def test_it_is_a_platform(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    project = project_file.load(root).config
    platforms.check(Jsbsim, project, several.of_project(project, root), {})


def test_a_run_gets_its_seed_and_the_program_that_simulates_it(tmp_path: Path) -> None:
    made = inputs(make(tmp_path / "p"), "wind=7")
    seeded = f'<run start="0" end="2" dt="0.01"><property value="{SEED}">simulation/randomseed</property>'
    flat = re.sub(r">\s+<", "><", made["input.xml"])
    assert (seeded in flat, '<set name="a/b" value="7"/>' in flat) == (True, True)
    assert made[DRIVER] == (Path(sierra.extensions.simulators.__file__).parent / "drivers" / DRIVER).read_text()


def test_a_seed_that_the_script_has_is_used(tmp_path: Path) -> None:
    seeded = SCRIPT.replace("    <event", '    <property value="42"> simulation/randomseed </property>\n    <event')
    text = inputs(make(tmp_path / "p", script=seeded), "wind=1")["input.xml"]
    assert text == seeded.replace("42", str(SEED))


def test_options_set_the_end_and_the_recorded_properties(tmp_path: Path) -> None:
    options = 'platforms.jsbsim = { end = 90.0, properties = ["velocities/vc-kts"], rate = 5.0, root = "jsb" }\n'
    root = make(tmp_path / "p", options)
    text = inputs(root, "wind=1")["input.xml"]
    added = '<output name="flight.csv" type="CSV" rate="5"><property>velocities/vc-kts</property></output>'
    assert ('end="90"' in text, added in re.sub(r">\s+<", "><", text)) == (True, True)
    assert command(root) == "{python} {run}/jsbsim_driver.py {input} {output} --root {project}/jsb"


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (' end="2"', "", "/runscript/run has no end"),
        ("output", "input", "the script has no output; set properties in [platforms.jsbsim]"),
        ("heights.csv", "/tmp/heights.csv", "would write '/tmp/heights.csv'"),
    ],
)
def test_scripts_that_would_go_wrong_are_refused(tmp_path: Path, before: str, after: str, message: str) -> None:
    with pytest.raises(TemplateError, match=re.escape(message)):
        inputs(make(tmp_path / "p", script=SCRIPT.replace(before, after)), "wind=1")


def test_the_example_needs_at_most_ten_lines(tmp_path: Path) -> None:
    done = projects.quick(tmp_path, "init", "--example", "jsbsim", "demo")
    assert (done.returncode, "next: cd demo && sierra run severity=1,3,5" in done.stdout) == (0, True)
    assert len((tmp_path / "demo" / "sierra.toml").read_text().splitlines()) <= 10
    assert 'severity" value="3"' in inputs(tmp_path / "demo", "severity=3")["input.xml"]
