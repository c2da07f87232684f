"""Programs in a folder that git ignores, if the store does not keep them: a replay uses the present build, and reports it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from tests import projects

SIMULATOR = """\
#include <stdio.h>
double speed(void);
int main(void) {
    FILE *out = fopen("swarm.csv", "w");
    fprintf(out, "tick,way\\n1,%g\\n", speed());
    return fclose(out);
}
"""
CONFIG = 'template = "arena.xml"\ncommand = "./build/sim {input}"\nruns = 2\n[variables]\npopulation_size = "//swarm/@count"\n'
CONFIG += "[source]\nmax_ignored = 0\n"
compiled = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


def build(root: Path, speed: float, rpath: str = "$ORIGIN") -> None:
    (root / "build").mkdir(exist_ok=True)
    (root / "speed.c").write_text(f"double speed(void) {{ return {speed}; }}\n")
    library = ["gcc", "-shared", "-fPIC", "-o", "build/libspeed.so", "speed.c"]
    program = ["gcc", "-o", "build/sim", "sim.c", "-Lbuild", "-lspeed", f"-Wl,-rpath,{rpath}"]
    for words in (library, program):
        subprocess.run(words, cwd=root, check=True)


def made(root: Path, rpath: str = "$ORIGIN") -> Path:
    """Return a project whose simulator is built in build/, after one query."""
    projects.make(root, CONFIG)
    (root / "sim.c").write_text(SIMULATOR)
    (root / ".gitignore").write_text("build/\n.venv/\n")
    build(root, 0.5, rpath)
    projects.commit(root)
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    return root


def batch_of(root: Path) -> str:
    return projects.quick(root, "sql", "SELECT batch FROM batches", "-f", "csv").stdout.split()[1]


def replayed(root: Path) -> tuple[int, str, str]:
    ended = projects.quick(root, "replay", batch_of(root))
    return ended.returncode, ended.stdout, ended.stderr


@pytest.mark.integration
@compiled
@pytest.mark.parametrize("place", ["$ORIGIN", "{root}/build"])
def test_a_replay_finds_a_built_program_with_its_libraries(tmp_path: Path, place: str) -> None:
    root = made(tmp_path / "p", place.format(root=tmp_path / "p"))
    code, out, err = replayed(root)
    assert (code, err) == (0, "")
    assert "identical (2 runs: 2 identical)" in out
    shown = json.loads(projects.quick(root, "show", batch_of(root), "--json").stdout)["programs"]
    [program] = [one for one in shown if "sim" in one["name"]]
    assert (program["name"], program["path"]) == ("{project}/build/sim", f"{root}/build/sim")


@pytest.mark.integration
@compiled
def test_a_replay_reports_a_rebuilt_library_before_the_verdict(tmp_path: Path) -> None:
    root = made(tmp_path / "p")
    build(root, 0.75)
    code, out, err = replayed(root)
    assert code == 1
    assert "libraries that differ from the record: {project}/build/libspeed.so" in err
    assert "'way' was 0.5 and is 0.75" in out


@pytest.mark.integration
@compiled
def test_executing_a_recorded_batch_with_a_rebuilt_library_is_reported(tmp_path: Path) -> None:
    root = made(tmp_path / "p")
    build(root, 0.75)
    replayed(root)
    ended = projects.quick(root, "run", batch_of(root), "--no-figures")
    assert "2 executed" in ended.stdout
    assert "since then: libraries that differ from the record: {project}/build/libspeed.so" in ended.stderr
    told = projects.quick(root, "why", batch_of(root)).stdout
    assert re.search(r"other programs or files before: \{project}/build/libspeed.so: \w{10} → \w{10}\n", told)


@pytest.mark.nightly
@compiled
def test_a_replay_names_a_program_that_is_not_built(tmp_path: Path) -> None:
    root = made(tmp_path / "p")
    (root / "build" / "sim").unlink()
    code, _, err = replayed(root)
    assert code == 3
    assert f"{root}/build/sim does not exist; runs need it, and the recorded source does not contain it" in err


@pytest.mark.nightly
def test_a_replay_with_a_virtual_environment_of_the_project_imports_its_packages(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p", projects.CONFIG.replace("python3", ".venv/bin/python"))
    (root / ".gitignore").write_text(".venv/\n")
    venv.create(root / ".venv", symlinks=True)
    packages = root / ".venv" / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    (packages / "installed.py").write_text("")
    (root / "sim.py").write_text("import installed\n" + projects.SIMULATOR)
    projects.commit(root)
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    code, out, err = replayed(root)
    assert (code, err) == (0, "")
    assert "identical" in out
    assert (packages / "installed.py").exists()


@pytest.mark.nightly
def test_a_program_next_to_the_project_is_found_relative_to_the_project(tmp_path: Path) -> None:
    config = projects.CONFIG.replace("python3 sim.py", "python3 ../shared/sim.py")
    root = projects.make(tmp_path / "repository" / "experiments", config)
    (tmp_path / "repository" / "shared").mkdir()
    simulator = (root / "sim.py").rename(tmp_path / "repository" / "shared" / "sim.py")
    projects.commit(root.parent)
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    assert (replayed(root)[0], replayed(root)[2]) == (0, "")
    simulator.write_text(projects.SIMULATOR.replace("count * tick", "count * tick + 1"))
    code, _, err = replayed(root)
    assert code == 1
    assert "different programs: sim.py: " in err
