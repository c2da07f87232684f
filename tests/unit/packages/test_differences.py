"""Two packages are the same if only the names of their outputs differ, which have the clock in them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import sierra
from tests import projects
from tests.unit.packages.test_imports import TOML

SIMULATOR = """\
import sys, time
count = int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])
seed = open(sys.argv[1]).read().split('<random seed="')[1].split('"')[0]
extra = int(open(EXTRA).read())
at = time.time_ns() + (int(seed) << 60) * (-1 if extra else 1)  # in the last package, the names of runs have another order
for number in range(2):
    open(f"log_{at % 2**100:040d}_{number}.csv", "w").write(f"t,v\\n0,{seed}\\n1,{count + number * extra}\\n")
"""


@pytest.mark.integration
def test_names_with_a_clock_are_no_difference_between_packages(tmp_path: Path) -> None:
    extra = tmp_path / "extra"
    simulator = SIMULATOR.replace("EXTRA", repr(str(extra)))
    first = projects.make(tmp_path / "a", projects.CONFIG + '[outputs.log]\nfile = "log_*.csv"\n' + TOML, simulator=simulator)
    for name in "bc":
        shutil.copytree(first, tmp_path / name)
    for name, value in (("a", "0"), ("b", "0"), ("c", "5")):
        extra.write_text(value)
        project = sierra.open(tmp_path / name)
        project.packages.pack(
            project.run("population_size=1", figures=False).batch, report=False, path=tmp_path / f"{name}.zip"
        )
    said = projects.quick(tmp_path, "diff", "a.zip", "b.zip").stdout
    assert said.splitlines()[-1] == "the same: batches, runs, source, programs, environment, results"
    said = projects.quick(tmp_path, "diff", "a.zip", "c.zip").stdout
    assert "results: 2 of 2 runs in both have other results" in said
    assert said.count("_1.csv differs in 1 run") == 2
    assert "_0.csv differs" not in said
    [table] = (line for line in said.splitlines() if line.startswith("results: table log"))
    assert table.endswith(": row 3: 'v' was 1 and is 6; largest difference 5 (relative 5); in 1 of 4 rows")


def test_a_patch_of_packages_is_refused(tmp_path: Path) -> None:
    ended = projects.quick(tmp_path, "diff", "a.zip", "b.zip", "--patch")
    assert (ended.returncode, ended.stderr) == (
        2,
        "sierra: --patch shows patches of two records of a project; for packages, leave it out\n",
    )
