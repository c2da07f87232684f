"""The platform `sumo`: the inputs that it generates; SUMO itself is not needed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sierra.config import plugin_registry, project_file
from sierra.design.query import grammar
from sierra.errors import ConfigError, QueryError, TemplateError
from sierra.extensions.simulators.sumo import Sumo
from sierra.templates import several
from sierra.testing import platforms
from tests import projects
from tests.projects import quick
from tests.simulator_inputs import SEED, inputs
from tests.unit.setup.test_init_files import settings

CONFIGURATION = """\
<configuration>
  <input><net-file value="city.net.xml"/><route-files value="city.rou.xml"/></input>
  <time><begin value="0"/><end value="3600"/></time>
  <output><queue-output value="queue.xml"/></output>
</configuration>
"""
ROUTES = """\
<routes>
  <route id="ring" edges="a b"/>
  <flow id="cars" route="ring" begin="0" end="60" number="4"/>
  <flow id="lorries" route="ring" begin="0" end="60" vehsPerHour="100"/>
</routes>
"""
CONFIG = """\
templates = { config = "sim/city.sumocfg", routes = "sim/city.rou.xml" }
files = ["sim/*.net.xml"]
platform = "sumo"
command = "true {input.config}"
runs = 2
platforms.sumo = { flow = "cars" }
"""


def make(folder: Path, config: str = CONFIG, configuration: str = CONFIGURATION, routes: str = ROUTES) -> Path:
    """Write a project of SUMO."""
    (folder / "sim").mkdir(parents=True)
    (folder / "sim" / "city.sumocfg").write_text(configuration)
    (folder / "sim" / "city.rou.xml").write_text(routes)
    (folder / "sim" / "city.net.xml").write_text("<net/>\n")
    (folder / "sierra.toml").write_text(config)
    return folder


def test_it_is_a_platform(tmp_path: Path) -> None:
    routes = '<routes><flow id="both" number="1" vehsPerHour="1"/></routes>'
    root = make(tmp_path / "p", CONFIG.replace("cars", "both"), routes=routes)
    project = project_file.load(root).config
    template = several.of_project(project, root)
    words = ("population_size.Log8", "vehicles_per_hour=100,200", "scale=0.5,1")
    platforms.check(Sumo, project, template, {one.name: one for one in grammar.parse_all(words)})


def test_faults_of_sierra_are_not_attributed_to_a_platform_that_it_ships() -> None:
    plugin_registry.PLATFORMS.load("sumo")
    with pytest.raises(ConfigError) as raised:
        project_file.parse({"platfrom": "sumo"}, "sierra.toml")
    assert plugin_registry.culprit(raised.value) is None


def test_a_run_gets_its_seed_and_its_outputs_beside_what_the_configuration_says(tmp_path: Path) -> None:
    made = inputs(make(tmp_path / "p"), "scale=0.5")
    assert set(made) == {"sim/city.sumocfg", "sim/city.rou.xml"}
    assert made["sim/city.rou.xml"] == ROUTES
    text = made["sim/city.sumocfg"]
    assert f'<seed value="{SEED}"/>' in text
    assert '<queue-output value="../output/queue.xml"/>' in text
    assert '<summary-output value="../output/summary.xml"/>' in text
    assert '<tripinfo-output value="../output/tripinfo.xml"/>' in text
    assert '<scale value="0.5"/>' in text


def test_options_set_the_end_and_the_outputs(tmp_path: Path) -> None:
    options = CONFIG.replace('{ flow = "cars" }', '{ end = 60.0, step_length = 0.5, outputs = ["summary"] }')
    text = inputs(make(tmp_path / "p", options), "scale=1")["sim/city.sumocfg"]
    assert ('<end value="60"/>' in text, '<step-length value="0.5"/>' in text, "tripinfo" in text) == (True, True, False)


def test_an_output_that_the_configuration_names_by_its_short_name_is_not_named_twice(tmp_path: Path) -> None:
    short = CONFIGURATION.replace("</output>", '<summary value="../output/s.xml"/></output>')
    assert "summary-output" not in inputs(make(tmp_path / "p", configuration=short), "scale=1")["sim/city.sumocfg"]


@pytest.mark.parametrize(
    ("query", "flow", "wanted"),
    [
        ("population_size=9", "cars", '<flow id="cars" route="ring" begin="0" end="60" number="9"/>'),
        ("vehicles_per_hour=250", "lorries", '<flow id="lorries" route="ring" begin="0" end="60" vehsPerHour="250"/>'),
    ],
)
def test_criteria_set_the_chosen_flow(tmp_path: Path, query: str, flow: str, wanted: str) -> None:
    made = inputs(make(tmp_path / "p", CONFIG.replace("cars", flow)), query)
    before = next(line for line in ROUTES.splitlines() if f'"{flow}"' in line)
    assert made["sim/city.rou.xml"] == ROUTES.replace(before.strip(), wanted)


@pytest.mark.parametrize(
    ("query", "config", "message"),
    [
        ("population_size=2", CONFIG.replace('{ flow = "cars" }', "{}"), "2 flows are selected; set flow in [platforms.sumo]"),
        ("vehicles_per_hour=2", CONFIG, "the flow has no vehsPerHour"),
        ("population_size=0.5", CONFIG, "0.5 is not a whole number of 0 or more"),
        ("scale=-1,1", CONFIG, "-1 is not a number of 0 or more"),
    ],
)
def test_criteria_that_do_not_fit_are_refused(tmp_path: Path, query: str, config: str, message: str) -> None:
    with pytest.raises(QueryError, match=re.escape(message)):
        inputs(make(tmp_path / "p", config), query)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('"city.net.xml"', '"../roads.xml"', "add 'roads.xml' to files or templates"),
        ("<time>", '<time><random value="true"/>', "the option random of SUMO makes each execution different"),
        ('"queue.xml"', '"logs/queue.xml"', "outside of the run's output folder"),
        ('"queue.xml"', '"/tmp/queue.xml"', "outside of the run's output folder"),
        ("configuration>", "sumoConfiguration>", "/configuration matches nothing"),
    ],
)
def test_configurations_that_would_go_wrong_are_refused(tmp_path: Path, before: str, after: str, message: str) -> None:
    with pytest.raises(TemplateError, match=re.escape(message)):
        inputs(make(tmp_path / "p", configuration=CONFIGURATION.replace(before, after)), "montecarlo.C1")


def test_one_template_with_files_beside_it_needs_no_names(tmp_path: Path) -> None:
    config = 'template = "sim/city.sumocfg"\nfiles = ["sim/city.*.xml"]\nplatform = "sumo"\ncommand = "true {input}"\n'
    root = make(tmp_path / "p", config)
    assert '"../output/summary.xml"' in inputs(root, "scale=2")["input.sumocfg"]
    with pytest.raises(QueryError, match="population_size needs the routes as a template"):
        inputs(root, "population_size=2")


def test_the_example_needs_at_most_ten_lines(tmp_path: Path) -> None:
    done = projects.quick(tmp_path, "init", "--example", "sumo", "demo")
    assert (done.returncode, "next: cd demo && sierra run vehicles_per_hour=" in done.stdout) == (0, True)
    assert len((tmp_path / "demo" / "sierra.toml").read_text().splitlines()) <= 10
    assert "merge.sumocfg" in inputs(tmp_path / "demo", "vehicles_per_hour=50")


def test_a_configuration_of_sumo_selects_its_platform(tmp_path: Path) -> None:
    assert quick(tmp_path, "init", "--example", "sumo", "demo").returncode == 0
    folder = tmp_path / "demo"
    (folder / "sierra.toml").unlink()
    done = quick(folder, "init", "-y", "--no-try")
    assert done.returncode == 0, done.stderr
    found = settings(folder)
    assert found["templates"] == {"sumocfg": "merge.sumocfg", "rou": "merge.rou.xml"}
    assert (found["files"], found["platform"]) == (["merge.net.xml"], "sumo")
    assert "command" not in found
    assert "next: sierra run scale=0.5,1,2 -n" in done.stdout
