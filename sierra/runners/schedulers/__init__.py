"""Schedulers: the programs that assign a cluster's nodes to jobs."""

from __future__ import annotations

from sierra.runners.schedulers.base import Scheduler, find, recorded_table, table

__all__ = ["Scheduler", "find", "recorded_table", "table"]
