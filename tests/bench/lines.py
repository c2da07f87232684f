"""Count the lines of this project: code, docstrings and modules, of the core, of extensions and of each package.

    lines.py [FOLDER]           print the numbers (by default, of this checkout)

A line of code has at least one token that is no comment and belongs to no docstring. Strings after attributes, which say what
these are, count as docstrings.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "sierra"
EXTENSIONS = "extensions"
"""The package of extensions; all others are the core."""
WITHOUT_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


class Size(NamedTuple):
    """The size of one or several modules."""

    code: int = 0
    docstrings: int = 0
    """The number of their lines."""
    modules: int = 0

    def __add__(self, other: object) -> Size:
        return Size(*map(sum, zip(self, other, strict=True))) if isinstance(other, Size) else NotImplemented


def size(text: str) -> Size:
    """Return the size of one module, from its text."""
    documented = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in WITHOUT_CODE:
            code.update(range(token.start[0], token.end[0] + 1))
    return Size(len(code - documented), len(documented), 1)


def packages(root: Path = ROOT) -> dict[str, Size]:
    """Return the sizes of the packages of a checkout, those of extensions as `extensions.NAME`; modules beside them as `.`."""
    found: dict[str, Size] = {}
    for path in sorted((root / PACKAGE).rglob("*.py")):
        *folders, _ = path.relative_to(root / PACKAGE).parts
        name = ".".join(folders[:2] if folders[:1] == [EXTENSIONS] else folders[:1]) or "."
        found[name] = found.get(name, Size()) + size(path.read_text())
    return found


def total(sizes: Iterable[Size]) -> Size:
    return sum(sizes, Size())


def core(found: dict[str, Size]) -> Size:
    return total(size for name, size in found.items() if name.partition(".")[0] != EXTENSIONS)


def main() -> None:
    found = packages(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT)
    print(f"{'package':24} {'code':>7} {'docstrings':>11} {'modules':>8}")
    for name, one in sorted(found.items(), key=lambda pair: -pair[1].code):
        print(f"{name:24} {one.code:7,} {one.docstrings:11,} {one.modules:8,}")
    every = total(found.values())
    for name, one in (("core", core(found)), ("extensions", Size(*map(int.__sub__, every, core(found)))), ("all", every)):
        print(f"{name:24} {one.code:7,} {one.docstrings:11,} {one.modules:8,}")


if __name__ == "__main__":
    main()
