"""Other versions of Python on this machine."""

from __future__ import annotations

import contextlib
import subprocess
from pathlib import Path


def python_of(version: str) -> str | None:
    """Return the path or name of a Python of this version, for example 3.8; None if there is none."""
    for command in (f"python{version}", *Path.home().glob(f".pyenv/versions/{version}.*/bin/python")):
        with contextlib.suppress(OSError):
            asked = subprocess.run([str(command), "--version"], capture_output=True, text=True, check=False)
            if asked.returncode == 0 and f"Python {version}." in asked.stdout:
                return str(command)
    return None
