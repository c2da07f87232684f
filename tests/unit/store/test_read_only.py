"""Stores that are read-only or have no project can be read."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import sierra
from tests import projects, stores

READING = [
    ("ls",),
    ("show", "{batch}"),
    ("sql", "SELECT count(*) FROM swarm"),
    ("stats", "swarm", "coverage", "-b", "{batch}"),
    ("files", "{batch}"),
    ("diff", "{batch}", "{other}"),
    ("why", "{batch}"),
    ("fsck",),
]


def filled(root: Path, words: tuple[str, ...]) -> tuple[str, ...]:
    batches = [row.batch for row in sierra.open(root).batches]
    return tuple(word.format(batch=batches[0], other=batches[1]) for word in words)


@pytest.fixture
def readonly(recorded: Path, tmp_path: Path, require: Callable[..., str]) -> Iterator[Path]:
    """Yield a project on a read-only file system."""
    root = stores.copy(recorded, tmp_path / "project")
    mounted = subprocess.run(["mount", "--bind", root, root], check=False, capture_output=True)
    require("the right to mount a disk", there=mounted.returncode == 0)
    try:
        subprocess.run(["mount", "-o", "remount,bind,ro", root], check=True, capture_output=True)
        yield root
    finally:
        subprocess.run(["umount", "--lazy", root], check=True)


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("words", READING, ids=lambda words: words[0])
def test_a_read_only_store_can_be_read(readonly: Path, words: tuple[str, ...]) -> None:
    done = projects.quick(readonly, *filled(readonly, words))
    assert done.returncode == (words[0] == "diff"), (done.stdout, done.stderr)
    assert done.stdout
    assert "damaged" not in done.stdout


@pytest.mark.integration
def test_a_replay_of_a_read_only_store_needs_the_option_no_record(readonly: Path) -> None:
    batch = sierra.open(readonly).batches[0].batch
    refused = projects.quick(readonly, "replay", batch)
    assert (refused.returncode, refused.stderr.count("\n")) == (3, 1)
    assert "--no-record" in refused.stderr
    done = projects.quick(readonly, "replay", batch, "--no-record")
    assert done.returncode == 0, done.stderr
    assert "identical" in done.stdout


@pytest.mark.integration
def test_a_replay_without_a_record_leaves_the_store_unchanged(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    before = stores.state(root)
    project = sierra.open(root)
    answer = project.replay(project.batches[0].batch, runs=1, record=False)
    assert (answer.verdict, len(answer.runs)) == ("identical", 2)
    assert stores.state(root) == before
    assert not [path for path in (tmp_path / "tmp").iterdir() if path.name.startswith("sierra-beside")]
    refused = projects.quick(root, "replay", project.batches[0].batch, "--no-record", "--keep")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)


@pytest.fixture
def alone(recorded: Path, tmp_path: Path) -> Path:
    """Return a folder that contains only the store of a project."""
    (tmp_path / "alone").mkdir()
    shutil.copytree(recorded / ".sierra", tmp_path / "alone" / ".sierra", symlinks=True)
    return tmp_path / "alone"


@pytest.mark.integration
@pytest.mark.parametrize("words", [*READING, ("figures", "{batch}")], ids=lambda words: words[0])
def test_a_store_without_a_project_can_be_read(recorded: Path, alone: Path, tmp_path: Path, words: tuple[str, ...]) -> None:
    (alone / "below").mkdir()
    words = filled(recorded, words)
    whole = stores.copy(recorded, tmp_path / "project") if words[0] == "figures" else recorded
    done, before = projects.quick(alone / "below", *words), projects.quick(whole, *words)
    assert (done.returncode, done.stdout != "") == (before.returncode, True), done.stderr
    if words[0] not in ("why", "figures", "fsck"):  # these print the project or their duration
        assert done.stdout.replace(str(alone), str(recorded)) == before.stdout


def test_queries_in_a_store_without_a_project_are_refused(alone: Path) -> None:
    for words in (("run", "population_size=1"), ("run", "population_size=1", "--dry-run")):
        done = projects.quick(alone, *words)
        assert (done.returncode, done.stderr.count("\n")) == (3, 1)
        assert "sierra init" in done.stderr


def test_a_folder_without_project_and_store_is_reported(tmp_path: Path) -> None:
    done = projects.quick(tmp_path, "ls")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "no sierra.toml" in done.stderr


@pytest.mark.nightly
def test_recorded_declarations_of_outputs_are_used_without_a_project(tmp_path: Path) -> None:
    config = projects.CONFIG + '[outputs.swarm]\nfile = "swarm.csv"\ntime = "tick"\nunits = { coverage = "m" }\n'
    root = projects.make(tmp_path / "project", config)
    batch = sierra.open(root).run("population_size=1", figures=False).batch
    before = sierra.open(root).statistics(batch, "swarm", "coverage").to_pylist()
    (root / "sierra.toml").unlink()
    project = sierra.open(root)
    assert project.config.outputs["swarm"].units == {"coverage": "m"}
    assert project.statistics(batch, "swarm", "coverage").to_pylist() == before
