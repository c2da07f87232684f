"""ROS 2 for tests: the environment that `make integration` fills with its wheels."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

import sierra.extensions.ros
from tests.support.robot_fleet import LENT

DRIVERS = Path(sierra.extensions.ros.__file__).parent / "drivers"
PROGRAMS = Path(__file__).parents[3] / ".venv-ros2" / "bin"


SETUP = f"""
packages=$(echo {LENT}/lib/python3*/site-packages)
export AMENT_PREFIX_PATH={LENT} PYTHONPATH=$packages
export LD_LIBRARY_PATH={LENT}/lib$(printf ':%s' $packages/ros_*.libs)
"""
"""A setup script of robots to which the environment is lent, for the Python of the system."""


def find(monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]) -> None:
    """Let programs find ROS 2."""
    there = any(PROGRAMS.parent.glob("lib/python3*/site-packages/rclpy"))
    require("ROS 2: `make .venv-ros2/installed`", there=there)
    monkeypatch.setenv("PATH", f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}")


def driver(name: str) -> ModuleType:
    """Return a program that runs have beside their launch files, as a module."""
    if str(DRIVERS) not in sys.path:
        sys.path.append(str(DRIVERS))
    return importlib.import_module(name)
