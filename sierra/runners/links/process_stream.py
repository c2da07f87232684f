"""Commands on hosts as processes of this machine."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import os
import selectors
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from typing import cast

from sierra.runners.links.commands import LEAVE_S

PIPE_BYTES = 1 << 20
"""The bytes of output that a process can write without waiting. Copies of folders are faster with more than Linux's 64 KiB."""


class ProcessStream:
    """The Stream of a process of this machine, for example a client that is connected to a host."""

    def __init__(self, argv: Sequence[str], environment: Mapping[str, str]) -> None:
        self._process = subprocess.Popen(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True, env=environment
        )
        assert self._process.stdin and self._process.stdout and self._process.stderr  # noqa: PT018, S101 - all are pipes
        self._input = self._process.stdin
        self._outputs = {1: cast(io.BufferedReader, self._process.stdout), 2: cast(io.BufferedReader, self._process.stderr)}
        os.set_blocking(self._input.fileno(), False)
        with contextlib.suppress(OSError):  # the limit of all pipes of a user
            fcntl.fcntl(self._process.stdout, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._open = selectors.DefaultSelector()
        for number, pipe in self._outputs.items():
            self._open.register(pipe, selectors.EVENT_READ, number)
        self._first: list[tuple[int, bytes]] = []
        self._lock = threading.Lock()

    def has_begun(self, timeout: float) -> bool:
        """Wait for standard output; return whether there is some. What comes is kept for `read`."""
        end = time.monotonic() + timeout
        with contextlib.suppress(TimeoutError):
            while found := self._read(max(0.0, end - time.monotonic())):
                self._first.append(found)
                if found[0] == 1:
                    return True
        return False

    def send(self, data: bytes, timeout: float) -> None:
        view = memoryview(data)
        try:
            with selectors.DefaultSelector() as writable:
                writable.register(self._input, selectors.EVENT_WRITE)
                while view:
                    if not writable.select(timeout):
                        raise TimeoutError
                    with self._lock:  # the number of a closed pipe may be that of another file
                        view = view[os.write(self._input.fileno(), view[: 1 << 16]) :]
        except ValueError:  # another thread has closed it
            raise BrokenPipeError from None

    def end_input(self) -> None:
        with self._lock:
            self._input.close()

    def read(self, timeout: float) -> tuple[int, bytes] | None:
        return self._first.pop(0) if self._first else self._read(timeout)

    def _read(self, timeout: float) -> tuple[int, bytes] | None:
        with contextlib.suppress(ValueError, KeyError):  # another thread has closed it
            while self._open.get_map():
                ready = self._select(timeout)
                if not ready:
                    raise TimeoutError
                for key, _ in ready:
                    data = self._outputs[key.data].read1(1 << 18)  # not by its number, which may be that of another file
                    if data:
                        return key.data, data
                    self._open.unregister(key.fileobj)
        return None

    def _select(self, timeout: float) -> list[tuple[selectors.SelectorKey, int]]:
        """Return the pipes with output. Raises ValueError if another thread has closed them, also at this moment."""
        try:
            return self._open.select(timeout)
        except OSError as error:
            if error.errno != errno.EBADF:
                raise
            raise ValueError from None

    def close(self, *, ended: bool = False) -> None:
        with contextlib.suppress(OSError):
            self.end_input()
        try:
            self._process.wait(LEAVE_S)  # until it has noticed the end of its input, or of its command
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._open.close()
        for pipe in self._outputs.values():
            pipe.close()

    def problem(self) -> str:
        said = b"".join(data for number, data in self._first if number == 2).decode(errors="replace")
        return next((" ".join(line.split()).rstrip(".") for line in said.splitlines() if line.strip()), "")
