"""Programs of the project that git ignores are kept in the store, and a replay puts them back."""

from __future__ import annotations

import json
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from tests import projects

SIM = """\
#!/bin/sh
here="$(dirname "$0")"
cat "$here"/secret > /dev/null || true
printf 'tick,value\\n1,%s\\n' "$("$here"/part)" > swarm.csv
"""
PART = "#!/bin/sh\necho {}\n"
SECRET = "password\n"


def make(root: Path, more: str = "", observe: str = "all") -> Path:
    """Return a project whose simulator is `build/sim`, which starts `build/part` and reads `build/secret`, after one query."""
    config = projects.CONFIG.replace("python3 sim.py", "./build/sim").replace("runs = 2", f'runs = 2\nobserve = "{observe}"')
    projects.make(root, config + more)
    (root / ".gitignore").write_text("build/\n")
    (root / "build").mkdir()
    write(root, "sim", SIM)
    write(root, "part", PART.format(5))
    write(root, "secret", SECRET)
    projects.commit(root)
    done = projects.quick(root, "run", "population_size=1", "--no-figures")
    assert done.returncode == 0, done.stderr
    return root


def write(root: Path, name: str, text: str) -> None:
    (root / "build" / name).write_text(text)
    (root / "build" / name).chmod(0o755)


def replay(root: Path) -> tuple[int, dict[str, Any], str]:
    [batch] = json.loads(projects.quick(root, "ls", "--json").stdout)
    done = projects.quick(root, "replay", batch["batch"], "--json")
    return done.returncode, json.loads(done.stdout or "{}"), done.stderr


def is_kept(root: Path, text: str) -> bool:
    digest = sha256(text.encode()).hexdigest()
    return f"{digest}" in projects.quick(root, "sql", "SELECT DISTINCT sha256 FROM objects", "-f", "csv").stdout


@pytest.fixture
def root(tmp_path: Path, require: Callable[..., str]) -> Path:
    require("strace")
    return make(tmp_path / "project")


@pytest.mark.parametrize("name", ["sim", "part"])
def test_a_changed_program_is_put_back(root: Path, name: str) -> None:
    before = (root / "build" / name).read_text()
    write(root, name, before + "echo other >> swarm.csv\n")
    code, answer, _ = replay(root)
    assert (code, answer["verdict"], answer["notes"], answer["same_files"]) == (0, "identical", [], True)
    assert (root / "build" / name).read_text() != before


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["sim", "part"])
def test_a_missing_program_is_put_back(root: Path, name: str) -> None:
    (root / "build" / name).unlink()
    code, answer, _ = replay(root)
    assert (code, answer["verdict"]) == (0, "identical")
    assert not (root / "build" / name).exists()


def test_a_recorded_batch_is_executed_with_the_kept_programs(root: Path) -> None:
    write(root, "part", PART.format(7))
    [batch] = json.loads(projects.quick(root, "ls", "--json").stdout)
    done = projects.quick(root, "run", batch["batch"], "--no-figures")
    assert done.returncode == 0, done.stderr
    values = "SELECT DISTINCT value FROM swarm JOIN effective USING (execution)"
    assert projects.quick(root, "sql", values, "-f", "csv").stdout.split() == ["value", "5"]


@pytest.mark.nightly
def test_files_that_are_no_programs_are_not_kept(root: Path) -> None:
    assert is_kept(root, SIM)
    assert is_kept(root, PART.format(5))
    assert not is_kept(root, SECRET)
    (root / "build" / "secret").write_text("other\n")
    _, answer, _ = replay(root)
    assert any(note.endswith("{project}/build/secret") for note in answer["notes"])


@pytest.mark.nightly
@pytest.mark.parametrize(("limit", "kept"), [("0", []), ('"30 B"', ["part"]), ('"1 kB"', ["part", "sim"])])
def test_the_setting_limits_what_is_kept(tmp_path: Path, require: Callable[..., str], limit: str, kept: list[str]) -> None:
    require("strace")
    root = make(tmp_path / "project", f"[source]\nmax_ignored = {limit}\n")
    texts = {"part": PART.format(5), "sim": SIM}
    assert [name for name, text in texts.items() if is_kept(root, text)] == kept
    if "sim" not in kept:
        (root / "build" / "sim").unlink()
        code, _, said = replay(root)
        assert (code, "build/sim does not exist; runs need it" in said) == (3, True)


@pytest.mark.nightly
def test_without_observation_only_named_programs_are_kept(tmp_path: Path) -> None:
    root = make(tmp_path / "project", observe="none")
    assert is_kept(root, SIM)
    assert not is_kept(root, PART.format(5))


@pytest.mark.nightly
def test_kept_programs_stay_until_their_batch_is_removed(root: Path) -> None:
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert is_kept(root, SIM)
    assert projects.quick(root, "fsck").returncode == 0
    [batch] = json.loads(projects.quick(root, "ls", "--json").stdout)
    assert projects.quick(root, "rm", batch["batch"], "--yes").returncode == 0
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert not is_kept(root, SIM)
    assert not is_kept(root, PART.format(5))


@pytest.mark.nightly
def test_a_program_of_the_source_is_not_kept_twice(tmp_path: Path) -> None:
    root = projects.commit(projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", "./tool.sh")), "none")
    (root / "tool.sh").write_text(SIM.replace("/part", "/build/part").replace("/secret", "/build/part"))
    (root / "tool.sh").chmod(0o755)
    (root / "build").mkdir()
    write(root, "part", PART.format(5))
    projects.commit(root)
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode in (0, 1)
    assert not is_kept(root, (root / "tool.sh").read_text())
