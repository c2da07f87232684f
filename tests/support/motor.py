"""A motor with memory for a robot of the tests: it obeys the last command for ever, also if the robot has no power.

Commands are lines with a speed, which programs on the robot write to a named pipe. This process is the motor, and logs them.
"""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import NamedTuple

from tests.waiting import until


class Command(NamedTuple):
    """A speed, and when it was commanded, by the monotonic clock of this machine."""

    at: float
    speed: float


class Motor:
    """The motor of one robot. It stands still at first."""

    def __init__(self, pipe: Path) -> None:
        os.mkfifo(pipe)
        pipe.chmod(0o666)  # whatever the umask is
        self._pipe = os.open(pipe, os.O_RDWR)  # both ends, so that there always is a reader and a writer
        self.commands: list[Command] = []
        threading.Thread(target=self._obey, daemon=True).start()

    def _obey(self) -> None:
        unread = b""
        while data := os.read(self._pipe, 4096):
            now = time.monotonic()
            *lines, unread = (unread + data).split(b"\n")
            self.commands += [Command(now, float(line)) for line in lines]

    @property
    def speed(self) -> float:
        """Return the speed that was commanded last."""
        return self.commands[-1].speed if self.commands else 0.0

    def moves(self) -> None:
        """Wait until it moves."""
        until(lambda: self.speed, "the motor moves")

    def stopped_after(self, since: float) -> float:
        """Return how many seconds after a time it was told to stop for the first time; the program may have moved it again."""
        return next((command.at - since for command in self.commands if command.at > since and not command.speed), 0.0)

    def stood_after(self, since: float) -> float:
        """Return how many seconds after a time it stood still for good: 0 if it did before."""
        moved = [number for number, command in enumerate(self.commands) if command.speed]
        stops = self.commands[moved[-1] + 1 :] if moved else self.commands
        assert not self.speed, f"it moves with {self.speed}"
        return max(0.0, stops[0].at - since) if stops else 0.0

    def forget(self) -> None:
        """Stand still, and forget all commands."""
        self.commands.clear()
