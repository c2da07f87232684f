"""Documents of INI, properties and texts with placeholders, and what independent readers read from them."""

from __future__ import annotations

import configparser
import re
from collections.abc import Hashable
from itertools import count

from hypothesis import strategies as st

from sierra.errors import TemplateError
from sierra.model import Set
from tests.written_values.claim import Document, Reader, Values, check
from tests.written_values.trees import MARKS, NEWLINES, VALUES

REFUSED = (
    "read in different ways|continues on the next line|may contain a comment|has quotes or escapes|has an escape|white space"
    "|which not all programs|cannot become|too large|too close to 0|occurs twice|neither a key|carriage return"
)
KEYS = ["a", "b", "c.d", "my key", "x-y", "é", "A"]
VALUES_OF_LINES = [
    *(
        "N",
        "-N.5",
        "tN",
        "t N x",
        '"tN"',
        "'tN'",
        "",
        "N ; comment",
        "tN;5",
        "tN # comment",
        "N#5",
        "\\N",
        "t\\\\N",
        "N%",
        "%(zz)sN",
        "tN \\",
    ),
    *("tN:5", "N=5", "=N", '"tN', "t'N'", "\tN \t", "N\\\n  5", "N\n   more", "t\\u0041N", "\u00a0N", "N\x0c", "\u3000N"),
]
SIGNS = ["=", " = ", ":", " : ", "\t=  ", "=\t"]
EXTRAS = [
    "",
    "# comment = 5\n",
    "; comment = 5\n",
    "! comment = 5\n",
    "\n",
    "  # indented\n",
    "\t\n",
    "   \n",
    "key\n",
    "\rz = 5\n",
]


@st.composite
def in_lines(draw: st.DrawFn, format: str) -> Document:
    numbers, pieces = count(1), []
    for section in range(draw(st.integers(1, 2))):
        if format == "ini":
            pieces.append(f"{draw(st.sampled_from(['', ' ']))}[{draw(st.sampled_from(['s', 'DEFAULT', 't u']))}{section}]\n")
        for key in draw(st.lists(st.sampled_from(KEYS), min_size=1, max_size=3, unique=True)):
            name = key if format == "ini" else f"{key}{section}"
            pieces.append(draw(st.sampled_from([*[""] * 8, *EXTRAS])))
            written = draw(st.sampled_from(VALUES_OF_LINES)).replace("N", str(next(numbers)))
            indent = draw(st.sampled_from(["", "", "", "  "]))
            pieces.append(f"{indent}{name}{draw(st.sampled_from(SIGNS))}{written}\n")
    return Document(format, draw(MARKS) + "".join(pieces).replace("\n", draw(NEWLINES)).encode())


def unquoted(text: str) -> str:
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'" else text


def configparser_reader(data: bytes, **options: object) -> Values:
    parser = configparser.ConfigParser(**options)  # type: ignore[call-overload]
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string("\n".join(re.split("\r\n|\r|\n", data.decode("utf-8-sig"))))
    found: dict[Hashable, object] = {}
    for section in parser.sections():
        for key in parser.options(section):
            try:
                found[section, key] = unquoted(parser.get(section, key))
            except configparser.InterpolationError:
                found[section, key] = unquoted(parser.get(section, key, raw=True))
    return found


def plain_configparser(data: bytes) -> Values:
    return configparser_reader(data, interpolation=None)


def commenting_configparser(data: bytes) -> Values:
    return configparser_reader(data, interpolation=None, inline_comment_prefixes=(";", "#"), delimiters=("=",))


def ini_reader(data: bytes) -> Values:
    """Read as programs do that know no continued lines: sections, and what is around the first `=` or `:` of a line."""
    found: dict[Hashable, object] = {}
    section = ""
    for line in re.split("\r\n|\r|\n", data.decode("utf-8-sig")):
        text = line.strip()
        if text[:1] == "[":
            section = text.strip("[]")
        elif text[:1] not in ("", "#", ";"):
            key, value = re.split("[=:]", text, maxsplit=1)
            found[section, key.strip()] = unquoted(value.strip())
    return found


_ESCAPES = {"t": "\t", "n": "\n", "r": "\r", "f": "\f"}


def properties_reader(data: bytes) -> Values:
    """Read as `java.util.Properties.load` specifies it, but in UTF-8."""
    found: dict[Hashable, object] = {}
    lines = iter(re.split("\r\n|\r|\n", data.decode("utf-8-sig")))
    for line in lines:
        line = line.lstrip(" \t\f")
        if not line or line[0] in "#!":
            continue
        while re.search(r"(?<!\\)(\\\\)*\\$", line):
            line = line[:-1] + next(lines, "").lstrip(" \t\f")
        match = re.fullmatch(r"((?:\\.|[^\\=: \t\f])*)[ \t\f]*[=:]?[ \t\f]*(.*)", line, re.DOTALL)
        assert match, line
        key, value = (re.sub(r"\\(?:u([0-9a-fA-F]{4})|(.))", _unescaped, text) for text in match.groups())
        found[key] = unquoted(value)
    return found


def _unescaped(match: re.Match[str]) -> str:
    return chr(int(match[1], 16)) if match[1] else _ESCAPES.get(match[2], match[2])


PLACEHOLDER = re.compile(r"\{\{[ \t]*(\w+)[ \t]*\}\}")


@st.composite
def in_text(draw: st.DrawFn) -> Document:
    words = st.sampled_from(["{{one}}", "{{ two }}", "{{one}}", " x ", "\n", "{", "}", "é𝄞", "<!-- 5 -->", "$x"])
    return Document(
        "text", draw(MARKS) + ("{{one}}" + "".join(draw(st.lists(words, max_size=6)))).replace("\n", draw(NEWLINES)).encode()
    )


def text_claim(document: Document, value: str) -> None:
    """Check that a value stands in the place of each of its placeholders, and that all other bytes stay."""
    try:
        template = document.template
    except TemplateError as error:
        assert "is not a placeholder" in str(error)  # noqa: PT017
        return
    text = document.data.decode()
    changes = [Set(f"/{name}", "{v}") for name in dict.fromkeys(PLACEHOLDER.findall(text))]
    wanted = PLACEHOLDER.sub(lambda _: value, text).encode()
    assert template.changed(changes, {"v": value}).render() == wanted
    assert template.changed((), {}).per_run(changes)({"v": value}) == wanted


READERS: dict[str, dict[str, Reader]] = {
    "ini": {
        "configparser": configparser_reader,
        "without interpolation": plain_configparser,
        "with comments": commenting_configparser,
        "of lines": ini_reader,
    },
    "properties": {"Java": properties_reader},
}
STRATEGIES = {format: (in_lines(format), st.integers(0, 1000), VALUES) for format in READERS}
TEXT_STRATEGIES = (in_text(), VALUES)


def claim(document: Document, choice: int, value: str) -> None:
    """Check that all readers of INI or properties read a value that was set."""
    check(document, choice, value, READERS[document.format], REFUSED)
