"""Check that no long function has a local or a parameter whose name does not say what it holds.

    python tests/bench/vague_names.py

`make check` calls it. `REMAINING` names the packages and modules that still have such names; the list may only become shorter.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

from lines import PACKAGE, ROOT

VAGUE = {"one", "found", "made", "place", "those"}
LONG = 10
"""The largest number of lines of a function whose names are not checked."""
REMAINING = (
    "extensions/gazebo/drivers",
    "extensions/ros/drivers",
    "setup/examples",
)
"""The packages and modules that are not checked: their bytes are part of the ids of runs."""


def main() -> int:
    faults = [fault for path in sorted((ROOT / PACKAGE).rglob("*.py")) for fault in _vague(path)]
    new = [fault for fault in faults if not _remaining(fault[0])]
    for path, line, name in new:
        print(f"{path.relative_to(ROOT)}:{line}: name this {name!r} by what it holds, as run, row or path", file=sys.stderr)
    there = {entry for entry in REMAINING if (ROOT / PACKAGE / entry).exists()}  # extensions can be deleted
    clean = there - {entry for path, _, _ in faults for entry in _remaining(path)}
    for entry in sorted(clean):
        print(f"{PACKAGE}/{entry} has no vague names: remove it from {Path(__file__).name}", file=sys.stderr)
    return 1 if new or clean else 0


def _remaining(path: Path) -> list[str]:
    """Return the entries of REMAINING that a module belongs to."""
    return [entry for entry in REMAINING if path.is_relative_to(ROOT / PACKAGE / entry)]


def _vague(path: Path) -> Iterator[tuple[Path, int, str]]:
    """Yield the vague names that long functions of a module bind, each with its line."""
    for function in ast.walk(ast.parse(path.read_text())):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef) and _lines(function) > LONG:
            for node in ast.walk(function):
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in VAGUE:
                    yield path, node.lineno, node.id
                elif isinstance(node, ast.arg) and node.arg in VAGUE:
                    yield path, node.lineno, node.arg


def _lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    return (function.end_lineno or function.lineno) - function.lineno + 1


if __name__ == "__main__":
    sys.exit(main())
