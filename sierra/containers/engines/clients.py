"""What the clients of all engines have in common: how they read mounts, and how their ends are read."""

from __future__ import annotations

import signal
from collections.abc import Set as AbstractSet
from dataclasses import replace

from sierra.containers.engines.base import Mount
from sierra.errors import Missing
from sierra.model import Result

SIGNALLED = 128


def mounted(mount: Mount) -> str:
    """A mount as clients read it: a line of CSV. Raises Missing for a path that can't stand in one."""
    if '"' in mount.source or "\n" in mount.source:
        raise Missing(f"{mount.source!r} cannot be mounted into a container; take a path without quotes and line feeds")
    return f'--mount=type=bind,"source={mount.source}","destination={mount.target}"{"" if mount.writable else ",ro"}'


def last_line(said: str) -> str:
    """The last line of what was said; empty where nothing was."""
    return (said.strip().splitlines() or [""])[-1]


def killed(name: str, result: Result) -> Result:
    """The result of a client that a signal has ended."""
    return replace(result, error=f"{name} was ended by signal {result.signal}, and its container with it")


def signalled(result: Result, enforced: AbstractSet[str]) -> Result:
    """The result, with the signal that ended its process: as in a shell, 128 and its number are the exit status then."""
    number = (result.exit_code or 0) - SIGNALLED
    if result.error is not None or not 0 < number < 65:
        return result
    stopped = "memory" if number == signal.SIGKILL and "memory" in enforced else None
    return replace(result, exit_code=None, signal=number, stopped=result.stopped or stopped)
