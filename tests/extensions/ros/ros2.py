"""ROS 2 for tests: the environment that `make integration` fills with its wheels."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra.extensions.ros

DRIVERS = Path(sierra.extensions.ros.__file__).parent / "drivers"
PROGRAMS = Path(__file__).parents[3] / ".venv-ros2" / "bin"


def find(monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]) -> None:
    """Let programs find ROS 2."""
    there = any(PROGRAMS.parent.glob("lib/python3*/site-packages/rclpy"))
    require("ROS 2: `make .venv-ros2/installed`", there=there)
    monkeypatch.setenv("PATH", f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}")
