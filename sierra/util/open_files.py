"""The limit on open files: raised for this process, which reads many files at once, and as it was for programs of runs.

A program may behave differently with another soft limit (`select` fails for descriptors from 1024 on, and some close all that
are possible), and the limits are part of the recorded environment.
"""

from __future__ import annotations

import contextlib
import os
import resource

MOST = 1 << 16
"""The largest soft limit that is set. Some systems allow a billion, and some libraries make tables of that size."""
OWN = 50
"""The number of files that this process has open besides those that DuckDB reads."""
PER_THREAD = 100
"""The number of Parquet files that a thread of DuckDB has open at once; measured: 200 to 256 for two threads."""

_before: list[int] = []
"""The soft limit with which this process was started, once it has been raised."""


def raise_limit() -> None:
    """Raise the soft limit on open files of this process to the hard one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST if hard == resource.RLIM_INFINITY else min(hard, MOST)
    if soft != resource.RLIM_INFINITY and soft < most:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
            _before[:] = _before or [soft]


def restore(process: int) -> None:
    """Give a new process the soft limit with which this one was started."""
    if _before and hasattr(resource, "prlimit"):
        _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        with contextlib.suppress(OSError):  # it has ended
            resource.prlimit(process, resource.RLIMIT_NOFILE, (_before[0], hard))


def before() -> int | None:
    """Return the soft limit with which this process was started; None if it was not raised."""
    return _before[0] if _before else None


def threads() -> int | None:
    """Return the number of threads for which there are enough open files; None if there are enough for all cores."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return None
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    most = max(1, (soft - OWN) // PER_THREAD)
    return most if most < cores else None
