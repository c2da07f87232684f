"""The path of these modules as one program, which Python executes: a zip on other hosts and in containers, or this folder."""

from __future__ import annotations

import os
import sys

HERE = os.path.dirname(os.path.abspath(__file__))
NAME = "worker.pyz"
"""The name of the zip."""
PROGRAM = HERE if os.path.isfile(HERE) else os.path.join(HERE, "__main__.py")


def words(*arguments: str) -> list[str]:
    """Return the command that executes the program with these arguments; `__main__` describes them."""
    return [sys.executable, "-I", "-S", PROGRAM, *arguments]
