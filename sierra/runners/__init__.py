"""Runners: the places where runs execute."""

from __future__ import annotations

from sierra.runners.base import check, cluster, find, scheduler_of

__all__ = ["check", "cluster", "find", "scheduler_of"]
