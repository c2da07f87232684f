"""The driver's connection to one host: it is made again when it is lost, until the session ends."""

from __future__ import annotations

import contextlib
import json
import posixpath
import queue
import threading
import time
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from sierra.config.plugin_registry import LINKS
from sierra.errors import Missing, SierraError
from sierra.extensions.hosts.clock import Clock, measured
from sierra.extensions.hosts.push import content_name, has_python, push_content, push_programs
from sierra.extensions.lab import agent
from sierra.extensions.lab.agent import front, host_folder
from sierra.extensions.lab.agent.host_folder import Record
from sierra.extensions.lab.lab_table import Host, LabTable
from sierra.extensions.lab.tasks import Tasks
from sierra.runners.links.base import Overdue, Unreachable, UntrustedHost
from sierra.runners.links.commands import Commands, Exchange
from sierra.util.lazy_logger import Log
from sierra.worker import program

log = Log(__name__)
LOST_S = 8.0
"""The seconds without a sign of life after which a connection counts as lost. A host sends one each second."""
BEAT_S = 2.0
AGAIN_S, LATER_S = 1.0, 30.0
"""The shortest and longest pause before a lost connection is made again."""
LONGEST_LINE = 16 << 20
LONGEST_PART = 16 << 20
FRONT = front.__name__


class Unusable(Missing):
    """A host that cannot execute runs, whatever is tried again."""


class HostConnection:
    """One host of a lab. Its thread connects, and passes each event of the host to `handle`."""

    def __init__(
        self,
        host: Host,
        table: LabTable,
        tasks: Tasks,
        session: str,
        lease: Callable[[], float | None],
        have: Callable[[], Mapping[str, int]],
        handle: Callable[[HostConnection, Record, bytes], None],
    ) -> None:
        """`tasks` say what runs request, and what is copied to the host. `session` names the folder of the session there.

        `lease` returns the seconds for which the host goes on without a connection; None: without end. `have` returns the bytes
        of each result log that this machine has. `handle` is called by this thread, for the events of the host and for those of
        the connection: `connected` and `lost`, with the reason.
        """
        self.host = host
        self.name = host.name
        self.slots = 0
        """The number of runs that it executes at a time."""
        self.clock: Clock | None = None
        self.folder = ""
        """The absolute path of the session's folder there."""
        self.places: dict[str, str] = {}
        """The absolute paths there of what was copied, by those of this machine."""
        self.heard = host_folder.now()
        """When something came from the host, in seconds since boot, in which a suspended computer also counts."""
        self.connected = False
        self._table, self._tasks, self._session = table, tasks, session
        self._have, self._handle, self._lease = have, handle, lease
        kind = table.link
        self._link = LINKS.make(kind, {kind: {**tasks.links.get(kind, {}), **table.link_options}}, host.name)
        if not isinstance(self._link, Commands):
            raise Missing(f"link {kind!r} cannot carry files for a lab; use openssh or fabric")
        self._link.python = table.python
        self._closing = threading.Event()
        self._outgoing: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._exchange: Exchange | None = None
        self._pieces = b""
        """The bytes that have come and were not taken in yet."""
        self._part: Record = {}
        """The event of the part of a result log that comes now; `at` is where the rest of it begins."""
        self._left = 0
        """The bytes of that rest."""

    def start(self) -> None:
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        pause = AGAIN_S
        while not self._closing.is_set():
            try:
                self._serve()
                pause = AGAIN_S
            except (UntrustedHost, Unusable) as error:
                self._lost(str(error), again=False)
                return
            except (SierraError, OSError) as error:
                pause = AGAIN_S if self.connected else min(LATER_S, 2 * pause)
                self._lost(str(error), again=True)
            self._closing.wait(pause)

    def _lost(self, reason: str, *, again: bool) -> None:
        self.connected = False
        if not self._closing.is_set():
            about = reason.removeprefix(f"{self.name}: ")
            self._handle(self, {"event": "lost" if again else "unusable", "reason": about}, b"")

    def send(self, do: str, content: bytes = b"", **fields: Any) -> None:
        """Send a request, if there is a connection. Otherwise it is dropped: see `Lab` for what is sent again."""
        size = {"size": len(content)} if content else {}
        self._outgoing.put(json.dumps({"do": do, **fields, **size}).encode() + b"\n" + content)

    def close(self) -> None:
        self._closing.set()
        self._outgoing.put(None)
        if self._exchange is not None:
            self._exchange.close()
        self._link.close()

    def _serve(self) -> None:
        """Connect, and pass on events until the connection is lost. Raises SierraError."""
        programs = self._prepare()
        self._pieces, self._left = b"", 0
        argv = (self._table.python, "-I", "-S", "-B", f"{programs}/{program.NAME}", FRONT, self.folder)
        self._exchange = exchange = self._link.stream(argv)
        try:
            gpus, cores = self._tasks.gpus, self._tasks.cores
            requested = {"slots": self.host.slots, "lease": self._lease(), "gpus": gpus, "cores": cores}
            exchange.send(_line("hello", **requested, have=self._have()), LOST_S)
            while (hello := self._next(exchange)[0])["event"] != "hello":
                if hello["event"] == "trouble":
                    raise Missing(f"{self.name}: {hello['reason']}")
            self.slots = int(hello["slots"])
            if self.slots < 1 and gpus and hello["gpus"] < gpus:
                raise Unusable(f"{self.name}: runs request {gpus:g} GPUs each ([limits] gpus), and it has {hello['gpus']}")
            if self.slots < 1:
                raise Unusable(f"{self.name}: runs request {cores} cores each ([limits] cores), and it has fewer slots")
            early: list[tuple[Record, bytes]] = []
            self.clock = measured(lambda: self._ask_clock(exchange, early), time.time_ns)
            self._outgoing = queue.SimpleQueue()
            sender = threading.Thread(target=self._send_all, args=(exchange, self._outgoing), daemon=True)
            sender.start()
            self.connected = True
            for event in ({"event": "connected"}, b""), *early:
                self._handle(self, *event)
            while not self._closing.is_set():
                self._handle(self, *self._next(exchange))
        except (KeyError, TypeError, ValueError) as error:
            raise Missing(f"{self.name}: it sends what is not in the protocol: {error}") from error
        finally:
            self._outgoing.put(None)
            with contextlib.suppress(OSError, EOFError, SierraError):
                exchange.close()

    def _prepare(self) -> str:
        """Copy what the session needs to the host, unless it is there; return the folder of the programs."""
        link, root = self._link, self._table.folder.removeprefix("~/")
        if not has_python(link, self._table.python):
            raise Unusable(f"{self.name}: needs Python 3.8 or newer as {self._table.python!r}; set python in the lab's table")
        programs = push_programs(link, root, Path(agent.__file__).parent)
        home = link.run(("pwd",)).stdout.decode(errors="replace").rstrip("\n")
        for path, kind in self._tasks.contents.items():
            if path in self.places and link.run(("test", "-e", self.places[path])).status == 0:
                continue  # this process has copied it, and no program can change it
            self._check_open()
            copied = posixpath.join(home, push_content(link, Path(path), root, kind, named(path)))
            self.places[path] = posixpath.join(copied, Path(path).name) if Path(path).is_file() else copied
        self._check_open()
        own = "".join(character if character.isalnum() or character in "_.@-" else "_" for character in self.name)
        self.folder = posixpath.join(home, root, "sessions", self._session, own)
        return programs

    def _check_open(self) -> None:
        """Raise Unreachable if the connection is not wanted any more: a command would connect again."""
        if self._closing.is_set():
            raise Unreachable(f"{self.name}: the connection was closed")

    def _ask_clock(self, exchange: Exchange, early: list[tuple[Record, bytes]]) -> int:
        """Return the host's clock in ns; other events that come meanwhile are kept."""
        exchange.send(_line("clock"), LOST_S)
        while True:
            event, content = self._next(exchange)
            if event["event"] == "clock":
                return int(event["wall"])
            early.append((event, content))

    def _next(self, exchange: Exchange) -> tuple[Record, bytes]:
        """Return the next event of the host: of a result log, each piece of a part when it comes. Raises Unreachable."""
        if not self._left:
            while (end := self._pieces.find(b"\n")) < 0:
                self._receive(exchange, LONGEST_LINE)
            event, self._pieces = json.loads(self._pieces[:end]), self._pieces[end + 1 :]
            if not isinstance(event, dict) or not isinstance(event.get("event"), str):
                raise ValueError("no event")
            size = int(event.get("size", 0))
            if not 0 <= size <= LONGEST_PART or (size and event["event"] != "log"):
                raise ValueError(f"a part of {size} bytes")
            if not size:
                return event, b""
            self._part, self._left = event, size
        while not self._pieces:
            self._receive(exchange, LONGEST_PART)
        part, piece = self._part, self._pieces[: self._left]
        self._pieces = self._pieces[len(piece) :]
        self._left -= len(piece)
        self._part = {**part, "at": int(part["at"]) + len(piece)}
        return part, piece

    def _receive(self, exchange: Exchange, most: int) -> None:
        if len(self._pieces) > most:
            raise ValueError("a line that is too long")
        try:
            piece = exchange.read(LOST_S)
        except TimeoutError:
            raise Overdue(f"{self.name}: no sign of life for {LOST_S:g} s") from None
        if piece is None:
            raise Unreachable(f"{self.name}: its program has ended (status {exchange.status})")
        self.heard = host_folder.now()
        if piece[0] == 1:
            self._pieces += piece[1]
        else:
            log.debug("%s: %s", self.name, piece[1].decode(errors="replace").strip())

    def _send_all(self, exchange: Exchange, outgoing: queue.SimpleQueue[bytes | None]) -> None:
        """Send the requests, and a beat whenever there is none for some time."""
        try:
            while True:
                try:
                    data = outgoing.get(timeout=BEAT_S)
                except queue.Empty:
                    data = _line("beat")
                if data is None:
                    return
                exchange.send(data, LOST_S)
        except (OSError, SierraError) as error:
            log.debug("%s: %s", self.name, error)
            with contextlib.suppress(OSError, EOFError, SierraError):
                exchange.close()


@cache
def named(path: str) -> str:
    """Return the name of the content of a file or folder that does not change any more. Large ones take long to read."""
    return content_name(Path(path))


def _line(do: str, **fields: Any) -> bytes:
    return json.dumps({"do": do, **fields}).encode() + b"\n"
