"""Videos of a matrix of 40 × 30 cells in 640 × 480 pixels: time, computing time and memory of `sierra video`.

The target for 1,000 frames is 15 seconds on two cores. The memory must not grow with the number of frames.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from idle import measured, project

SIERRA = str(Path(sys.executable).with_name("sierra"))
SIMULATOR = """
awk -v frames={frames} 'BEGIN {{
  print "tick,i,j,heat"
  for (t = 0; t < frames; t++) for (i = 0; i < 40; i++) for (j = 0; j < 30; j++)
    printf "%d,%d,%d,%.4f\\n", t, i, j, 10 * sin(i / 7 + t / 30) * cos(j / 5 - t / 50)
}}' > floor.csv
"""
VIDEO = """
[outputs.floor]
file = "floor.csv"
time = "tick"
[videos.heat]
table = "floor"
column = ["i", "j", "heat"]
"""


def main() -> None:
    for frames, target in ((1000, "under 15 s"), (3000, "the same memory")):
        with tempfile.TemporaryDirectory(prefix="sierra-bench-") as folder:
            here = project(Path(folder), VIDEO, command="sh sim.sh {input}")
            (here / "sim.sh").write_text(SIMULATOR.format(frames=frames))
            query = ("population_size=1", "--runs", "1", "--no-figures")
            subprocess.run([SIERRA, "run", *query], cwd=here, check=True, stdout=subprocess.DEVNULL)
            seconds, cpu, memory = measured(here, SIERRA, "video", "-q")
            print(f"video of {frames:,} frames  {cpu:6.2f} s CPU  {seconds:6.2f} s  {memory / 1e6:6.0f} MB  ({target})")


if __name__ == "__main__":
    main()
