"""Schedulers: the programs that share out a cluster's nodes."""

from __future__ import annotations

from sierra.runners.schedulers.base import SHIPPED, Scheduler, find

__all__ = ["SHIPPED", "Scheduler", "find"]
