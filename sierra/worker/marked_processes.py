"""Processes of this host that are found by a mark: a NAME=value in the environment with which they were started (Linux)."""

from __future__ import annotations

import os
from collections.abc import Set as AbstractSet

from sierra.worker import worker


def marked(marks: AbstractSet[bytes]) -> set[int]:
    """Return the ids of processes that have one of these marks. Zombies and other users' processes are not found."""
    try:
        pids = [int(name) for name in os.listdir("/proc") if name.isdigit()]  # noqa: PTH208 - as quick as can be
    except OSError:
        return set()
    return {pid for pid in pids if not marks.isdisjoint(worker.environment_of(pid))}
