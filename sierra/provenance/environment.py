"""The machine around executions, in a few facts, recorded once and referred to by hash."""

from __future__ import annotations

import os
import platform
from functools import cache
from pathlib import Path
from typing import Any

from sierra.hashing import digest


def capture(version: str) -> dict[str, Any]:
    """The record of this machine; `version` is SIERRA's."""
    facts = {**_facts(), "sierra": version}
    return {"environment": digest("environment", facts), **facts}


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@cache
def _facts() -> dict[str, Any]:
    uname = os.uname()
    return {
        "host": uname.nodename,
        "os": _os_release(),
        "kernel": uname.release,
        "machine": uname.machine,
        "cpu": _cpu(),
        "cores": usable_cores(),
        "memory": os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"),
        "libc": _libc(),
        "python": platform.python_version(),
    }


def _os_release() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        return os.uname().sysname


def _cpu() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return os.uname().machine


def _libc() -> str:
    try:
        return os.confstr("CS_GNU_LIBC_VERSION") or ""
    except (ValueError, OSError, AttributeError):
        return ""
