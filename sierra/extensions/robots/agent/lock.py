"""The lock of a robot: an abstract socket.

Only one process of a host can have it, of whatever user, and the kernel frees it when that process ends. Whoever finds it taken
connects to it, and reads who has it.
"""

from __future__ import annotations

import contextlib
import json
import socket
import time

from sierra.extensions.robots.agent.processes import LOOK_S
from sierra.extensions.robots.agent.records import Record, Refused

SILENT_S = 1.0  # for a holder of the lock that says nothing, because it is ending


class Lock:
    """The lock of this robot."""

    def __init__(self, name: str) -> None:
        self.address = "\0" + name
        self.socket: socket.socket | None = None
        """The lock, if this process has it."""

    def acquire(self, who: Record, give_up: float) -> None:
        """Lock the robot. An agent that is ending, or that of the same driver, is waited for. Raises Refused."""
        began = time.monotonic()
        while self.socket is None:
            lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                lock.bind(self.address)
                lock.listen(8)
                lock.setblocking(False)
                self.socket = lock
            except OSError:
                lock.close()
                holder = self.holder()
                now = time.monotonic()
                own = holder.get("session") == who.get("session")
                if own and holder.get("robot") != who.get("robot"):
                    same = "is the same host as %s; each robot needs a host of its own" % holder.get("robot")
                    raise Refused(same, "lock") from None
                waits = now < give_up if holder.get("leaving") or own else not holder and now < began + SILENT_S
                if not waits:
                    text = holder.get("text") or "another process that holds its lock"
                    raise Refused("in use by %s" % text, "lock") from None
                time.sleep(LOOK_S)

    def holder(self) -> Record:
        """Return who holds the lock; empty if nobody says so."""
        with contextlib.suppress(OSError, ValueError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as lock:
            lock.settimeout(2.0)
            lock.connect(self.address)
            with lock.makefile("rb") as file:
                who = json.loads(file.readline(1 << 16))
                return who if isinstance(who, dict) else {}
        return {}

    def tell(self, who: Record) -> None:
        """Tell another process who holds the lock."""
        with contextlib.suppress(OSError):
            if self.socket is not None:
                other, _ = self.socket.accept()
                with other:
                    other.setblocking(False)
                    other.send(json.dumps(who).encode() + b"\n")
