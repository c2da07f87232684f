"""Real simulators from an index of Python packages: their environments, and their examples.

Lock files are made by `uv pip compile --universal --python-version 3.11 --generate-hashes --no-header --no-annotate
--no-emit-index-url --no-emit-find-links`.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import projects

PIP = ("-m", "pip", "--disable-pip-version-check", "--quiet")
LOCKED = ("--no-deps", "--only-binary", ":all:", "--require-hashes", "--requirement")


class Environment:
    """A virtual environment of Python, which has the packages of lock files."""

    def __init__(self, folder: Path) -> None:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        self.bin = folder / "bin"
        [self.site] = folder.glob("lib/python3*/site-packages")

    def pip(self, *words: str | Path) -> str:
        """Call pip; return its errors."""
        done = subprocess.run([self.bin / "python", *PIP, *words], check=False, capture_output=True, text=True)
        return (done.stderr or "pip failed") if done.returncode else ""

    def install(self, lock: Path) -> str:
        """Install exactly what a lock file names; return the errors."""
        return self.pip("install", *LOCKED, lock)


Made = Callable[[Path], tuple[Environment, str]]
Install = Callable[[Path], Environment]
Started = Callable[[Path], tuple[Path, Environment]]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return a function that makes the environment of a lock file once; it also returns the errors of pip."""

    @functools.cache
    def made(lock: Path) -> tuple[Environment, str]:
        environment = Environment(tmp_path_factory.mktemp(lock.stem) / "venv")
        return environment, environment.install(lock)

    return made


@pytest.fixture
def installed(made: Made, require: Callable[..., str]) -> Install:
    """Return a function that returns the environment of a lock file."""

    def installed(lock: Path) -> Environment:
        require("strace")
        environment, errors = made(lock)
        require(f"an index with packages of {lock.stem} for this Python", there="No matching distribution" not in errors)
        assert errors == ""
        return environment

    return installed


@pytest.fixture
def started(installed: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Started:
    """Return a function that copies the example of a simulator, whose programs are then in `PATH`."""

    def started(lock: Path) -> tuple[Path, Environment]:
        environment = installed(lock)
        monkeypatch.setenv("PATH", f"{environment.bin}{os.pathsep}{os.environ['PATH']}")
        done = projects.quick(tmp_path, "init", "--example", lock.stem, "demo")
        assert done.returncode == 0, done.stderr
        return tmp_path / "demo", environment

    return started


def configure(root: Path, before: str, after: str) -> None:
    """Replace a text in sierra.toml."""
    settings = (root / "sierra.toml").read_text()
    assert before in settings
    (root / "sierra.toml").write_text(settings.replace(before, after))
