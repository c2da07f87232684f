"""Products of real compilers are built when their content asks for it, and again from source by a replay."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sierra
from tests import projects

SIMULATOR = """\
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
int coverage(int count, int tick);
int main(int argc, char **argv) {
  char text[4096] = {0};
  FILE *in = fopen(argv[1], "r");
  if (!in || !fread(text, 1, sizeof text - 1, in)) return 1;
  int count = atoi(strstr(text, "<swarm count=\\"") + 14);
  FILE *out = fopen("swarm.csv", "w");
  fprintf(out, "tick,coverage\\n");
  for (int tick = 0; tick < 5; tick++) fprintf(out, "%d,%d\\n", tick, coverage(count, tick));
  return fclose(out);
}
"""
LIBRARY = "int coverage(int count, int tick) { return count * tick; }\n"
CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project(sim C)
set(CMAKE_BUILD_RPATH_USE_ORIGIN ON)
add_library(core SHARED core.c)
set_target_properties(core PROPERTIES VERSION 1.0 SOVERSION 1)
add_executable(sim sim.c)
target_link_libraries(sim core)
"""
MAKE = """\
build/sim: sim.c core.c
\tmkdir -p build
\t$(CC) $(CFLAGS) -o $@ sim.c core.c
"""
CONFIG = """\
template = "arena.xml"
command = "build/sim {input} {seed}"
runs = 2
[variables]
population_size = "//swarm/@count"
[build]
"""
WITH_CMAKE = CONFIG + 'command = "sh build.sh"\nproduces = ["build/sim", "build/libcore.so"]\n'
WITH_MAKE = CONFIG + 'command = "make"\nproduces = "build/sim"\n'
QUERY = ("run", "population_size=1,2", "--no-figures")
Disk = Callable[[Path, str], Path]


@pytest.fixture(params=["cmake", "make"])
def root(request: pytest.FixtureRequest, tmp_path: Path, require: Callable[..., str]) -> Path:
    """Return a project in git whose simulator is written in C."""
    for program in (request.param, "make", "cc"):
        require(program)
    folder = tmp_path / "project"
    folder.mkdir()
    build = "cmake -S . -B build -DCMAKE_BUILD_TYPE=Release && cmake --build build\n"
    made = {"CMakeLists.txt": CMAKE, "build.sh": build} if request.param == "cmake" else {"Makefile": MAKE}
    code = {"sim.c": SIMULATOR, "core.c": LIBRARY, "arena.xml": projects.TEMPLATE, ".gitignore": "build/\n"}
    config = {"sierra.toml": WITH_CMAKE if request.param == "cmake" else WITH_MAKE}
    for name, text in {**code, **made, **config}.items():
        (folder / name).write_text(text)
    return projects.commit(folder)


def run(root: Path, *words: str, code: int = 0) -> str:
    done = projects.quick(root, *(words or QUERY))
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def rows(root: Path, statement: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = sierra.open(root).sql(statement).to_pylist()
    return found


def test_a_simulator_in_c_is_built_once_for_each_content(root: Path) -> None:
    assert "4 executed" in run(root)
    assert "building" not in run(root)
    [build] = rows(root, "FROM builds")
    assert build["compiler"]
    (root / "core.c").write_text(LIBRARY.replace("tick;", "tick + 1;"))
    assert "building, because the source has changed (core.c)" in run(root)
    assert rows(root, "SELECT max(coverage) AS most FROM swarm") == [{"most": 9}]
    (root / "core.c").write_text(LIBRARY)
    told = run(root)
    assert "building, because " in told
    assert "0 executed, 4 reused" in told


@pytest.mark.parametrize("how", ["changed", "removed"])
def test_a_tampered_program_is_linked_again(root: Path, how: str) -> None:
    run(root)
    program = root / "build/sim"
    if how == "changed":
        program.write_bytes(program.read_bytes() + b"x")
    else:
        program.unlink()
    told = run(root)
    assert "building, because build/sim is" in told
    assert "0 executed, 4 reused" in told


@pytest.mark.nightly
def test_a_simulator_in_c_is_replayed_from_source_in_a_fresh_clone(root: Path, tmp_path: Path) -> None:
    run(root)
    [batch] = rows(root, "FROM batches")
    clone = tmp_path / "somewhere" / "clone"
    subprocess.run(["git", "clone", "-q", root, clone], check=True)
    (root / ".sierra").rename(clone / ".sierra")
    (root / "build").rename(tmp_path / "nowhere")
    told = run(clone, "replay", batch["batch"])
    assert "identical (4 runs: 4 identical; built from source: build/" in told
    assert "differ" not in told
    assert not (clone / "build").exists()


def test_a_library_that_no_pattern_matches_is_noted(root: Path) -> None:
    note = "note: runs use build/libcore.so.1, which no pattern of [build] produces matches: add it if the build makes it"
    assert (note in run(root)) is (root / "CMakeLists.txt").exists()


@pytest.mark.nightly
def test_a_mistake_in_the_code_is_shown_with_its_line(root: Path) -> None:
    (root / "core.c").write_text(LIBRARY + "int y\n")
    told = run(root, code=1)
    assert "the build failed, so nothing was executed: exit status" in told
    assert "core.c:2:" in told


@pytest.mark.nightly
@pytest.mark.parametrize(("folder", "size"), [("build", "4k"), (".sierra", "40k")])
def test_a_full_disk_is_reported_in_one_line(root: Path, disk: Disk, folder: str, size: str) -> None:
    disk(root / folder, size)
    done = projects.quick(root, *QUERY)
    assert done.returncode == 3, done.stderr
    [line] = [line for line in done.stderr.splitlines() if not line.startswith("note: ")]
    assert "No space left on device" in line
    disk(root / folder, "50m")
    assert "4 executed" in run(root)
