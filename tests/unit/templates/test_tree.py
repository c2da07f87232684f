"""Templates of keys, lists and values: what all formats share, and what each of them refuses."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from sierra import templates
from sierra.config.plugin_registry import TEMPLATES
from sierra.errors import ConfigError, TemplateError
from sierra.model import Add, Change, Remove, Rename, Set, Value
from sierra.templates.base import Template
from sierra.testing import templates as conformance
from tests import projects

JSON = """\
{
  "swarm": {"count": 8, "name": "blue", "speed": 0.5, "on": true, "nothing": null},
  "robots": [
    {"name": "r1", "x": 1},
    {"name": "r2", "x": 2}
  ],
  "my key/2": 5, "empty": []
}
"""
YAML = """\
# a swarm
swarm:   # the robots
    count: 8  # robots
    name: blue
    speed: 0.5
    "on": true
robots:
  - {name: r1, x: 1}
  -  name: 'r2'
     x: 2   # the last
my key/2: 5

empty: []
"""
SAMPLES = {"json": JSON, "yaml": YAML}
TEXT_PLACES = ["/swarm/name", "/robots/item[2]/name", "/swarm/count", "//robots/item[2]/x"]


SCALARS = st.one_of(
    st.integers(-(10**20), 10**20),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=8),
    st.booleans(),
    st.none(),
)
DATA = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4), max_leaves=12
)


def leaves(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield the single values of a document in order, with their kind."""
    if isinstance(data, dict | list):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from leaves(value, (*path, key))
    else:
        yield path, (type(data).__name__, data)


def make(format: str, data: str | bytes, name: str = "template") -> Template:
    template: Template = TEMPLATES.make(format, {}, data.encode() if isinstance(data, str) else data, name)
    return template


def rendered(template: Template, *changes: Change, **values: Value) -> str:
    made = template.changed(changes, values).render()
    assert isinstance(made, bytes)
    return made.decode()


def only_line(before: str, after: str) -> list[tuple[str, str]]:
    """Return the lines that differ; the number of lines is the same."""
    pairs = zip(before.splitlines(keepends=True), after.splitlines(keepends=True), strict=True)
    return [(one.strip(), other.strip()) for one, other in pairs if one != other]


@pytest.mark.parametrize("format", SAMPLES)
def test_a_format_passes_the_conformance_suite(format: str) -> None:
    conformance.check(lambda data, name: make(format, data, name), SAMPLES[format].encode(), TEXT_PLACES)


@pytest.mark.parametrize("format", SAMPLES)
@pytest.mark.parametrize(
    ("path", "found"),
    [
        ("/swarm/count", ("8",)),
        ("//count", ("8",)),
        ("swarm/count", ("8",)),
        ("/swarm/*[1]", ("8",)),
        ("//item[name='r2']/x", ("2",)),
        ("/robots/item[2]/x", ("2",)),
        ("//key[@name='my key/2']", ("5",)),
        ("//x[. > /swarm/speed]", ("1", "2")),
        ("/robots/item[x = /robots/item[last()]/x]/name", ("r2",)),
        ("//x | /swarm/speed", ("0.5", "1", "2")),
        ("//x[2 * 3 = 6 and /swarm]", ("1", "2")),
        ("//x/../name", ("r1", "r2")),
        ("/robots/item/name/text()", ("r1", "r2")),
        ("/none", ()),
    ],
)
def test_paths_select_keys_and_items(format: str, path: str, found: tuple[str, ...]) -> None:
    assert sorted(make(format, SAMPLES[format]).find(path)) == sorted(found)


@pytest.mark.parametrize("format", SAMPLES)
def test_a_value_keeps_its_type(format: str) -> None:
    template = make(format, SAMPLES[format])
    changes = (Set("//swarm/count", "16"), Set("//speed", "1"), Set("//swarm/name", "7"), Set("//swarm/on", "false"))
    made = template.reread(template.changed(changes, {}).render(), "made")
    assert made.find("//count | //speed") == ("16", "1.0")
    assert (
        template.changed((Set("//swarm/name", "7"),), {}).render()
        != template.changed((Set("//swarm/count", "7"),), {}).render()
    )
    assert made.changed((Set("//swarm/name", "a text again"),), {}).render()
    with pytest.raises(TemplateError, match="boolean"):
        made.changed((Set("//swarm/on", "1"),), {})


@pytest.mark.parametrize("format", SAMPLES)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (Set("/swarm/cuont", "1", why="w"), "w: /swarm/cuont in template matches nothing; nearest is /swarm/count"),
        (Set("//item[nam='r1']/x", "1"), "//item[nam='r1']/x in template matches nothing; nearest is //item/x"),
        (Set("//x", "1", expect=1), "//x in template matches 2, not 1 as expected"),
        (Set("/swarm", "1"), "/swarm in template is a mapping; set works on single values"),
        (Set("/robots", "1"), "/robots in template is a list; set works on single values"),
        (Set("//count", "many"), "//count in template is the number 8, which cannot become 'many'; use a number"),
        (Set("//count", "007"), "//count in template is the number 8, which cannot become '007'; use a number"),
        (Set("//count", "nan"), "//count in template is the number 8, which cannot become 'nan'; use a number"),
        (Set("//count", "1e999"), "//count in template cannot become 1e999; it is too large"),
        (Set("//swarm/on", "yes"), "//swarm/on in template is a boolean, which cannot become 'yes'; use true or false"),
        (Set("//count", "1", attribute="n"), "//count in template has no attribute 'n'"),
        (Set("//key/@name", "x"), "//key/@name in template selects names of keys; select the keys themselves"),
        (Set("count(//x)", "1"), "returns a number"),
        (Set("//x[", "1"), "is not an XPath"),
        (Add("/swarm", '{"count": 1}'), "/swarm in template already has the key 'count'; set it"),
        (Add("/swarm", "[1]"), "/swarm in template is a mapping; add keys to it"),
        (Add("/swarm", "<a/>"), "/swarm in template cannot contain '<a/>'; json:1:1: not JSON"),
        (Add("//count", "1"), "//count in template is a number; add works on lists and mappings"),
        (Add("/robots", "1", at=3), "/robots in template has 2 items, so at=3 is too large"),
        (Rename("/swarm/speed", "on"), "/swarm/speed in template cannot get the key 'on'; there is another one"),
        (Rename("//item[1]", "on"), "//item[1] in template is an item of a list, which has no key"),
        (Remove("/"), "/ in template is the whole document, which cannot be removed"),
    ],
)
def test_a_change_that_does_not_fit_is_refused(format: str, change: Change, message: str) -> None:
    with pytest.raises(TemplateError) as refused:
        make(format, SAMPLES[format]).changed((change,), {})
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_null_cannot_be_set() -> None:
    with pytest.raises(TemplateError, match="is null, which has no type"):
        make("json", JSON).changed((Set("//nothing", "1"),), {})


@pytest.mark.parametrize("format", SAMPLES)
def test_an_unknown_name_in_an_expression_is_refused(format: str) -> None:
    with pytest.raises(ConfigError, match="unknown name 'n'"):
        make(format, SAMPLES[format]).changed((Add("/robots", '{"x": "{n}"}'),), {})


def test_changes_of_yaml_keep_its_layout() -> None:
    template = make("yaml", YAML)
    made = rendered(template, Set("//count", "9"), Set("//speed", "1"), Set("//name", "a: b"), Set("//x", "3"))
    assert only_line(YAML, made) == [
        ("count: 8  # robots", "count: 9  # robots"),
        ("name: blue", 'name: "a: b"'),
        ("speed: 0.5", "speed: 1.0"),
        ("- {name: r1, x: 1}", '- {name: "a: b", x: 3}'),
        ("-  name: 'r2'", "-  name: 'a: b'"),
        ("x: 2   # the last", "x: 3   # the last"),
    ]
    added = rendered(template, Add("/robots", '{"name": "r3", "x": "{n + 1}"}'), Add("/swarm", '{"k": [true, 1e-5]}'), n=2)
    assert added == YAML.replace("# the last\n", '# the last\n  - {"name": "r3", "x": 3}\n').replace(
        "true\n", "true\n    k: [true, 1.0e-5]\n"
    )
    assert rendered(template, Remove("/robots/item[1]")) == YAML.replace("  - {name: r1, x: 1}\n", "")
    assert rendered(template, Remove("/robots/item[1]/name")) == YAML.replace("name: r1, ", "")
    assert rendered(template, Remove("/robots/item[2]/x")) == YAML.replace("     x: 2   # the last\n", "")
    assert rendered(template, Remove("/robots/item[2]/name")) == YAML.replace("name: 'r2'\n     ", "")
    assert rendered(template, Remove("//item")) == YAML.replace(YAML[YAML.index("- {") : YAML.index("my key")], "[]\n")
    assert rendered(template, Rename("//name", "label")) == YAML.replace("name", "label")
    assert rendered(template, Add("/robots", "0", at=1)) == YAML.replace("  -  name", "  - 0\n  -  name")


@pytest.mark.parametrize(
    ("old", "value", "new"),
    [
        ("a", "b", "b"),
        ("a", "12", '"12"'),
        ("a", "yes", '"yes"'),
        ("a", "null", '"null"'),
        ("a", "", '""'),
        ("a", "x # y", '"x # y"'),
        ("a", "1e5", '"1e5"'),
        ("a", "2001-01-01", '"2001-01-01"'),
        ("a", "two words", "two words"),
        ("a", "é\u2028\x07", '"é\\u2028\\u0007"'),
        ("'a'", "it's", "'it''s'"),
        ('"a"', "b", '"b"'),
        ("|\n  a\n  b", "c", '"c"'),
        ("&n a", "b", "&n b"),
        ("1", "1e-05", "1.0e-05"),
        ("1.50", "1.5", "1.5"),
        ("1.5", "1.50", "1.50"),
        ("0.5", "0.50", "0.50"),
        ("1", "1.0", "1"),
        ("True", "true", "True"),
        ("True", "false", "false"),
    ],
)
def test_a_value_of_yaml_is_written_so_that_all_programs_read_it_alike(old: str, value: str, new: str) -> None:
    template = make("yaml", f"k: {old}\nz: 1\n")
    assert rendered(template, Set("/k", value)) == f"k: {new}\nz: 1\n"
    assert rendered(template, Set("/k", value), Set("/z", "2")) == f"k: {new}\nz: 2\n"


@pytest.mark.parametrize(
    "old", ["yes", "off", "y", "010", "0x1F", "0o17", "1e5", "1_000", "1:30", ".5", "+1", ".inf", "2001-01-01"]
)
def test_a_value_that_versions_of_yaml_read_differently_is_not_set(old: str) -> None:
    with pytest.raises(
        TemplateError, match=r"/k in template is .*, which YAML 1.1 and 1.2 read in different ways; write a plain"
    ):
        make("yaml", f"k: {old}\n").changed((Set("/k", "1"),), {})


@pytest.mark.parametrize(
    ("text", "path", "message"),
    [
        ("a: &x {k: 1}\nb: *x\n", "/a/k", "is part of the anchor &x, which an alias repeats elsewhere"),
        ("a: &x 1\nb: *x\n", "/a", "is part of the anchor &x"),
        ("a: &x 1\nb: *x\n", "/b", "is the alias *x; write its content there to change it"),
        ("a: &x {k: 1}\nb: *x\n", "/b/k", "/b/k in template matches nothing; only /b matches"),
        ("a: !degrees 3\n", "/a", "has the tag !degrees"),
        ("a: !!int 3\n", "/a", "has the tag tag:yaml.org,2002:int"),
        ("a:\n", "/a", "is null"),
        ("a: ~\n", "/a", "is null"),
    ],
)
def test_a_value_of_yaml_with_another_meaning_is_not_set(text: str, path: str, message: str) -> None:
    with pytest.raises(TemplateError) as refused:
        make("yaml", text).changed((Set(path, "1"),), {})
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "t.yaml:1:1: not YAML: the document is empty"),
        ("a: 1\n---\nb: 2\n", "t.yaml:2:1: not a YAML template: a second document begins there"),
        ("a: 1\na: 2\n", "t.yaml:2:1: not a YAML template: the key 'a' occurs twice"),
        ("? [a]\n: 1\n", "a key must be a single value"),
        ("a: &x [*x]\n", "t.yaml:1:8: not a YAML template: the alias *x is part of its own anchor"),
        ("a: *x\n", "t.yaml:1:4: not a YAML template: the alias *x has no anchor before it"),
        ("a: [1\n", "t.yaml:2:1: not YAML"),
        ("a:\n\t- 1\n", "t.yaml:2:1: not YAML"),
        ("a: \x07\n", "t.yaml:1:4: not YAML"),
        ("[" * 200 + "]" * 200, "t.yaml:1:102: not a YAML template: more than 100 levels"),
        (f"a: {'9' * 500}\n", "t.yaml:1:4: not a YAML template: the number 99999999999999999999… is too large"),
        (
            "a0: &a0 [0]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 9)),
            "aliases expand the document to more than 1000000 nodes",
        ),
    ],
)
def test_invalid_yaml_is_refused_with_its_place(text: str, message: str) -> None:
    with pytest.raises(TemplateError) as refused:
        make("yaml", text, "t.yaml")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@given(DATA, st.booleans(), st.integers(0, 10**9), st.text(max_size=8), st.data())
def test_a_set_in_yaml_changes_one_value_and_nothing_else(
    data: Any, flow: bool, number: int, text: str, draw: st.DataObject
) -> None:
    before = yaml.safe_dump({"top": data}, default_flow_style=flow, allow_unicode=True, width=20)
    template = make("yaml", before)
    assert rendered(template) == before
    paths = [path for path, _ in template.attributes()]
    if not paths:
        return
    path = draw.draw(st.sampled_from(paths))
    old = template.find(path)[0]
    known = dict(leaves(yaml.safe_load(before)))
    for value in (str(number), text.replace("{", "{{").replace("}", "}}")):
        try:
            after = rendered(template, Set(path, value))
        except TemplateError as error:
            if re.search("is the number|is a boolean|too large", str(error)):
                continue
            raise
        now = dict(leaves(yaml.safe_load(after)))
        different = [where for where in known if known[where] != now[where]]
        assert len(different) <= 1
        assert known.keys() == now.keys()
        assert all(
            known[where][0] == now[where][0] or {known[where][0], now[where][0]} == {"int", "float"} for where in different
        )
        found = template.reread(after.encode(), "after").find(path)[0]
        assert found == value.replace("{{", "{").replace("}}", "}") or float(found) == float(value)
        assert different or found == old or float(found) == float(old)


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


@pytest.mark.parametrize("format", SAMPLES)
@pytest.mark.parametrize(
    ("data", "message"), [(b"a\n\xff", "template:2: not a text in UTF-8"), (b"a\0", "template:1: contains a NUL")]
)
def test_a_binary_file_is_refused(format: str, data: bytes, message: str) -> None:
    with pytest.raises(TemplateError, match=message):
        make(format, data)


@pytest.mark.parametrize("format", SAMPLES)
def test_a_byte_order_mark_and_line_ends_stay(format: str) -> None:
    before = "\ufeff" + SAMPLES[format].replace("\n", "\r\n")
    assert rendered(make(format, before), Set("//count", "9")) == before.replace("8", "9", 1)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        (
            "t.wbt",
            b"WorldInfo { }",
            "its ending names no format, and it does not begin as XML; set template_format to one of xml, json, yaml",
        ),
        ("t.json", b" <a/>", "its ending means json, but it begins as XML; set template_format to one of"),
        ("t", b"", "its ending names no format"),
    ],
)
def test_a_doubtful_format_is_refused(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(TemplateError) as refused:
        templates.read(tmp_path / name)
    assert message in str(refused.value)


def test_a_project_may_name_the_format(tmp_path: Path) -> None:
    (tmp_path / "t.conf").write_text('{"n": 1}')
    assert templates.read(tmp_path / "t.conf", format="json").find("/n") == ("1",)
    with pytest.raises(ConfigError, match="unknown template 'jsno'; known are xml, json, yaml"):
        templates.read(tmp_path / "t.conf", format="jsno")


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
