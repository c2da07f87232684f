"""Runners: the places where runs execute."""

from __future__ import annotations

from sierra.runners.base import find, scheduler_of

__all__ = ["find", "scheduler_of"]
