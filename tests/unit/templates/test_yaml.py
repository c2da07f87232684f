"""YAML templates."""

from __future__ import annotations

import re
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from sierra.errors import TemplateError
from sierra.model import Add, Remove, Rename, Set
from tests.trees import DATA, YAML, leaves, make, only_line, rendered


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
