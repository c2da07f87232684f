"""Functions that the clients of all engines share: the syntax of mounts, and the interpretation of exit statuses."""

from __future__ import annotations

import signal
from collections.abc import Set as AbstractSet
from dataclasses import replace

from sierra.containers.engines.base import Mount
from sierra.errors import Missing
from sierra.model import Result

SIGNALLED = 128


def mounted(mount: Mount) -> str:
    """Return the option for a mount, a line of CSV. Raises Missing for a path that cannot be written in it."""
    if '"' in mount.source or "\n" in mount.source:
        raise Missing(f"{mount.source!r} cannot be mounted into a container; use a path without quotes and line feeds")
    return f'--mount=type=bind,"source={mount.source}","destination={mount.target}"{"" if mount.writable else ",ro"}'


def last_line(output: str) -> str:
    """Return the last line of a text; empty for an empty text."""
    return (output.strip().splitlines() or [""])[-1]


def killed(name: str, result: Result) -> Result:
    """Return the result of a client that was ended by a signal."""
    return replace(result, error=f"{name} was ended by signal {result.signal}, and its container with it")


def signalled(result: Result, enforced: AbstractSet[str]) -> Result:
    """Return the result with the signal that ended the process: as in a shell, the exit status is then 128 plus its number."""
    number = (result.exit_code or 0) - SIGNALLED
    if result.error is not None or not 0 < number < 65:
        return result
    stopped = "memory" if number == signal.SIGKILL and "memory" in enforced else None
    return replace(result, exit_code=None, signal=number, stopped=result.stopped or stopped)
