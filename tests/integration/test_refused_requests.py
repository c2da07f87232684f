"""A request that is refused before anything executes leaves no record."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import projects

pytestmark = pytest.mark.integration


def listed(folder: Path) -> list[object]:
    found: list[object] = json.loads(projects.quick(folder, "ls", "--json").stdout or "[]")
    return found


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Put programs of SLURM on the PATH; `sbatch` executes the given line."""

    def install(line: str) -> None:
        programs = tmp_path / "bin"
        programs.mkdir()
        answers = {"sbatch": line, "scontrol": "exit 0", "squeue": "exit 0", "sinfo": "exit 0", "sacctmgr": "exit 0"}
        for name, answer in answers.items():
            (programs / name).write_text(f'#!/bin/sh\n[ "$1" = --version ] && echo "slurm 23.11.0" && exit 0\n{answer}\n')
            (programs / name).chmod(0o755)
        monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")

    return install


def refused(folder: Path, *words: str) -> str:
    done = projects.quick(folder, "run", "population_size=1,2", "--no-figures", *words)
    assert done.returncode in (2, 3), done.stdout + done.stderr
    assert listed(folder) == []
    assert not list(folder.glob(".sierra/segments/*"))
    again = projects.quick(folder, "run", "population_size=1,2", "--no-figures", *words)
    assert "submitted before" not in again.stdout + again.stderr
    return done.stderr


def test_a_job_that_the_scheduler_refuses(tmp_path: Path, cluster: Callable[[str], None]) -> None:
    cluster("echo 'sbatch: error: invalid partition specified: nowhere' >&2; exit 1")
    folder = projects.commit(projects.make(tmp_path / "project"))
    assert "nowhere" in refused(folder, "--on", "slurm")


def test_a_supervised_trial_without_a_terminal(tmp_path: Path) -> None:
    refused(projects.make(tmp_path / "project", projects.CONFIG + "[trials]\nsupervised = true\n"))


def test_a_second_batch_that_is_refused_leaves_the_first(tmp_path: Path, cluster: Callable[[str], None]) -> None:
    cluster("echo 'sbatch: error: invalid partition specified: nowhere' >&2; exit 1")
    folder = projects.commit(projects.make(tmp_path / "project"))
    projects.run(folder, "population_size=1")
    assert len(listed(folder)) == 1
    for query in ("population_size=1,2", "population_size=1"):
        projects.quick(folder, "run", query, "--no-figures", "--on", "slurm", "--runs", "3")
        assert len(listed(folder)) == 1
    summary, _ = projects.run(folder, "population_size=1")
    assert summary["reused"] == 2


@pytest.mark.nightly
def test_a_refused_batch_stays_if_another_session_has_recorded_since(tmp_path: Path, cluster: Callable[[str], None]) -> None:
    """The other batch has runs of the refused one, whose inputs it has not recorded again."""
    folder = tmp_path / "project"
    run = f"cd '{folder}' && '{sys.executable}' '{projects.SIERRA}' run population_size=1 --no-figures"
    cluster(f"{run} > '{tmp_path}/said' 2>&1; echo 'sbatch: error: invalid partition specified: nowhere' >&2; exit 1")
    projects.commit(projects.make(folder))
    done = projects.quick(folder, "run", "population_size=1,2", "--no-figures", "--on", "slurm", "--only", "population_size=2")
    assert done.returncode == 2, done.stdout + done.stderr
    [(batch,)] = {(row["batch"],) for row in projects.sql(folder, "SELECT batch FROM executions")}
    replayed = projects.quick(folder, "replay", batch)
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr + (tmp_path / "said").read_text()
