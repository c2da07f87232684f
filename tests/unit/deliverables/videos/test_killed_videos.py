"""A killed process leaves no half video under its name, and the next one removes what it left."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import projects, stores, videos
from tests.waiting import until

SIMULATOR = """\
with open("floor.csv", "w") as file:
    print("tick,i,j,heat", file=file)
    for tick in range(400):
        for cell in range(4):
            print(tick, cell // 2, cell % 2, tick + cell, sep=",", file=file)
"""
VIDEO = '[outputs.floor]\nfile = "floor.csv"\ntime = "tick"\n[videos.heat]\ntable = "floor"\ncolumn = ["i", "j", "heat"]\n'


@pytest.mark.integration
def test_a_killed_encoder_leaves_no_half_video(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p", projects.CONFIG + VIDEO, simulator=SIMULATOR)
    batch = stores.ask(root, "population_size=1", runs=1)
    folder = root / "figures" / batch[:10]
    with projects.start(root, "video") as making:
        until(lambda: any(path.stat().st_size for path in folder.glob(".video-*/heat.mp4")))
        making.kill()
    assert [path.name for path in folder.glob("*.mp4")] == []
    assert list(folder.glob(".video-*"))
    done = projects.quick(root, "video")
    assert done.returncode == 0, done.stderr
    assert len(videos.decoded(folder / "heat.mp4")) == 400
    assert list(folder.glob(".video-*")) == []
