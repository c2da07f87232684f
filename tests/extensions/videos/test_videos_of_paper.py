"""`sierra paper` makes the videos that are bound to queries, and keeps them as long as they show the same."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from tests import projects
from tests.extensions.videos import filmed

QUERIES = '\n[queries.sizes]\ncriteria = "population_size=1,2"\nruns = 2\n'


@pytest.mark.integration
def test_bound_videos_belong_to_the_paper(tmp_path: Path) -> None:
    bound = filmed.CONFIG.replace("[videos.heat]\n", '[videos.heat]\nquery = "sizes"\n').replace('"gif", "mp4"', '"mp4"')
    root = projects.make(tmp_path / "project", bound + QUERIES, simulator=filmed.SIMULATOR)
    done = projects.quick(root, "paper")
    assert done.returncode == 0, done.stderr
    folder = root / "paper" / "sierra"
    [video] = (folder / "videos").iterdir()
    assert video.suffix == ".mp4"
    first = video.read_bytes()
    provenance = folder / "provenance.json"
    files = json.loads(provenance.read_text())["files"]
    assert (files[f"videos/{video.name}"]["kind"], files[f"videos/{video.name}"]["name"]) == ("video", "heat")
    assert projects.quick(root, "paper", "--check").stdout == "all files follow from the store\n"
    assert "follows from the store" in projects.quick(root, "show", str(video.relative_to(root))).stdout

    # as if another machine had encoded it: the same data and definition keep the file
    video.write_bytes(first + b"other")
    found = json.loads(provenance.read_text())
    found["files"][f"videos/{video.name}"]["sha256"] = hashlib.sha256(video.read_bytes()).hexdigest()
    provenance.write_text(json.dumps(found, indent=1, sort_keys=True, ensure_ascii=False) + "\n")
    assert projects.quick(root, "paper").returncode == 0
    assert video.read_bytes() == first + b"other"

    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("size = [200, 160]", "size = [160, 160]"))
    checked = projects.quick(root, "paper", "--check")
    assert (checked.returncode, f"paper/sierra/videos/{video.name} is made otherwise now" in checked.stdout) == (1, True)
    assert projects.quick(root, "paper").returncode == 0
    assert video.read_bytes() not in (first, first + b"other")

    config.write_text(config.read_text().replace('column = ["i", "j", "heat"]', 'column = ["i", "j", "nope"]'))
    wrong = projects.quick(root, "paper")
    assert (wrong.returncode != 0, "video heat: " in wrong.stderr) == (True, True), wrong.stderr
