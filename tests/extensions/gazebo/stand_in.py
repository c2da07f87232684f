"""A program with the messages of gzserver, and without physics."""

from __future__ import annotations

from pathlib import Path

STAND_IN = Path(__file__).parent / "gzserver"
