"""XPath 1.0 over a document of keys, lists and values, whose root element stands for the document itself.

A document of XML has one root element, but a mapping has many keys. Therefore the view of a mapping has a root element without
a name of its own, and absolute paths begin below it: `/swarm/count` becomes `/*/swarm/count`, `//count` becomes `/*//count`.
A lone `/` selects the root. Relative paths begin at the root already.
"""

from __future__ import annotations

import re

_TOKEN = re.compile(
    r"""\s*(?: (?P<literal> '[^']*' | "[^"]*") | (?P<number> \d+(?:\.\d*)? | \.\d+) | (?P<name> [^\W\d][\w.-]*)
    | (?P<sign> // | :: | \.\. | != | <= | >= | [^\s]) )""",
    re.VERBOSE,
)
_STEP = re.compile(r"\s*[\w*@.]")
_OPERATORS = frozenset({"and", "or", "div", "mod"})
_ENDS = frozenset({")", "]", ".", ".."})
"""Signs that end an operand; the others are operators, or expect one more step."""


def below_root(path: str) -> str:
    """Return a path in which every absolute path begins below the root element."""
    pieces: list[str] = []
    operand = slash = False  # after an operand; after a sign that a step must follow
    end = 0
    for token in _TOKEN.finditer(path):
        pieces.append(path[end : token.start()])
        end, sign, text = token.end(), token["sign"], token.group()
        if sign in ("/", "//") and not operand:
            text = text.replace(sign, _rooted(path, end, sign))
            operand, slash = text.endswith("*"), True
        elif sign == "*" or token["name"]:
            is_operator = operand and not slash and (sign == "*" or token["name"] in _OPERATORS)
            operand, slash = not is_operator, False
        elif sign in ("/", "//", "@", "::"):
            operand, slash = sign in ("/", "//"), True
        else:
            operand, slash = sign is None or sign in _ENDS, False
        pieces.append(text)
    return "".join([*pieces, path[end:]])


def _rooted(path: str, end: int, sign: str) -> str:
    return f"/*{sign}" if sign == "//" or _STEP.match(path, end) else "/*"
