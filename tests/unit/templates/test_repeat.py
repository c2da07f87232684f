"""Elements and items that are repeated as often as a variable says."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest
import yaml

from sierra.errors import TemplateError
from sierra.model import Change, Repeat, Set
from sierra.templates import base
from tests import projects

ITEM = "/agents/item[1]"
JSON = """\
{
  "agents": [
    {"id": "{index}", "name": "a{index}", "pose": [1, 2.50], "on": true, "led": null},
    {"id": 7}
  ],
  "ticks": 20
}
"""
YAML = """\
agents:  # all robots
  - name: "a{index}"
    pose: [1, 2.50]
  - name: other
ticks: 20
"""
TOML = """\
ticks = 20
[[agents]]
name = "a{index}"
[[agents]]
name = "other"
"""
XML = """\
<w:world xmlns:w="urn:w">
  <w:agent id="a{index}"><pose x='1'/>number {index} &amp; more</w:agent>
  <agent id="another name"/>
  <w:agent id="b"/>
  <light/>
  <w:agent id="c"/>
</w:world>
"""


def repeated(name: str, text: str, path: str, count: object) -> str:
    template = base.of_bytes(Path(name), text.encode())
    rendered = template.changed([Repeat(path, "{n}")], {"n": count}).render()  # type: ignore[dict-item]
    assert isinstance(rendered, bytes)
    return rendered.decode()


@pytest.mark.parametrize("count", [0, 1, 2, 30])
@pytest.mark.parametrize("text", [JSON, JSON.replace("\n", "\r\n"), json.dumps(json.loads(JSON))])
def test_items_of_json_are_repeated(text: str, count: int) -> None:
    made = json.loads(repeated("a.json", text, ITEM, count))
    agents = [{"id": k, "name": f"a{k}", "pose": [1, 2.5], "on": True, "led": None} for k in range(count)]
    assert made == {"agents": agents, "ticks": 20}


@pytest.mark.parametrize("count", [0, 1, 3])
def test_items_of_yaml_are_repeated(count: int) -> None:
    made = repeated("a.yaml", YAML, ITEM, count)
    assert made.startswith("agents:  # all robots\n")
    assert yaml.safe_load(made) == {"agents": [{"name": f"a{k}", "pose": [1, 2.5]} for k in range(count)], "ticks": 20}


def test_tables_of_toml_are_repeated() -> None:
    assert [table["name"] for table in tomllib.loads(repeated("a.toml", TOML, ITEM, 3))["agents"]] == ["a0", "a1", "a2"]


def test_elements_of_xml_are_repeated_in_their_place() -> None:
    assert (
        repeated("a.xml", XML, "/w:world/w:agent[1]", 2)
        == """\
<w:world xmlns:w="urn:w">
  <w:agent id="a0"><pose x="1"/>number 0 &amp; more</w:agent>
  <w:agent id="a1"><pose x="1"/>number 1 &amp; more</w:agent>
  <agent id="another name"/>
  <light/>
</w:world>
"""
    )
    assert "w:agent" not in repeated("a.xml", XML, "/w:world/w:agent[1]", 0)


def test_later_changes_see_the_copies() -> None:
    for name, text, path, place in (
        ("a.xml", XML, "/w:world/w:agent[1]", "/w:world/w:agent[3]/@id"),
        ("a.json", JSON, ITEM, "/agents/item[3]/name"),
    ):
        changes: list[Change] = [Repeat(path, "{n}"), Set(place, "last {n}")]
        template = base.of_bytes(Path(name), text.encode())
        assert template.reread(template.changed(changes, {"n": 3}).render(), name).find(place) == ("last 3",)


def test_earlier_changes_are_in_the_copies() -> None:
    changes: list[Change] = [Set("/w:world/w:agent[1]/pose/@x", "5"), Repeat("/w:world/w:agent[1]", "2")]
    rendered = base.of_bytes(Path("a.xml"), XML.encode()).changed(changes, {}).render()
    assert isinstance(rendered, bytes)
    assert rendered.count(b'<pose x="5"/>') == 2


@pytest.mark.parametrize(
    ("name", "text", "path", "count", "message"),
    [
        ("a.json", JSON, "/agents", 2, "is no item of a list; repeat works on these"),
        ("a.json", JSON, "/", 2, "is no item of a list"),
        ("a.json", JSON, "/agents/item", 2, "matches 2, not 1 as expected"),
        ("a.json", JSON, "/agents/item[9]", 2, "matches nothing"),
        ("a.json", JSON, ITEM, 1.5, "cannot be repeated '1.5' times; use a whole number from 0"),
        ("a.json", JSON, ITEM, -1, "cannot be repeated '-1' times"),
        ("a.json", JSON, ITEM, "many", "cannot be repeated 'many' times"),
        ("a.json", JSON, ITEM, 10**9, "cannot be repeated"),
        ("a.xml", XML, "/w:world", 2, "selects the root element"),
        ("a.xml", XML, "/w:world/w:agent", 2, "matches 3 in a.xml, not 1 as expected"),
        ("a.xml", XML, "/w:world/w:agent[1]/@id", 2, "selects attributes in a.xml; repeat works on elements"),
        ("a.xml", XML, "/w:world/w:agent[1]", "x", "cannot be repeated 'x' times"),
        ("a.toml", TOML, ITEM, 0, "cannot be changed in its place"),
        ("a.ini", "[a]\nb = 1\n", "/a/b", 2, "is no item of a list"),
        ("a.txt", "n = {{n}}\n", "n", 2, "n"),
    ],
)
def test_what_cannot_be_repeated_is_refused(name: str, text: str, path: str, count: object, message: str) -> None:
    with pytest.raises(TemplateError) as raised:
        repeated(name, text, path, count)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


SIMULATOR = """\
import json, sys
scene = json.load(open(sys.argv[1]))
with open("poses.csv", "w") as file:
    print("tick,agent,speed", file=file)
    for tick in range(20):
        for agent in scene["agents"]:
            print(tick, agent["name"], scene["speed"], sep=",", file=file)
"""


def test_the_number_of_agents_is_a_variable(tmp_path: Path) -> None:
    config = 'template = "scene.json"\ncommand = "python3 sim.py {input}"\nseed = "/seed"\nruns = 1\n[variables]\n'
    root = projects.make(tmp_path / "p", config + 'agents = { repeat = "/agents/item[1]" }\n', simulator=SIMULATOR)
    (root / "scene.json").write_text('{"seed": 1, "speed": 2, "agents": [{"name": "r{index}"}, {"name": "b"}, {"name": "c"}]}')
    projects.run(root, "agents=1,4")
    rows = projects.sql(
        root, "SELECT r.agents, count(*) AS rows, max(agent) AS last FROM poses JOIN runs r USING (run) GROUP BY 1"
    )
    assert sorted(rows, key=lambda row: row["agents"]) == [
        {"agents": 1, "rows": 20, "last": "r0"},
        {"agents": 4, "rows": 80, "last": "r3"},
    ]


LISTED = """
template = "scene.json"
command = "python3 sim.py {input}"
seed = "/seed"
runs = 1
[variables]
agents = { repeat = "/agents/item[1]" }
others = { repeat = "/agents/item[2]" }
size = "/agents/item[1]/size"
"""


@pytest.fixture
def listed(tmp_path: Path) -> Path:
    root = projects.make(tmp_path / "p", LISTED, simulator=SIMULATOR)
    (root / "scene.json").write_text('{"seed": 1, "speed": 2, "agents": [{"name": "r{index}", "size": 0}, {"name": "b"}]}')
    return root


def test_copies_are_made_before_values_are_set(listed: Path) -> None:
    made = []
    for number, words in enumerate((("agents=3", "size=7"), ("size=7", "agents=3"))):
        folder = f"../inputs{number}"
        done = projects.quick(listed, "run", *words, "--inputs", folder)
        assert done.returncode == 0, done.stderr
        [file] = (listed / folder).rglob("input.json")
        made.append([agent["size"] for agent in json.loads(file.read_text())["agents"]])
    assert made == [[7, 0, 0], [7, 0, 0]]


def test_two_variables_do_not_repeat_items_of_one_list(listed: Path) -> None:
    done = projects.quick(listed, "run", "agents=3", "others=2", "--dry-run")
    assert done.returncode == 2
    assert "'agents' and 'others' both set" in done.stderr


def test_a_query_that_does_not_vary_the_number_is_noted(listed: Path) -> None:
    done = projects.quick(listed, "run", "size=7", "--dry-run")
    assert "note: the query does not vary agents, others: {index} stays as it is in the input" in done.stderr
