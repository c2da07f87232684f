"""Platforms: how each simulator or robot stack is driven."""

from __future__ import annotations

from sierra.platforms.base import find, names

__all__ = ["find", "names"]
