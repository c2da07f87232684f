"""Processes on a robot: their states and ends, and processes that the agent forks."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from typing import Callable

from sierra.worker.processes import birth, descendants, is_ending, signal_group, signal_process, stat_of

LOOK_S = 0.1  # between two looks at a run, and at the clocks
SETTLE_S = 3.0  # after the grace time, for a worker to end what it has killed, and to hash the outputs of others
TAIL_BYTES = 400


class Forked:
    """A process that this one has forked, and one end of a pipe between them."""

    def __init__(self, work: Callable[[int], None], *, reads: bool) -> None:
        """Start the process, which does `work` with its end of the pipe: it `reads` this, or writes it. Raises OSError."""
        ends = os.pipe()
        own, self.pipe = ends if reads else ends[::-1]
        self.pid = os.fork()
        if self.pid == 0:
            with contextlib.suppress(BaseException):
                signal.set_wakeup_fd(-1)
                work(own)
            os._exit(0)
        os.close(own)

    def close(self) -> None:
        """Close the pipe, and wait until the process has ended."""
        os.close(self.pipe)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self.pid, 0)


def keep_open(*descriptors: int) -> None:
    """Close all other files of this process, which was forked. Standard input and output lead nowhere then."""
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    for descriptor in [int(name) for name in os.listdir("/proc/self/fd")]:
        if descriptor > 2 and descriptor not in descriptors:
            with contextlib.suppress(OSError):  # of that listing
                os.close(descriptor)


def is_running(pid: int, born: int | None = None) -> bool:
    """Return whether a process, or one of its threads, is alive; `born`: it must have been born then."""
    return bool(stat_of(pid)) and not is_ending(pid) and born in (None, birth(pid))


def kill_all(pid: int) -> None:
    """Kill a process, its descendants and its group."""
    for descendant in descendants(pid):
        signal_process(descendant, signal.SIGKILL)
    signal_group(pid, signal.SIGKILL)


def end_process(process: subprocess.Popen[bytes]) -> None:
    """Kill a process that this one has started, with all that it has started, and close its pipes."""
    kill_all(process.pid)
    process.wait()
    for file in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):
            if file is not None:
                file.close()


def output_of(process: subprocess.Popen[bytes]) -> int:
    """Return the descriptor of the pipe from which the output of a process is read."""
    return process.stdout.fileno() if process.stdout else -1


def ending(status: int) -> str:
    return "signal %d" % -status if status < 0 else "status %d" % status
