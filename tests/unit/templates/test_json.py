"""JSON templates."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.errors import TemplateError
from sierra.model import Add, Remove, Rename, Set
from tests import projects
from tests.trees import DATA, JSON, leaves, make, rendered


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


def test_a_null_cannot_be_set() -> None:
    with pytest.raises(TemplateError, match="is null, which has no type"):
        make("json", JSON).changed((Set("//nothing", "1"),), {})


def new_value(old: Any, text: str, number: int) -> str:
    return (
        text.replace("{", "{{").replace("}", "}}") if isinstance(old, str) else str(number) if type(old) is not bool else "true"
    )


@given(DATA, st.sampled_from([None, 1, "\t"]), st.booleans(), st.integers(0, 10**9), st.text(max_size=8), st.data())
def test_a_set_in_json_changes_one_value_and_nothing_else(
    data: Any, indent: Any, escaped: bool, number: int, text: str, draw: st.DataObject
) -> None:
    before = json.dumps(data, indent=indent, ensure_ascii=escaped)
    template = make("json", before)
    assert rendered(template) == before
    settable = [(path, value) for path, (_, value) in leaves(data) if value is not None]
    paths = [path for path, _ in template.attributes()]
    assert len(paths) == len(settable)
    if not paths:
        return
    index = draw.draw(st.integers(0, len(paths) - 1))
    path, old = settable[index]
    after = rendered(template, Set(paths[index], new_value(old, text, number)))
    expected = text if isinstance(old, str) else True if isinstance(old, bool) else type(old)(number)
    changed = dict(leaves(json.loads(after)))
    assert changed == {**dict(leaves(data)), path: (type(old).__name__, expected)}
    assert template.reread(after.encode(), "after").find(paths[index]) == (
        json.dumps(expected) if not isinstance(old, str) else text,
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "t.json:1:1: not JSON: the document ends too early"),
        ('{"a": 1,}', "t.json:1:9: not JSON: a key in double quotes is expected"),
        ('{"a": 1} 2', "t.json:1:10: not JSON: text after the end of the document"),
        ('{"a": 1,\n "a": 2}', "t.json:2:2: not JSON: the key 'a' occurs twice"),
        ('{"a": NaN}', "t.json:1:7: not JSON: 'NaN' is not a value of JSON"),
        ("[-Infinity]", "t.json:1:2: not JSON: '-Infinity' is not a value of JSON"),
        ("[1e999]", "t.json:1:2: not JSON: the number 1e999… is too large"),
        (f"[{'9' * 5000}]", "is too large"),
        ("[01]", "'01' is not a value of JSON"),
        ("// c\n1", "t.json:1:1: not JSON: comments are not allowed in JSON"),
        ("{'a': 1}", "a key in double quotes is expected"),
        ('["a\nb"]', "t.json:1:4: not JSON: invalid control character in a string"),
        ("[" * 200 + "]" * 200, "t.json:1:101: not JSON: more than 100 levels"),
        ("[1 2]", "t.json:1:4: not JSON: ',' is expected"),
    ],
)
def test_invalid_json_is_refused_with_its_place(text: str, message: str) -> None:
    with pytest.raises(TemplateError) as refused:
        make("json", text, "t.json")
    assert message in str(refused.value)


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
