"""Engines: the programs that run containers."""

from __future__ import annotations

from sierra.containers.engines.base import Abilities, find, names

__all__ = ["Abilities", "find", "names"]
