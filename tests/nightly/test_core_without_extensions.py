"""The core's checks and fast tests pass in a copy of the repository without an extension, its tests and its pages."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sierra.config.extensions import ADDS
from tests.support.pages import extension_of

ROOT = Path(__file__).parents[2]
PYTHON = sys.executable
CHECKS = (
    ("ruff", "check"),
    ("ruff", "format", "--check"),
    ("mypy", "sierra"),
    ("lint-imports", "--no-logo"),
    (PYTHON, "tests/bench/ratchet.py"),
    (PYTHON, "tests/bench/extension_names.py"),
    (PYTHON, "tests/bench/vague_names.py"),
)
"""The steps of `make check`."""
TESTS = (PYTHON, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not integration and not nightly", "tests/unit")


def without(name: str, copy: Path) -> None:
    """Copy the files that git knows or does not ignore, without an extension and those that need it."""
    argv = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    listed = subprocess.run(argv, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    for path in filter(None, listed):
        if (ROOT / path).is_file():
            (copy / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / path, copy / path)
    for lost in (name, *(other for other, adds in ADDS.items() if name in adds.get("needs", {}))):
        shutil.rmtree(copy / "sierra" / "extensions" / lost)
        shutil.rmtree(copy / "tests" / "extensions" / lost)
        for page in (copy / "docs" / "extensions").glob("*.md"):
            if extension_of(page) == lost:
                page.unlink()
    (copy / "tests" / "__init__.py").touch()  # else modules of tests that are not here are found in the original


@pytest.mark.parametrize("name", ADDS)
def test_checks_and_fast_tests_of_the_core_pass_without_an_extension(name: str, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    without(name, copy)
    programs = Path(sys.executable).parent
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    environment |= {"PYTHONPATH": str(copy), "PATH": f"{programs}{os.pathsep}{environment['PATH']}"}

    def call(*argv: str) -> None:
        done = subprocess.run(argv, cwd=copy, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{' '.join(argv)}\n{done.stdout[-20_000:]}{done.stderr[-5_000:]}"

    call("sierra", "schema", "--write", "schemas")
    call(PYTHON, "docs/generate.py")
    for check in CHECKS:
        call(*check)
    call(*TESTS)
