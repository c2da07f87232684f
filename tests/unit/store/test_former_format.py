"""Stores and packages of format 4, in which files of outputs are called by their tables: read as they are, and gone on with.

The package in `tests/data` was written by the last SIERRA before format 5. Its folder `project` is a project with a store.
"""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import sierra
from sierra.store.segments import FORMAT, FORMER
from tests import projects, stores

PACKAGE = Path(__file__).parents[2] / "data" / "stores" / "format-4.zip"
TABLES = {
    "swarm": "SELECT n, number, t, v, w FROM swarm ORDER BY ALL",
    "_1": "SELECT n, number, last FROM _1 ORDER BY ALL",
    "executions": "SELECT execution, result FROM executions ORDER BY ALL",
}
KILLED = """
import os, signal, sys
from sierra.store import segments
step, number = sys.argv.pop(1), int(sys.argv.pop(1))
owner = segments if hasattr(segments, step) else {"pwrite": os, "fsync": os, "rename": segments.Path}[step]
before, calls = getattr(owner, step), []
def killed(*given):
    calls.append(given)
    if len(calls) > number:
        os.kill(os.getpid(), signal.SIGKILL)
    return before(*given)
setattr(owner, step, killed)
from sierra.cli.main import main
main()
"""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    with zipfile.ZipFile(PACKAGE) as packed:
        packed.extractall(tmp_path / "package")
    return tmp_path / "package" / "project"


def rows(root: Path) -> dict[str, object]:
    return {name: sierra.open(root).sql(statement).to_pylist() for name, statement in TABLES.items()}


def number(root: Path) -> str:
    return (root / ".sierra" / "format").read_text()


@pytest.mark.integration
def test_commands_that_only_read_leave_a_store_of_the_former_format_as_it_is(root: Path) -> None:
    before = stores.state(root)
    found = rows(root)
    assert found["_1"] == [{"n": n, "number": k, "last": 10 * n} for n in (1, 2, 3) for k in (0, 1)]
    assert [(row["n"], row["w"]) for row in found["swarm"]][6:9] == [(2, 0), (2, 1), (2, 2)]  # type: ignore[attr-defined]
    for words in (("ls",), ("fsck",), ("stats", "swarm", "v"), ("run", "n=1,2", "-n")):
        ended = projects.quick(root, *words)
        assert ended.returncode == 0, ended.stderr
    after = stores.state(root)
    assert {name: after[name] for name in before} == before


@pytest.mark.integration
def test_the_first_session_that_writes_replaces_the_number_and_no_record(root: Path) -> None:
    before, segments = rows(root), {name for name in stores.state(root) if name.startswith("segments/")}
    inode = (root / ".sierra" / "format").stat().st_ino
    assert number(root) == FORMER
    summary = sierra.open(root).run("n=7", figures=False)
    assert (number(root), summary.executed) == (FORMAT, 2)
    assert (root / ".sierra" / "format").stat().st_ino == inode  # readers hold a lock on it
    assert segments <= stores.state(root).keys()
    merged = {name: [*found, *(row for row in rows(root)[name] if row not in found)] for name, found in before.items()}
    assert {name: sorted(map(str, found)) for name, found in rows(root).items()} == {
        name: sorted(map(str, found)) for name, found in merged.items()
    }
    assert [row["v"] for row in sierra.open(root).sql("SELECT v FROM swarm WHERE n = 7 AND t = 2").to_pylist()]
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.nightly
def test_segments_with_either_kind_of_names_are_merged_and_packed(root: Path, tmp_path: Path) -> None:
    project = sierra.open(root)
    project.replay(project.batches[0].batch, runs=1)
    before, many = rows(root), len(sierra.open(root).store.segments())
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert rows(root) == before
    assert len(sierra.open(root).store.segments()) < many
    assert projects.quick(root, "fsck").returncode == 0
    project.packages.pack(*(one.batch for one in project.batches), path=tmp_path / "all.zip", report=False)
    other = projects.make(tmp_path / "other")
    sierra.open(other).packages.import_records(tmp_path / "all.zip")
    assert rows(other)["swarm"] == before["swarm"]
    assert not [name for name in stores.state(other) if "swarm" in name]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("step", "calls"),
    [("renew", 0), ("pwrite", 0), ("fsync", 0), ("rename", 0), ("rename", 1), ("renew", 1)],
    ids=["before the number", "before its byte", "after its byte", "before the segment", "after the segment", "between two"],
)
def test_nothing_is_lost_if_the_first_writer_is_killed(root: Path, tmp_path: Path, step: str, calls: int) -> None:
    before = rows(root)
    program = tmp_path / "killed.py"
    program.write_text(KILLED)
    words = [sys.executable, str(program), step, str(calls), "run", "n=8", "--no-figures"]
    assert subprocess.run(words, cwd=root, capture_output=True, check=False).returncode == -9
    assert number(root) in (FORMER, FORMAT)
    after = rows(root)
    assert all(row in after[name] for name, found in before.items() for row in found)  # type: ignore[attr-defined, operator]
    summary = sierra.open(root).run("n=8", figures=False)
    assert (summary.failed, summary.missing, number(root)) == (0, 0, FORMAT)
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
def test_packages_of_the_former_format_are_opened_imported_and_reproduced(tmp_path: Path) -> None:
    other = projects.make(tmp_path / "other")
    shown = projects.quick(other, "open", str(PACKAGE))
    assert shown.returncode == 0, shown.stderr
    sierra.open(other).packages.import_records(PACKAGE)
    assert sierra.open(other).sql("SELECT round(sum(v), 3) AS v FROM swarm").to_pylist() == [{"v": 52.398}]
    for _ in range(2):  # the second time, the copy's store has the present number
        ended = projects.quick(tmp_path, "reproduce", str(PACKAGE), "--into", "again", "--yes")
        assert ended.returncode == 0, ended.stdout + ended.stderr
    assert number(tmp_path / "again" / "package" / "project") == FORMAT
