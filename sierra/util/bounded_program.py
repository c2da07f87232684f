"""A program that is executed to its end, within limits on its time and its output, without a shell and without input.

The program gets a process group of its own, and the limit on open files with which this process was started. When it ends,
exceeds a limit, or this process is interrupted, what is left of its group is ended. Processes that have left the group are
found by a mark in their environment, if the caller names one.
"""

from __future__ import annotations

import contextlib
import math
import os
import resource
import selectors
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

from sierra.util import open_files
from sierra.util.lazy_definitions import dataclass
from sierra.util.signals import noted
from sierra.worker.processes import marked, signal_group, signal_process

MOST = 64 << 20
"""The largest number of bytes that a program may print, unless the caller sets another."""
KEPT = 1 << 16
"""The number of bytes that are kept of a program's messages, from their end."""
GRACE_S = 5.0
"""The seconds that a program has to end after a signal."""
LOOK_S = 0.02


@dataclass(frozen=True, slots=True)
class Ended:
    """The end of a program, and what it has printed to pipes."""

    status: int | None
    """The exit status, or the negative number of a signal; None if the program exceeded a limit."""
    output: bytes
    errors: bytes
    """The end of its messages."""


def execute(
    argv: Sequence[str],
    *,
    cwd: str | Path,
    env: Mapping[str, str] | None = None,
    wall: float | None = None,
    most: int = MOST,
    stdout: int | IO[bytes] = subprocess.PIPE,
    stderr: int | IO[bytes] = subprocess.PIPE,
    limits: Mapping[int, int] | None = None,
    mark: str | None = None,
) -> Ended:
    """Execute a program until its end, at most `wall` seconds, and while it prints at most `most` bytes.

    `limits` are resource limits of the kernel, where it can set those of another process. `mark` names an environment variable
    that marks the processes that the program starts: when it ends, they are killed at once. Without a mark, the program has
    only ended when all processes have closed its standard output. Raises OSError or ValueError if it cannot be started.
    """
    value = os.urandom(16).hex()
    variables = dict(os.environ if env is None else env)
    with noted() as signals:
        try:
            process = subprocess.Popen(
                argv,
                cwd=cwd,
                env={**variables, mark: value} if mark else variables,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                start_new_session=True,
            )
        except (OSError, ValueError):
            if signals:
                raise KeyboardInterrupt from None
            raise
    try:
        if signals:
            raise KeyboardInterrupt
        open_files.restore(process.pid)
        for kind, limit in (limits or {}).items() if hasattr(resource, "prlimit") else ():
            with contextlib.suppress(OSError, ValueError):
                resource.prlimit(process.pid, kind, (limit, limit))
        return _followed(process, math.inf if wall is None else time.monotonic() + wall, most, to_eof=mark is None)
    finally:
        _end(process, f"{mark}={value}".encode() if mark else None)


def _followed(process: subprocess.Popen[bytes], end: float, most: int, *, to_eof: bool) -> Ended:
    """Read what a program prints until it ends, or until a limit; `to_eof`: also the output of processes that it leaves."""
    output, errors = bytearray(), bytearray()
    with selectors.DefaultSelector() as pipes:
        for pipe, printed in ((process.stdout, output), (process.stderr, errors)):
            if pipe is not None:
                pipes.register(pipe, selectors.EVENT_READ, printed)

        def is_awaited() -> bool:
            return to_eof and any(key.data is output for key in pipes.get_map().values())

        while pipes.get_map() and len(output) <= most and time.monotonic() < end:
            # before looking: it may print and end meanwhile
            has_ended = not is_awaited() and process.poll() is not None
            ready = pipes.select(0 if has_ended else min(LOOK_S, end - time.monotonic()))
            for key, _ in ready:
                piece = os.read(key.fd, KEPT)
                key.data.extend(piece)
                if not piece:
                    pipes.unregister(key.fileobj)
            del errors[:-KEPT]
            if has_ended and not ready:
                break
        exceeded = len(output) > most or is_awaited()
    if not exceeded:
        _wait(process, None if end == math.inf else max(0.0, end - time.monotonic()))
    return Ended(None if exceeded else process.returncode, bytes(output), bytes(errors))


def _end(process: subprocess.Popen[bytes], mark: bytes | None) -> None:
    """End what is left of a program's group: first it is asked. With a mark, kill it and all marked processes at once."""
    if mark is None and process.poll() is None:
        signal_group(process.pid, signal.SIGTERM)
        _wait(process, GRACE_S)
    signal_group(process.pid, signal.SIGKILL)
    give_up = time.monotonic() + GRACE_S
    while mark and (left := marked({mark})) and time.monotonic() < give_up:
        for pid in left:
            signal_process(pid, signal.SIGKILL)
    for pipe in filter(None, (process.stdout, process.stderr)):
        pipe.close()
    _wait(process, GRACE_S)


def _wait(process: subprocess.Popen[bytes], seconds: float | None) -> None:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(seconds)
