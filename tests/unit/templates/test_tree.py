"""What all templates of keys, lists and values share."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from sierra import templates
from sierra.errors import ConfigError, TemplateError
from sierra.model import Add, Change, Remove, Rename, Set
from sierra.testing import templates as conformance
from tests.effort import is_cheap
from tests.trees import SAMPLES, TEXT_PLACES, make, rendered


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


@pytest.mark.parametrize("format", SAMPLES)
def test_an_unknown_name_in_an_expression_is_refused(format: str) -> None:
    with pytest.raises(ConfigError, match="unknown name 'n'"):
        make(format, SAMPLES[format]).changed((Add("/robots", '{"x": "{n}"}'),), {})


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
            "its ending names no format, and it does not begin as XML; set template_format to one of xml, json, yaml, toml,",
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
    with pytest.raises(ConfigError, match="unknown template 'jsno'; known are xml, json, yaml, toml, ini, properties"):
        templates.read(tmp_path / "t.conf", format="jsno")


@pytest.mark.parametrize(
    ("format", "text"),
    [
        pytest.param("json", "[" + "0," * 50_000 + "0]", marks=pytest.mark.integration),
        ("json", "[" * 1_000_000),
        ("json", '"' + "\\" * 1_000_001),
        ("yaml", "[" * 1_000_000),
        ("yaml", "a: " + "&a " * 300_000),
        ("yaml", "".join(f"k{number}: *a\n" for number in range(20_000))),
        pytest.param("toml", "".join(f"[a{number}]\n" for number in range(20_000)), marks=pytest.mark.integration),
        ("toml", "a = " + "[" * 100_000),
        pytest.param("toml", 'a = """' + '"' * 2 + "\\" * 1_000_001, marks=pytest.mark.integration),
        pytest.param("ini", "[a]\n" + "".join(f"k{number} = 1\n" for number in range(20_000)), marks=pytest.mark.integration),
        ("ini", "".join(f"[k{number}]\n" for number in range(20_000))),
        ("ini", "[a]\nb" + " " * 1_000_000 + "b"),
        ("ini", "[a]\nb = b" + " " * 1_000_000 + "b"),
        ("ini", "[" * 1_000_000),
        ("text", "{{" * 500_000),
        ("text", "{{" + "a" * 1_000_000),
        ("text", "{" * 1_000_000 + "a}}"),
    ],
)
def test_the_time_for_hostile_files_is_in_proportion(format: str, text: str) -> None:
    def read() -> None:
        with contextlib.suppress(TemplateError):
            make(format, text).changed((), {}).render()

    assert is_cheap(read, 60)
