"""Templates of keys, lists and values: what all formats share, and what each of them refuses."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
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
SAMPLES = {"json": JSON}
TEXT_PLACES = ["/swarm/name", "/robots/item[2]/name", "/swarm/count", "//robots/item[2]/x"]


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
    changes = (Set("//swarm/count", "16"), Set("//speed", "1"), Set("//swarm/name", "7"), Set("//on", "false"))
    made = template.reread(template.changed(changes, {}).render(), "made")
    assert made.find("//count | //speed") == ("16", "1.0")
    assert (
        template.changed((Set("//swarm/name", "7"),), {}).render()
        != template.changed((Set("//swarm/count", "7"),), {}).render()
    )
    assert made.changed((Set("//swarm/name", "a text again"),), {}).render()
    with pytest.raises(TemplateError, match="boolean"):
        made.changed((Set("//on", "1"),), {})


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
        (Set("//on", "yes"), "//on in template is a boolean, which cannot become 'yes'; use true or false"),
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
            "its ending names no format, and it does not begin as XML; set template_format to one of xml, json",
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
    with pytest.raises(ConfigError, match="unknown template 'jsno'; known are xml, json"):
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
