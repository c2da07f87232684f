"""Commands about a batch take the last one if no id is given, and name it on standard error."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from sierra.runners.cluster.submission_record import Submission
from sierra.store.layout import ProjectPaths, SessionPaths, StorePaths
from tests import projects

PACKAGE = '[package]\ntitle = "A swarm"\nlicense = "MIT"\nauthors = [{ name = "A. Person" }]\n'


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = projects.make(tmp_path_factory.mktemp("last") / "project", projects.CONFIG + PACKAGE)
    for size in ("1", "2"):
        projects.run(folder, f"population_size={size}", "--runs", "1")
    return folder


def batches(project: Path) -> list[str]:
    return [row["batch"] for row in json.loads(projects.quick(project, "ls", "--json").stdout)]


def submitted(project: Path, chosen: Sequence[str]) -> None:
    """Leave a session on a cluster for each of these batches."""
    for number, batch in enumerate(chosen):
        session = SessionPaths(StorePaths(ProjectPaths(project).store).work / f"{number:016x}")
        session.root.mkdir(parents=True)
        session.owner(0).write_text('{"pid": 1, "where": "elsewhere"}')
        Submission("slurm", "slurm", "slurm 23.11", {}, batch, (1,), {}).save(session)


@pytest.mark.parametrize("words", ["show", "show --json", "show --files", "show --files --json", "files", "why", "why --json"])
def test_the_last_batch_is_shown_and_named(project: Path, words: str) -> None:
    last = batches(project)[-1]
    command, *options = words.split()
    named = projects.quick(project, command, last, *options)
    done = projects.quick(project, *words.split())
    assert (done.returncode, done.stdout) == (0, named.stdout)
    assert done.stderr == f"note: batch {last[:10]}, the last one\n" + named.stderr


def test_the_first_word_of_show_is_no_path_in_the_last_batch(project: Path) -> None:
    done = projects.quick(project, "show", "swarm.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert "'swarm.csv' is not an id" in done.stderr


def test_the_files_of_the_last_batch_are_written(project: Path, tmp_path: Path) -> None:
    done = projects.quick(project, "show", "--to", str(tmp_path / "recorded"))
    assert done.returncode == 0, done.stderr
    assert batches(project)[-1][:10] in done.stderr
    assert [path.name for path in (tmp_path / "recorded").rglob("swarm.csv")] == ["swarm.csv"]


@pytest.mark.integration
def test_the_last_batch_is_replayed_and_packed(project: Path) -> None:
    last = batches(project)[-1]
    replayed = projects.quick(project, "replay", "--json")
    assert (replayed.returncode, json.loads(replayed.stdout)["target"]) == (0, last)
    packed = projects.quick(project, "package", "-o", "../last.zip", "--yes", "--no-report")
    assert packed.returncode == 0, packed.stderr
    for done in (replayed, packed):
        assert f"note: batch {last[:10]}, the last one\n" in done.stderr
    assert "population_size=2" in projects.quick(project, "open", "../last.zip").stdout
    shown = projects.quick(project, "open", "../last.zip", "show", "--json")
    assert json.loads(shown.stdout)["batch"] == last


@pytest.mark.parametrize("words", ["show", "show --files", "why", "replay", "package -o x.zip"])
def test_a_store_without_batches_has_no_last_one(tmp_path: Path, words: str) -> None:
    done = projects.quick(projects.make(tmp_path / "new", projects.CONFIG + PACKAGE), *words.split())
    assert (done.returncode, done.stdout) == (3, "")
    assert "nothing has been run here yet" in done.stderr


@pytest.mark.parametrize("command", ["attach", "cancel"])
def test_without_cluster_jobs_there_is_nothing_to_attach_or_cancel(project: Path, command: str) -> None:
    done = projects.quick(project, command)
    assert (done.returncode, done.stdout) == (2, "")
    assert "no batch has jobs on a cluster" in done.stderr


def test_of_several_batches_on_clusters_none_is_cancelled_without_an_id(project: Path, tmp_path: Path) -> None:
    both = batches(project)
    folder = tmp_path / "project"
    shutil.copytree(project, folder)
    submitted(folder, both)
    done = projects.quick(folder, "cancel")
    listed = ", ".join(f"{batch[:10]} (population_size={size})" for size, batch in enumerate(both, 1))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"sierra: 2 batches have jobs on a cluster; name one of them: {listed}\n"


def test_rm_needs_an_id(project: Path) -> None:
    done = projects.quick(project, "rm", "--yes")
    assert done.returncode == 2
    assert len(batches(project)) == 2
