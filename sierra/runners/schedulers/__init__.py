"""Schedulers: the programs that assign a cluster's nodes to jobs."""

from __future__ import annotations

from sierra.runners.schedulers.base import SHIPPED, Scheduler, find

__all__ = ["SHIPPED", "Scheduler", "find"]
