"""Packages with plug-ins: the installed package of tests/plugin, and small ones that are written for a test."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

SOURCE = Path(__file__).parent / "plugin"
PIP = ("-m", "pip", "--quiet", "--disable-pip-version-check", "install", "--no-deps", "--no-index", "--no-build-isolation")


def install(folder: Path) -> Path:
    """Build the package in tests/plugin and install it; return the folder for Python's path."""
    source = shutil.copytree(SOURCE, folder / "source")
    target = folder / "installed"
    subprocess.run([sys.executable, *PIP, "--target", str(target), str(source)], check=True, timeout=300)
    return target


def project(folder: Path, *more: str) -> Path:
    """Copy the project of the package, with further lines in its sierra.toml; return its folder."""
    shutil.copytree(SOURCE / "project", folder)
    with (folder / "sierra.toml").open("a") as file:
        file.writelines(f"{line}\n" for line in more)
    return folder


def write(folder: Path, name: str, points: Mapping[str, str], code: str = "", version: str = "1") -> Path:
    """Write an installed package with one module; return its folder. `points` maps `GROUP NAME` to a class."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.py").write_text(code)
    info = folder / f"{name}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = (f"[{point.split()[0]}]\n{point.split()[1]} = {name}:{made}\n" for point, made in points.items())
    (info / "entry_points.txt").write_text("".join(lines))
    return folder
