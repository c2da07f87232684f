"""Containers of one run: those that are started before their run begins, and the end of containers without a client."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import select
import signal
import subprocess
import time
from typing import Callable

from sierra.worker import program
from sierra.worker.errors import NotHeld
from sierra.worker.files import last_line_of, unlink
from sierra.worker.job import GRACE_S, Job, Program, with_folder
from sierra.worker.layout import LOGS
from sierra.worker.processes import POLL_S, SAMPLE_S, has_ended, reap, signal_group
from sierra.worker.running import START_S, start

PROGRAM = re.compile(rb"\0-I\0-S\0[^\0]*/%s\0" % re.escape(program.NAME.encode()))
"""The words of SIERRA's own program in a container."""
CLEAN_S = 10.0  # for an engine's cleanup after its containers have ended


class HeldContainer:
    """A container that is started before its run begins.

    A program in it waits to read a line from a named pipe, and then becomes the program of the run. It has opened the pipe for
    reading as soon as the pipe can be opened for writing here.
    """

    def __init__(self, job: Job, folder: str) -> None:
        client = with_folder(job["client"], folder)
        self.client = client
        self.log = os.path.join(folder, LOGS[1])
        self.path = client["start_pipe"]
        self.pipe: int | None = None
        self.grace = job["limits"].get("grace_s", GRACE_S)
        os.mkfifo(self.path, 0o600)
        self.process = start(job, folder)

    def await_ready(self, is_stopping: Callable[[], bool]) -> None:
        """Wait until the program in the container waits for its line. Raises NotHeld, OSError."""
        give_up = time.monotonic() + START_S
        while not self.is_waiting() and not is_stopping():
            self.check()
            if time.monotonic() > give_up:
                raise NotHeld("its container did not start within %g s" % START_S)
            select.select((), (), (), SAMPLE_S / 10)

    def is_waiting(self) -> bool:
        try:
            self.pipe = os.open(self.path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            if error.errno != errno.ENXIO:  # nobody has opened it for reading
                raise
        return self.pipe is not None

    def check(self) -> None:
        """Check that the container has not ended. Raises NotHeld."""
        if has_ended(self.process.pid):
            raise NotHeld("its container ended before the run began: " + (last_line_of(self.log) or "it printed no error"))

    def begin(self) -> subprocess.Popen[bytes]:
        """Let the program begin, and return its client. It may have ended by itself just before."""
        if self.pipe is not None:
            with contextlib.suppress(BrokenPipeError):
                os.write(self.pipe, b"\n")
        self.close()
        return self.process

    def end(self) -> None:
        """End the container. Its program has not begun: it ends when the pipe is closed."""
        self.close()
        signal_group(self.process.pid, signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(self.grace)
        signal_group(self.process.pid, signal.SIGKILL)
        self.process.wait()
        end_container(self.client)

    def close(self) -> None:
        if self.pipe is not None:
            os.close(self.pipe)
        unlink(self.path)


def end_container(client: Program) -> None:
    """End the container of a client that is gone or does not react."""
    if client.get("stop"):
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):  # a later check looks for the container again
            subprocess.run(
                client["stop"],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=client["environment"],
                timeout=3 * CLEAN_S,
                start_new_session=True,
            )


def await_orphans() -> None:
    """Wait while an engine cleans up after containers that have ended."""
    give_up = time.monotonic() + CLEAN_S
    while reap() and time.monotonic() < give_up:
        time.sleep(POLL_S / 10)
