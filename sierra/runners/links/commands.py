"""Commands and copies of folders on a host, for any back end that can start a command line there."""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

from sierra.runners.links import copy_folder, framing
from sierra.runners.links.address import parse
from sierra.runners.links.base import LIMIT, Ended, Folder, LinkOptions, NoSession, Overdue, Unreachable

AT_ONCE = 1 << 14
"""The bytes of input that a command can be sent without waiting: less than the buffers of all links."""

LONGEST_LINE = 64 << 20
"""The limit on the bytes of a line that a command may send."""

PAUSE_S = 0.05
"""Seconds between attempts to get a session, if sshd has no more: those of overdue commands last a little longer."""
LEAVE_S = 0.5
"""Seconds in which a command that has ended leaves its session."""


class Stream(Protocol):
    """A command line that was started on a host, as bytes."""

    def send(self, data: bytes, timeout: float) -> None:
        """Send input. Raises TimeoutError if none was taken for `timeout` s, BrokenPipeError if nobody reads, Unreachable."""

    def end_input(self) -> None:
        """Close the input."""

    def read(self, timeout: float) -> tuple[int, bytes] | None:
        """Return 1 or 2 and some bytes of standard output or error; None at the end. Raises TimeoutError, and Unreachable."""

    def close(self, *, ended: bool = False) -> None:
        """Forget the command, while others may wait in `send` or `read`. `ended`: the command has ended."""

    def problem(self) -> str:
        """Return why the stream has ended without a status, if something is known."""


class Exchange:
    """A command that executes: its stream without frames, and its place among the sessions of the link."""

    def __init__(self, name: str, stream: Stream, mark: str, forget: Callable[[Exchange], None]) -> None:
        """`forget` is called once, when the exchange is closed."""
        self.name, self._stream, self._forget = name, stream, forget
        self._outputs = {1: framing.Unframed(mark), 2: framing.Unframed(mark)}
        self._open = threading.Lock()

    @property
    def status(self) -> int | None:
        return self._outputs[1].status

    @property
    def ended(self) -> bool:
        return all(one.status is not None for one in self._outputs.values())

    def send(self, data: bytes, timeout: float) -> None:
        self._stream.send(data, timeout)

    def end_input(self) -> None:
        with contextlib.suppress(OSError, Unreachable):
            self._stream.end_input()

    def read(self, timeout: float) -> tuple[int, bytes] | None:
        """Return 1 or 2 and bytes that the command wrote, if any; None if it has ended. Raises TimeoutError, Unreachable."""
        if self.ended:
            return None
        piece = self._stream.read(timeout)
        if piece is None:
            said = self._stream.problem() or " ".join(filter(None, (output.before for output in self._outputs.values())))
            raise Unreachable(f"{self.name}: the connection ended while a command executed{f': {said}' if said else ''}")
        try:
            return piece[0], self._outputs[piece[0]].feed(piece[1])
        except ValueError:
            raise Unreachable(f"{self.name}: the end of a command comes without its exit status") from None

    def close(self) -> None:
        if self._open.acquire(blocking=False):  # only once
            self._stream.close(ended=self.ended)
            self._forget(self)


class Lines:
    """The Channel of an exchange."""

    def __init__(self, exchange: Exchange, silence: float) -> None:
        self._exchange, self._silence = exchange, silence
        self._held, self._errors, self._over = b"", b"", False

    def send(self, line: str) -> None:
        name = self._exchange.name
        try:
            self._exchange.send(line.encode() + b"\n", self._silence)
        except TimeoutError:
            raise Unreachable(f"{name}: does not take a line for {self._silence:g} s") from None
        except OSError:
            raise Unreachable(f"{name}: the command has ended, so that it takes no line") from None

    def receive(self, timeout: float) -> str | None:
        end = time.monotonic() + timeout
        while b"\n" not in self._held and not self._over:
            if len(self._held) > LONGEST_LINE:
                raise Unreachable(f"{self._exchange.name}: sends a line of more than {LONGEST_LINE >> 20} MiB")
            try:
                piece = self._exchange.read(max(0.0, end - time.monotonic()))
            except TimeoutError:
                raise Overdue(f"{self._exchange.name}: no answer within {timeout:g} s") from None
            self._over = piece is None
            match piece:
                case (1, data):
                    self._held += data
                case (2, data):
                    self._errors = (self._errors + data)[:LIMIT]
        line, complete, self._held = self._held.partition(b"\n")
        return line.decode(errors="replace") if line or complete else None

    def status(self) -> int | None:
        return self._exchange.status if self._over else None

    def errors(self) -> str:
        return self._errors.decode(errors="replace")

    def close(self) -> None:
        if not self._exchange.ended:
            self._exchange.end_input()
        self._exchange.close()


class Commands(ABC):
    """All methods of a Link but its connection. A back end implements `_start` and `_disconnect`."""

    python = "python3"

    def __init__(self, host: str, options: LinkOptions) -> None:
        self.name = host
        self._address = parse(host, options.ssh_config)
        self._options = options
        self._places = threading.Semaphore(options.sessions)
        self._open: set[Exchange] = set()

    @abstractmethod
    def _start(self, line: str) -> Stream:
        """Start a command line on the host; connect if there is no connection. Raises Unreachable and UntrustedHost."""

    @abstractmethod
    def _disconnect(self) -> None:
        """End the connection, if there is one."""

    def close(self) -> None:
        for exchange in tuple(self._open):
            exchange.close()
        self._disconnect()

    def run(self, argv: Sequence[str], *, stdin: bytes = b"", timeout: float = 30.0) -> Ended:
        end = time.monotonic() + timeout
        with self._exchange(argv, timeout, limit=timeout, alone=not stdin) as exchange:
            if len(stdin) > AT_ONCE:
                threading.Thread(target=_feed, args=(exchange, stdin, timeout), daemon=True).start()
            elif stdin:
                _feed(exchange, stdin, timeout)
            kept = {1: bytearray(), 2: bytearray()}
            try:
                while piece := exchange.read(max(0.0, end - time.monotonic())):
                    output = kept[piece[0]]
                    output += piece[1][: LIMIT - len(output)]
                    if time.monotonic() > end and not exchange.ended:
                        raise TimeoutError
            except TimeoutError:
                raise Overdue(f"{self.name}: {argv[0]} did not end within {timeout:g} s") from None
        assert exchange.status is not None  # noqa: S101 - it has ended
        return Ended(exchange.status, bytes(kept[1]), bytes(kept[2]))

    def stream(self, argv: Sequence[str]) -> Exchange:
        """Start a command with which bytes are exchanged."""
        return self._exchanged(argv, self._options.lost)

    def channel(self, argv: Sequence[str]) -> Lines:
        return Lines(self._exchanged(argv, self._options.lost), self._options.lost)

    def push(
        self, folder: Path, target: str, *, timeout: float = 60.0, progress: Callable[[int], None] = lambda size: None
    ) -> Folder:
        listed = copy_folder.listed(folder)
        root = folder.parent if folder.is_file() else folder
        with self._exchange(copy_folder.program("push", self.python), timeout) as exchange:
            return copy_folder.push(exchange, root, listed, target, timeout, progress)

    def pull(self, folder: str, target: Path, *, timeout: float = 60.0) -> Folder:
        with self._exchange(copy_folder.program("pull", self.python), timeout) as exchange:
            return copy_folder.pull(exchange, folder, target, timeout)

    @contextlib.contextmanager
    def _exchange(
        self, argv: Sequence[str], wait: float, limit: float | None = None, *, alone: bool = False
    ) -> Iterator[Exchange]:
        exchange = self._exchanged(argv, wait, limit, alone=alone)
        try:
            yield exchange
        finally:
            exchange.close()

    def _exchanged(self, argv: Sequence[str], wait: float, limit: float | None = None, *, alone: bool = False) -> Exchange:
        if not self._places.acquire(timeout=wait):
            raise NoSession(
                f"{self.name}: {self._options.sessions} commands are executing, and none ended within {wait:g} s; "
                "increase sessions of the link if the host allows more"
            )
        mark = framing.new_mark()
        try:
            exchange = Exchange(
                self.name, self._start(framing.line(argv, mark, limit, alone=alone)), mark, self._forget_exchange
            )
        except BaseException:
            self._places.release()
            raise
        self._open.add(exchange)
        return exchange

    def _forget_exchange(self, exchange: Exchange) -> None:
        self._open.discard(exchange)
        self._places.release()


def no_session(name: str) -> NoSession:
    return NoSession(f"{name}: sshd refuses one more session; increase its MaxSessions, or decrease sessions of the link")


def _feed(exchange: Exchange, data: bytes, timeout: float) -> None:
    """Send the input of a command, and end it. A command may end without reading it."""
    with contextlib.suppress(OSError, Unreachable):
        exchange.send(data, timeout)
        exchange.end_input()
