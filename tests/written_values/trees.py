"""Documents of JSON, YAML and TOML, and what independent readers read from them. All values of a document differ."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Hashable, Iterator
from itertools import count
from typing import Any

import pydantic_core
import tomlkit
import yaml
from hypothesis import strategies as st
from ruamel.yaml import YAML

from tests.written_values.claim import Document, Reader, Values, check

REFUSED = (
    "is the number .*, which cannot become|is a boolean, which|which cannot become .*; use a date|too large|too close to 0"
    "|occurs twice|which an alias repeats|is merged by <<|is the alias|has the tag|read in different ways|not (YAML|TOML|JSON)"
)
WORDS = [
    *("0", "-0", "1.0", "1e5", "1E-5", "1.5e+3", "1e-400", "true", "false", "yes", "null", "~", "010", "0x10", "1_0", "12:30"),
    *("a: b", "- a", "a #b", "#", "*a", "&a", "!a", "|", ">", "%a", "@", "`", "'", '"', "\\", "---", "a\nb", "\t", " a ", ""),
    *(
        "1979-05-27",
        "1979-05-27T07:32:00Z",
        "07:32:00",
        '"""',
        "'''",
        "\x7f",
        "\u2028",
        "\x85",
        "\ufeff",
        "𝄞",
        "\r\n",
        "=",
        "<<",
    ),
    *("%(a)s", "%%", "a ; b", "a=b", "{", "a,b]"),
]
NUMBERS = st.integers(-(10**20), 10**20).map(str) | st.floats(allow_nan=False, allow_infinity=False).map(repr)
VALUES = st.one_of(NUMBERS, NUMBERS, st.sampled_from(WORDS), st.text(max_size=6))
KEYS = st.sampled_from(
    ["a", "b", "0x1", "yes", "null", "my key", "c.d", "é", "", "1", "true", "x-y", "<<", "#", "a:", "~", '"', "\u2028"]
)
NEWLINES = st.sampled_from(["\n", "\r\n"])
MARKS = st.sampled_from([b"", b"", b"\xef\xbb\xbf"])


def leaves(data: Any, path: tuple[Hashable, ...] = ()) -> Iterator[tuple[Hashable, object]]:
    """Yield the single values of a document with their places, and what each list and mapping is."""
    if isinstance(data, dict | list):
        yield (*path, "kind"), isinstance(data, dict)
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from leaves(value, (*path, (type(key).__name__, key)))
    else:
        yield path, data


def numbered(draw: st.DrawFn, kinds: list[str]) -> Iterator[str]:
    """Yield values that all differ, as they are written."""
    for number in count(1):
        yield draw(st.sampled_from(kinds)).replace("N", str(number))


@st.composite
def shapes(draw: st.DrawFn, depth: int = 2) -> Any:
    """Draw a document whose values are None."""
    kind = draw(st.sampled_from(["value", "list", "mapping"])) if depth else "value"
    if kind == "list":
        return draw(st.lists(shapes(depth - 1), max_size=3))
    if kind == "mapping":
        return draw(mappings(depth))
    return None


def mappings(depth: int = 2) -> st.SearchStrategy[Any]:
    return st.dictionaries(KEYS, shapes(depth - 1), min_size=1, max_size=3)


# JSON

JSON_VALUES = [
    "N",
    "-N.5",
    "N.5e3",
    "NE-2",
    '"tN"',
    '"\\u00e9N"',
    '"N\\n\\"\\/"',
    "12345678901234567890N",
    '"N"',
    "true",
    "null",
]


@st.composite
def in_json(draw: st.DrawFn) -> Document:
    values = numbered(draw, JSON_VALUES)

    def blank() -> str:
        return draw(st.sampled_from(["", "", " ", "\n\t", "\r\n"]))

    def written(shape: Any) -> str:
        if isinstance(shape, dict):
            members = [
                f"{blank()}{json.dumps(key, ensure_ascii=draw(st.booleans()))}{blank()}:{written(shape[key])}" for key in shape
            ]
            twice = [members[0]] if draw(st.integers(0, 40)) == 40 else []
            return f"{blank()}{{{','.join([*members, *twice])}{blank()}}}{blank()}"
        if isinstance(shape, list):
            return f"{blank()}[{','.join(map(written, shape)) or blank()}]{blank()}"
        return f"{blank()}{next(values)}{blank()}"

    return Document("json", draw(MARKS) + written(draw(shapes())).encode())


def json_reader(data: bytes) -> Values:
    return dict(leaves(json.loads(data)))


def pydantic_reader(data: bytes) -> Values:
    return dict(leaves(pydantic_core.from_json(data.removeprefix(b"\xef\xbb\xbf"))))


# YAML

YAML_VALUES = [
    *(
        "N",
        "-N.5",
        "N.5e+3",
        "tN",
        "t N x",
        '"tN"',
        "'tN'",
        '"\\x41N\\n"',
        "'it''s N'",
        "N:30",
        "0xN",
        "NeN",
        "true",
        "~",
        "yes",
    ),
    *(
        "!!str N",
        "!own tN",
        "&anchorN tN",
        "&otherN N",
        '"t\n      N"',
        "t\n      N",
        "2001-01-0N",
        "N # comment",
        "tN # 5",
        "tN#5",
    ),
]
BLOCKS = ["|\n{i}tN\n", ">-\n{i}tN\n{i}  more\n\n{i}end\n", "|+\n{i}N\n\n", "|2 # comment\n{i}tN\n"]


@st.composite
def in_yaml(draw: st.DrawFn) -> Document:
    values, blocks, anchors = numbered(draw, YAML_VALUES), numbered(draw, BLOCKS), list[str]()
    wholes = numbered(draw, ["wholeN"])

    def key(text: str) -> str:
        plain = text in ("a", "b", "my key", "c.d", "é", "x-y", "<<", "1", "0x1", "true", "yes", "~", "null")
        return text if plain and draw(st.booleans()) else json.dumps(text, ensure_ascii=False).replace("\u2028", "\\L")

    def flow(shape: Any) -> str:
        if isinstance(shape, dict):
            return f"{{{', '.join(f'{key(one)}: {flow(shape[one])}' for one in shape)}}}"
        if isinstance(shape, list):
            return f"[{', '.join(map(flow, shape))}]"
        return next(value for value in values if not set(value) & set("#&\n"))

    def block(shape: Any, indent: str) -> str:
        """Return what follows a key or a dash."""
        if shape is None and anchors and draw(st.integers(0, 3)) == 0:
            return f" *{draw(st.sampled_from(anchors))}\n"
        if shape is None and draw(st.integers(0, 3)) == 0:
            return " " + next(blocks).replace("{i}", indent + "  ")
        if not shape or draw(st.integers(0, 3)) == 0:
            written = flow(shape) if shape is not None else next(values)
            anchors.extend(word[1:] for word in written.split() if word[0] == "&")
            return f"{draw(st.sampled_from([' ', '  ']))}{written}\n"
        name = next(wholes) if draw(st.integers(0, 3)) == 0 else ""
        begin = f" &{name}\n" if name else draw(st.sampled_from(["\n", " # 5\n", "\n\n"]))
        inner = indent + "  "
        if isinstance(shape, dict):
            lines = [f"{inner}{key(one)}:{block(shape[one], inner)}" for one in shape]
        else:
            lines = [f"{inner}-{block(one, inner)}" for one in shape]
        if name:
            anchors.append(name)
        return begin + "".join(lines)

    shape = draw(mappings(3))
    text = draw(st.sampled_from(["", "---\n", "# comment\n\n"]))
    text += "".join(f"{key(one)}:{block(shape[one], '')}" for one in shape) + draw(st.sampled_from(["", "# end\n", "...\n"]))
    return Document("yaml", draw(MARKS) + text.replace("\n", draw(NEWLINES)).encode())


def pyyaml_reader(data: bytes) -> Values:
    return dict(leaves(yaml.safe_load(data)))


def ruamel_reader(data: bytes) -> Values:
    return dict(leaves(YAML(typ="safe", pure=True).load(data)))


# TOML

TOML_VALUES = [
    *(
        "N",
        "+N",
        "-N.5",
        "N.5e+3",
        "0xN",
        "1_000N",
        "0oN",
        '"tN"',
        "'tN'",
        '"\\u00e9N\\t"',
        '"""\ntN\n  "more" \\\n   end"""',
        "'''\ntN\n'''",
    ),
    *("2001-01-01T00:00:00.00000NZ", "2001-01-01 00:00:00.00000N", "00:00:00.00000N", "true", "inf", "''", '"""a""N"""', "'N'"),
]


@st.composite
def in_toml(draw: st.DrawFn) -> Document:
    values = numbered(draw, TOML_VALUES)

    def key(text: str) -> str:
        bare = text in ("a", "b", "1", "true", "x-y")
        return text if bare and draw(st.booleans()) else json.dumps(text, ensure_ascii=False)

    def inline(shape: Any) -> str:
        if isinstance(shape, dict):
            return f"{{ {', '.join(f'{key(one)} = {inline(shape[one])}' for one in shape)} }}"
        if isinstance(shape, list):
            gap = draw(st.sampled_from([" ", "\n  ", " # 5, 6\n  "]))
            return f"[{gap}{f',{gap}'.join(map(inline, shape))}{',' if shape and draw(st.booleans()) else ''}{gap}]"
        return next(values)

    def table(shape: Any, above: str) -> str:
        lines, tables = [], []
        for one in shape:
            name, inner = key(one), shape[one]
            if isinstance(inner, dict) and draw(st.booleans()):
                where = f"{above}.{name}" if above else name
                tables.append(f"{draw(st.sampled_from(['', '# 5', '  ']))}\n[ {where} ] # t\n{table(inner, where)}")
            elif isinstance(inner, list) and inner and all(isinstance(item, dict) for item in inner):
                where = f"{above}.{name}" if above else name
                tables += [f"\n[[{where}]]\n{table(item, where)}" for item in inner]
            elif isinstance(inner, dict) and draw(st.booleans()):
                lines += [f"{name} . {key(deep)} = {inline(inner[deep])}\n" for deep in inner]
            else:
                lines.append(f"{name}={inline(inner)}{draw(st.sampled_from(['', ' # 5', '  ']))}\n")
        return "".join([*lines, *tables])

    text = table(draw(mappings(3)), "")
    return Document("toml", draw(MARKS) + text.replace("\n", draw(NEWLINES)).encode())


def tomllib_reader(data: bytes) -> Values:
    return dict(leaves(tomllib.loads(data.decode("utf-8-sig"))))


def tomlkit_reader(data: bytes) -> Values:
    return dict(leaves(tomlkit.loads(data.decode("utf-8-sig")).unwrap()))


READERS: dict[str, dict[str, Reader]] = {
    "json": {"json": json_reader, "pydantic": pydantic_reader},
    "yaml": {"PyYAML": pyyaml_reader, "ruamel.yaml": ruamel_reader},
    "toml": {"tomllib": tomllib_reader, "tomlkit": tomlkit_reader},
}
STRATEGIES = {
    format: (documents, st.integers(0, 1000), VALUES)
    for format, documents in {"json": in_json(), "yaml": in_yaml(), "toml": in_toml()}.items()
}


def claim(document: Document, choice: int, value: str) -> None:
    """Check that all readers of JSON, YAML or TOML read a value that was set."""
    check(document, choice, value, READERS[document.format], REFUSED)
