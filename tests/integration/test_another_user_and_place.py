"""Records are valid elsewhere: in a second checkout, at another path, for another user with another home."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

import sierra
from tests import projects

AS_ANOTHER = ("unshare", "--user", "--map-user=1234", "--map-group=1234")


def as_another(folder: Path, *words: str) -> tuple[int, dict[str, Any]]:
    """Run the command as somebody else: another name and home, and, if the kernel allows it, another user id."""
    allowed = shutil.which("unshare") and not subprocess.run([*AS_ANOTHER, "true"], check=False, capture_output=True).returncode
    home = folder.parent / "another's home"
    home.mkdir(exist_ok=True)
    around = {"HOME": str(home), "USER": "another", "LOGNAME": "another", "LANG": "C", "TZ": "Asia/Kathmandu"}
    ended = subprocess.run(
        [*(AS_ANOTHER if allowed else ()), str(projects.SIERRA), *words, "--json"],
        cwd=folder,
        env={**{name: value for name, value in os.environ.items() if not name.startswith("XDG_")}, **around},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Traceback" not in ended.stderr
    return ended.returncode, json.loads(ended.stdout) if ended.stdout else {"stderr": ended.stderr}


def clone(root: Path, to: Path) -> Path:
    """Return a second checkout with a copy of the store."""
    subprocess.run(["git", "clone", "--quiet", "--no-local", str(root), str(to)], check=True)
    shutil.copytree(root / ".sierra", to / ".sierra")
    return to


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, str]:
    """Return a committed project with a recorded batch; Python is not in the home of who recorded it."""
    monkeypatch.setenv("HOME", str(tmp_path / "first home"))
    root = projects.commit(projects.make(tmp_path / "first" / "project"))
    batch: str = sierra.open(root).run("population_size=1,2", figures=False).batch
    return root, batch


def test_a_second_checkout_has_the_same_ids_and_replays_identically(recorded: tuple[Path, str], tmp_path: Path) -> None:
    root, batch = recorded
    (tmp_path / "some where").mkdir()
    second = clone(root, tmp_path / "some where" / "else")
    code, said = as_another(second, "replay", batch)
    assert (code, said["verdict"], said["runs"], said["notes"]) == (0, "identical", 4, [])
    code, said = as_another(second, "run", "population_size=1,2", "--no-figures")
    assert (code, said["batch"], said["executed"], said["reused"]) == (0, batch, 0, 4)


def test_a_second_checkout_without_the_store_gives_the_same_batch_and_results(
    recorded: tuple[Path, str], tmp_path: Path
) -> None:
    root, batch = recorded
    second = clone(root, tmp_path / "second")
    shutil.rmtree(second / ".sierra")
    assert as_another(second, "run", "population_size=1,2", "--no-figures")[1]["batch"] == batch
    results = "SELECT run, result FROM executions WHERE purpose = 'run' ORDER BY 1"
    assert sierra.open(second).sql(results).equals(sierra.open(root).sql(results))


@pytest.mark.nightly
def test_an_old_commit_replays_in_a_second_checkout_with_newer_commits(recorded: tuple[Path, str], tmp_path: Path) -> None:
    root, batch = recorded
    (root / "sim.py").write_text(projects.SIMULATOR.replace("count * tick", "count * tick + 1"))
    projects.commit(root, "second")
    second = clone(root, tmp_path / "second")
    code, said = as_another(second, "replay", batch)
    assert (code, said.get("verdict")) == (0, "identical")
    assert as_another(second, "run", "population_size=1,2", "--no-figures")[1]["batch"] != batch


@pytest.mark.nightly
def test_code_that_was_never_committed_is_reported_as_missing_elsewhere(recorded: tuple[Path, str], tmp_path: Path) -> None:
    root, _ = recorded
    (root / "sim.py").write_text(projects.SIMULATOR.replace("count * tick", "count * tick + 1"))
    batch = sierra.open(root).run("population_size=1,2", figures=False).batch
    second = clone(root, tmp_path / "second")
    code, said = as_another(second, "replay", batch)
    assert (code, said["stderr"].count("\n"), "sim.py" in said["stderr"]) == (3, 1, True)
    assert sierra.open(root).replay(batch).verdict == "identical"
