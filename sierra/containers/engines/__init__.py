"""Engines: the programs that run containers."""

from __future__ import annotations

from sierra.containers.engines.base import Capabilities, find, names

__all__ = ["Capabilities", "find", "names"]
