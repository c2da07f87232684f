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


def test_a_condition_of_the_core_must_not_name_an_extension(
    modules: tuple[ModuleType, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import extension_names

    monkeypatch.delitem(sys.modules, "extension_names")
    assert extension_names.main() == 0
    (tmp_path / "sierra" / "cli").mkdir(parents=True)
    (tmp_path / "sierra" / "cli" / "run.py").write_text('def f(kind):\n    return 1 if kind == "gazebo" else "argos"\n')
    monkeypatch.setattr(extension_names, "ROOT", tmp_path)
    monkeypatch.setattr(extension_names, "EXCEPTIONS", set())
    assert extension_names.main() == 1
    assert capsys.readouterr().err == "sierra/cli/run.py:2: a condition names 'gazebo', which belongs to an extension\n"


def test_long_functions_must_not_have_vague_names(
    modules: tuple[ModuleType, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import vague_names

    monkeypatch.delitem(sys.modules, "vague_names")
    (tmp_path / "sierra" / "store").mkdir(parents=True)
    (tmp_path / "sierra" / "api.py").write_text("def f(found):\n    return [one for one in found]\n")
    (tmp_path / "sierra" / "gc.py").write_text(
        f"def f(made):\n    for one in made:\n        x = one{chr(10) * 9}        y = 1\n"
    )
    (tmp_path / "sierra" / "store" / "store.py").write_text(f"def f():\n    place = 1{chr(10) * 9}    return place\n")
    monkeypatch.setattr(vague_names, "ROOT", tmp_path)
    monkeypatch.setattr(vague_names, "REMAINING", ("api.py", "store"))
    assert vague_names.main() == 1
    assert capsys.readouterr().err == (
        "sierra/gc.py:1: name this 'made' by what it holds, as run, row or path\n"
        "sierra/gc.py:2: name this 'one' by what it holds, as run, row or path\n"
        "sierra/api.py has no vague names: remove it from vague_names.py\n"
    )
