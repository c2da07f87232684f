"""The image with ROS 1, made from its recipe once for all tests that execute runs in it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

from tests import projects

IMAGE = "localhost/sierra/ros"
RECIPE = Path(__file__).parents[2] / "containers" / "ros"


def pin(root: Path, require: Callable[..., str]) -> None:
    """Pin the image for the project in `root`; build it if podman has none."""
    for program in ("podman", "mmdebstrap"):
        require(program)
    if subprocess.run(("podman", "image", "exists", IMAGE), check=False).returncode:
        built = projects.quick(root, "image", "build", str(RECIPE))
        assert built.returncode == 0, built.stderr
    pinned = projects.quick(root, "image", "pin", IMAGE)
    assert pinned.returncode == 0, pinned.stderr
