"""A pipe that wakes the main thread of a worker."""

from __future__ import annotations

import contextlib
import os
import select


class WakeupPipe:
    """A means to wake the main thread from any thread, from a signal handler, or when a pipe is closed.

    (Python's own events and queues hold locks, so a signal handler must not use them.)
    """

    def __init__(self) -> None:
        self._read_end, self._write_end = os.pipe()
        os.set_blocking(self._read_end, False)
        os.set_blocking(self._write_end, False)
        self._poll = select.poll()
        self._poll.register(self._read_end, select.POLLIN)
        self._pipe: int | None = None

    def watch_pipe(self, pipe: int) -> None:
        """Wake also when the other end of `pipe` is closed, even if data in it is still unread."""
        self._pipe = pipe
        self._poll.register(pipe, 0)

    def wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._write_end, b"!")

    def close(self) -> None:
        os.close(self._read_end)
        os.close(self._write_end)

    def wait(self, seconds: float) -> bool:
        """Wait for so many seconds, or until woken. Return False if the pipe was closed."""
        ready = [descriptor for descriptor, _ in self._poll.poll(seconds * 1000)]
        if self._read_end in ready:
            os.read(self._read_end, 4096)
        if self._pipe not in ready:
            return True
        self._poll.unregister(self._pipe)
        return False
