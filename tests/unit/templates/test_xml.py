from __future__ import annotations

import functools
import hashlib
import os
import re
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from xml.sax.saxutils import escape

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from lxml import etree

from sierra import templates
from sierra.config.plugin_registry import TEMPLATES
from sierra.errors import ConfigError, Missing, SierraError, TemplateError
from sierra.model import Add, Change, Remove, Rename, Set, Value
from sierra.templates.base import Rendered, Template
from sierra.templates.xml import XmlTemplate
from tests import projects
from tests.effort import is_cheap
from tests.properties import given_in_tiers

MUJOCO = """<mujoco model="swarm">
  <option timestep="0.01" integrator="implicitfast"/>
  <custom>
    <numeric name="random_seed" data="42"/>
    <numeric name="noise" data="0.3"/>
  </custom>
  <visual><global offwidth="640" offheight="480"/></visual>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1" rgba=".8 .8 .8 1"/>
    <replicate count="8" offset="0.35 0 0" euler="0 0 0.4">
      <body name="robot" pos="0.5 0 0.12">
        <joint name="x" type="slide" axis="1 0 0" damping="2"/>
        <joint name="y" type="slide" axis="0 1 0" damping="2"/>
      </body>
    </replicate>
  </worldbody>
  <actuator/>
</mujoco>
"""
GAZEBO = """<?xml version="1.0"?>
<sdf version="1.6">
  <world name="swarm">
    <include><uri>model://ground_plane</uri></include>
    <physics type="ode">
      <max_step_size>0.01</max_step_size>
    </physics>
    <population name="robots">
      <model_count>8</model_count>
      <distribution><type>random</type></distribution>
    </population>
  </world>
</sdf>
"""
SUMO = """<routes>
  <vType id="agent" accel="1.0" sigma="0.5" speedFactor="normc(1,0.1,0.5,1.5)"/>
  <flow id="agents" type="agent" begin="0" end="60" number="8" departPos="random_free"/>
</routes>

"""
NAMESPACES = """<sdf xmlns="urn:sdf" xmlns:a="urn:a" a:version="1">
  <a:robot name="r"/>
  <world><deep xmlns:b="urn:b"><b:x b:y="1"/></deep></world>
</sdf>
"""
SEED = Set("//numeric[@name='random_seed']/@data", "{seed}")


def template(text: str | bytes, name: str = "template.xml") -> Template:
    return XmlTemplate(text.encode() if isinstance(text, str) else text, name)


def changed(text: str | bytes, *changes: Change, **values: Value) -> str:
    return template(text).changed(changes, values).render().decode()


def refused(text: str | bytes, *changes: Change, error: type[SierraError] = TemplateError, **values: Value) -> str:
    with pytest.raises(error) as caught:
        template(text).changed(changes, values)
    assert str(caught.value).isprintable(), "one line"
    return str(caught.value)


# Reading


def test_a_file_with_any_name_is_read(tmp_path: Path) -> None:
    for name in ("template.xml", "swarm.world", "swarm.rou.xml", "no ending", 'a\'; echo "ü"\n.launch'):
        file = tmp_path / name
        file.write_text(MUJOCO)
        read = templates.read(file)
        assert read.find("//replicate/@count") == ("8",)
        assert read.sha256 == hashlib.sha256(MUJOCO.encode()).hexdigest()


def test_texts_of_elements_are_proposed_with_their_paths() -> None:
    assert template("<a><seed>3</seed><robots>4</robots></a>").attributes() == (("//seed", "3"), ("//robots", "4"))


@pytest.mark.integration
@pytest.mark.parametrize("element", ["<b c='1'/>", "<b xmlns='urn:b' c='1'/>", "<b id='{n}' c='1'/>"])
def test_the_time_to_propose_paths_grows_linearly(element: str) -> None:
    def seconds(count: int) -> float:
        many = template(f"<a>{''.join(element.format(n=n) for n in range(count))}</a>")
        taken = []
        for _ in range(3):
            begin = time.process_time()
            many.attributes()
            taken.append(time.process_time() - begin)
        return min(taken)

    assert seconds(10_000) < 12 * max(
        seconds(2_500), 0.005
    )  # four times as many elements; quadratic growth would take 16 times as long


def test_xml_is_the_first_template_format() -> None:
    assert TEMPLATES.names()[0] == "xml"


@pytest.mark.parametrize("text", [MUJOCO, GAZEBO, SUMO, NAMESPACES])
def test_real_templates_are_rendered_byte_for_byte(text: str) -> None:
    assert changed(text) == text


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("<?xml version='1.0'  encoding='utf-8' standalone = 'yes' ?>\n", "\n"),
        ("<?xml version='1.1'?><!-- 'odd > \" -->\n\n<?target some='data'?>\n", "<!-- end -->\n<?last?>\n\n"),
        ('\ufeff<?xml version="1.0"?>', ""),
        ('<!DOCTYPE  root   SYSTEM "a>b.dtd"  [ <!-- ]> \' <!ENTITY --> <!ELEMENT root ANY>\n]  >\n', "\n"),
        ("<!DOCTYPE root PUBLIC \"-//A//B\" 'c.dtd'>\n<!-- <root> -->", "<!-- </root> -->"),
    ],
)
def test_content_around_the_root_is_kept_byte_for_byte(before: str, after: str) -> None:
    text = f'{before}<root a="1"/>{after}'
    assert changed(text) == text
    assert changed(text, Set("/root/@a", "2")) == text.replace('a="1"', 'a="2"')


@pytest.mark.parametrize(
    "root",
    [
        "<r>a<!-- b -->c<?d e?>f<![CDATA[<g> & h]]>i</r>",
        "<r>&lt;&amp;&gt; ' \" é € 𝄞</r>",
        '<r a="&lt;&amp;&gt; \' &quot; &#10;&#9; é"/>',
        '<r xml:space="preserve"> \n\t <a/> <b/>\n\n </r>',
        '<r xmlns="u" xmlns:p="v"><p:a xmlns=""><b/></p:a></r>',
        '<r xmlns:xi="http://www.w3.org/2001/XInclude"><xi:include href="/etc/passwd" parse="text"/></r>',
    ],
)
def test_content_of_the_root_is_kept_byte_for_byte(root: str) -> None:
    assert changed(root) == root


@pytest.mark.parametrize(
    "text",
    [
        "<r  a='1' ><b /><c></c>&#233;</r >",
        "<r\n  a = '&#49;'\n  b=\"&quot;'\">&quot;&#x41;</r\n>",
        "<r>\r\n<a/>\n<b/>\r</r>\n",
        "<r><![CDATA[]]><![CDATA[a]]>b</r>",
        '<!DOCTYPE r SYSTEM "x.dtd"><r a="1&u;2">3&v;4</r>',
        '<!DOCTYPE r [<!ATTLIST r a NMTOKENS #IMPLIED>]><r a="  1   2 "> </r>',
        '<!DOCTYPE r [<!ATTLIST r xmlns CDATA "urn:d" xmlns:q CDATA "urn:q">]><r><q:b q:c="1"/></r>',
    ],
)
def test_the_way_in_which_a_document_is_written_is_kept(text: str) -> None:
    assert changed(text) == text
    set_there = changed(text, Set("/*", "5", attribute="new"), Set("//@new", "6"))
    assert set_there.replace(' new="6"', "") == text
    added = changed(text, Add("/*", "<n>1</n>"), Set("//*[local-name()='n']", "2"), Remove("//*[local-name()='n']"))
    assert added == text


NAMES = st.sampled_from(["a", "b", "robot", "Größe", "x-1", "_"])
CHARACTERS = st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"], exclude_characters="\ufffe\uffff") | st.just("\n")
TEXTS = st.text(CHARACTERS, max_size=8)


@st.composite
def elements(draw: st.DrawFn, depth: int = 3) -> str:
    """Draw an element, written as libxml2 writes it."""
    attributes = draw(st.dictionaries(NAMES, TEXTS, max_size=3)).items()
    written = "".join(f' {name}="{escape(text, {chr(34): "&quot;", chr(10): "&#10;"})}"' for name, text in attributes)
    name = draw(NAMES)
    content = draw(st.lists(contents(depth), max_size=3))
    return f"<{name}{written}>{''.join(content)}</{name}>" if any(content) else f"<{name}{written}/>"


def contents(depth: int) -> st.SearchStrategy[str]:
    inner = [elements(depth - 1)] if depth else []
    return st.one_of(
        TEXTS.map(escape),
        st.just("\n    "),
        TEXTS.filter(lambda text: "-" not in text).map(lambda text: f"<!--{text}-->"),
        TEXTS.filter(lambda text: "]]>" not in text and text).map(lambda text: f"<![CDATA[{text}]]>"),
        st.just("<?pi and > more?>"),
        *inner,
    )


AROUND = st.lists(st.sampled_from(["\n", "<!-- <x y='>' -->", "<?p <z> ?>", "  "])).map("".join)


@pytest.mark.integration
@given(elements(), AROUND, AROUND)
def test_an_untouched_template_is_rendered_byte_for_byte(root: str, before: str, after: str) -> None:
    text = before + root + after
    assert changed(text) == text


@pytest.mark.parametrize(
    ("encoding", "declared"),
    [("latin-1", "ISO-8859-1"), ("ascii", "US-ASCII"), ("cp1252", "windows-1252"), ("utf-16", "UTF-16")],
)
def test_the_encoding_of_a_template_is_kept(encoding: str, declared: str) -> None:
    sign = "é" if encoding != "ascii" else "e"
    data = f'<?xml version="1.0" encoding="{declared}"?>\n<r a="{sign}">{sign}</r>\n'.encode(encoding)
    assert template(data).changed((), {}).render() == data
    assert template(data).find("//@a") == (sign,)


def test_characters_that_the_encoding_lacks_become_references() -> None:
    data = '<?xml version="1.0" encoding="ISO-8859-1"?><r é="1">ü</r>'.encode("latin-1")
    for make in (changes_made, per_run_made):
        made = make(template(data), [Set("/r/@é", "€ é"), Set("/r", "𝄞")], {})
        assert made == data.replace(b'"1">\xfc<', b'"&#8364; \xe9">&#119070;<')
        assert XmlTemplate(made, "made").find("//@é") == ("€ é",)


def test_characters_that_the_encoding_changes_become_references() -> None:
    """Python writes a yen sign in EUC-JP as a backslash; the second value of a place is checked as the first is."""
    data = '<?xml version="1.0" encoding="EUC-JP"?><r a="x">あ</r>'.encode("euc-jp")
    per_run = template(data).changed((), {}).per_run([Set("/r/@a", "{value}")])
    assert per_run({"value": "\\"}) == data.replace(b'"x"', b'"\\"')
    assert per_run({"value": "¥あ"}) == data.replace(b'"x"', '"&#165;あ"'.encode("euc-jp"))
    added = changes_made(template(data), [Add("/r", "<b c='{value}'/>")], {"value": "¥あ"})
    assert added.endswith('あ<b c="&#165;あ"/></r>'.encode("euc-jp"))
    assert "write &#8364; for €" in refused(data, Add("/r", "<!-- ¥ --><b/>"))


@pytest.mark.parametrize("encoding", ["EUC-JP", "Shift_JIS", "CP932", "GB18030", "Big5", "EUC-KR", "windows-1252"])
def test_a_value_is_read_back_or_refused_in_all_ways_of_changing(encoding: str) -> None:
    """Libraries read some bytes of these encodings differently."""
    made = template(f'<?xml version="1.0" encoding="{encoding}"?>\n<r a="x">y<b/></r>'.encode())
    sets = [Set("/r/@a", "{value}"), Set("/r/text()", "{value}"), Set("//b", "{value}", attribute="c")]
    per_run = made.changed((), {}).per_run(sets)
    per_run({"value": "first"})
    for character in "\\~¥‾\uff5e∥￣￢갂ḿあé€":
        values = {"value": character}
        ways = {
            read_or_refused(partial(per_run, values)),
            read_or_refused(partial(changes_made, made, sets, values)),
            read_or_refused(partial(changes_made, made, [*sets, Rename("//b", "d")], values)),
            read_or_refused(partial(changes_made, made, [Rename("//b", "b"), *sets], values)),
        }
        assert ways in ({(character,) * 3}, {("refused",)})


def read_or_refused(make: Callable[[], Rendered]) -> tuple[str, ...]:
    try:
        root = etree.fromstring(make())
    except TemplateError as error:
        return ("refused",) if str(error).isprintable() else (str(error), "is not one line")
    return str(root.get("a")), str(root.text), str(root[0].get("c"))


@pytest.mark.parametrize(
    ("encoding", "codec"), [("ISO-8859-1", "latin-1"), ("ISO-8859-15", "iso8859-15"), ("windows-1252", "cp1252")]
)
def test_all_libraries_read_the_encodings_of_single_bytes_alike(encoding: str, codec: str) -> None:
    text = bytes(range(128, 256)).decode(codec, "ignore")
    data = f'<?xml version="1.0" encoding="{encoding}"?><r>{text}</r>'.encode(codec)
    assert etree.fromstring(data).text == text == template(data).find("/r")[0]


def test_names_with_characters_that_the_encoding_lacks_are_refused() -> None:
    data = b'<?xml version="1.0" encoding="ISO-8859-1"?><r/>'
    for change in (Rename("//r", "\u03b1"), Set("//r", "", attribute="\u03b1"), Add("//r", "<a><!-- \u03b1 --></a>")):
        assert "8859-1" in refused(data, change).replace("_", "-").lower()
    assert template(data).changed([Add("//r", "<a>&#945;</a>")], {}).render().endswith(b"<r><a>&#945;</a></r>")


def test_line_ends_of_windows_are_kept_if_all_lines_have_them() -> None:
    text = MUJOCO.replace("\n", "\r\n")
    assert changed(text) == text
    assert changed(text, Set("//body", "a\nb\rc")).count("a\r\nb&#13;c") == 1
    assert per_run_made(template(text), [Set("//body", "a\nb\rc")], {}).count(b"a\r\nb&#13;c") == 1
    mixed = "<r a=''>\r\n</r>\n"
    assert changed(mixed) == mixed
    assert changed(mixed, Set("/r", "a\nb")) == "<r a=''>a\nb</r>\n"


# Hostile templates

BOMB = "".join(f'<!ENTITY l{n} "{(f"&l{n - 1};" if n else "lol") * 10}">' for n in range(12))
QUADRATIC = f'<!DOCTYPE r [<!ENTITY a "{"x" * 50_000}">]><r b="{"&a;" * 50_000}">{"&a;" * 50_000}</r>'


@pytest.mark.parametrize(
    "hostile",
    [
        f"<!DOCTYPE r [{BOMB}]><r>&l11;</r>",
        f'<!DOCTYPE r [{BOMB}]><r a="&l11;"/>',
        f"<!DOCTYPE r [{BOMB}]><r/>",
        QUADRATIC,
        '<!DOCTYPE r [<!ENTITY a "b">]><r>&a;</r>',
        '<!DOCTYPE r [<!-- it\'s --><!ENTITY a "b">]><r/>',
        '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><r>&a;</r>',
        '<!DOCTYPE r [<!ENTITY % a SYSTEM "http://127.0.0.1:9/a.dtd"> %a;]><r/>',
        '<!DOCTYPE r [<!ENTITY a SYSTEM "/etc/passwd" NDATA b>]><r/>',
        "<a>" * 100_000,
        f"<r>{'x' * 11_000_000}</r>",
    ],
    ids=range(11),
)
def test_entities_and_entity_bombs_are_refused_quickly(hostile: str) -> None:
    assert refused(hostile).startswith("template.xml:")
    assert is_cheap(lambda: refused(hostile), 20)


def test_an_external_dtd_is_not_loaded(tmp_path: Path) -> None:
    dtd = tmp_path / "a.dtd"
    dtd.write_text('<!ENTITY a "expanded"><!ATTLIST r b CDATA "defaulted">')
    text = f'<!DOCTYPE r SYSTEM "{dtd.as_uri()}">\n<r>&a;</r>'
    assert changed(text) == text
    assert template(text).find("//r | //@b") == ("",)


def test_default_attributes_are_not_written_out() -> None:
    text = '<!DOCTYPE r [<!ATTLIST r b CDATA "defaulted">]>\n<r/>'
    assert changed(text) == text


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", r"^template\.xml:1:1: not XML: Document is empty"),
        (b" \n", r"^template\.xml:\d+:\d+: not XML"),
        (b"[a]\nb = 1", r"^template\.xml:1:1: not XML: Start tag expected"),
        (b"<r>\n  <a></b>\n</r>", r"^template\.xml:2:\d+: not XML: Opening and ending tag mismatch"),
        (b"<r/><r/>", "not XML: Extra content"),
        (b"<p:r/>", "not XML: Namespace prefix p"),
        (b"<r>&unknown;</r>", "Entity 'unknown' not defined"),
        (b'<?xml version="1.0" encoding="no-such"?><r/>', "Unsupported encoding"),
        (b"<r>\xff</r>", "not XML"),
        (b"<r>\x00</r>", "not XML"),
        (b"\x89PNG\r\n\x1a\n\x00", "not XML"),
        ("<r/>".encode("utf-32"), "save it as UTF-8|not XML"),
    ],
)
def test_invalid_xml_is_reported_with_its_position(data: bytes, message: str) -> None:
    assert re.search(message, refused(data))


@given(st.binary(max_size=60) | st.text(alphabet="<>!?[]-/'\"= &;#xarDOCTYPE%", max_size=60).map(str.encode))
def test_any_bytes_are_a_template_or_are_refused(data: bytes) -> None:
    message = ""
    try:
        made = template(data).changed((), {}).render()
    except TemplateError as error:
        message = str(error)
    else:
        assert XmlTemplate(made, "again").changed((), {}).render() == made
    assert message.isprintable()


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    for path in (tmp_path / "none.xml", tmp_path / "a\nb", tmp_path / "nul\0"):
        with pytest.raises(Missing, match=r"cannot read the template$") as caught:
            templates.read(path)
        assert str(caught.value).isprintable()


def test_a_directory_or_a_pipe_is_not_a_template(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(TemplateError, match="not a file"):
            templates.read(path)


# Paths


def test_find_returns_texts_in_document_order() -> None:
    assert template(MUJOCO).find("//joint/@name | //replicate/@count") == ("8", "x", "y")
    assert template(GAZEBO).find("//model_count") == ("8",)
    assert template(GAZEBO).find("//type/text()") == ("random",)
    assert template(GAZEBO).find("//nothing") == ()


def test_a_relative_path_starts_at_the_root_element() -> None:
    assert template(SUMO).find("flow/@number") == template(SUMO).find("/routes/flow/@number") == ("8",)


def test_paths_may_use_the_documents_prefixes_and_underscore_for_the_default() -> None:
    found = template(NAMESPACES)
    assert found.find("//a:robot/@name") == ("r",)
    assert found.find("/_:sdf/@a:version") == ("1",)
    assert found.find("//b:x/@b:y") == ("1",)
    assert found.find("//*[local-name()='robot']/@name") == ("r",)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("//[", "is not an XPath"),
        ("", "is not an XPath"),
        ("//p:a", "Undefined namespace prefix; known prefixes are _, a, b"),
        ("//a\0", "is not an XPath"),
        ("nope()", "is not an XPath"),
        ("$x", "is not an XPath"),
        ("count(//*)", "returns a number"),
        ("string(//*)", "returns a string"),
        ("1 = 1", "returns a boolean"),
        ("//namespace::*", "selects namespaces"),
    ],
)
def test_a_path_that_does_not_select_nodes_is_refused(path: str, message: str) -> None:
    with pytest.raises(TemplateError, match=message) as caught:
        template(NAMESPACES).find(path)
    assert str(caught.value).isprintable()
    assert message in refused(NAMESPACES, Set(path, "1", why="variable 'x'"))


def test_paths_cannot_read_other_documents() -> None:
    assert "is not an XPath" in refused("<r/>", Set("document('/etc/passwd')//x", "1"))


# Changes


def test_set_changes_the_value_of_attributes_elements_and_texts() -> None:
    assert 'count="16"' in changed(MUJOCO, Set("//replicate/@count", "{population_size * 2}"), population_size=8)
    assert "<model_count>16</model_count>" in changed(GAZEBO, Set("//model_count", "16"))
    assert "<type>grid</type>" in changed(GAZEBO, Set("//distribution/type/text()", "{kind}"), kind="grid")


def test_set_changes_all_matches() -> None:
    assert changed(MUJOCO, Set("//joint/@damping", "5")) == MUJOCO.replace('damping="2"', 'damping="5"')


def test_set_keeps_the_children_of_an_element() -> None:
    assert changed("<r>\n <b/></r>", Set("/r", "x")) == "<r>x<b/></r>"
    assert changed("<r>a<b/>c</r>", Set("/r/text()[2]", "x")) == "<r>a<b/>x</r>"
    for text in ("<r>a<b/></r>", "<r><b/>c</r>", "<r><!-- d -->a<b/></r>"):
        message = refused(text, Set("/r", "x", why="variable 'v'"))
        assert message.startswith("variable 'v': /r has text beside child elements in template.xml; set an element without")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("<!-- robots -->5", "<!-- robots -->2"),
        ("5<!-- robots -->", "2<!-- robots -->"),
        ("<!-- robots -->", "2<!-- robots -->"),
        (" <!-- a -->\n <?b c?> 5 ", "<!-- a --><?b c?>2"),
        ("4<!-- a --> <?b c?>5\n", "2<!-- a --><?b c?>"),
        ("<!-- <count>1</count> --><![CDATA[5]]><!-- b -->6&#55;", "<!-- <count>1</count> --><![CDATA[2]]><!-- b -->"),
        ("5<!-- a -->\n<![CDATA[6]]><?b?><![CDATA[7]]>8", "2<!-- a --><![CDATA[]]><?b?>"),
    ],
)
def test_a_value_takes_the_place_of_all_text_around_comments(before: str, after: str) -> None:
    text = f"<r>\n <count>{before}</count>\n <b/></r>"
    written = f"<r>\n <count>{after}</count>\n <b/></r>"
    for path in ("//count", "//count/text()", "//count/node()[self::text()]"):
        if "text" not in path or XmlTemplate(text.encode(), "t").find(path):
            assert changed(text, Set(path, "2", expect=1)) == written
            assert per_run_made(template(text), [Set(path, "7"), Set(path, "2")], {}) == written.encode()
            assert (
                changed(text, Set(path, "7"), Set("//b", "1", attribute="c"), Set(path, "2")).replace(' c="1"', "") == written
            )
    assert XmlTemplate(written.encode(), "t").find("//count") == ("2",)
    assert ("//count", "2") in XmlTemplate(written.encode(), "t").attributes()
    again = template(text).find("//count")[0]
    assert changed(text, Set("//count", again.replace("{", "{{"))) == text, "set to itself"


def test_a_value_that_cdata_cannot_hold_becomes_a_usual_text() -> None:
    data = '<?xml version="1.0" encoding="ISO-8859-1"?><r><!-- a --><![CDATA[x]]></r>'.encode("latin-1")
    for value, written in (
        ("<&", "<![CDATA[<&]]>"),
        ("]]>", "]]&gt;"),
        ("a\rb", "a&#13;b"),
        ("€", "&#8364;"),
        ("", "<![CDATA[]]>"),
    ):
        made = changes_made(template(data), [Set("/r", value)], {})
        assert made.decode("latin-1").endswith(f"<r><!-- a -->{written}</r>")
        assert made == per_run_made(template(data), [Set("/r", "{v}")], {"v": value})
        assert template(made).find("/r") == (value,)


def test_a_text_beside_a_reference_cannot_be_set() -> None:
    for text in ("<r>&u;5</r>", "<r>5<!-- c -->&u;</r>", "<r>&u;</r>"):
        message = refused(f'<!DOCTYPE r SYSTEM "r.dtd">{text}', Set("/r", "2"))
        assert message == "/r has the reference &u; beside its text in template.xml; write its text there instead"
    assert 'a="2"' in changed('<!DOCTYPE r SYSTEM "r.dtd"><r a="&u;"/>', Set("/r/@a", "2"))


def test_set_with_attribute_adds_missing_attributes() -> None:
    assert changed("<r><a/><a b='1'/></r>", Set("//a", "2", attribute="b")) == """<r><a b="2"/><a b='2'/></r>"""


def test_set_with_attribute_accepts_prefixes_of_the_document() -> None:
    assert '<a:robot name="r" a:id="7"/>' in changed(NAMESPACES, Set("//a:robot", "7", attribute="a:id"))
    assert 'xml:lang="de"' in changed(SUMO, Set("//flow", "de", attribute="xml:lang"))
    assert "known are" in refused(SUMO, Set("//flow", "1", attribute="p:x"))


@pytest.mark.parametrize("name", ["", "1a", "a b", "a>", "xmlns", "xmlns:p", "{a", "a:", "\0", 'a="1" b'])
def test_invalid_xml_names_are_refused(name: str) -> None:
    refused(SUMO, Set("//flow", "1", attribute=name))
    refused(SUMO, Rename("//flow", name))


def test_changes_are_applied_in_order_and_see_earlier_ones() -> None:
    made = changed(SUMO, Rename("//flow", "vehicle"), Set("//vehicle", "1", attribute="a"), Set("//@a", "2"))
    assert '<vehicle id="agents"' in made
    assert ' a="2"' in made


def test_a_template_never_changes() -> None:
    made = template(MUJOCO)
    document = made.changed([SEED, Remove("//actuator")], {"seed": 1})
    document.per_run([SEED])({"seed": 2})
    assert made.changed((), {}).render() == MUJOCO.encode()
    assert 'data="1"' in document.render().decode()


@given(st.text() | st.text(alphabet="\r\n\t <>&\"'{}]\0\x0b€é"))
@example("]]>")
@example("\x85\u2028")
@example("\ud800")
@example("\uffff")
def test_any_text_that_is_set_is_read_back_or_refused(text: str) -> None:
    value = text.replace("{", "{{").replace("}", "}}")
    changes = [Set("/r/@a", value), Set("/r/b", value), Set("/r/c/text()", value), Set("/r/b", value, attribute="d")]
    begin = template("<r a='1'><b/><c>1</c></r>")
    if re.search("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", text):
        for change in changes:
            with pytest.raises(TemplateError, match="XML does not allow it"):
                begin.changed([change], {})
        return
    made = begin.changed(changes, {}).render()
    assert XmlTemplate(made, "made").find("/r/@a | /r/b | /r/c | //@d") == (text,) * 4


def test_a_value_that_xml_cannot_contain_is_refused_with_the_name_of_the_change() -> None:
    message = refused(SUMO, Set("//flow/@number", "a\0b", why="variable 'x'"))
    assert message == "variable 'x': //flow/@number cannot contain the character U+0000 in template.xml: XML does not allow it"


def test_an_unknown_name_in_an_expression_is_reported_with_the_name_of_the_change() -> None:
    message = refused(SUMO, Set("//flow/@number", "{n}", why="variable 'x'"), error=ConfigError, m=1)
    assert message.startswith("variable 'x': unknown name 'n'")


def test_add_appends_a_copy_to_each_match() -> None:
    made = changed(MUJOCO, Add("//custom", '<numeric name="length" data="{n}"/>'), n=60)
    last = '    <numeric name="noise" data="0.3"/>\n'
    assert made == MUJOCO.replace(last, last + '    <numeric name="length" data="60"/>\n')


def test_add_inserts_a_copy_at_an_index_of_the_child_elements() -> None:
    text = "<r>\n  <!-- c -->\n  <a/>\n  <b/>\n</r>"
    assert changed(text, Add("/r", "<x/>", at=0)) == text.replace("<a/>", "<x/>\n  <a/>")
    assert changed(text, Add("/r", "<x/>", at=1)) == text.replace("<b/>", "<x/>\n  <b/>")
    assert changed(text, Add("/r", "<x/>", at=2)) == text.replace("<b/>", "<b/>\n  <x/>")
    assert "has 2 child elements" in refused(text, Add("/r", "<x/>", at=3))


def test_elements_added_to_an_empty_element_on_its_own_line_are_indented() -> None:
    made = changed(MUJOCO, Add("//actuator", "<motor/>"), Add("//joint[1]", "<a/>"), Add("//global", "<b/>"))
    assert "\n  <actuator>\n    <motor/>\n  </actuator>\n" in made
    assert 'damping="2">\n          <a/>\n        </joint>\n' in made
    assert '<visual><global offwidth="640" offheight="480"><b/></global></visual>' in made
    assert changed("<r/>", Add("/r", "<a/>")) == "<r><a/></r>"
    assert changed("<r>text <b/></r>", Add("/r", "<a/>")) == "<r>text <b/><a/></r>"


def test_added_elements_inherit_the_namespaces_of_their_place() -> None:
    made = changed(NAMESPACES, Add("//_:world", '<light a:on="1"/>'), Set("//_:light/@a:on", "2"))
    assert '<light a:on="2"/>' in made
    assert "xmlns" not in made.replace(NAMESPACES.splitlines()[0], "").replace('xmlns:b="urn:b"', "", 1)


def test_an_added_namespace_can_be_used_in_later_paths() -> None:
    made = changed(SUMO, Add("/routes", '<n:x xmlns:n="urn:n" y="1"/>'), Set("//n:x/@y", "2"))
    assert '<n:x xmlns:n="urn:n" y="2"/>' in made


def test_a_value_cannot_become_markup() -> None:
    made = changed(SUMO, Add("/routes", '<p a="{v}">{v}<b/>{v}</p>'), v='"/><evil/>&amp;')
    assert XmlTemplate(made.encode(), "made").find("//p/@a | //p | //p/text()[2]") == ('"/><evil/>&amp;',) * 3
    assert XmlTemplate(made.encode(), "made").find("//evil") == ()


@pytest.mark.parametrize(
    "xml",
    [
        "",
        "text",
        "<a>",
        "<a/><b/>",
        "text<a/>",
        "<!-- c -->",
        "</_><_>",
        "<p:a/>",
        "<a>&b;</a>",
        "<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>",
        "<?xml version='1.0'?><a/>",
        "<a>\0</a>",
        "<a b='{1 +}'/>",
    ],
)
def test_only_one_safe_element_can_be_added(xml: str) -> None:
    message = refused(SUMO, Add("//flow", xml, why="scenario 'x'"), error=SierraError)
    assert message.startswith("scenario 'x': ")


def test_remove_deletes_an_element_with_its_line_and_keeps_the_following_text() -> None:
    text = "<r>\n  <a/>\n  <b/>\n</r>"
    assert changed(text, Remove("//a")) == "<r>\n  <b/>\n</r>"
    assert changed(text, Remove("//b")) == "<r>\n  <a/>\n</r>"
    assert changed(text, Remove("//*[not(*)]")) == "<r>\n</r>"
    assert changed("<r>one <a/>two <b/>three</r>", Remove("//a"), Remove("//b")) == "<r>one two three</r>"
    assert changed("<r><![CDATA[<]]><a/></r>", Remove("//a")) == "<r><![CDATA[<]]></r>"


def test_remove_deletes_attributes_and_comments() -> None:
    assert changed("<r a='1'  b='2'/>", Remove("//@a")) == "<r  b='2'/>"
    assert changed("<r>1<!-- c -->2<?p?></r>", Remove("//comment()"), Remove("//processing-instruction()")) == "<r>12</r>"


def test_remove_deletes_matches_within_removed_elements() -> None:
    assert changed("<r><a><a/>x</a>y</r>", Remove("//a", expect=2)) == "<r>y</r>"


def test_removing_the_root_or_a_text_is_refused() -> None:
    assert "the root element" in refused(SUMO, Remove("/routes"))
    assert "texts" in refused(GAZEBO, Remove("//type/text()"))


def test_rename_keeps_the_namespace_unless_another_is_given() -> None:
    assert changed(NAMESPACES, Rename("//a:robot", "drone")) == NAMESPACES.replace("a:robot", "a:drone")
    assert changed(NAMESPACES, Rename("//_:world", "a:w")).count("a:w>") == 2
    assert "<b:robot " in changed(NAMESPACES, Rename("//b:x", "robot"))
    assert "<a:c " in changed(NAMESPACES, Rename("//b:x", "{urn:a}c"))
    assert changed(SUMO, Rename("/routes", "r")).startswith("<r>\n")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (Set("//@id", "1", attribute="b"), "selects attributes in template.xml; set works on elements"),
        (Add("//@id", "<a/>"), "selects attributes in template.xml; add works on elements"),
        (Rename("//@id", "a"), "selects attributes in template.xml; rename works on elements"),
        (Set("/", "1"), ""),
    ],
)
def test_changes_of_unsuitable_nodes_are_refused(change: Change, message: str) -> None:
    assert message in refused(SUMO, change)


def test_a_comment_cannot_be_set() -> None:
    assert "comments" in refused("<r><!-- c --></r>", Set("//comment()", "x"))


def test_a_number_of_matches_other_than_expected_is_refused() -> None:
    changed(MUJOCO, Set("//joint/@damping", "1", expect=2), Remove("//joint", expect=2))
    message = refused(MUJOCO, Set("//joint/@damping", "1", expect=1, why="variable 'd'"))
    assert message == "variable 'd': //joint/@damping matches 2 in template.xml, not 1 as expected"
    assert "matches 2" in refused(MUJOCO, Remove("//joint", expect=3))


def test_a_text_with_cdata_sections_is_one_match() -> None:
    assert changed("<r>a<![CDATA[b]]>c</r>", Set("/r/text()", "x", expect=1)) == "<r>x</r>"


def test_a_number_in_cdata_sections_that_is_set_to_itself_stays() -> None:
    text = "<r><![CDATA[.]]><![CDATA[0]]><!-- b --></r>"
    for path in ("/r", "//text()[1]"):
        assert changed(text, Set(path, "0")) == text, ".0 is 0"
        assert changed(text, Set(path, "1")) == "<r>1<!-- b --></r>"
        assert changed(text.replace("[0]", "[5]"), Set(path, "0")) == "<r>0<!-- b --></r>"


def test_a_text_that_is_empty_is_no_match() -> None:
    for text, changes in (("<r><a><![CDATA[]]></a></r>", []), ("<r><a>1</a></r>", [Set("//a", "")])):
        message = refused(text, *changes, Set("//a/text()", "x"))
        assert "matches nothing" in message
        assert changed(text, *changes, Set("//a", "x")) == "<r><a>x</a></r>"


def test_a_new_prefix_is_the_same_for_changes_together_and_one_by_one() -> None:
    text = "<r><a/><b/><c/></r>"
    renamed = [Rename("//a", "{urn:x}n"), Rename("//b", "{urn:y}n")]
    made = changed(text, *renamed)
    assert made == '<r><ns0:n xmlns:ns0="urn:x"/><ns0:n xmlns:ns0="urn:y"/><c/></r>'
    assert made == changed(changed(text, renamed[0]), renamed[1])
    assert "Undefined namespace prefix" in refused(text, *renamed, Remove("//ns1:n"))
    assert changed(text, *renamed, Remove("//ns0:n")) == '<r><ns0:n xmlns:ns0="urn:y"/><c/></r>'


# Paths without a match


@pytest.mark.parametrize(
    ("text", "path", "nearest"),
    [
        (MUJOCO, "//replicate/@cuont", "nearest is //replicate/@count"),
        (MUJOCO, "//replicat/@cuont", "nearest is //replicate/@count"),
        (MUJOCO, "/mojoco/option/@timestep", "nearest is /mujoco/option/@timestep"),
        (MUJOCO, "/mujoco/replicate/@count", "nearest is /mujoco//replicate/@count"),
        (MUJOCO, "mujoco/option/@timestep", "nearest is //mujoco/option/@timestep"),
        (MUJOCO, "option/@timestp", "nearest is option/@timestep"),
        (MUJOCO, "@modle", "nearest is @model"),
        (MUJOCO, "//numeric[@name='random_sed']/@data", "nearest is //numeric[@name='random_seed']/@data"),
        (MUJOCO, "//numeirc[@name='noise']/@data", "nearest is //numeric[@name='noise']/@data"),
        (MUJOCO, "//joint[5]/@damping", "nearest is //joint/@damping"),
        (MUJOCO, "//body[joint/@name='x']/jiont", "nearest is //body[joint/@name='x']/joint"),
        (MUJOCO, "//replicate/@zzz", "//replicate has @count, @offset, @euler"),
        (MUJOCO, "//zzz", "there are mujoco, option, custom, numeric, visual, global, worldbody, geom, …"),
        (MUJOCO, "//replicate/text()[9]/..", "//replicate/text()"),
        (GAZEBO, "//model_cuont", "nearest is //model_count"),
        (SUMO, "//flow[@id='agent']/@number", "nearest is //flow[@id='agents']/@number"),
        (NAMESPACES, "/sdf/world", "nearest is /_:sdf/_:world"),
        (NAMESPACES, "//robot/@nam", "nearest is //a:robot/@name"),
        (NAMESPACES, "/_:sdf/@version", "nearest is /_:sdf/@a:version"),
        ('<r><a b="it\'s"/></r>', '//a[@b="its"]', 'nearest is //a[@b="it\'s"]'),
    ],
)
def test_the_error_for_a_path_without_a_match_suggests_the_nearest_match(text: str, path: str, nearest: str) -> None:
    message = refused(text, Set(path, "1", why="variable 'population_size'"))
    assert message.startswith(f"variable 'population_size': {path} matches nothing in template.xml; ")
    assert nearest in message
    for change in (Add(path, "<a/>"), Remove(path), Rename(path, "a"), Set(path, "1", attribute="b")):
        assert "matches nothing" in refused(text, change)


def test_elements_without_a_prefix_are_suggested_by_local_name() -> None:
    text = '<a xmlns="urn:1"><robot xmlns="urn:2" count="1"/></a>'
    message = refused(text, Set("/_:a/robto/@count", "2"))
    assert "/_:a has *[local-name()='robot']" in message
    assert 'count="2"' in changed(text, Set("/_:a/*[local-name()='robot']/@count", "2"))


@given(st.text(alphabet="/@*.[]()'\"|abflowid:_=1 \n", max_size=20))
def test_any_path_selects_nodes_or_is_refused_in_one_line(path: str) -> None:
    message = ""
    try:
        template(NAMESPACES).changed([Set(path, "1", why="a\nb")], {})
    except TemplateError as error:
        message = str(error)
    assert message.isprintable()


# Runs


def changes_made(made: Template, changes: list[Change], values: Mapping[str, Value]) -> bytes:
    return made.changed(changes, values).render()


def per_run_made(made: Template, changes: list[Change], values: Mapping[str, Value]) -> bytes:
    return made.changed((), {}).per_run(changes)(values)


PER_RUN: list[Change] = [
    SEED,
    Set("//joint/@damping", "{seed}"),
    Set("//body", "{text}"),
    Set("//body/text()[last()]", "{text}"),
    Set("//global", "{text}", attribute="gap"),
    Set("//@gap", "0{text}1"),
    Set("//visual", "gap:0:text:"),
]
STRUCTURAL: list[Change] = [
    Add("//actuator", '<motor name="{text}">{seed}</motor>'),
    Set("//motor/@name", "m{seed}"),
    Rename("//motor", "engine"),
    Remove("//replicate"),
]


def outcome(make: Callable[..., bytes], changes: list[Change], values: dict[str, Value]) -> bytes | str:
    try:
        return make(template(MUJOCO), changes, values)
    except TemplateError as error:  # a number that programs would not read as one
        return str(error)


@given_in_tiers(st.text(CHARACTERS | st.sampled_from("\r\n\t<>&\"'")), st.integers())
@example("1E100", 0)
def test_changes_per_run_give_the_same_bytes_as_changes_of_the_template(text: str, seed: int) -> None:
    for changes in (PER_RUN, STRUCTURAL, []):
        values: dict[str, Value] = {"seed": seed % 2**64, "text": text}
        assert outcome(per_run_made, changes, values) == outcome(changes_made, changes, values)


@pytest.mark.parametrize("changes", [PER_RUN, STRUCTURAL])
def test_the_bytes_of_a_run_do_not_depend_on_earlier_renderings(changes: list[Change]) -> None:
    runs: list[dict[str, Value]] = [{"seed": seed, "text": "x" * (seed % 3)} for seed in range(10)]
    document = template(MUJOCO).changed([Set("//option/@timestep", "0.02")], {})
    fresh = [document.per_run(changes)(values) for values in runs]
    render = document.per_run(changes)
    forwards = [render(values) for values in runs]
    with pytest.raises(SierraError):
        render({"seed": 1, "text": "\0"})
    with pytest.raises(ConfigError):
        render({})
    backwards = [render(values) for values in reversed(runs)]
    assert fresh == forwards == backwards[::-1]
    assert len(set(fresh)) == 10
    assert document.render() == MUJOCO.replace("0.01", "0.02").encode()


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ([Set("//nothing/@data", "{seed}")], TemplateError),
        ([Set("//joint/@name", "{seed}", expect=1)], TemplateError),
        ([Set("//joint/@name", "{seed +}")], ConfigError),
        ([Remove("//nothing")], TemplateError),
        ([Add("//body", "<a>"), SEED], TemplateError),
    ],
)
def test_changes_per_run_that_do_not_match_are_refused_early(changes: list[Change], error: type[SierraError]) -> None:
    with pytest.raises(error):
        template(MUJOCO).changed((), {}).per_run(changes)


def test_errors_of_changes_per_run_name_the_change() -> None:
    render = template(MUJOCO).changed((), {}).per_run([Set(SEED.path, "{seed}", why="the seed")])
    with pytest.raises(ConfigError, match=r"^the seed: unknown name 'seed'"):
        render({})
    with pytest.raises(TemplateError, match=r"^the seed: .* U\+0007 .*template\.xml"):
        render({"seed": "\a"})


# A number that is set to itself


@pytest.mark.parametrize(
    ("there", "value"),
    [("0", "0.0"), ("0.0", "0"), ("1000", "1e3"), (" 5 ", "5.0"), ("-0.5", "-.5"), ("+1", "1"), ("2.", "2"), ("0.25", "25e-2")],
)
def test_setting_an_equal_number_in_another_spelling_keeps_the_bytes(there: str, value: str) -> None:
    text = f'<a b="{there}"><c>{there}</c></a>'
    sets = [Set("//c", value), Set("/a/@b", value)]
    assert changed(text, *sets) == text
    assert template(text).changed((), {}).per_run(sets)({}).decode() == text


@pytest.mark.parametrize(
    ("there", "value"),
    [
        ("0", "-0.0"),
        ("007", "7"),
        ("1.10", "1.1"),
        ("1.1", "1.10"),
        ("0", ""),
        ("0", "false"),
        ("1", "\uff11"),
        ("\u00a05", "5"),
        ("0.1", "0.1000000000000000055511151231257827"),
        ("9007199254740992", "9007199254740993.0"),
        ("1,0", "1,00"),
        ("nan", "NaN"),
        ("0x10", "16"),
        ("1e999", "1e9999"),
    ],
)
def test_a_value_that_may_be_another_number_is_written(there: str, value: str) -> None:
    text = f'<a b="{there}"/>'
    assert changed(text, Set("/a/@b", value)) == f'<a b="{value}"/>'
    assert template(text).changed((), {}).per_run([Set("/a/@b", value)])({}).decode() == f'<a b="{value}"/>'


SPELLED = st.lists(st.sampled_from(["0", "0.0", "1", "1.0", "1e0", "x", "-0", "01"]), min_size=1, max_size=4)


@given(SPELLED)
def test_several_changes_per_run_give_the_same_bytes_as_changes_one_by_one(values: list[str]) -> None:
    text = '<a b="0" c="1"><d>1.0</d></a>'
    sets = [Set("//@*", value) for value in values[:2]] + [Set("//d | /a/@c", value) for value in values[2:]]
    assert template(text).changed((), {}).per_run(sets)({}).decode() == changed(text, *sets)


def test_changes_of_structure_that_are_made_again_see_their_own_values() -> None:
    made = template(SUMO)
    add, count = Add("/routes", '<p a="{v}"/>', why="a"), Set("//flow/@number", "{n}")
    for v, n in ((1, 1), (1, 2), (2, 2), (1, 2)):
        rendered = made.changed([add, count, Rename("//p", "q")], {"v": v, "n": n}).render()
        assert rendered == changed(SUMO, add, count, Rename("//p", "q"), v=v, n=n).encode()
    with pytest.raises(ConfigError, match=r"^a: unknown name 'v'"):
        made.changed([add, count, Rename("//p", "q")], {"n": 2})


# Paths whose evaluation would not end


MANY = "<a>" + '<b c="1"><d/></b>' * 2000 + "</a>"


@functools.cache
def many_elements(times: int) -> Template:
    """Return a template with many elements; no test changes it."""
    return template(MANY if times == 1 else f"<x>{MANY * times}</x>")


@pytest.mark.integration
@pytest.mark.parametrize(
    "path",
    [
        "//*[count(//*[count(//*[count(//*) > 0]) > 0]) > 0]/@c",
        "/a/b[/a/b[/a/b[/a/b/d]/@c = 2]/@c = 2]/@c",
        "//d[../../b[../b[../b/d[../../b/@c = 2]/@c = 2]/@c = 2]]",
        "//b[preceding::d[following::d[preceding::d[following::b/@c = 2]]]]",
    ],
)
def test_a_path_whose_evaluation_takes_too_long_is_refused(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sierra.templates.xpath_time_limit.LIMIT_S", 1)
    with pytest.raises(TemplateError) as caught:
        many_elements(1).find(path)
    assert str(caught.value).startswith(f"{path} takes more than 1 s of computing time in template.xml; use a path")


@pytest.mark.nightly
def test_the_command_line_names_a_slow_path_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sierra.templates.xpath_time_limit.LIMIT_S", 1)
    wide = "//*[count(//*[count(//*[count(//*)>0])>0])>0]/@c"
    folder = projects.make(tmp_path / "p", template=projects.TEMPLATE.replace("</arena>", MANY + "</arena>"))
    ran = projects.quick(folder, "run", "noise=1", "--set", f"{wide}=2", "-n")
    assert ran.returncode == 2
    [line] = ran.stderr.splitlines()
    assert wide in line


@pytest.mark.integration
@pytest.mark.parametrize(
    ("path", "count"), [("//b[@c = //b/@c]/@c", 2000), ("//b[d and //b[d]]/d", 2000), ("//a|//b|//d", 4001)]
)
def test_a_complex_path_that_is_fast_selects_its_nodes(path: str, count: int) -> None:
    assert len(many_elements(1).find(path)) == count


def test_an_invalid_complex_path_is_reported_like_any_other() -> None:
    with pytest.raises(TemplateError, match=r"is not an XPath for template\.xml"):
        many_elements(1).find("//b[//b[//b[//b[]]]]")


@pytest.mark.parametrize(
    "path",
    [
        "/a/b[@c='//x']/@c",
        "//b[@c > 0]/d",
        "(//b)[2]/@c",
        "a/b[starts-with(@c, '1')]/d",
        ".//b[d][last()]",
    ],
)
def test_a_usual_path_starts_no_process(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("sierra.templates.xpath_time_limit.subprocess.run")
    assert many_elements(10).find(path) is not None


def test_rendering_ten_thousand_inputs_of_3_kb_is_fast() -> None:
    text = MUJOCO.replace("<actuator/>", "<actuator>" + '<motor name="fx" joint="x" gear="1"/>' * 70 + "</actuator>")
    assert len(text) > 3000
    render = template(text).changed((), {}).per_run([SEED])
    assert render({"seed": 7}) == text.replace('"42"', '"7"').encode()
    assert is_cheap(lambda: [render({"seed": seed}) for seed in range(10_000)], 20)
