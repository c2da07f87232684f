"""A killed process leaves no half video under its name, and the next one removes what it left."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import projects, stores
from tests.extensions.videos import video_files
from tests.waiting import until

SIMULATOR = """\
for tick in range(400):
    with open(f"frame-{tick}.ppm", "wb") as file:
        file.write(b"P6 16 12 255 " + bytes((tick % 256, 0, 0)) * 192)
"""
CONFIG = projects.CONFIG.replace("runs = 2", 'observe = "none"')
VIDEO = (
    '[outputs.camera]\nfile = "frame-{tick}.ppm"\ntime = "tick"\n[videos.camera]\nkind = "pictures"\ntable = "camera"\n'
    "size = [640, 480]\n"
)


@pytest.mark.integration
def test_a_killed_encoder_leaves_no_half_video(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p", CONFIG + VIDEO, simulator=SIMULATOR)
    batch = stores.ask(root, "population_size=1", runs=1)
    folder, extracted = root / "figures" / batch[:10], root / ".sierra/extracted"
    with projects.start(root, "video") as making:
        until(lambda: any(path.stat().st_size for path in folder.glob(".video-*/camera.mp4")))
        making.kill()
    assert [path.name for path in folder.glob("*.mp4")] == []
    assert list(folder.glob(".video-*"))
    assert len(list(extracted.glob("frame-*/*.ppm"))) == 400
    (root / "sierra.toml").write_text(CONFIG + VIDEO.replace("640, 480", "160, 160"))
    done = projects.quick(root, "video")
    assert done.returncode == 0, done.stderr
    assert len(video_files.decoded(folder / "camera.mp4")) == 400
    assert list(folder.glob(".video-*")) == []
    assert list(extracted.iterdir()) == []
