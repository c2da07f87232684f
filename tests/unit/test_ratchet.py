"""The limits on the size of this project: see tests/bench/ratchet.py."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest

BENCH = Path(__file__).parents[1] / "bench"


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> tuple[ModuleType, ModuleType]:
    monkeypatch.syspath_prepend(str(BENCH))
    import lines
    import ratchet

    for name in ("lines", "ratchet", "idle"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return lines, ratchet


def test_blank_lines_comments_and_docstrings_are_not_code(modules: tuple[ModuleType, ModuleType]) -> None:
    lines, _ = modules
    text = '"""A module,\nwith two lines."""\n\nx = 1  # one\n"""What x is."""\n# a comment\ntext = """\nlong"""\n'
    assert lines.size(text) == lines.Size(code=3, docstrings=3, modules=1)


def test_only_numbers_that_fell_are_written(modules: tuple[ModuleType, ModuleType]) -> None:
    _, ratchet = modules
    text = '# limits\n[size]\n"core code" = 20\n\n[imported]\n"run -n" = 7\n"run" = 8\n'
    now = {"size": {"core code": 19}, "imported": {"run -n": 9, "run": 6}}
    limits = {"size": {"core code": 20}, "imported": {"run -n": 7, "run": 8}}
    assert ratchet.lowered(text, limits, now) == '# limits\n[size]\n"core code" = 19\n\n[imported]\n"run -n" = 7\n"run" = 6\n'
