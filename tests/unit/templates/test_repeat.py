"""Elements and items that are repeated as often as a variable says."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from sierra.errors import TemplateError
from sierra.model import Change, Repeat, Set
from sierra.templates import base
from sierra.util.random_poses import PlanePose
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


def repeated(name: str, text: str, path: str, count: object, poses: tuple[PlanePose, ...] = ()) -> str:
    template = base.of_bytes(Path(name), text.encode())
    rendered = template.changed([Repeat(path, "{n}", poses=poses)], {"n": count}).render()  # type: ignore[dict-item]
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


POSES: tuple[PlanePose, ...] = ((0.1, -2.0, 0.0), (1e-05, 1e22, -3.141592653589793))


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("a.json", '{"agents": [{"p": ["{x}", "{y}"], "t": "at {x} {yaw}, ${x} {{y}}"}]}', json.loads),
        ("a.yaml", "agents:\n  - p: ['{x}', \"{y}\"]\n    t: at {x} {yaw}, ${x} {{y}}\n", yaml.safe_load),
        ("a.toml", "[[agents]]\np = ['{x}', '{y}']\nt = 'at {x} {yaw}, ${x} {{y}}'\n", tomllib.loads),
    ],
)
def test_copies_of_items_get_poses_as_numbers(name: str, text: str, read: Callable[[str], object]) -> None:
    assert read(repeated(name, text, ITEM, 2, POSES)) == {
        "agents": [
            {"p": [0.1, -2.0], "t": "at 0.1 0.0, ${x} {{y}}"},
            {"p": [1e-05, 1e22], "t": "at 1e-05 -3.141592653589793, ${x} {{y}}"},
        ]
    }


def test_copies_of_elements_get_poses() -> None:
    text = '<w><a p="{x} {y} 0"><!-- {x} -->{yaw}<b/>{index}</a></w>'
    made = '<a p="0.1 -2.0 0"><!-- {x} -->0.0<b/>0</a><a p="1e-05 1e+22 0"><!-- {x} -->-3.141592653589793<b/>1</a>'
    assert repeated("a.xml", text, "/w/a", 2, POSES) == f"<w>{made}</w>"


@pytest.mark.parametrize(
    ("name", "text", "path", "count", "message"),
    [
        ("a.json", '{"a": [{"x": "{x}"}]}', "/a/item[1]", 3, "cannot be repeated 3 times with 2 poses; add poses, or use"),
        ("a.xml", '<w><a x="{x}"/></w>', "/w/a", 3, "cannot be repeated 3 times with 2 poses in a.xml"),
        ("a.json", '{"a": [{"x": 1}], "b": "{x}"}', "/a/item[1]", 0, "has poses, but no text in it contains {x}, {y} or {yaw}"),
        ("a.xml", "<w><a><!-- {x} --></a>{x}</w>", "/w/a", 1, "has poses, but no text in it contains"),
        ("a.xml", '<w><a x="${x}"/></w>', "/w/a", 1, "has poses, but no text in it contains"),
        ("a.yaml", "a:\n  - x: {x}\n    y: '{y}'\n", "/a/item[1]", 1, "{x} without quotes is a mapping; write '{x}'"),
    ],
)
def test_poses_that_cannot_be_right_are_refused(name: str, text: str, path: str, count: int, message: str) -> None:
    with pytest.raises(TemplateError) as raised:
        repeated(name, text, path, count, POSES)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "text", "path"), [("a.json", '{"a": ["{x}"]}', "/a/item"), ("a.xml", "<w><a>{y}</a></w>", "/w/a")]
)
def test_a_place_without_poses_is_refused(name: str, text: str, path: str) -> None:
    with pytest.raises(
        TemplateError, match=r"contains \{[xy]\}, but there are no poses.*; give the variable poses or random_poses"
    ):
        repeated(name, text, path, 1)


def test_a_mapping_and_the_texts_of_other_programs_are_copied_without_poses() -> None:
    assert json.loads(repeated("a.json", '{"a": [{"p": {"x":null}, "q": "${x}"}]}', "/a/item", 1)) == {
        "a": [{"p": {"x": None}, "q": "${x}"}]
    }


def posed(root: Path, poses: str, *words: str) -> list[dict[str, Any]]:
    """Return the scenes of the runs of a query, whose agents have poses."""
    projects.make(root, LISTED.replace('item[1]" }', f'item[1]", {poses} }}'), simulator=SIMULATOR)
    (root / "scene.json").write_text(
        '{"seed": 1, "agents": [{"name": "r{index}", "x": "{x}", "y": "{y}", "size": 0}], "o": [{"x": "{x}"}]}'
    )
    done = projects.quick(root, "run", *words, "--runs", "2", "--inputs", "../inputs")
    assert done.returncode == 0, done.stderr
    return [json.loads(file.read_text()) for file in sorted((root / "../inputs").rglob("input.json"))]


RANDOM = "random_poses = { x = [-1, 1], y = [2, 3], distance = 0.4 }"


def test_random_poses_come_from_the_seed_of_the_run_and_not_from_the_number_of_copies(tmp_path: Path) -> None:
    scenes = posed(tmp_path / "p", RANDOM, "agents=2,5", "size=7")
    few, other, many, _ = [[(agent["x"], agent["y"]) for agent in scene["agents"]] for scene in scenes]
    assert many[:2] == few != other
    assert all(-1 <= x <= 1 and 2 <= y <= 3 for x, y in many)
    assert min(abs(complex(*a) - complex(*b)) for a in many for b in many if a != b) >= 0.4
    assert [agent["size"] for agent in scenes[2]["agents"]] == [7, 0, 0, 0, 0]


def test_two_variables_draw_different_poses(tmp_path: Path) -> None:
    root = tmp_path / "p"
    others = f'o = {{ repeat = "/o/item[1]", {RANDOM} }}'
    scenes = posed(root, f'{RANDOM} }}\n{others}\nmore = {{ set = "/seed"', "agents=1", "o=1", "size=7")
    assert scenes[0]["agents"][0]["x"] != scenes[0]["o"][0]["x"]


@pytest.mark.parametrize(
    ("table", "words", "message"),
    [
        (RANDOM, "agents=99", "cannot be repeated 99 times; random_poses: number "),
        ("poses = [[1, 2]]", "agents=2", "cannot be repeated 2 times with 1 pose; add poses, or use random_poses"),
        ("poses = [[1, nan]]", "agents=1", "variables.agents.poses.0.1 should be a finite number"),
        ("poses = [[1]]", "agents=1", "variables.agents.poses.0 should have at least 2 items"),
        (f"poses = [[1, 2]], {RANDOM}", "agents=1", "poses and random_poses exclude each other"),
        ("random_poses = { x = [1, 0] }", "agents=1", "the limits of x are in the wrong order"),
        (
            "random_poses = { x = [-1e308, 1e308], distance = 1 }",
            "agents=2",
            "numbers for x and distance must be at most 1e+100",
        ),
        ('poses = [[1, 2]] }\nmore = { set = "/seed", poses = [[1, 2]]', "agents=1", 'give it "repeat"'),
    ],
)
def test_wrong_poses_end_the_query_in_one_line(listed: Path, table: str, words: str, message: str) -> None:
    (listed / "sierra.toml").write_text(LISTED.replace('item[1]" }', f'item[1]", {table} }}'))
    (listed / "scene.json").write_text('{"seed": 1, "agents": [{"name": "{x}", "size": 0}, {"name": "b"}]}')
    done = projects.quick(listed, "run", words, "--dry-run")
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
