"""`make release` tags a version that all files name and that passes the checks, and nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TODAY = "2031-05-06"
FILES = {
    "sierra/util/version.py": '"""The version."""\n\n__version__ = "0.3.0"\n',
    "CITATION.cff": f"version: 0.3.0\ndate-released: {TODAY}\n",
    "CHANGELOG.md": f"# Changelog\n\n## [Unreleased]\n\n## [0.3.0] - {TODAY}\n",
    ".ci/run": "#!/bin/sh\ntest ! -e fails\n",
    "Makefile": "dist:\n\tmkdir -p dist\n\ttouch dist/wheel\n",
    ".gitignore": "dist/\n",
}


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / ".ci" / "run").chmod(0o755)
    date = tmp_path.with_name(f"{tmp_path.name}-programs") / "date"
    date.parent.mkdir()
    date.write_text(f"#!/bin/sh\necho {TODAY}\n")
    date.chmod(0o755)
    script = tmp_path / "tests" / "system" / "release.sh"
    script.parent.mkdir(parents=True)
    shutil.copy2(ROOT / "tests" / "system" / "release.sh", script)
    _git(tmp_path, "init", "-q")
    _commit(tmp_path)
    return tmp_path


def _git(folder: Path, *words: str) -> str:
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    return subprocess.run(["git", *author, *words], cwd=folder, capture_output=True, text=True, check=True).stdout


def _commit(folder: Path) -> None:
    _git(folder, "add", ".")
    _git(folder, "commit", "-q", "-m", "all")


def _release(folder: Path) -> subprocess.CompletedProcess[str]:
    _git(folder, "config", "user.name", "a")
    _git(folder, "config", "user.email", "a@b")
    programs = folder.with_name(f"{folder.name}-programs")
    environment = os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.run(["tests/system/release.sh"], cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_a_version_that_passes_all_checks_is_tagged(repository: Path) -> None:
    done = _release(repository)
    assert done.returncode == 0, done.stderr
    assert _git(repository, "cat-file", "-p", "v0.3.0").splitlines()[-1] == "SIERRA 0.3.0"
    assert "dist/wheel" in done.stdout


REFUSALS: dict[str, tuple[Callable[[Path], object], int, str]] = {
    "changes": (lambda root: (root / "new").touch(), 2, "the working tree has changes"),
    "a tag": (lambda root: _git(root, "tag", "v0.3.0"), 2, "there is a tag v0.3.0"),
    "another version": (
        lambda root: _changed(root, "CITATION.cff", "0.3.0", "0.2.0"),
        2,
        "CITATION.cff has another version",
    ),
    "another day": (lambda root: _changed(root, "CITATION.cff", TODAY, "2020-01-01"), 2, f"date-released: {TODAY}"),
    "no heading": (lambda root: _changed(root, "CHANGELOG.md", "## [0.3.0]", "## 0.3.0"), 2, "needs the heading"),
    "a development version": (lambda root: _changed(root, "sierra/util/version.py", "0.3.0", "0.3.dev1"), 2, "is no version"),
    "a commit meanwhile": (
        lambda root: _changed(root, ".ci/run", "test ! -e fails", "git commit --allow-empty -q -m other"),
        1,
        "there is another commit than the one that was checked",
    ),
    "files of checks": (lambda root: _changed(root, ".ci/run", "test ! -e fails", "touch new"), 1, "the checks changed files"),
    "failing checks": (lambda root: _changed(root, ".ci/run", "test ! -e fails", "exit 1"), 1, ""),
}


def _changed(root: Path, name: str, before: str, after: str) -> None:
    path = root / name
    path.write_text(path.read_text().replace(before, after))
    _commit(root)


@pytest.mark.parametrize(("change", "code", "message"), REFUSALS.values(), ids=REFUSALS)
def test_nothing_is_tagged_otherwise(repository: Path, change: Callable[[Path], object], code: int, message: str) -> None:
    change(repository)
    before = _git(repository, "tag")
    refused = _release(repository)
    assert (refused.returncode, _git(repository, "tag")) == (code, before)
    assert message in refused.stderr
