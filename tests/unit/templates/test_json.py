"""JSON templates."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.model import Add, Remove, Rename
from tests import projects
from tests.trees import JSON, make, rendered


def test_changes_of_json_keep_its_layout() -> None:
    template = make("json", JSON)
    added = rendered(template, Add("/robots", '{"name": "r3", "x": "{n + 1}"}'), Add("/", '{"k": [true]}'), n=2)
    assert added == JSON.replace('"x": 2}\n', '"x": 2},\n    {"name": "r3", "x": 3}\n').replace("[]\n}", '[], "k": [true]\n}')
    assert rendered(template, Remove("/robots/item[1]")) == JSON.replace('{"name": "r1", "x": 1},\n    ', "")
    assert rendered(template, Remove("/robots/item[2]")) == JSON.replace(',\n    {"name": "r2", "x": 2}', "")
    assert rendered(template, Remove("//x"), Remove("//swarm")) == JSON.replace(', "x": 1', "").replace(', "x": 2', "").replace(
        JSON.splitlines()[1].strip() + "\n  ", ""
    )
    assert rendered(template, Rename("//name", "label")) == JSON.replace('"name"', '"label"')
    assert rendered(template, Add("/robots", "0", at=0)) == JSON.replace('{"name": "r1"', '0,\n    {"name": "r1"')


SIMULATOR = """\
import json, sys
world = json.load(open(sys.argv[1]))
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    print(0, world["swarm"]["count"] * world["swarm"]["speed"] + world["seed"], sep=",", file=file)
"""
CONFIG = """\
template = "world.json"
command = "python3 sim.py {input}"
seed = "/seed"
runs = 2
[variables]
population_size = "/swarm/count"
speed = "//speed"
[controllers.two]
changes = [{ add = "/robots", json = '{"name": "r3"}' }]
"""


@pytest.mark.integration
def test_a_project_with_a_json_template_runs(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "p", CONFIG, simulator=SIMULATOR)
    (folder / "world.json").write_text('{\n  "seed": 0,\n  "swarm": {"count": 1, "speed": 0.5},\n  "robots": []\n}\n')
    ran, _ = projects.run(folder, "population_size.Log4", "speed=1,2", "--controller", "two")
    assert ran["executed"] == 12
    refused = projects.quick(folder, "run", "population_size=a,b", "--dry-run")
    assert refused.returncode == 2
    assert "is the number 1, which cannot become 'a'" in refused.stderr
    clash = projects.quick(folder, "run", "population_size.Log4", "--set", "//count=3", "--dry-run")
    assert clash.returncode == 2
    assert "is overwritten" in clash.stderr
