"""Check that no condition in the core names an extension, or what one adds: the core must work without any of them.

    python tests/bench/extension_names.py

`make check` calls it. A word that is also the core's own is an exception; the list of these may only become shorter.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

from lines import PACKAGE, ROOT

DATA = ("options", "needs")
"""Kinds whose names are no words of their own."""
EXCEPTIONS = {
    ("sierra/config/figure_options.py", "figures"),  # a key of sierra.toml, whose kinds extensions add
    ("sierra/ingest/compare_robots.py", "robots"),  # a table of the store
    ("sierra/setup/key_tables.py", "figures"),
    ("sierra/ingest/recorder.py", "trials"),  # a table of the store
    ("sierra/store/views.py", "trials"),
    ("sierra/store/public_result.py", "arrow"),  # a method of pandas and DuckDB
}
"""Files, each with a word that it may use in conditions."""


def main() -> int:
    sys.path.insert(0, str(ROOT))
    from sierra.config.extensions import ADDS

    words = {name for adds in ADDS.values() for kind, names in adds.items() if kind not in DATA for name in names} | {*ADDS}
    found = {(file, word): line for path in _core() for file, word, line in _named(path, words)}
    for (file, word), line in found.items():
        if (file, word) not in EXCEPTIONS:
            print(f"{file}:{line}: a condition names {word!r}, which belongs to an extension", file=sys.stderr)
    for file, word in sorted(EXCEPTIONS - found.keys()):
        print(f"{file}: remove the exception for {word!r} from {Path(__file__).name}", file=sys.stderr)
    return 1 if found.keys() ^ EXCEPTIONS else 0


def _core() -> Iterator[Path]:
    folder = ROOT / PACKAGE
    for path in sorted(folder.rglob("*.py")):
        if not {"extensions", "examples"} & {*path.relative_to(folder).parts} and path != folder / "config" / "extensions.py":
            yield path


def _named(path: Path, words: set[str]) -> Iterator[tuple[str, str, int]]:
    """Yield the words in the conditions of a file, each with its line."""
    for node in ast.walk(ast.parse(path.read_text())):
        for condition in _conditions(node):
            for part in ast.walk(condition):
                if isinstance(part, ast.Constant) and part.value in words:
                    yield str(path.relative_to(ROOT)), str(part.value), part.lineno


def _conditions(node: ast.AST) -> list[ast.AST]:
    match node:
        case ast.If() | ast.IfExp() | ast.While() | ast.Assert():
            return [node.test]
        case ast.comprehension():
            return [*node.ifs]
        case ast.match_case():
            return [node.pattern, *filter(None, [node.guard])]
        case ast.Compare():
            return [node]
    return []


if __name__ == "__main__":
    sys.exit(main())
