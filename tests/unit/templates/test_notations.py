"""What templates of keys, lists and values refuse, and how a set value is read back by other parsers."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from typing import Any

import pytest
import yaml
from hypothesis import strategies as st

from sierra.errors import TemplateError
from sierra.model import Add, Change, Remove, Rename, Set
from tests.properties import given_in_tiers
from tests.trees import DATA, JSON, leaves, make, rendered


@pytest.mark.parametrize(
    ("format", "text", "message"),
    [
        ("json", "", "t:1:1: not JSON: the document ends too early"),
        ("json", '{"a": 1,}', "t:1:9: not JSON: a key in double quotes is expected"),
        ("json", '{"a": 1} 2', "t:1:10: not JSON: text after the end of the document"),
        ("json", '{"a": 1,\n "a": 2}', "t:2:2: not JSON: the key 'a' occurs twice"),
        ("json", '{"a": NaN}', "t:1:7: not JSON: 'NaN' is not a value of JSON"),
        ("json", "[-Infinity]", "t:1:2: not JSON: '-Infinity' is not a value of JSON"),
        ("json", "[1e999]", "t:1:2: not JSON: the number 1e999… is too large"),
        ("json", f"[{'9' * 5000}]", "is too large"),
        ("json", "[01]", "'01' is not a value of JSON"),
        ("json", "// c\n1", "t:1:1: not JSON: comments are not allowed in JSON"),
        ("json", "{'a': 1}", "a key in double quotes is expected"),
        ("json", '["a\nb"]', "t:1:4: not JSON: invalid control character in a string"),
        ("json", "[" * 200 + "]" * 200, "t:1:101: not JSON: more than 100 levels"),
        ("json", "[1 2]", "t:1:4: not JSON: ',' is expected"),
        ("yaml", "", "t:1:1: not YAML: the document is empty"),
        ("yaml", "a: 1\n---\nb: 2\n", "t:2:1: not a YAML template: a second document begins there"),
        ("yaml", "a: 1\na: 2\n", "t:2:1: not a YAML template: the key 'a' occurs twice"),
        ("yaml", "1: a\n0x1: b\n", "t:2:1: not a YAML template: the key '0x1' occurs twice"),
        ("yaml", "true: a\nyes: b\n", "t:2:1: not a YAML template: the key 'yes' occurs twice"),
        ("yaml", "~: a\nnull: b\n", "t:2:1: not a YAML template: the key 'null' occurs twice"),
        ("yaml", "? [a]\n: 1\n", "a key must be a single value"),
        ("yaml", "a: &x [*x]\n", "t:1:8: not a YAML template: the alias *x is part of its own anchor"),
        ("yaml", "a: *x\n", "t:1:4: not a YAML template: the alias *x has no anchor before it"),
        ("yaml", "a: [1\n", "t:2:1: not YAML"),
        ("yaml", "a:\n\t- 1\n", "t:2:1: not YAML"),
        ("yaml", "a: \x07\n", "t:1:4: not YAML"),
        ("yaml", "[" * 200 + "]" * 200, "t:1:102: not a YAML template: more than 100 levels"),
        ("yaml", f"a: {'9' * 500}\n", "t:1:4: not a YAML template: the number 99999999999999999999… is too large"),
        (
            "yaml",
            "a0: &a0 [0]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 9)),
            "aliases expand the document to more than 1000000 nodes",
        ),
        ("toml", "a = 1\na = 2\n", "t:2:6: not TOML: Cannot overwrite a value"),
        ("toml", "a = \n", "t:1:5: not TOML: Invalid value"),
        ("toml", "a = [1", "t:1:1: not TOML: Unclosed array"),
        ("toml", "a = 1e999\n", "t:1:5: the number 1e999… is too large"),
        ("toml", f"a = {'9' * 5000}\n", "t:2:1: not TOML: Exceeds the limit"),
        ("toml", f"a = {'[' * 150}{']' * 150}\n", "more than 100 levels"),
        ("toml", f"a = {'[' * 5000}{']' * 5000}\n", "more than 100 levels"),
        (
            "ini",
            "a = 1\n",
            "^t:1:1: not INI: a key before the first section; set template_format to properties if there are none$",
        ),
        ("ini", "[s]\na = 1\na = 2\n", "^t:3:1: not INI: the key 'a' occurs twice$"),
        ("ini", "[s]\n[t]\n[s]\n", "^t:3:1: not INI: the section [s] occurs twice$"),
        ("ini", "[s]\nwords\n", "^t:2:1: not INI: neither a key with a value nor a section$"),
        ("ini", "[s]\n[t]=1\n", "^t:2:1: not INI: neither a key with a value nor a section$"),
        ("ini", "[s\n", "^t:1:1: not INI: neither a key with a value nor a section$"),
        ("ini", "", "^t:1:1: not INI: there are no keys$"),
        ("ini", "[s]\na = 1\rb = 2\n", "t:2:6: not INI: a carriage return, which some programs read as the end of the line"),
        ("properties", "a = 1\r", "^t:1:6: not properties: a carriage return, which some programs read as the end of the line"),
        ("properties", "[s]\n", "^t:1:1: not properties: properties have no sections; set template_format to ini$"),
        ("properties", "a b\n", "^t:1:1: not properties: neither a key with a value nor a section$"),
    ],
)
def test_an_invalid_file_is_refused_with_its_place(format: str, text: str, message: str) -> None:
    """In a message, ^ stands for its beginning, and $ for its end."""
    with pytest.raises(TemplateError) as refused:
        make(format, text, "t")
    assert message in f"^{refused.value}$"
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("format", "text", "change", "message"),
    [
        ("yaml", "a: &x {k: 1}\nb: *x\n", Set("/a/k", "1"), "is part of the anchor &x, which an alias repeats elsewhere"),
        ("yaml", "a: &x 1\nb: *x\n", Set("/a", "1"), "is part of the anchor &x"),
        ("yaml", "a: &x 1\nb: *x\n", Set("/b", "1"), "is the alias *x; write its content there to change it"),
        ("yaml", "a: &x {k: 1}\nb: *x\n", Set("/b/k", "1"), "/b/k in template matches nothing; only /b matches"),
        ("yaml", "a: !degrees 3\n", Set("/a", "1"), "has the tag !degrees"),
        ("yaml", "a: !!int 3\n", Set("/a", "1"), "has the tag tag:yaml.org,2002:int"),
        ("yaml", "a:\n", Set("/a", "1"), "is null"),
        ("yaml", "a: ~\n", Set("/a", "1"), "is null"),
        ("toml", "k = inf\n", Set("/k", "1"), "is inf, which is not a finite number"),
        (
            "toml",
            "k = 1979-05-27\n",
            Set("/k", "1"),
            "is 1979-05-27, which cannot become '1'; use a date or time of the same kind",
        ),
        ("toml", "k = 1979-05-27\n", Set("/k", "1980-01-01 # x"), "cannot be"),
        ("toml", "k = 07:32:00\n", Set("/k", "1979-05-27"), "use a date or time of the same kind"),
        ("toml", "a.b = 1\n", Remove("/a/b"), "cannot be changed in its place"),
        ("toml", "[a.b]\n", Add("/a", '{"c": 1}'), "is a table without a header"),
        ("toml", "[a]\n", Add("/a", '{"c": null}'), "cannot contain null; TOML has none"),
        ("toml", "[[a]]\n", Add("/a", "1"), "is a list of tables; add a table to its end"),
        ("toml", "[[a]]\n", Add("/a", "{}", at=0), "is a list of tables; add a table to its end"),
        ("ini", "[s]\na = 1 ; c\n", Set("//a", "2"), "may contain a comment"),
        ("ini", "[s]\na = 1\n  2\n", Set("//a", "2"), "continues on the next line"),
        ("ini", "[s]\na = \"b\" 'c'\n", Set("//a", "2"), "may contain a comment or a part in quotes"),
        ("ini", '[s]\na = "b\\"c"\n', Set("//a", "2"), "has quotes or escapes within quotes"),
        ("ini", "[s]\na:b = 1\n", Set("//a", "2"), "has : and ="),
        ("ini", "[s]\na = 1\n", Set("//a", "1 # 2"), "cannot become '1 # 2'; programs would read it in different ways"),
        ("ini", "[s]\na = 1\n", Set("//a", "x\ny"), "cannot become 'x\\ny'"),
        ("ini", "[s]\na = 1\n", Set("//a", " x"), "cannot become ' x'"),
        ("ini", "[s]\na = 1\n", Set("/s", "x"), "is a mapping; set works on single values"),
        ("ini", "[s]\na = 1\n", Add("/", '{"b": 1}'), "has sections; add keys to one of them"),
        ("ini", "[s]\na = 1\n", Add("/s", '{"b": [1]}'), "cannot contain a list; INI has texts only"),
        ("ini", "[s]\na = 1\n", Rename("//a", "b=c"), "cannot get the key 'b=c'"),
        ("toml", "k = 1979-05-27T07:32:00Z\n", Set("/k", "1979-05-27"), "use a date or time of the same kind"),
        ("toml", "k = 1979-05-27T07:32:00Z\n", Set("/k", "5"), "use a date or time of the same kind"),
        ("yaml", "<<: {k: 1}\nk: 2\n", Set("/key/k", "3"), "is merged by <<, where programs may ignore it; write it beside"),
        ("ini", "[s]\na = 1\\\n", Set("//a", "2"), "continues on the next line"),
        ("ini", "[s]\na: 1\n", Set("//a", "b=c"), "cannot become 'b=c' behind a colon"),
        ("ini", "[s]\na = 1\n", Set("//a", "50%%"), "cannot become '50%%'; programs would read it in different ways"),
        ("ini", "[s]\na = 1\n", Set("//a", "%(b)s"), "cannot become '%(b)s'"),
        ("ini", "[s]\na = \u00a01\n", Set("//a", "2"), "has unusual white space around it"),
        ("ini", "[s]\na = 1\u3000\n", Set("//a", "2"), "has unusual white space around it"),
        ("ini", "[s]\n! b = 1\n  a = 2\n", Set("//a", "2"), "matches nothing"),
        ("properties", "a\\=b = 1\n", Set("/*", "2"), "has an escape"),
        ("properties", "a b = 1\n", Set("/*", "2"), "has white space in its key, where some programs begin the value"),
        ("properties", "a = '1' \n", Set("/a", "2"), "has white space behind its quotes"),
        ("json", JSON, Set("//nothing", "1"), "is null, which has no type"),
        ("json", JSON, Add("/robots", '{"x": 1e-400}'), "cannot contain 1e-400; it is too close to 0"),
        ("json", '{"a": 0.5}', Set("/a", "9" * 350), "cannot become 9999999999999999999999999999999999999999; it is too large"),
    ],
)
def test_a_change_that_a_format_cannot_write_is_refused(format: str, text: str, change: Change, message: str) -> None:
    with pytest.raises(TemplateError) as refused:
        make(format, text).changed((change,), {})
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("text", ["1e400", "-1e400", "1e-400", "-1e-400", "0." + "0" * 330 + "1"])
@pytest.mark.parametrize(
    ("format", "data", "path"),
    [
        ("json", '{"a": 0.5, "i": 3}', "/*"),
        ("yaml", "a: 0.5\ni: 3\n", "/*"),
        ("toml", "a = 0.5\ni = 0x1e\n", "/*"),
        ("ini", "[s]\na = 0.5\n", "//a"),
        ("properties", "a = 0.5\n", "/a"),
        ("xml", "<r><a b='0.5'/></r>", "//@b"),
        ("xml", "<r><a>0</a></r>", "//a"),
        ("xml", "<r><a/></r>", "//a | //@b"),
    ],
)
def test_a_number_that_floats_cannot_represent_is_refused_in_place_of_a_number(
    format: str, data: str, path: str, text: str
) -> None:
    template = make(format, data)
    if not any(template.find(path)):
        assert text in rendered(template, Set(path, text)), "a text stays a text"
        return
    for change in (Set(path, text), Set(path, "{n}")):
        with pytest.raises(TemplateError, match=r"too large|too close to 0") as refused:
            template.changed((), {}).per_run([change])({"n": text})
        assert "\n" not in str(refused.value)
        assert text[:30] in str(refused.value)
    assert rendered(template, Set(path, "1e-310")) == rendered(template, Set(path, "{n}"), n="1e-310")


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


def in_json(data: Any, *, flat: bool) -> str:
    return json.dumps(data, indent=None if flat else "\t", ensure_ascii=flat)


def in_yaml(data: Any, *, flat: bool) -> str:
    return yaml.safe_dump({"top": data}, default_flow_style=flat, allow_unicode=True, width=20)


def in_toml_document(data: Any, *, flat: bool) -> str:
    return in_tables(data) if not flat else "".join(f"{quoted(key)} = {in_toml(value)}\n" for key, value in data.items())


def spelled(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


FORMATS: dict[str, tuple[st.SearchStrategy[Any], Callable[..., str], Callable[[str], Any]]] = {
    "json": (DATA, in_json, json.loads),
    "yaml": (DATA, in_yaml, yaml.safe_load),
    "toml": (st.dictionaries(KEYS, IN_TOML, max_size=4), in_toml_document, tomllib.loads),
}
"""Data of each format, how it is written here, and how another parser reads it."""


@given_in_tiers(st.data(), st.booleans(), st.integers(0, 10**9), st.text(max_size=8), quick=40)
@pytest.mark.parametrize("format", FORMATS)
def test_a_set_value_is_read_back_and_nothing_else_changes(
    format: str, draw: st.DataObject, flat: bool, number: int, text: str
) -> None:
    strategy, write, read = FORMATS[format]
    before = write(draw.draw(strategy), flat=flat)
    known = dict(leaves(read(before)))
    template = make(format, before)
    assert rendered(template) == before
    paths = [path for path, _ in template.attributes()]
    settable = [where for where, (_, value) in known.items() if value is not None]
    assert len(paths) == len(settable) or format == "yaml", "aliases and some spellings cannot be set in YAML"
    if not paths:
        return
    index = draw.draw(st.integers(0, len(paths) - 1))
    path, old = paths[index], template.find(paths[index])[0]
    for value in (str(number), "true", text.replace("{", "{{").replace("}", "}}")):
        try:
            after = rendered(template, Set(path, value))
        except TemplateError as error:
            if re.search("is the number|is a boolean|too large", str(error)):
                continue
            raise
        now = dict(leaves(read(after)))
        different = [where for where in known if known[where] != now[where]]
        assert len(different) <= 1
        assert different in ([], settable[index : index + 1]) or format == "yaml"
        assert known.keys() == now.keys()
        for where in different:
            (was, _), (kind, read_back) = known[where], now[where]
            assert was == kind or ({was, kind} == {"int", "float"} and not (format == "json" and value.isdecimal()))
            assert spelled(read_back) == value.replace("{{", "{").replace("}}", "}") or float(read_back) == float(value)
        found = template.reread(after.encode(), "after").find(path)[0]
        assert found == value.replace("{{", "{").replace("}}", "}") or float(found) == float(value)
        assert different or found == old or float(found) == float(old)
