"""The driver's end of one agent (see `agent.robot_agent`): requests, answers, events, and the beats of the lease."""

from __future__ import annotations

import contextlib
import itertools
import json
import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, InvalidStateError
from pathlib import Path
from typing import Any

from sierra.errors import Missing, SierraError
from sierra.extensions.hosts.clock import Clock, measured
from sierra.extensions.robots import agent_messages
from sierra.extensions.robots.agent_messages import Record
from sierra.runners.links import copy_folder
from sierra.runners.links.base import Channel, Link, Overdue, Unreachable
from sierra.util.lazy_logger import Log

log = Log(__name__)

LOCK = "sierra-robot"
"""The name of the lock that a robot has once, for all of its users."""
ANSWER_S = 10.0
POLL_S = 0.1
BEATS = 5
"""The number of beats in the time of a lease."""


class Refused(Missing):
    """A request that the agent refuses, for a reason that it gives."""

    about = ""
    """The reason in one word: see `agent_messages`."""


def refused(name: str, record: Record) -> Refused:
    """Return the error for a message in which an agent refuses a request."""
    error = Refused(f"{name}: {record['reason']}")
    error.about = record.get("about", "")
    return error


class _Pieces:
    """A folder in pieces, which an agent sends: a `copy_folder.Conversation`."""

    def __init__(self, agent: AgentLink, number: int) -> None:
        self.name = agent.name
        self.number = number
        self._agent = agent
        self._queue: queue.Queue[Record] = queue.Queue(16)
        self._closed = threading.Event()

    def send(self, data: bytes, timeout: float) -> None:
        self._agent.tell("pull", id=self.number, line=data.decode().rstrip("\n"))

    def read(self, timeout: float) -> tuple[int, bytes] | None:
        """Return the next piece; None at the end. Raises TimeoutError, Missing, Unreachable."""
        end = time.monotonic() + timeout
        while True:
            try:
                record = self._queue.get(timeout=POLL_S)
            except queue.Empty:
                if self._agent.lost is not None:
                    raise Unreachable(f"{self.name}: {self._agent.lost}") from None
                if time.monotonic() > end:
                    raise TimeoutError from None
                continue
            if record["event"] == "refused":
                raise refused(self.name, record)
            return (1, record["data"]) if record["event"] == "data" else None

    def put(self, record: Record) -> None:
        """Take a message of the agent. It waits while there are many, so that the agent sends no more."""
        while not self._closed.is_set():
            with contextlib.suppress(queue.Full):
                self._queue.put(record, timeout=POLL_S)
                return

    def close(self) -> None:
        self._closed.set()


class AgentLink:
    """One robot's agent. Its events that answer no request are put into `events`, with the robot's name."""

    def __init__(self, name: str, link: Link, lease: float, events: queue.SimpleQueue[tuple[str, Record]]) -> None:
        self.name = name
        self.link = link
        self.lost: str | None = None
        """The reason why the agent is not there any more; None while it is."""
        self.heard = time.monotonic()
        self._lease = lease
        self._events = events
        self._outgoing: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._pending: dict[int, Future[Record]] = {}
        self._pieces: dict[int, _Pieces] = {}
        """The folders that are received, by the numbers of their requests."""
        self._numbers = itertools.count(1)
        self._channel: Channel | None = None

    def start(self, argv: tuple[str, ...]) -> None:
        """Start the agent, and begin to send beats. Raises Unreachable, UntrustedHost."""
        self.lost = None
        self._outgoing = queue.SimpleQueue()
        self._channel = self.link.channel(argv)
        self.heard = time.monotonic()
        for work in (self._send, self._receive):
            threading.Thread(target=work, args=(self._channel, self._outgoing), daemon=True).start()

    @property
    def silence(self) -> float:
        """Return the seconds since the agent was heard of."""
        return time.monotonic() - self.heard

    def ask(self, do: str, timeout: float = ANSWER_S, **fields: Any) -> Record:
        """Send a request, and return its answer. Raises Refused, and Unreachable if there is none."""
        number, answer = next(self._numbers), Future[Record]()
        self._pending[number] = answer
        self._put({"do": do, "id": number, **fields})
        if self.lost is not None:
            raise Unreachable(f"{self.name}: {self.lost}")
        try:
            record = answer.result(timeout)
        except TimeoutError:
            raise Unreachable(f"{self.name}: no answer for {timeout:g} s") from None
        finally:
            self._pending.pop(number, None)
        if record["event"] == "refused":
            raise refused(self.name, record)
        return record

    def tell(self, do: str, **fields: Any) -> None:
        """Send a request, and wait for no answer."""
        self._put({"do": do, **fields})

    def pull(self, folder: str, target: Path, timeout: float = 60.0) -> None:
        """Copy a folder of the robot as `Link.pull` does, by the agent that executes anyway unless it is large."""
        try:
            self._pull(folder, target, timeout)
        except Refused as error:
            if error.about != "large":
                raise
            self.link.pull(folder, target, timeout=timeout)

    def _pull(self, folder: str, target: Path, timeout: float) -> None:
        pieces = _Pieces(self, next(self._numbers))
        self._pieces[pieces.number] = pieces
        try:
            copy_folder.pull(pieces, folder, target, timeout, started=True)
        finally:
            self._pieces.pop(pieces.number, None)
            pieces.close()

    def clock(self, now_ns: Callable[[], int]) -> Clock:
        """Measure the robot's clock, compared with `now_ns`. Raises Unreachable."""
        return measured(lambda: int(self.ask("clock")["wall"]), now_ns)

    def close(self) -> None:
        """Give the robot back."""
        self.tell("bye")
        self._outgoing.put(None)

    def abandon(self, reason: str) -> None:
        """Count the agent as lost, and close the connection."""
        self._lose(reason)
        self._outgoing.put(None)

    def _put(self, record: Mapping[str, Any]) -> None:
        self._outgoing.put(json.dumps(record, separators=(",", ":")))

    def _send(self, channel: Channel, outgoing: queue.SimpleQueue[str | None]) -> None:
        """Send the requests, and a beat whenever there is none for some time."""
        beat = '{"do":"beat"}'
        try:
            while True:
                try:
                    line = outgoing.get(timeout=self._lease / BEATS)
                except queue.Empty:
                    line = beat
                if line is None:
                    return
                channel.send(line)
        except SierraError as error:
            self._lose(str(error), channel)
        finally:
            with contextlib.suppress(OSError, EOFError):  # of a connection that is lost
                channel.close()

    def _receive(self, channel: Channel, outgoing: queue.SimpleQueue[str | None]) -> None:
        reason = "its agent has ended"
        try:
            while (line := self._line(channel)) is not None:
                self.heard = time.monotonic()
                self._take(agent_messages.read(line))
            reason += f": {words[-1]}" if (words := channel.errors().strip().splitlines()) else ""
        except SierraError as error:
            reason = str(error)
        except ValueError:
            reason = "its agent sends what is not in the protocol"
        self._lose(reason, channel)
        outgoing.put(None)

    def _line(self, channel: Channel) -> str | None:
        while True:
            try:
                return channel.receive(self._lease)
            except Overdue:
                if channel is not self._channel or self.lost is not None:
                    return None

    def _take(self, record: Record) -> None:
        if record["event"] == "beat":
            return
        if pieces := self._pieces.get(record.get("id") or 0):
            pieces.put(record)
            return
        if record["event"] in ("data", "pulled"):  # nobody wants them any more
            return
        answer = self._pending.pop(record.get("id") or 0, None)
        if answer is None:
            self._events.put((self.name, record))
        else:
            with contextlib.suppress(InvalidStateError):  # the agent was given up meanwhile
                answer.set_result(record)

    def _lose(self, reason: str, channel: Channel | None = None) -> None:
        """Note why the agent is lost; the first reason counts. The threads of an earlier channel are ignored."""
        if self.lost is not None or (channel is not None and channel is not self._channel):
            return
        log.debug("%s: lost: %s", self.name, reason)
        self.lost = reason.removeprefix(f"{self.name}: ")
        for answer in list(self._pending.values()):
            with contextlib.suppress(InvalidStateError):
                answer.set_exception(Unreachable(f"{self.name}: {self.lost}"))
        for pieces in list(self._pieces.values()):
            pieces.close()
        self._events.put((self.name, {"event": "lost", "reason": self.lost}))
