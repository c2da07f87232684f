"""Platforms: the ways to drive a simulator or robot stack."""

from __future__ import annotations

from sierra.design.platforms.base import find

__all__ = ["find"]
