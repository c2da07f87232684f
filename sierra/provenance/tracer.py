"""The tracer of this machine that was found to work, remembered, because trying it takes as long as a short run.

A tracer is tried again if its file, the kernel, the user or the rights of this process have changed. Only one that works is
remembered. If it does not work any more, an observed run is disturbed, and the worker executes it again without it.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

from sierra.store.layout import user_tracers
from sierra.util.cache import Cache

MAX_ENTRIES = 16
RIGHTS = ("NoNewPrivs", "Seccomp", "CapEff", "NSpid")
"""Lines of /proc/PID/status that decide about the right to trace; NSpid distinguishes containers."""
SCOPE = Path("/proc/sys/kernel/yama/ptrace_scope")


def usable() -> str | None:
    """Return the path of a tracer that works here; None if there is none."""
    path = shutil.which("strace")
    if path is None:
        return None
    program = str(Path(path).absolute())
    cache = Cache(user_tracers(), MAX_ENTRIES)
    try:
        key = json.dumps([program, *_surroundings(program)])
    except OSError:
        return None
    if cache.get(key) is None:
        from sierra.worker.observers import Strace  # only now, because it takes 5 ms to import

        if Strace(program).trouble() is not None:
            return None
        cache.put(key, True)
        cache.save()
    return program


def _surroundings(program: str) -> list[int | str]:
    """Return facts on which it depends whether a tracer works. Raises OSError if the tracer is gone."""
    status = os.stat(program)  # noqa: PTH116 - as in the hash cache
    system = os.uname()
    file = [status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_mode]
    return [*file, os.geteuid(), os.getuid(), system.nodename, system.release, system.version, _rights(), _text(SCOPE)]


def _rights() -> str:
    lines = _text(Path("/proc/self/status")).splitlines()
    return " ".join(_levels(line) for line in lines if line.startswith(RIGHTS))


def _levels(line: str) -> str:
    """Return a line of /proc/PID/status; of the ids in nested namespaces only their number."""
    name, _, value = line.partition(":")
    return f"{name}={len(value.split())}" if name == "NSpid" else f"{name}={value.strip()}"


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
