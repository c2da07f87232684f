"""Executions do not count if files that they were observed to use have changed."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.execution.observation.file_sets import UsedFile
from sierra.execution.observation.stale_sessions import reason
from sierra.worker.observed_record import graphics
from tests import projects

SIMULATOR = """\
import os, sys
factor = open(os.environ["LIBRARY"] + "/factor").read()
extra = os.environ["LIBRARY"] + "/extra"
more = open(extra).read() if os.path.exists(extra) else 0
print("tick,value", *(f"{tick},{int(factor) + int(more)}" for tick in range(3)), sep="\\n", file=open("swarm.csv", "w"))
"""
VALUES = "SELECT DISTINCT value FROM swarm ORDER BY ALL"


@pytest.fixture(params=["first", pytest.param("all", marks=pytest.mark.integration)])
def root(request: pytest.FixtureRequest, tmp_path: Path, require: Callable[..., str]) -> Path:
    """A project whose runs read a file outside the project that nothing names; `library` is its folder."""
    require("strace")
    library = tmp_path / "library"
    library.mkdir()
    (library / "factor").write_text("1")
    config = projects.CONFIG.replace("runs = 2", f'runs = 2\nobserve = "{request.param}"')
    config += f'[environment]\nset = {{ LIBRARY = "{library}" }}\n'
    return projects.make(tmp_path / "project", config, simulator=SIMULATOR)


QUERY = "population_size=1,2"


@pytest.mark.integration
def test_a_changed_file_executes_all_runs_again_if_they_used_it(root: Path) -> None:
    library = root.parent / "library"
    assert projects.run(root, QUERY)[0]["executed"] == 4
    (library / "other").write_text("5")
    assert projects.run(root, QUERY)[0]["executed"] == 0
    (library / "factor").write_text("2")
    summary, said = projects.run(root, QUERY)
    assert (summary["executed"], summary["reexecuted"]) == (4, 4)
    assert f"files that they used have changed: {library}/factor" in said
    assert projects.sql(root, VALUES) == [{"value": 2}]
    assert projects.run(root, QUERY)[0]["executed"] == 0


@pytest.mark.integration
def test_a_changed_file_that_git_ignores_executes_the_runs_of_a_commit_again(root: Path) -> None:
    """A commit's runs are executed in a checkout, and yet read this file in the project's folder."""
    library = root / "library"
    library.mkdir()
    (library / "factor").write_text("1")
    (root / ".gitignore").write_text(".sierra\nlibrary\n")
    config = root / "sierra.toml"
    text = config.read_text().replace(str(root.parent / "library"), str(library))
    config.write_text(text + '[source]\ndirty = "ignore"\n')
    projects.commit(root, "ignore")
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.run(root, QUERY)[0]["executed"] == 0
    (library / "factor").write_text("2")
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.sql(root, VALUES) == [{"value": 2}]


@pytest.mark.integration
def test_a_file_that_comes_into_existence_executes_all_runs_again(root: Path) -> None:
    projects.run(root, QUERY)
    (root.parent / "library" / "extra").write_text("5")
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.sql(root, VALUES) == [{"value": 6}]


@pytest.mark.nightly
def test_executions_count_again_once_the_file_is_restored(root: Path) -> None:
    library = root.parent / "library"
    projects.run(root, QUERY)
    (library / "factor").write_text("2")
    projects.run(root, QUERY)
    (library / "factor").write_text("1")
    summary, said = projects.run(root, QUERY)
    assert (summary["executed"], summary["reused"]) == (0, 4)
    assert "do not count" not in said
    assert projects.sql(root, VALUES) == [{"value": 1}]
    (library / "factor").write_text("2")
    assert projects.run(root, QUERY)[0]["executed"] == 0
    assert projects.sql(root, VALUES) == [{"value": 2}]


@pytest.mark.nightly
def test_new_runs_are_never_mixed_with_stale_ones(root: Path) -> None:
    projects.run(root, QUERY)
    (root.parent / "library" / "factor").write_text("2")
    assert projects.run(root, QUERY, "--runs", "4")[0]["executed"] == 8
    assert projects.sql(root, "SELECT DISTINCT value FROM swarm JOIN effective USING (execution)") == [{"value": 2}]


@pytest.mark.nightly
def test_a_dry_run_predicts_executions(root: Path) -> None:
    projects.run(root, QUERY)
    (root.parent / "library" / "factor").write_text("2")
    done = projects.quick(root, "run", "population_size=1,2", "-n", "--json")
    assert json.loads(done.stdout)["to_execute"] == 4


@pytest.mark.integration
def test_why_names_the_changed_file(root: Path) -> None:
    library = root.parent / "library"
    projects.run(root, QUERY)
    (library / "factor").write_text("2")
    predicted = projects.quick(root, "run", "population_size=1,2", "-n", "--explain")
    assert f"files that they used have changed: {library}/factor" in predicted.stdout + predicted.stderr
    projects.run(root, QUERY)
    execution = projects.sql(root, "SELECT run FROM executions ORDER BY lamport LIMIT 1")[0]["run"]
    said = projects.quick(root, "why", execution).stdout
    assert f"executed with other programs or files before: files that they used have changed: {library}/factor" in said
    assert "without this session's knowledge" not in said
    assert projects.quick(root, "fsck").returncode == 0


LIKE_A_GPU_PROGRAM = """\
import ctypes.util, os, sys
open(os.environ["LIBRARY"] + "/libcuda.so.1").read()
print("tick,value", *(f"{tick},1" for tick in range(3)), sep="\\n", file=open("swarm.csv", "w"))
"""


@pytest.mark.nightly
def test_a_different_replay_of_runs_that_used_a_gpu_names_what_differs_there(root: Path) -> None:
    library = root.parent / "library" / "libcuda.so.1"
    (root / "sim.py").write_text(LIKE_A_GPU_PROGRAM.replace("{tick},1", "{tick},{os.getpid()}"))
    library.touch()
    projects.run(root, QUERY)
    done = projects.quick(root, "replay", projects.sql(root, "SELECT batch FROM batches")[-1]["batch"], "--runs", "1")
    assert done.returncode == 1
    assert "torch.use_deterministic_algorithms(True), and set CUBLAS_WORKSPACE_CONFIG" in done.stdout


@pytest.mark.integration
def test_runs_that_use_a_gpu_depend_on_it_and_its_driver(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (root / "sim.py").write_text(LIKE_A_GPU_PROGRAM)
    (root.parent / "library" / "libcuda.so.1").touch()
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.sql(root, "SELECT count(*) AS n FROM files_read WHERE path = '{gpu}'") == [{"n": 1}]
    assert projects.run(root, QUERY)[0]["executed"] == 0
    monkeypatch.setattr("sierra.worker.observed_record.graphics", lambda root="/": ["another driver"])
    summary, said = projects.run(root, QUERY)
    assert summary["executed"] == 4
    assert "files that they used have changed: {gpu}" in said


GPUS = [*Path("/proc/driver/nvidia/gpus").glob("*"), *Path("/sys/class/drm").glob("card[0-9]/device")]


@pytest.mark.real
@pytest.mark.integration
@pytest.mark.skipif(not GPUS, reason="needs a GPU")
def test_the_kernel_describes_this_machines_gpu() -> None:
    assert graphics()


@pytest.mark.integration
def test_files_that_have_not_changed_are_not_reported_after_a_session_with_a_wrong_clock(
    root: Path, require: Callable[..., str]
) -> None:
    """The times of all files are in the future for that session."""
    clock = require("faketime")
    words = (clock, "-f", "-700d", str(projects.SIERRA), "run", QUERY, "--no-figures", "--json")
    done = subprocess.run(words, cwd=root, capture_output=True, text=True)
    assert (done.returncode, json.loads(done.stdout)["executed"]) == (0, 4), done.stderr
    assert "changed" not in done.stderr
    for query, executed in ((QUERY, 0), ("population_size=2,3", 2)):
        summary, said = projects.run(root, query)
        assert (summary["executed"], "do not count" in said, "changed" in said) == (executed, False, False)
    (root.parent / "library" / "factor").write_text("2")
    summary, said = projects.run(root, QUERY)
    assert summary["executed"] == 4
    assert f"files that they used have changed: {root.parent / 'library'}/factor" in said


def test_only_files_with_other_bytes_are_said_to_have_changed() -> None:
    files = [
        UsedFile("/a", "read", "1"),
        UsedFile("/b", "missed", None),
        UsedFile("/c", "listed", "2"),
        UsedFile("/d", "read", None),
    ]
    begin = "earlier executions do not count, because "
    said = {file: reason({"s": file}).removeprefix(begin) for file in files}
    assert list(said.values()) == [
        "files that they used have changed: /a",
        "files that they used have changed: /b (new)",
        "files that they used have changed: /c (its names)",
        "it is not known with which content they used /d",
    ]
