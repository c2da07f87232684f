"""TOML templates."""

from __future__ import annotations

import pytest

from sierra.model import Add, Remove, Rename, Set
from tests.trees import TOML, make, only_line, rendered


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


def test_a_hexadecimal_number_with_the_digit_e_is_read() -> None:
    template = make("toml", "a = 0x1e\nb = 0xE\n")
    assert (template.find("/a"), template.find("/b")) == (("30",), ("14",))
    assert rendered(template, Set("/a", "30")) == "a = 0x1e\nb = 0xE\n"
    assert rendered(template, Set("/b", "5")) == "a = 0x1e\nb = 5\n"
