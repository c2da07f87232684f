"""Unfinished files of killed processes are removed by gc and by the next drawing; no other file is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sierra.deliverables.record import marked_folder
from sierra.store import unfinished_files
from sierra.store.store import Store
from sierra.util.scratch import is_abandoned, scratch
from tests import projects, stores

KILLED = """
import os, sys
from pathlib import Path
from sierra.util.fs import unfinished_beside
from sierra.util.scratch import scratch
with scratch(Path(sys.argv[1]), ".video-") as folder:
    (folder / "half.mp4").write_text("half")
    unfinished_beside(Path(sys.argv[1]) / "a.pdf").write_text("half")
    os.kill(os.getpid(), 9)
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project in whose folders of figures a killed process left files."""
    root = projects.make(tmp_path_factory.mktemp("killed") / "project")
    for name in ("marked", "mine"):
        (root / "figures" / name).mkdir(parents=True)
        subprocess.run([sys.executable, "-c", KILLED, str(root / "figures" / name)], check=False)
    (root / "figures/marked/.drawn").touch()
    for name in ("a.pdf", ".hidden", f".b.pdf.01234567.{os.getpid()}", ".c.pdf.1"):
        (root / "figures/marked" / name).touch()
    return root


def names(folder: Path) -> set[str]:
    return {path.name.partition("-")[0] for path in folder.iterdir()}


KEPT = {".drawn", "a.pdf", ".hidden", f".b.pdf.01234567.{os.getpid()}", ".c.pdf.1"}


def test_gc_and_the_next_drawing_remove_what_killed_processes_left(killed: Path, tmp_path: Path) -> None:
    for place in ("gc", "drawing"):
        root = stores.copy(killed, tmp_path / place)
        folder = root / "figures/marked"
        left = [path.name for path in unfinished_files.unfinished(root)]
        assert [name.startswith(start) for name, start in zip(left, (".a.pdf.", ".video-"), strict=True)] == [True, True]
        if place == "gc":
            Store.create(root / ".sierra")
            assert "2 unfinished files" in projects.quick(root, "gc", "--dry-run").stdout
            assert projects.quick(root, "gc", "--yes").returncode == 0
        else:
            marked_folder(folder / ".drawn", "")
        assert names(folder) == KEPT
        assert len(names(root / "figures/mine")) == 2, "a folder without our mark is left alone"


def test_a_temporary_folder_of_a_living_process_stays(tmp_path: Path) -> None:
    (tmp_path / ".drawn").touch()
    with scratch(tmp_path, ".video-") as folder:
        assert (is_abandoned(folder), list(unfinished_files.unfinished_in(tmp_path))) == (False, [])
    (tmp_path / ".video-mine").mkdir()
    assert list(unfinished_files.unfinished_in(tmp_path)) == []
