"""The stop command of a robot. `robot_agent` says when it is executed."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import subprocess
import time
from typing import Mapping, Sequence

from sierra.extensions.robots.agent.processes import LOOK_S, TAIL_BYTES, end_process, ending, output_of
from sierra.worker.errors import explain

STOP_S = 5.0
PASSING = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)  # reasons why a program cannot be started that pass


class Standstill:
    """The stop command of a robot. Each demand is fulfilled by an execution that begins after it, one after the other."""

    def __init__(self, argv: Sequence[str] = (), environment: Mapping[str, str] | None = None, limit: float = STOP_S) -> None:
        """`argv`: the command; empty: the robot needs none. `limit`: the seconds that it may take."""
        self.argv = argv
        self.environment = environment
        self.limit = limit
        self.problem: str | None = None
        """Why the last execution has failed; None if it has not."""
        self.problems: list[str] = []
        """Why executions have failed since this list was emptied."""
        self.demanded = False
        self.process: subprocess.Popen[bytes] | None = None
        self.retry_until = self.kill_at = 0.0
        """Until when a failed start is tried again, and when an execution takes too long."""
        self.said = b""
        self.null = os.open(os.devnull, os.O_RDWR)

    @property
    def pid(self) -> int:
        """Return the process of the command; 0 if it does not execute."""
        return self.process.pid if self.process else 0

    def demand(self) -> None:
        """Execute the command as soon as an execution that has begun before has ended."""
        if self.argv:
            self.demanded, self.retry_until = True, time.monotonic() + self.limit
            self.look()

    @property
    def busy(self) -> bool:
        """Return whether an execution has begun or is demanded."""
        return self.process is not None or self.demanded

    def look(self) -> bool:
        """Start or end executions that are due; return whether nothing is left to do."""
        if self.process is not None and self.has_ended(self.process):
            self.process = None
        if self.process is None and self.demanded:
            self.start()
        return not self.busy

    def execute(self) -> str | None:
        """Execute the command, and wait for its end; return why it has failed."""
        self.demand()
        while not self.look():
            select.select((), (), (), LOOK_S / 20)  # a clock that tests replace makes time.sleep fail
        return self.problem

    def start(self) -> None:
        try:
            self.process = subprocess.Popen(
                self.argv,
                stdin=self.null,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=self.environment,
                start_new_session=True,
            )
        except (OSError, ValueError) as error:
            if getattr(error, "errno", None) in PASSING and time.monotonic() < self.retry_until:
                return  # it is tried again
            self.demanded = False
            self.note("cannot be started: " + explain(error))
            return
        self.demanded, self.said, self.kill_at = False, b"", time.monotonic() + self.limit
        os.set_blocking(output_of(self.process), False)

    def has_ended(self, process: subprocess.Popen[bytes]) -> bool:
        """Return whether an execution has ended; ends it if it takes too long."""
        status = process.poll()
        with contextlib.suppress(BlockingIOError):  # it could not end if nobody read what it prints
            while data := os.read(output_of(process), 1 << 16):
                self.said = (self.said + data)[-TAIL_BYTES:]
        if status is None and time.monotonic() < self.kill_at:
            return False
        end_process(process)
        words = self.said.decode("utf-8", "replace").strip().splitlines()[-1:]
        if status is None:
            self.note("did not end within %g s" % self.limit)
        else:
            self.note(": ".join(["ended with %s" % ending(status), *words]) if status else None)
        return True

    def note(self, problem: str | None) -> None:
        self.problem = problem and "the stop command " + problem
        if self.problem and self.problem not in self.problems:
            self.problems.append(self.problem)
