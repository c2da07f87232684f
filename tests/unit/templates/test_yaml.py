"""YAML templates."""

from __future__ import annotations

import pytest

from sierra.errors import TemplateError
from sierra.model import Add, Remove, Rename, Set
from tests.trees import YAML, make, only_line, rendered


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
