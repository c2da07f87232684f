"""Without [build], a note names compiled programs that stayed the same although their code changed."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests import projects

CONFIG = """\
template = "arena.xml"
command = "build/sim -c 'echo tick,coverage > swarm.csv; echo 1,1 >> swarm.csv; cat {input} > /dev/null'"
runs = 1
[variables]
population_size = "//swarm/@count"
"""
QUERY = ("run", "population_size=1", "--no-figures")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Return a project whose program is compiled (a shell), and that git ignores."""
    folder = tmp_path / "project"
    (folder / "build").mkdir(parents=True)
    shutil.copy(Path("/bin/sh").resolve(), folder / "build/sim")
    for name, text in {"arena.xml": projects.TEMPLATE, "sierra.toml": CONFIG, ".gitignore": "build/\n"}.items():
        (folder / name).write_text(text)
    (folder / "sim.c").write_text("int main() {}\n")
    (folder / "README").write_text("read me\n")
    return projects.commit(folder)


def notes(root: Path, *words: str) -> list[str]:
    done = projects.quick(root, *QUERY, *words)
    assert done.returncode == 0, done.stderr
    return [line for line in done.stderr.splitlines() if "[build]" in line]


@pytest.mark.integration
def test_code_that_changed_alone_is_noted_each_time(root: Path) -> None:
    assert notes(root) == []
    (root / "sim.c").write_text("int main() { return 1; }\n")
    [line] = notes(root)
    assert line.startswith("note: sim.c changed since batch ")
    assert ", but build/sim did not: build it, or declare [build]" in line
    assert notes(root) == [line]
    assert notes(root, "--dry-run", "--explain") == [line]


@pytest.mark.nightly
def test_a_program_that_was_built_again_is_not_noted(root: Path) -> None:
    notes(root)
    (root / "sim.c").write_text("int main() { return 1; }\n")
    with (root / "build/sim").open("ab") as file:
        file.write(b"\0")
    assert notes(root) == []


@pytest.mark.nightly
def test_times_and_other_files_are_no_evidence(root: Path) -> None:
    notes(root)
    os.utime(root / "sim.c", (2**31, 2**31))
    (root / "README").write_text("read this\n")
    assert notes(root) == []


@pytest.mark.nightly
def test_a_project_with_build_gets_no_note(root: Path) -> None:
    build = '[build]\ncommand = "sh -c \'mkdir -p build && cp /bin/sh build/sim\'"\nproduces = ["build/sim"]\n'
    (root / "sierra.toml").write_text(CONFIG + build)
    notes(root)
    (root / "sim.c").write_text("int main() { return 1; }\n")
    assert notes(root) == []


@pytest.mark.integration
def test_a_note_names_programs_that_a_commit_does_not_vouch_for(root: Path) -> None:
    (root / "sierra.toml").write_text(CONFIG + '[source]\ndirty = "refuse"\n')
    projects.commit(root, "refuse")
    [line] = notes(root)
    assert "everything is committed, but build/sim may have been built from other code; declare [build]" in line
