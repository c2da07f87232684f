"""Any extension can be deleted: nothing else needs it, and what was made with it can be read."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

import sierra
from sierra.config.extensions import ADDS
from tests import projects, stores

ROOT = Path(__file__).parents[2]
PROGRAM = "import sys; from sierra.cli.main import program; program()"
IMPORT_ALL = """
import importlib, pkgutil, sierra
for module in pkgutil.walk_packages(sierra.__path__, "sierra."):
    importlib.import_module(module.name)
"""


class Use(NamedTuple):
    """A project that uses an extension."""

    config: str
    """The lines that are added to its sierra.toml."""
    makes: tuple[tuple[str, ...], ...]
    """The commands that use it, after the project's query was executed."""
    traces: tuple[str, ...]
    """Words that only appear where the extension exists."""


USES = {
    "videos": Use(
        '[videos.map]\nkind = "poses"\ntable = "swarm"\ncolumn = ["tick", "coverage"]\n',
        (("video",),),
        ("sierra video", "[videos"),
    ),
}
PACKAGE = '[package]\ntitle = "A study"\nauthors = [{ name = "Ada Lovelace" }]\nlicense = "MIT"\n'


@pytest.fixture
def used(recorded: Path, tmp_path: Path) -> Callable[[Use], tuple[Path, str]]:
    def use(one: Use) -> tuple[Path, str]:
        root = stores.copy(recorded, tmp_path / "project")
        with (root / "sierra.toml").open("a") as file:
            file.write(f"\n{one.config}{PACKAGE}")
        batch = sierra.open(root).batches[-1].batch
        for words in (*one.makes, ("package", batch, "--yes", "--no-report", "-o", "p.zip")):
            ended = projects.sierra(root, *words)
            assert ended.returncode == 0, ended.stderr
        return root, batch

    return use


@pytest.fixture
def without(tmp_path: Path) -> Callable[[str], Callable[..., subprocess.CompletedProcess[str]]]:
    """Return a function that deletes an extension in a copy, and returns a function that executes programs with the copy."""

    def delete(name: str) -> Callable[..., subprocess.CompletedProcess[str]]:
        copy = tmp_path / "copy"
        left_out = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / "sierra", copy / "sierra", ignore=left_out, copy_function=os.link)
        shutil.rmtree(copy / "sierra" / "extensions" / name)

        def execute(*words: str, cwd: Path = copy, program: str = PROGRAM) -> subprocess.CompletedProcess[str]:
            argv = [sys.executable, "-c", program, *words]
            variables = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": ""}
            return subprocess.run(argv, cwd=cwd, env=variables, capture_output=True, text=True, check=False)

        return execute

    return delete


def test_each_extension_is_deleted_by_a_test() -> None:
    assert (
        USES.keys()
        == ADDS.keys()
        == {path.name for path in (ROOT / "sierra" / "extensions").iterdir() if path.is_dir()} - {"__pycache__"}
    )


@pytest.mark.each_case
@pytest.mark.parametrize("name", ADDS)
def test_an_extension_can_be_deleted(
    name: str,
    used: Callable[[Use], tuple[Path, str]],
    without: Callable[[str], Callable[..., subprocess.CompletedProcess[str]]],
) -> None:
    root, batch = used(USES[name])
    execute = without(name)
    imported = execute(program=IMPORT_ALL)
    assert imported.returncode == 0, imported.stderr
    for words in (("--help",), ("schema",), ("package", "--help")):
        told = execute(*words, cwd=root.parent)
        assert told.returncode == 0, told.stderr
        assert not [word for word in USES[name].traces if word in told.stdout], words
    refused = execute("run", "-n", "population_size=5", cwd=root)
    assert refused.returncode == 2
    assert f"belongs to the extension {name!r}, which is not installed; install sierra-{name}, or" in refused.stderr
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace(USES[name].config, ""))
    for words in (("ls",), ("run", "population_size=5", "--runs", "1", "--no-figures"), ("open", "p.zip", "ls")):
        ended = execute(*words, cwd=root)
        assert ended.returncode == 0, (words, ended.stderr)
    opened = execute("open", "p.zip", cwd=root)
    assert f"is ignored: the extension {name!r} is not installed" in opened.stdout
    assert "the extension that makes deliverables of kind" in execute("figures", batch, "--check", cwd=root).stdout
