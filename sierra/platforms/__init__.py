"""Platforms: the ways to drive a simulator or robot stack."""

from __future__ import annotations

from sierra.platforms.base import find, names

__all__ = ["find", "names"]
