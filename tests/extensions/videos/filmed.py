"""A project with a batch, a video in two formats and `[package]`, for reports that have videos."""

from __future__ import annotations

from pathlib import Path

from tests import projects, stores

FLOOR = """
with open("floor.csv", "w") as file:
    print("tick,i,j,heat", file=file)
    for tick in range(10):
        for i in range(4):
            for j in range(6):
                print(tick, i, j, count * tick + i * j, sep=",", file=file)
"""
"""The end of a simulator that leaves a table of matrices."""
SIMULATOR = projects.SIMULATOR + FLOOR
OUTPUT = """
[outputs.floor]
file = "floor.csv"
time = "tick"
"""
CONFIG = (
    projects.CONFIG
    + OUTPUT
    + """
[figures.coverage]
column = "coverage"

[comparisons.sizes]
by = "population_size"

[videos.heat]
table = "floor"
column = ["i", "j", "heat"]
experiments = "population_size=1"
formats = ["gif", "mp4"]
title = "<script>alert(1)</script>"
size = [200, 160]

[package]
title = "Heat of floors"
authors = [{ name = "Jane Doe" }]
license = "MIT"
"""
)


def make(folder: Path) -> tuple[Path, str]:
    """Make the project and its videos; return its folder and the id of its batch."""
    root = projects.make(folder, CONFIG, simulator=SIMULATOR)
    batch = stores.ask(root, "population_size=1,2", runs=3)
    done = projects.quick(root, "video")
    assert done.returncode == 0, done.stderr
    return root, batch
