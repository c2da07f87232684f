"""TOML templates."""

from __future__ import annotations

import json
import re
import tomllib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.errors import TemplateError
from sierra.model import Add, Change, Remove, Rename, Set
from tests.trees import TOML, leaves, make, only_line, rendered


def test_changes_of_toml_keep_its_layout() -> None:
    template = make("toml", TOML)
    made = rendered(template, Set("//count", "9"), Set("//speed", "1"), Set("//name", 'a "b"'), Set("//x", "3"))
    assert only_line(TOML, made) == [
        ("count = 8  # robots", "count = 9  # robots"),
        ('name = "blue"', 'name = "a \\"b\\""'),
        ("speed = 0.5", "speed = 1.0"),
        ('name = "r1"', 'name = "a \\"b\\""'),
        ("x = 1", "x = 3"),
        ("name = 'r2'", "name = 'a \"b\"'"),
        ("x = 0x2   # the last", "x = 3   # the last"),
    ]
    assert rendered(template, Set("//x", "2")) == TOML.replace("x = 1", "x = 2")
    added = rendered(template, Add("/robots", '{"name": "r3", "x": "{n + 1}"}'), Add("/", '{"k l": {"m": [true, 1e-5]}}'), n=2)
    assert added == TOML.replace("[]\n", '[]\n"k l" = {m = [true, 1e-5]}\n') + '\n[[robots]]\nname = "r3"\nx = 3\n'
    assert rendered(template, Add("/swarm", '{"k": "v"}')) == TOML.replace("on = true\n", 'on = true\n  k = "v"\n')
    assert rendered(template, Remove("/robots/item[1]")) == TOML.replace('[[robots]]\nname = "r1"\nx = 1\n', "")
    assert rendered(template, Remove("/robots")) == TOML[: TOML.index("[[robots]]")] + "\n# the other\n"
    assert rendered(template, Remove("//x"), Remove("//empty")) == TOML.replace("x = 1\n", "").replace(
        "x = 0x2   # the last\n", ""
    ).replace("empty = []\n", "")
    assert rendered(template, Rename("//robots", "ro bots")) == TOML.replace("[robots]", '["ro bots"]')


@pytest.mark.parametrize(
    ("old", "value", "new"),
    [
        ("1_000", "1000", "1_000"),
        ("1_000", "2", "2"),
        ("+1.5", "2", "2.0"),
        ("1979-05-27", "1980-01-01", "1980-01-01"),
        ("1979-05-27 07:32:00Z", "1980-01-01T00:00:00Z", "1980-01-01T00:00:00Z"),
        ('"""a\nb"""', "c\nd", '"c\\nd"'),
        ("'''a''''", "b", '"b"'),
        ('""', "\x7f", '"\\u007f"'),
        ("'a'", "it's", '"it\'s"'),
    ],
)
def test_a_value_of_toml_is_written_in_its_type(old: str, value: str, new: str) -> None:
    template = make("toml", f"k = {old}# c\nz.y = 1")
    assert rendered(template, Set("/k", value), Set("/z/y", "2")) == f"k = {new}# c\nz.y = 2"


@pytest.mark.parametrize(
    ("text", "change", "message"),
    [
        ("k = inf\n", Set("/k", "1"), "is inf, which is not a finite number"),
        ("k = 1979-05-27\n", Set("/k", "1"), "is 1979-05-27, which cannot become '1'; use a date or time of the same kind"),
        ("k = 1979-05-27\n", Set("/k", "1980-01-01 # x"), "cannot be"),
        ("k = 07:32:00\n", Set("/k", "1979-05-27"), "use a date or time of the same kind"),
        ("a.b = 1\n", Remove("/a/b"), "cannot be changed in its place"),
        ("[a.b]\n", Add("/a", '{"c": 1}'), "is a table without a header"),
        ("[a]\n", Add("/a", '{"c": null}'), "cannot contain null; TOML has none"),
        ("[[a]]\n", Add("/a", "1"), "is a list of tables; add a table to its end"),
        ("[[a]]\n", Add("/a", "{}", at=0), "is a list of tables; add a table to its end"),
    ],
)
def test_a_change_of_toml_that_does_not_fit_is_refused(text: str, change: Change, message: str) -> None:
    with pytest.raises(TemplateError) as refused:
        make("toml", text).changed((change,), {})
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = 1\na = 2\n", "t.toml:2:6: not TOML: Cannot overwrite a value"),
        ("a = \n", "t.toml:1:5: not TOML: Invalid value"),
        ("a = [1", "t.toml:1:1: not TOML: Unclosed array"),
        ("a = 1e999\n", "t.toml:1:5: the number 1e999… is too large"),
        (f"a = {'9' * 5000}\n", "t.toml:2:1: not TOML: Exceeds the limit"),
        (f"a = {'[' * 150}{']' * 150}\n", "more than 100 levels"),
        (f"a = {'[' * 5000}{']' * 5000}\n", "more than 100 levels"),
    ],
)
def test_invalid_toml_is_refused_with_its_place(text: str, message: str) -> None:
    with pytest.raises(TemplateError) as refused:
        make("toml", text, "t.toml")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def quoted(key: str) -> str:
    return json.dumps(key, ensure_ascii=False)


def in_toml(data: Any) -> str:
    """Return a value on one line, or on several lines with comments."""
    if isinstance(data, dict):
        return "{ " + ", ".join(f"{quoted(key)} = {in_toml(value)}" for key, value in data.items()) + " }"
    if isinstance(data, list):
        return "[ # c\n" + "".join(f"  {in_toml(value)}, # d\n" for value in data) + "]"
    return json.dumps(data, ensure_ascii=False)


def in_tables(data: dict[str, Any], path: tuple[str, ...] = ()) -> str:
    """Return a document with a header for each table, and dotted keys."""
    tables = {key: value for key, value in data.items() if isinstance(value, dict) and key[:1] > "m"}
    lines = [f"{quoted(key)} = {in_toml(value)}  # e\n" for key, value in data.items() if key not in tables]
    for key, value in tables.items():
        where = (*path, key)
        lines.append(f"\n[{' . '.join(map(quoted, where))}] # t\n{in_tables(value, where)}")
    return "".join(lines)


KEYS = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=6)
IN_TOML = st.recursive(
    st.one_of(st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False, allow_infinity=False), KEYS, st.booleans()),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=12,
)


@given(st.dictionaries(KEYS, IN_TOML, max_size=4), st.integers(0, 10**9), st.text(max_size=8), st.data())
def test_a_set_in_toml_changes_one_value_and_nothing_else(
    data: dict[str, Any], number: int, text: str, draw: st.DataObject
) -> None:
    before = in_tables(data)
    known = dict(leaves(tomllib.loads(before)))
    template = make("toml", before)
    assert rendered(template) == before
    paths = [path for path, _ in template.attributes()]
    assert len(paths) == len(known)
    if not paths:
        return
    path = draw.draw(st.sampled_from(paths))
    for value in (str(number), text.replace("{", "{{").replace("}", "}}")):
        try:
            after = rendered(template, Set(path, value))
        except TemplateError as error:
            if re.search("is the number|is a boolean|too large", str(error)):
                continue
            raise
        now = dict(leaves(tomllib.loads(after)))
        different = [where for where in known if known[where] != now[where]]
        assert len(different) <= 1
        assert known.keys() == now.keys()
        assert all(
            known[where][0] == now[where][0] or {known[where][0], now[where][0]} == {"int", "float"} for where in different
        )
        found = template.reread(after.encode(), "after").find(path)[0]
        assert found == value.replace("{{", "{").replace("}}", "}") or float(found) == float(value)
