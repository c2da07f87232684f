"""Runners: the places where runs execute."""

from __future__ import annotations

from sierra.runners.find import check, find, on_cluster, scheduler_of

__all__ = ["check", "find", "on_cluster", "scheduler_of"]
