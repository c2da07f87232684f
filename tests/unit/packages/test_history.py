"""The history in a package is a bundle that git clones, whose bytes do not depend on how the repository stores its objects."""

from __future__ import annotations

import subprocess
import zipfile
from pathlib import Path

import pytest

import sierra
from tests import projects

PACKAGE = '\n[package]\ntitle = "T"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
BUNDLE = "source/history.bundle"
pytestmark = pytest.mark.integration


def git(folder: Path, *words: str) -> str:
    return subprocess.run(["git", *words], cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.mark.nightly
def test_the_history_of_the_recorded_commits_is_a_bundle(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + PACKAGE)
    for number in range(5):
        (root / "notes.txt").write_text("".join(f"line {one}\n" for one in range(number, 300)))
        projects.commit(root, f"number {number}")
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "one.zip")
    (root / "later.txt").write_text("not recorded")
    projects.commit(root, "later")
    git(root, "-c", "gc.pruneExpire=now", "gc", "--aggressive", "--quiet")
    git(root, "config", "pack.window", "3")
    packed = sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "two.zip")
    assert packed is not None
    assert packed.preview.notes == ()
    with zipfile.ZipFile(tmp_path / "one.zip") as one, zipfile.ZipFile(tmp_path / "two.zip") as two:
        assert one.read(BUNDLE) == two.read(BUNDLE)
        (tmp_path / "history.bundle").write_bytes(two.read(BUNDLE))
    git(tmp_path, "clone", "--quiet", "history.bundle", "cloned")
    assert git(tmp_path / "cloned", "log", "--format=%s").split("\n")[:-1] == [f"number {one}" for one in range(4, -1, -1)]
    git(tmp_path / "cloned", "fsck", "--full", "--strict")

    git(tmp_path, "clone", "--quiet", "--depth=1", f"file://{root}", "shallow")
    (root / ".sierra").rename(tmp_path / "shallow/.sierra")
    git(tmp_path / "shallow", "fetch", "--quiet", "--depth=1", "origin", git(root, "rev-parse", "HEAD~1").strip())
    packed = sierra.open(tmp_path / "shallow").packages.pack(batch, report=False, path=tmp_path / "three.zip")
    assert packed is not None
    assert [
        "history of the commits is not packed: the repository is a shallow clone" in one for one in packed.preview.notes
    ] == [True]


def test_a_secret_that_only_the_history_has_is_found(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + PACKAGE)
    (root / "access.txt").write_text("npm_" + "aB3dE5gH7jK9mN1pQ3sT5vW7yZ9bC1eF3hJ5")
    projects.commit(root)
    (root / "access.txt").unlink()
    projects.commit(root, "second")
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    ended = projects.quick(root, "package", batch, "--no-report", "-o", "../x.zip", "--yes")
    assert (ended.returncode, "access.txt (a token of npm in the history" in ended.stderr) == (2, True)
    (root / "sierra.toml").write_text(projects.CONFIG + PACKAGE + "history = false\n")
    assert projects.quick(root, "package", batch, "--no-report", "-o", "../x.zip").returncode == 0
    with zipfile.ZipFile(tmp_path / "x.zip") as file:
        assert BUNDLE not in file.namelist()
