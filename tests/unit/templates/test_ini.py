"""INI and properties templates."""

from __future__ import annotations

import configparser

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.errors import TemplateError
from sierra.model import Add, Remove, Rename, Set
from sierra.testing import templates as conformance
from tests.trees import make, only_line, rendered

INI = """\
; a swarm
[swarm]
count = 8
  # indented comment
name="blue"
speed: 5.0

[General]
**.host[*].x = 5s
empty =
"""
PROPERTIES = """\
# a swarm
! another comment
swarm.count=8
  swarm.name : blue
"""


@pytest.mark.parametrize(
    ("format", "data", "places"),
    [
        ("ini", INI, ["/swarm/name", "/swarm/count", "//empty"]),
        ("properties", PROPERTIES, ["/swarm.name", "/swarm.count"]),
    ],
)
def test_the_format_passes_the_conformance_suite(format: str, data: str, places: list[str]) -> None:
    conformance.check(lambda data, name: make(format, data, name), data.encode(), places)
    conformance.check(lambda data, name: make(format, data, name), data.replace("\n", "\r\n").encode(), places)


def test_changes_keep_the_layout() -> None:
    template = make("ini", INI)
    made = rendered(template, Set("//count", "9"), Set("//name", "a b"), Set("//key[@name='**.host[*].x']", "{n}s"), n=6)
    assert only_line(INI, made) == [
        ("count = 8", "count = 9"),
        ('name="blue"', 'name="a b"'),
        ("**.host[*].x = 5s", "**.host[*].x = 6s"),
    ]
    assert rendered(template, Set("//speed", "5")) == INI
    assert rendered(template, Set("//empty", "1")) == INI.replace("empty =\n", "empty =1\n")
    assert rendered(template, Add("/swarm", '{"k": "v", "n": 1}')) == INI.replace("5.0\n", "5.0\nk: v\nn: 1\n")
    assert rendered(template, Add("/", '{"new": {"k": true}}')) == INI + "[new]\nk = true\n"
    assert rendered(template, Remove("//name"), Remove("/General")) == INI[: INI.index("[General]")].replace(
        'name="blue"\n', ""
    )
    assert rendered(template, Rename("//count", "number"), Rename("/swarm", "s")) == INI.replace("count", "number").replace(
        "[swarm]", "[s]"
    )
    assert rendered(make("properties", PROPERTIES), Add("/", '{"k": 1}')) == PROPERTIES + "k : 1\n"


def test_values_of_properties_with_escapes_are_not_set() -> None:
    with pytest.raises(TemplateError, match="continues on the next line"):
        make("properties", "a = b\\\n  c\nd = 1\n").changed((Set("/a", "2"),), {})
    with pytest.raises(TemplateError, match="cannot become 'ü'"):
        make("properties", "a = 1\n").changed((Set("/a", "ü"),), {})


def test_white_space_behind_a_value_of_properties_is_replaced_with_it() -> None:
    """Java reads it as part of the value."""
    before = "a = 1 \t\r\nb=2\r\n"
    assert rendered(make("properties", before), Set("/a", "1")) == before
    assert rendered(make("properties", before), Set("/a", "3")) == "a = 3\r\nb=2\r\n"


@given(st.text(max_size=12))
def test_the_parser_of_python_reads_the_value_that_was_set(text: str) -> None:
    value = text.replace("{", "{{").replace("}", "}}")
    before = "[s]\na = 1\nb = 2\n"
    try:
        after = rendered(make("ini", before), Set("/s/a", value))
    except TemplateError as error:
        assert "programs would read it in different ways" in str(error)  # noqa: PT017
        return
    parser = configparser.ConfigParser(interpolation=None)
    parser.read_string(after)
    assert dict(parser["s"]) == {"a": text, "b": "2"}
    assert after == before.replace("1", text, 1)
