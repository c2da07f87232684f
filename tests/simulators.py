"""Real simulators from an index of Python packages: their environments, and projects that call them.

The lock files in `tests/data/simulators` are made by `uv pip compile --universal --python-version 3.11 --generate-hashes
--no-header --no-annotate --no-emit-index-url --no-emit-find-links`.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from tests import projects

LOCKS = Path(__file__).parent / "data" / "simulators"
STAND_IN = LOCKS / "gzserver"
"""A program with the messages of gzserver, and without physics."""
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

    def install(self, name: str) -> str:
        """Install exactly what a lock file names; return the errors."""
        return self.pip("install", *LOCKED, LOCKS / f"{name}.txt")


Install = Callable[[str], Environment]
Edit = Callable[[Path, bytes], None]


def project(folder: Path, command: str, template: str, *, seed: str, size: str, observe: str = "first") -> Path:
    """Write a project whose experiments are called by their size."""
    folder.mkdir()
    (folder / "template.xml").write_text(template)
    (folder / "sierra.toml").write_text(
        f'template = "template.xml"\ncommand = "{command}"\nseed = "{seed}"\nruns = 2\nobserve = "{observe}"\n'
        f'[variables]\nsize = "{size}"\n'
    )
    return folder


def values(root: Path, statement: str) -> set[object]:
    """Return the values of the only column of a statement."""
    return {value for row in projects.sql(root, statement) for value in row.values()}
