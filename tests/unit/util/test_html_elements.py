"""Elements of HTML hold any text."""

from html import unescape

import pytest

from sierra.util.html_elements import Markup, element, joined, text
from tests.support.characters import MIXED, SHOWN


def test_elements_escape_every_text_and_keep_what_is_markup_already() -> None:
    inner = element("b", "<i>", title='"x" \u202e')
    assert inner == '<b title="&quot;x&quot; \\u202e">&lt;i&gt;</b>'
    assert element("p", inner, " & ", None, class_="a", hidden=True, id=None, aria_label="l", tabindex=0) == (
        f'<p class="a" hidden aria-label="l" tabindex="0">{inner} &amp; </p>'
    )
    assert element("br") == "<br>"
    assert isinstance(joined((inner, "<")), Markup)
    assert joined((inner, None, "<"), "\n") == f"{inner}\n&lt;"


def test_text_shows_characters_that_control_as_escapes() -> None:
    assert text("a\0b\u202ec\ud800 <'\">\n") == "a\\x00b\\u202ec\\ud800 &lt;&#x27;&quot;&gt;\n"
    assert text(MIXED) == SHOWN


@pytest.mark.parametrize(
    "content", ["SELECT\t1,\r\n\t'a\xa0b'", "\u0645\u06cc\u200c\u062e", "क्\u200dष", "א\u200f\u200e", "a\u200bb\u3000"]
)
def test_text_of_any_script_can_be_copied(content: str) -> None:
    written = text(content)
    assert unescape(written) == content
    assert "\r" not in written, "a parser of HTML makes a line feed of it"
