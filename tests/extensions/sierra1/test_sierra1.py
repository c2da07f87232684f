"""`sierra init --from-sierra1`: projects of SIERRA 1.x, written for these tests, become projects here."""

from __future__ import annotations

import json
import os
import re
import subprocess
import tomllib
from pathlib import Path

import pytest
from lxml import etree

from sierra.config import project_file
from sierra.errors import TemplateError
from sierra.extensions.sierra1 import yaml_values
from tests import projects

TEMPLATE = """<?xml version="1.0"?>
<argos-configuration>
  <framework><system threads="0"/><experiment length="0" ticks_per_second="10" random_seed="1"/></framework>
  <controllers>
    <__CONTROLLER__ id="__CONTROLLER__" library="x">
      <actuators/><sensors><battery implementation="default"/></sensors>
      <params><wheel speed="10"/><nest x="1"/><nest x="2"/></params>
    </__CONTROLLER__>
  </controllers>
  <loop_functions library="x" label="none"><blocks count="3" output_dir="metrics"/></loop_functions>
  <arena size="10,10,2" center="5,5,1">
    <box id="wall_north" size="10,0.1,0.5" movable="false"><body position="5,9.95,0" orientation="0,0,0"/></box>
    <box id="wall_south" size="10,0.1,0.5" movable="false"><body position="5,0.05,0" orientation="0,0,0"/></box>
    <box id="wall_east" size="0.1,10,0.5" movable="false"><body position="9.95,5,0" orientation="0,0,0"/></box>
    <box id="wall_west" size="0.1,10,0.5" movable="false"><body position="0.05,5,0" orientation="0,0,0"/></box>
    <distribute>
      <position method="uniform" min="1,1,0" max="9,9,0"/>
      <entity quantity="1" max_trials="100"><foot-bot id="fb"><controller config="__CONTROLLER__"/></foot-bot></entity>
    </distribute>
  </arena>
  <physics_engines><dynamics2d id="dyn2d"/></physics_engines>
  <visualization><qt-opengl><user_functions label="x"/></qt-opengl></visualization>
</argos-configuration>
"""
CONTROLLERS = """
common: &common
  - LN_food
depth0:
  xml:
    attr_change:
      - ['.//loop_functions', 'label', 'depth0_loop_functions']
      - ['.//qt-opengl/user_functions', 'label', 'depth0_qt']
  controllers:
    - name: CRW
      xml:
        tag_change:
          - ['.//controllers', '__CONTROLLER__', 'crw_controller']
        attr_change:
          - ['.//__CONTROLLER__/params/nest', 'x', '7']
      graphs_inherit:
        - *common
    - name: DPO
      xml:
        element_change:
          - ['.//controllers', '__CONTROLLER__', 'dpo_controller']
          - ['.//params/wheel', 'speed', '5']
        tag_add:
          - ['.//params', 'memory', "{'size': 8, 'unit': '{a}'}"]
          - ['.//params', 'evil', "__import__('os').system('touch HACKED')"]
        attr_change:
          - ['.//sensor', 'x', '1']
    - name: 'bad name'
"""
GRAPHS = """
intra-exp:
  LN_food:
    - src_stem: collected-data
      dest_stem: counts
      cols: [walking, resting]
      title: 'Robots'
      ylabel: '\\# robots'
      type: stacked_line
    - {src_stem: collected-data, dest_stem: map, type: heatmap, z: z}
inter-exp:
  LN_food:
    - {src_stem: collected-data, dest_stem: energy, col: energy, title: Energy, type: summary_line}
    - {src_stem: collected-data, dest_stem: early, col: energy, type: summary_line, index: 3}
    - {src_stem: ../../etc/passwd, dest_stem: out, col: energy, type: summary_line}
imagize:
  - {src_stem: floor, title: Floor, type: heatmap}
inter-controller:
  - {src_stem: food, dest_stem: cc-food}
"""
MAIN = "sierra: {run: {run_metrics_leaf: metrics, library_name: libforaging}}\n"
SCENARIO = """
import sys
open("HACKED", "w").close()
mapping = {'LowBlockCount': 'low', "HighBlockCount": 'high'}
"""
SPEED = """
raise SystemExit("executed")
chgs = [AttrChangeSet(AttrChange(".//wheel", "speed", str(s))) for s in speeds]
"""
SCRIPT = """#!/bin/sh
sierra-cli --project=projects.old --expdef-template=exp/template.argos \\
   --batch-criteria population_size.Log4 --n-runs=2 --physics-n-engines=4 --n-robots=9 \\
   --exp-setup=exp_setup.T60.K5 --controller=depth0.CRW --scenario=LowBlockCount.20x10x2 > log.txt
sierra-cli --project=projects.old --batch-criteria max_speed.1.9.C5 --controller=depth0.XYZ
"""
ARGOS = """#!/usr/bin/env python3
import os, sys
import xml.etree.ElementTree as ET
root = ET.parse(sys.argv[sys.argv.index("-c") + 1]).getroot()
robots = int(next(e for e in root.iter("entity") if e.find("foot-bot") is not None).get("quantity"))
folder = root.find("loop_functions/blocks").get("output_dir")
os.makedirs(folder, exist_ok=True)
with open(folder + "/collected-data.csv", "w") as file:
    print("clock,walking,resting,energy,x", file=file)
    for tick in (10, 20):
        print(tick, robots, 0, -tick, root.find("arena").get("size").split(",")[0], sep=",", file=file)
"""
COPY = """
import json
with open("copy.jsonl", "w") as file:
    print(json.dumps({"input": open(sys.argv[sys.argv.index("-c") + 1]).read()}), file=file)
"""


def old_project(folder: Path, **files: str) -> Path:
    """Write an old project into a folder; `files` replace or add files of `config`, by their names."""
    content = {"controllers": CONTROLLERS, "graphs": GRAPHS, "main": MAIN, **files}
    texts = {f"projects/old/config/{name}.yaml": text for name, text in content.items()}
    texts |= {"projects/old/generators/scenario.py": SCENARIO, "projects/old/variables/max_speed.py": SPEED}
    texts |= {"exp/template.argos": TEMPLATE, "scripts/run.sh": SCRIPT, "projects/old/variables/other.py": "x = 1\n"}
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


@pytest.fixture
def new(tmp_path: Path) -> Path:
    """Return a folder with a converted project."""
    target = tmp_path / "new"
    target.mkdir()
    done = projects.quick(target, "init", "--from-sierra1", str(old_project(tmp_path / "old")))
    assert done.returncode == 0, done.stderr
    return target


def loaded(folder: Path) -> project_file.Project:
    return project_file.load(folder).config


def converted(tmp_path: Path, **files: str) -> list[str]:
    """Return what is not carried over of a project with these files."""
    (target := tmp_path / "new").mkdir()
    done = projects.quick(target, "init", "--from-sierra1", str(old_project(tmp_path / "old", **files)), "--json")
    assert done.returncode == 0, done.stderr
    found: list[str] = json.loads(done.stdout)["left_out"]
    return found


def refused(tmp_path: Path, **files: str) -> str:
    (target := tmp_path / "new").mkdir()
    done = projects.quick(target, "init", "--from-sierra1", str(old_project(tmp_path / "old", **files)))
    assert done.returncode in (2, 3), done.stdout
    assert len(done.stderr.splitlines()) == 1
    assert not list(target.iterdir())
    return done.stderr


@pytest.mark.integration
def test_nothing_of_the_old_project_is_executed(new: Path) -> None:
    assert not list(new.parent.rglob("HACKED"))


def test_controllers_keep_their_category_and_their_changes(new: Path) -> None:
    config = loaded(new)
    assert list(config.controllers) == ["depth0", "depth0.CRW", "depth0.DPO"]
    assert [(c.set, c.attribute, c.value) for c in config.controllers["depth0"].changes] == [
        ("//loop_functions", "library", "libforaging"),
        ("//loop_functions", "label", "depth0_loop_functions"),
    ]
    assert [(c.rename, c.to) for c in config.controllers["depth0.CRW"].changes if c.rename] == [
        ("//controllers/depth0.CRW", "crw_controller")
    ]


def test_the_first_of_several_matches_is_changed_as_before(new: Path) -> None:
    sets = [change.set for change in loaded(new).controllers["depth0.CRW"].changes if change.value == "7"]
    assert sets == ["(//depth0.CRW/params/nest)[1]"]


def test_elements_are_added_with_their_attributes(new: Path) -> None:
    (added,) = [change for change in loaded(new).controllers["depth0.DPO"].changes if change.add]
    assert (added.add, added.xml) == ("//params", '<memory size="8" unit="{{a}}"/>')


def test_scenarios_criteria_and_the_set_up_are_carried_over(new: Path) -> None:
    config = loaded(new)
    assert list(config.scenarios) == ["LowBlockCount.{x}x{y}x{z}", "HighBlockCount.{x}x{y}x{z}"]
    assert config.platforms["argos"] == {
        "origin": "corner",
        "length": 60,
        "ticks_per_second": 5,
        "physics_engines": 4,
        "remove_devices": ("battery",),
    }
    assert [change.set for change in config.variables["max_speed"].changes] == ["//wheel"]
    (query,) = config.queries.values()
    assert (query.criteria, query.runs) == (("population_size.Log4",), 2)
    assert (query.controller, query.scenario) == ("depth0.CRW", "LowBlockCount.20x10x2")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("population_size.Log1000", "population_size.Log512"),
        ("population_size.Linear200", "population_size.Linear200.C20"),
        ("population_size.Linear10.C5", "population_size.Linear10.C5"),
        ("builtin.MonteCarlo.C3", "montecarlo.C3"),
        ("population_constant_density.5p0.I16.C4", "population_constant_density.5p0.I16.C4"),
    ],
)
def test_criteria_keep_their_values(tmp_path: Path, old: str, new: str) -> None:
    folder = old_project(tmp_path / "old")
    (folder / "scripts/run.sh").write_text(f"sierra-cli --batch-criteria {old}\n")
    (tmp_path / "new").mkdir()
    assert projects.quick(tmp_path / "new", "init", "--from-sierra1", str(folder)).returncode == 0
    (query,) = loaded(tmp_path / "new").queries.values()
    assert query.criteria == (new,)


def test_graphs_become_figures_of_outputs(new: Path) -> None:
    config = loaded(new)
    assert {name: output.file for name, output in config.outputs.items()} == {"collected_data": "metrics/collected-data.csv"}
    assert {name: (figure.kind, figure.columns, figure.title) for name, figure in config.figures.items()} == {
        "collected_data_walking": ("timeseries", ("walking",), "Robots"),
        "collected_data_resting": ("timeseries", ("resting",), "Robots"),
        "collected_data_energy_summary": ("summary", ("energy",), "Energy"),
    }
    assert config.figures["collected_data_walking"].ylabel == "# robots"


def test_what_is_not_carried_over_is_listed_in_the_terminal_and_in_the_file(tmp_path: Path) -> None:
    left_out = converted(tmp_path, models="a: 1\n")
    text = (tmp_path / "new" / "sierra.toml").read_text()
    assert [line.removeprefix("# - ") for line in text.partition("# Not carried over:\n")[2].splitlines()] == left_out
    for expected in (
        "depth0: attr_change ['.//qt-opengl/user_functions', 'label', 'depth0_qt']: another change removes this part",
        "depth0.DPO: element_change ['.//params/wheel', 'speed', '5']: 'speed' is an attribute, not a tag",
        "depth0.DPO: attr_change ['.//sensor', 'x', '1']: it matches nothing",
        "'evil', \"__import__('os').system('touch HACKED')\"]: its attributes are not a plain list",
        "bad name",
        "graphs.yaml: intra-exp: LN_food: map: no figure of the type 'heatmap'",
        "graphs.yaml: inter-exp: LN_food: early: index 3",
        "LN_food: out: '../../etc/passwd' cannot be the name of a file",
        "graphs.yaml: imagize: floor",
        "graphs.yaml: inter-controller: cc-food: compare controllers by a query",
        "models.yaml: models are Python",
        "scenario LowBlockCount: it sets the arena; what else",
        "variables/other.py",
        "run.sh: --n-robots: is not carried over",
        "run.sh: --controller depth0.XYZ: controllers.yaml has no such controller",
    ):
        assert len([line for line in left_out if expected in line]) == 1, (expected, left_out)


def with_program(folder: Path) -> Path:
    """Give a converted project a program in place of ARGoS, which records its input."""
    (folder / "program.py").write_text(ARGOS + COPY)
    text = (folder / "sierra.toml").read_text()
    command = 'platform = "argos"\ncommand = "{python} {project}/program.py -c {input}"'
    text = text.replace('platform = "argos"', command) + '\n[outputs.copy]\nfile = "copy.jsonl"\n'
    (folder / "sierra.toml").write_text(text)
    return folder


@pytest.mark.integration
@pytest.mark.parametrize("controller", ["depth0.CRW", "depth0.DPO"])
def test_every_controller_and_scenario_can_be_expanded(new: Path, controller: str) -> None:
    words = ("population_size.Log4", "max_speed.1.9.C5", "--controller", controller, "--scenario", "HighBlockCount.20x10x2")
    done = projects.quick(with_program(new), "run", *words, "-n")
    assert done.returncode == 0, done.stderr


@pytest.mark.integration
def test_a_converted_project_runs_with_a_program_called_argos3(new: Path, tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "argos3").write_text(ARGOS)
    (tmp_path / "bin" / "argos3").chmod(0o755)
    path = {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    done = projects.sierra(new, "run", "population_size_Log4", environment=path)
    assert done.returncode == 0, done.stderr + done.stdout
    rows = projects.sql(new, "SELECT population_size, walking, x, clock FROM collected_data WHERE clock = 20 ORDER BY ALL")
    assert [(row["population_size"], row["walking"], row["x"]) for row in rows] == [
        (n, n, 20) for n in (1, 2, 4) for _ in (0, 1)
    ]
    (batch,) = projects.sql(new, "SELECT batch, controller, scenario FROM batches")
    assert (batch["controller"], batch["scenario"]) == ("depth0.CRW", "LowBlockCount.20x10x2")
    drawn = projects.quick(new, "figures", batch["batch"])
    assert drawn.returncode == 0, drawn.stderr
    assert "collected_data_energy_summary" in drawn.stdout


def arena_of_input(new: Path, *words: str) -> dict[str, str]:
    """Return the arena of the last input of a query, which is only generated."""
    done = projects.quick(with_program(new), "inputs", *words, "--runs", "1", "--to", str(new.parent / "made"))
    assert done.returncode == 0, done.stderr
    made = etree.parse(sorted(new.parent.glob("made/runs/*/*/input.argos"))[-1])
    places = {str(box.get("id")): f"{box.get('size')} {box.find('body').get('position')}" for box in made.iter("box")}
    arena, position = made.find("arena"), made.find("arena/distribute/position")
    return {"arena": f"{arena.get('size')} {arena.get('center')}", **position.attrib, **places}


def test_a_scenario_has_the_walls_and_the_start_area_of_the_old_program(new: Path) -> None:
    assert arena_of_input(new, "population_size=1", "--scenario", "LowBlockCount.20x10x2") == {
        "arena": "20,10,2 10,5,1",
        "method": "uniform",
        "min": "0.88,0.88,0",
        "max": "19.12,9.12,0",
        "wall_north": "20,0.4,0.5 10,10,0",
        "wall_south": "20,0.4,0.5 10,0,0",
        "wall_east": "0.4,10.4,0.5 19.8,5,0",
        "wall_west": "0.4,10.4,0.5 0,5,0",
    }


@pytest.mark.integration
def test_a_density_keeps_the_converted_walls(new: Path) -> None:
    words = ("population_constant_density.5p0.I10.C2", "--scenario", "LowBlockCount.20x10x2")
    made = arena_of_input(new, *words)
    assert (made["arena"], made["wall_east"], made["wall_north"]) == (
        "30,20,2 15,10,1",
        "0.4,20,0.5 29.8,10,0",
        "30,0.4,0.5 15,19.8,0",
    )


def test_walls_of_other_names_follow_the_arena_and_the_difference_is_listed(tmp_path: Path) -> None:
    old = old_project(tmp_path / "old")
    (old / "exp/template.argos").write_text(TEMPLATE.replace("wall_east", "wall_e"))
    (tmp_path / "new").mkdir()
    done = projects.quick(tmp_path / "new", "init", "--from-sierra1", str(old), "--json")
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in json.loads(done.stdout)["left_out"] if line.startswith("scenarios: ")]
    assert "start area 0.88 m inside the arena, walls of 0.4 m" in line
    assert all(len(group.changes) == 1 for group in loaded(tmp_path / "new").scenarios.values())


@pytest.mark.parametrize(
    ("script", "name"),
    [(SCRIPT, "libprojects.old"), ("sierra-cli --project=mine.old\n", "libmine.old"), ("", "libprojects.old")],
)
def test_the_library_is_named_after_the_project_if_main_yaml_does_not_name_it(tmp_path: Path, script: str, name: str) -> None:
    old = old_project(tmp_path / "old", main="sierra: {run: {run_metrics_leaf: metrics}}\n")
    (old / "scripts/run.sh").write_text(script)
    (tmp_path / "new").mkdir()
    assert projects.quick(tmp_path / "new", "init", "--from-sierra1", str(old)).returncode == 0
    groups = loaded(tmp_path / "new").controllers
    libraries = [(c.set, c.value) for group in groups.values() for c in group.changes if c.attribute == "library"]
    assert libraries == [
        ("//loop_functions", name), ("//depth0.CRW", name), ("//depth0.DPO", name)
    ]  # fmt: skip


@pytest.mark.integration
def test_the_input_is_what_the_old_project_meant(new: Path) -> None:
    projects.run(with_program(new), "population_size=3", "--scenario", "LowBlockCount.20x10x2", "--runs", "1")
    (row,) = projects.sql(new, "SELECT input FROM copy")
    made = etree.fromstring(row["input"].encode())
    assert made.xpath("string(//controllers/crw_controller/@id)") == "depth0.CRW"
    assert made.xpath("string(//foot-bot/controller/@config)") == "depth0.CRW"
    assert made.xpath("string(//crw_controller/params/nest[1]/@x)") == "7"
    assert made.xpath("string(//arena/@size)") == "20,10,2"
    assert made.xpath("string(//arena/@center)") == "10,5,1"
    assert made.xpath("string(//box[@id='wall_east']/body/@position)") == "19.8,5,0"
    assert made.xpath("string(//experiment/@length)") == "60"
    assert made.xpath("string(//entity/@quantity)") == "3"


def test_graphs_of_older_versions_are_read(tmp_path: Path) -> None:
    old = old_project(tmp_path / "old")
    (old / "projects/old/config/graphs.yaml").unlink()
    (old / "projects/old/config/inter-graphs-line.yaml").write_text(
        "LN_food:\n  graphs:\n    - {src_stem: collected-data, dest_stem: e, col: energy, title: E, summary: True}\n"
        "    - {src_stem: collected-data, dest_stem: w, col: walking, title: W}\n"
    )
    (tmp_path / "new").mkdir()
    assert projects.quick(tmp_path / "new", "init", "--from-sierra1", str(old)).returncode == 0
    kinds = {name: figure.kind for name, figure in loaded(tmp_path / "new").figures.items()}
    assert kinds == {"collected_data_energy_summary": "summary", "collected_data_walking": "timeseries"}


def test_options_that_do_not_fit_the_template_are_listed(tmp_path: Path) -> None:
    old = old_project(tmp_path / "old")
    bounded = '<dynamics2d id="a"><boundaries><top height="1"/></boundaries></dynamics2d>'
    (old / "exp/template.argos").write_text(TEMPLATE.replace('<dynamics2d id="dyn2d"/>', bounded))
    (tmp_path / "new").mkdir()
    done = projects.quick(tmp_path / "new", "init", "--from-sierra1", str(old), "--json")
    assert done.returncode == 0, done.stderr
    left_out = json.loads(done.stdout)["left_out"]
    assert [line for line in left_out if line.startswith('platforms.argos: origin = "corner": ')]
    assert [line for line in left_out if line.startswith("platforms.argos: physics_engines = 4: ")]
    assert set(loaded(tmp_path / "new").platforms["argos"]) == {"length", "ticks_per_second", "remove_devices"}


def test_an_existing_project_is_never_overwritten(new: Path, tmp_path: Path) -> None:
    before = (new / "sierra.toml").read_bytes()
    done = projects.quick(new, "init", "--from-sierra1", str(tmp_path / "old"))
    assert done.returncode == 2
    assert "exists already and is never overwritten" in done.stderr
    assert (new / "sierra.toml").read_bytes() == before


def test_an_existing_template_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "template.argos").write_text("mine")
    done = projects.quick(tmp_path / "new", "init", "--from-sierra1", str(old_project(tmp_path / "old")))
    assert done.returncode == 2
    assert "template.argos exists already" in done.stderr
    assert (tmp_path / "new" / "template.argos").read_text() == "mine"


def test_a_template_in_the_new_project_is_used_in_its_place(tmp_path: Path) -> None:
    folder = old_project(tmp_path / "both")
    done = projects.quick(folder, "init", "--from-sierra1", ".", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["template"] == "exp/template.argos"
    assert not (folder / "template.argos").exists()


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}, *a{n - 1}, *a{n - 1}]\n" for n in range(1, 30))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BOMB, "aliases expand it to more than"),
        ("a: &a [*a]\n", "within its own anchor"),
        ("[" * 100_000, "levels of lists and mappings"),
        ("a: 1\na: 2\n", "the key 'a' occurs twice"),
        ("a: 1\n---\nb: 2\n", "2 documents; use one"),
        ("{[1, 2]: 3}\n", "a key is not a single value"),
        ("a: [1\n", "not YAML"),
        ("x" * 1_000_001, "too large for settings"),
    ],
)
def test_hostile_yaml_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    assert said in refused(tmp_path, controllers=text)


def test_tags_of_yaml_construct_nothing(tmp_path: Path) -> None:
    found = yaml_values.values(b"a: !!python/object/apply:os.system ['touch HACKED']\n", "x.yaml")
    assert found == {"a": ["touch HACKED"]}


def test_yaml_that_is_not_text_is_refused() -> None:
    with pytest.raises(TemplateError, match="not YAML"):
        yaml_values.values(b"\xff\xfe\x00", "x.yaml")


def test_merge_keys_are_merged() -> None:
    found = yaml_values.values(b"a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\n", "x.yaml")
    assert found == {"a": {"x": "1", "y": "2"}, "b": {"x": "1", "y": "3"}}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "just text",
        "[1, 2]",
        "depth0: [a]",
        "depth0: {controllers: x}",
        "depth0: {controllers: [{name: [1]}, 3, {}]}",
        "depth0: {xml: {attr_change: x, strange: []}, controllers: [{name: A, xml: {attr_change: [[1], [a, b, c, d], 'x']}}]}",
        "depth0: {controllers: [{name: A, xml: {attr_change: [['//[', 'a', 'b'], ['.//x', '1 2', 'b']]}}]}",
        'depth0: {controllers: [{name: A, xml: {tag_change: [[".//params", "wheel", "1 <x>"]]}}]}',
        'depth0: {controllers: [{name: "A\\"]\\nx = 1"}, {name: "\\u0000"}, {name: "A{x}"}]}',
        'depth0: {controllers: [{name: A, xml: {attr_change: [[".//wheel", "speed", "\\u0007\\n{seed}\\"\\u2028"]]}}]}',
    ],
)
def test_doubtful_files_are_converted_or_refused_but_load(tmp_path: Path, text: str) -> None:
    (target := tmp_path / "new").mkdir()
    done = projects.quick(target, "init", "--from-sierra1", str(old_project(tmp_path / "old", controllers=text)))
    if done.returncode == 0:
        assert set(tomllib.loads((target / "sierra.toml").read_text())) <= {*project_file.Project.model_fields}
        assert loaded(target).platform == "argos"
        assert not re.search("[\x00-\x09\x0b-\x1f]", done.stdout)
    else:
        assert done.returncode in (2, 3)
        assert len(done.stderr.splitlines()) == 1


def test_a_folder_without_an_old_project_is_refused(tmp_path: Path) -> None:
    done = projects.quick(tmp_path, "init", "--from-sierra1", ".")
    assert done.returncode == 3
    assert "there is no config/*.yaml" in done.stderr


def test_several_old_projects_are_named(tmp_path: Path) -> None:
    old = old_project(tmp_path / "old")
    (old / "projects/b/config").mkdir(parents=True)
    (old / "projects/b/config/main.yaml").write_text("a: 1\n")
    (tmp_path / "new").mkdir()
    done = projects.quick(tmp_path / "new", "init", "--from-sierra1", str(old))
    assert done.returncode == 2
    assert "has several projects" in done.stderr


def test_links_out_of_the_old_project_are_not_followed(tmp_path: Path) -> None:
    old = old_project(tmp_path / "old")
    (tmp_path / "secret.yaml").write_text("depth1: {controllers: [{name: SECRET}]}\n")
    (old / "projects/old/config/controllers.yaml").unlink()
    (old / "projects/old/config/controllers.yaml").symlink_to(tmp_path / "secret.yaml")
    (tmp_path / "new").mkdir()
    done: subprocess.CompletedProcess[str] = projects.quick(tmp_path / "new", "init", "--from-sierra1", str(old))
    assert "SECRET" not in done.stdout + done.stderr


@pytest.mark.parametrize("name", ["../secret.argos", "{folder}/secret.argos", "exp/link.argos"])
def test_a_template_outside_the_old_project_is_not_copied_unless_the_user_names_it(tmp_path: Path, name: str) -> None:
    old = old_project(tmp_path / "old")
    (tmp_path / "secret.argos").write_text(TEMPLATE.replace('label="none"', 'label="SECRET"'))
    (old / "exp/link.argos").symlink_to(tmp_path / "secret.argos")
    (old / "scripts/run.sh").write_text(f"sierra-cli --expdef-template={name.format(folder=tmp_path)}\n")
    (tmp_path / "new").mkdir()
    done = projects.quick(tmp_path / "new", "init", "--from-sierra1", str(old))
    assert done.returncode == 0, done.stderr
    assert "SECRET" not in (tmp_path / "new" / "template.argos").read_text()
    (tmp_path / "other").mkdir()
    done = projects.quick(tmp_path / "other", "init", "--from-sierra1", str(old), "--template", str(tmp_path / "secret.argos"))
    assert done.returncode == 0, done.stderr
    assert "SECRET" in (tmp_path / "other" / "secret.argos").read_text()


def test_other_options_of_init_are_refused(tmp_path: Path) -> None:
    done = projects.quick(tmp_path, "init", "--from-sierra1", ".", "--command", "x")
    assert done.returncode == 2
    assert "--from-sierra1 can be combined only with" in done.stderr
