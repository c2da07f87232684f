"""Stores that several users share, and stores of which this process may not or cannot read all: nothing of this is damage."""

from __future__ import annotations

import contextlib
import os
import resource
import stat
import subprocess
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

import sierra
from sierra.execution import sessions
from sierra.store.layout import StorePaths
from sierra.util import open_files
from tests import projects, stores
from tests.unit.store.test_former_format import PACKAGE

SOMEBODY = 12345


@pytest.fixture
def root(tmp_path: Path) -> Path:
    with zipfile.ZipFile(PACKAGE) as packed:
        packed.extractall(tmp_path)
    return tmp_path / "project"


@contextlib.contextmanager
def umask(mask: int) -> Iterator[None]:
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)


def unprivileged(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Call the command line without root's right to read and write everything."""
    without = ("setpriv", "--bounding-set=-all", "--inh-caps=-all") if os.geteuid() == 0 else ()
    return subprocess.run([*without, projects.SIERRA, *words], cwd=root, capture_output=True, text=True, check=False)


@pytest.mark.integration
@pytest.mark.parametrize("mask", [0o002, 0o077])
def test_files_of_a_store_follow_the_umask(tmp_path: Path, mask: int) -> None:
    with umask(mask):
        root = projects.make(tmp_path / "project")
        assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    found = {path: stat.S_IMODE(path.stat().st_mode) for path in (root / ".sierra").rglob("*") if path.is_file()}
    assert {path.name for path in found} >= {"lock", "mark", "id", "format"}
    assert {path.name: oct(mode) for path, mode in found.items() if mode != 0o666 & ~mask} == {}


@pytest.mark.integration
def test_a_lock_that_a_user_may_only_read_is_enough(root: Path) -> None:
    paths = StorePaths(root / ".sierra")
    with sessions.exclusively(paths):
        pass
    paths.work_lock.chmod(0o444)  # as another user's lock of an earlier version
    assert unprivileged(root, "fsck").returncode == 0
    assert unprivileged(root, "run", "n=7", "--no-figures").returncode == 0


@pytest.mark.integration
def test_files_that_a_user_may_not_read_are_named_and_are_no_damage(root: Path) -> None:
    before = stores.state(root)
    hidden = stores.files(root, "output.swarm")[0]
    hidden.chmod(0)
    checked = unprivileged(root, "fsck")
    assert checked.returncode == 3, checked.stdout + checked.stderr
    assert f"unchecked: {hidden.relative_to(root / '.sierra')}: cannot be read: Permission denied" in checked.stdout
    assert "1 not checked: 6 segments" in checked.stdout
    assert "repair" not in checked.stdout
    read = unprivileged(root, "sql", "SELECT count(*) FROM swarm")
    assert (read.returncode, f"{hidden} cannot be read: Permission denied" in read.stderr) == (3, True)
    repaired = unprivileged(root, "fsck", "--repair")
    assert (repaired.returncode, "nothing that depends on it is repaired" in repaired.stderr) == (3, True)
    hidden.chmod(0o444)
    after = stores.state(root)
    assert {name: after[name] for name in before} == before
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
def test_a_store_that_a_user_may_not_read_is_not_taken_for_none(root: Path) -> None:
    for name in ("format", "segments"):
        (root / ".sierra" / name).chmod(0)
        for command in ("ls", "fsck"):
            ended = unprivileged(root, command)
            assert (ended.returncode, "Permission denied" in ended.stdout + ended.stderr) == (3, True), ended
            assert name in ended.stdout + ended.stderr
        (root / ".sierra" / name).chmod(0o755)


@pytest.mark.integration
def test_the_message_names_the_file_that_cannot_be_written(root: Path) -> None:
    (root / ".sierra" / "format").chmod(0o444)
    ended = unprivileged(root, "run", "n=1", "--runs", "3", "--no-figures")
    assert (ended.returncode, f"cannot write to {root}/.sierra/format: Permission denied" in ended.stderr) == (3, True)


# ---------------------------------------------------------------- open files


def limited(root: Path, limits: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Call the command line with limits on open files, such as `-Sn 72`."""
    script = f'ulimit {limits} && exec "$0" "$@"'
    return subprocess.run(["sh", "-c", script, projects.SIERRA, *words], cwd=root, capture_output=True, text=True, check=False)


@pytest.mark.integration
def test_too_few_open_files_are_named_and_are_no_damage(root: Path) -> None:
    assert limited(root, "-Sn 32", "sql", "SELECT count(*) FROM swarm").returncode == 0
    for words in (("sql", "SELECT count(*) FROM swarm"), ("ls",), ("fsck",), ("run", "n=1", "--no-figures")):
        ended = limited(root, "-n 7", *words)
        said = ended.stdout + ended.stderr
        assert (ended.returncode, "Too many open files; allow more (ulimit -n)" in said) == (3, True), said
        assert not any(word in said for word in ("damaged", "repair", "inconsistent", "Traceback"))
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
def test_programs_of_runs_have_the_limit_that_the_user_has(tmp_path: Path) -> None:
    program = 'import resource\nprint(resource.getrlimit(resource.RLIMIT_NOFILE)[0], file=open("limit.txt", "w"))\n'
    root = projects.make(tmp_path / "project", simulator=projects.SIMULATOR + program)
    assert limited(root, "-Sn 300", "run", "population_size=1", "--no-figures").returncode == 0
    project = sierra.open(root)
    assert projects.quick(root, "files", project.batches[0].batch, "limit.txt", "--to", "out").returncode == 0
    assert {path.read_text() for path in (root / "out").rglob("limit.txt")} == {"300\n"}
    assert project.sql("SELECT DISTINCT limits->'nofile'->>0 AS soft FROM environments").to_pylist() == [{"soft": "300"}]


@pytest.mark.parametrize(
    ("soft", "cores", "threads"), [(64, 8, 1), (250, 8, 2), (1024, 48, 9), (1024, 8, None), (-1, 64, None)]
)
def test_threads_are_bounded_by_the_limit_on_open_files(
    monkeypatch: pytest.MonkeyPatch, soft: int, cores: int, threads: int | None
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (soft, soft))
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)))
    assert open_files.threads() == threads
