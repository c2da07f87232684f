"""The platform `mujoco`: the inputs and commands that it makes; MuJoCo itself is not needed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import sierra.extensions.simulators
from sierra.config import project_file
from sierra.design.platforms import base
from sierra.design.platforms.base import Rendering, Renders
from sierra.design.query import grammar
from sierra.errors import ConfigError, QueryError, TemplateError
from sierra.extensions.simulators.mujoco import DRIVER, Mujoco
from sierra.templates import several
from sierra.templates.xml import XmlTemplate
from sierra.testing import platforms
from tests import projects
from tests.simulator_inputs import inputs

MODEL = '<mujoco>\n  <worldbody>\n    <replicate count="4"><body name="r"/></replicate>\n  </worldbody>\n</mujoco>\n'
CONFIG = 'template = "sim/crowd.xml"\nplatform = "mujoco"\n'


def make(folder: Path, more: str = "", model: str = MODEL) -> Path:
    """Write a project of MuJoCo."""
    (folder / "sim").mkdir(parents=True)
    (folder / "sim" / "crowd.xml").write_text(model)
    (folder / "sim" / "ball.stl").write_text("")
    (folder / "sierra.toml").write_text(CONFIG + more)
    return folder


def command(root: Path) -> str:
    project = project_file.load(root).config
    return " ".join(base.find("mujoco", project).command())


def test_it_is_a_platform(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    project = project_file.load(root).config
    [criterion] = grammar.parse_all(("population_size.Log8",))
    platforms.check(Mujoco, project, several.of_project(project, root), {"population_size": criterion})


def test_a_run_gets_its_model_and_the_program_that_simulates_it(tmp_path: Path) -> None:
    made = inputs(make(tmp_path / "p"), "population_size=9")
    assert made["input.xml"] == MODEL.replace('count="4"', 'count="9"')
    assert made[DRIVER] == (Path(sierra.extensions.simulators.__file__).parent / "drivers" / DRIVER).read_text()


def test_options_are_arguments_of_the_program(tmp_path: Path) -> None:
    assert command(make(tmp_path / "a")) == (
        "{python} {run}/mujoco_driver.py {input} {output} --seed {seed} --duration 10.0 --interval 0.1 "
        "--position-noise 0.0 --control-noise 0.0 --sensors *"
    )
    options = 'platforms.mujoco = { bodies = ["r*"], sensors = [], keyframe = "home", control = "walk.py" }\n'
    words = command(make(tmp_path / "b", options))
    assert words.endswith(" --bodies r* --keyframe home --control {project}/walk.py")


def test_the_program_lies_beside_the_model_if_there_are_files(tmp_path: Path) -> None:
    words = command(make(tmp_path / "p", 'files = ["sim/*.stl"]\ncommand = "/opt/env/bin/python"\n'))
    assert words.startswith("/opt/env/bin/python {run}/sim/mujoco_driver.py {input} ")


@pytest.mark.parametrize(
    ("query", "more", "message"),
    [
        ("population_size=0,1", "", "0 is not a whole number of 1 or more"),
        ("population_size=1", 'platforms.mujoco = { population = "//body/@count" }\n', "//body/@count selects 0 attributes"),
    ],
)
def test_populations_that_do_not_fit_are_refused(tmp_path: Path, query: str, more: str, message: str) -> None:
    with pytest.raises(QueryError, match=re.escape(message)):
        inputs(make(tmp_path / "p", more), query)


def rendering(root: Path) -> Rendering:
    project = project_file.load(root).config
    made = base.find("mujoco", project)
    assert isinstance(made, Renders)
    return made.rendering(project.capture, made.command())


def test_captures_use_the_intervals_of_the_recorded_command(tmp_path: Path) -> None:
    more = 'platforms.mujoco = { interval = 0.2 }\ncapture = { camera = "top", interval = 0.6, size = [320, 240] }\n'
    made = rendering(make(tmp_path / "p", more))
    assert " ".join(made.command).endswith(" --frames {output}/frames --size 320 240 --every 3 --camera top")
    assert (made.files, made.ticks_per_second(XmlTemplate(b"<a/>", "a"))) == ("frames/{tick}.png", 5)
    assert [name for name, _ in made.replaced] == [DRIVER]


def test_a_capture_between_two_rows_is_refused(tmp_path: Path) -> None:
    message = "[capture] interval: 0.25 s is not a multiple of the 0.1 s between two rows of the outputs"
    with pytest.raises(ConfigError, match=re.escape(message)):
        rendering(make(tmp_path / "p", "capture = { interval = 0.25 }\n"))


def test_a_file_that_is_no_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TemplateError, match="the root of a model of MuJoCo must be mujoco"):
        inputs(make(tmp_path / "p", model="<robot/>"), "montecarlo.C1")


def test_several_templates_are_refused(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    (root / "sierra.toml").write_text('templates = { a = "sim/crowd.xml" }\nplatform = "mujoco"\n')
    with pytest.raises(ConfigError, match='platform "mujoco" needs one template'):
        inputs(root, "population_size=1")


def test_the_example_needs_at_most_ten_lines(tmp_path: Path) -> None:
    done = projects.quick(tmp_path, "init", "--example", "mujoco", "demo")
    assert (done.returncode, "next: cd demo && sierra run population_size.Log8" in done.stdout) == (0, True)
    assert len((tmp_path / "demo" / "sierra.toml").read_text().splitlines()) <= 10
    assert '<replicate count="1"' in inputs(tmp_path / "demo", "population_size.Log8")["input.xml"]
