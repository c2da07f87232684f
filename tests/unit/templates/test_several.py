"""Several templates: selectors with names, and files that find each other in the folder of a run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.projects import quick, run, sql

SIMULATOR = """\
import json, pathlib, sys

world = pathlib.Path(sys.argv[1])
text = world.read_text()
included = text.split('include file="')[1].split('"')[0]
params = json.loads((world.parent / included).read_text())
with open("out.csv", "w") as file:
    print("tick,count,speed,seed", file=file)
    count = text.split('count="')[1].split('"')[0]
    print(0, count, params["speed"], params["seed"], sep=",", file=file)
"""
WORLD = '<world xmlns:gz="http://g"><swarm count="1"/><include file="../config/params.json"/></world>\n'
PARAMS = '{"speed": 0.5, "seed": 0, "count": 1}\n'
CONFIG = """\
templates = { world = "sim/world.sdf", params = "config/params.json" }
command = "python3 sim.py {input.world}"
runs = 1
seed = "params:/seed"
[variables]
max_speed = "params:/speed"
population_size = { set = "world://swarm/@count", changes = [{ set = "params:/count" , value = "{population_size * 2}" }] }
"""


def make(folder: Path, config: str = CONFIG) -> Path:
    (folder / "sim").mkdir(parents=True)
    (folder / "config").mkdir()
    (folder / "sim.py").write_text(SIMULATOR)
    (folder / "sim" / "world.sdf").write_text(WORLD)
    (folder / "config" / "params.json").write_text(PARAMS)
    (folder / "sierra.toml").write_text(config)
    return folder


@pytest.mark.integration
def test_templates_that_name_each_other_are_changed_together(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    summary, noted = run(root, "population_size=3,4", "max_speed=0.25")
    assert noted == ""
    rows = sql(root, "SELECT o.count, o.speed, o.seed = r.seed AS same, o.run FROM out o JOIN runs r USING (run) ORDER BY 1")
    assert [(row["count"], row["speed"], row["same"]) for row in rows] == [(3, 0.25, True), (4, 0.25, True)]
    done = quick(root, "files", str(rows[1]["run"]), "input/config/params.json")
    assert json.loads(done.stdout)["count"] == 8
    assert quick(root, "fsck").returncode == 0
    (root / "config" / "params.json").write_text("{}")
    done = quick(root, "replay", summary["batch"])
    assert "2 identical" in done.stdout, done.stderr


@pytest.mark.nightly
def test_one_named_template_needs_no_prefix_and_is_input(tmp_path: Path) -> None:
    root = make(tmp_path / "p", 'templates = { only = "config/params.json" }\ncommand = "python3 sim.py {input}"\nruns = 1\n'
                'seed = "/seed"\n[variables]\nmax_speed = "only:/speed"\n')  # fmt: skip
    (root / "sim.py").write_text("import sys\nopen('out.csv', 'w').write('tick,path\\n0,' + sys.argv[1] + '\\n')\n")
    run(root, "max_speed=1")
    assert str(sql(root, "SELECT path FROM out")[0]["path"]).endswith("/config/params.json")


@pytest.mark.integration
def test_the_names_of_templates_are_part_of_the_identity(tmp_path: Path) -> None:
    root = make(tmp_path / "p", CONFIG.replace("{input.world}", "{run}/sim/world.sdf"))
    run(root, "population_size=1", "max_speed=1")
    (root / "config" / "params.json").rename(root / "config" / "other.json")
    (root / "sim" / "world.sdf").write_text(WORLD.replace("params.json", "other.json"))
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text().replace("config/params", "config/other"))
    assert run(root, "population_size=1", "max_speed=1")[0]["executed"] == 1
    assert quick(root, "fsck").returncode == 0


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"params:/speed"', '"/speed"', "'/speed' does not say which template it is for; begin it with one of world:, params:"),
        ('"params:/speed"', '"param:/speed"', "'param:/speed' names no template; known are world:, params:"),
        ('"params:/speed"', '"world:/speed"', "/speed matches nothing in"),
        ("{input.world}", "{input}", "{input} in '{input}': there are several templates; use {input.world}, {input.params}"),
        (
            "{input.world}",
            "{input.map}",
            "{input.map} in '{input.map}' is no template; known are {input.world}, {input.params}",
        ),
        ('"config/params.json"', '"./sim/world.sdf"', "templates: world and params are the same file"),
        ('"config/params.json"', '"../p.json"', "should be a path within the project"),
        ('"config/params.json"', '"/p.json"', "should be a path within the project"),
        ('"config/params.json"', '"config/none.json"', "config/none.json: No such file or directory"),
        ('"config/params.json"', '"config/link.json"', "templates.params: config/link.json is a link, or in one"),
        (
            '"config/params.json"',
            '"output/p.json"',
            "the folder of a run has its own 'output'; move the file to another folder",
        ),
        ("{ world = ", "{ gz = ", "templates.gz: gz: is also a prefix of names in sim/world.sdf; use another name"),
        ("templates = ", 'template = "sim/world.sdf"\ntemplates = ', '"template" and "templates" exclude each other'),
    ],
)
def test_a_mistake_is_one_line(tmp_path: Path, old: str, new: str, told: str) -> None:
    assert old in CONFIG
    root = make(tmp_path / "p", CONFIG.replace(old, new, 1))
    (root / "config" / "link.json").symlink_to("params.json")
    (root / "output").mkdir()
    (root / "output" / "p.json").write_text(PARAMS)
    done = quick(root, "run", "population_size=1", "max_speed=1", "--dry-run")
    assert done.returncode in (2, 3), done.stdout
    assert done.stderr.count("\n") == 1, done.stderr
    assert told in done.stderr


def test_options_of_formats_have_a_new_name(tmp_path: Path) -> None:
    config = 'template = "a.txt"\ncommand = "cat {input}"\n[templates.text]\nplaceholder = "<<name>>"\n'
    root = make(tmp_path / "p", config)
    done = quick(root, "run", "x=1", "--dry-run")
    assert "templates: the options of formats have another name now: [template_formats.text]" in done.stderr
    assert done.returncode == 2
