"""Names by which runs may exchange data with others on their host: ports, sockets, multicast groups, keys and queues."""

from __future__ import annotations

import os
import re
from typing import Iterable, Mapping

from sierra.worker.file_trace import Trace
from sierra.worker.traced_processes import Call, without_escapes

LISTENED, REUSED, IN_USE, SEARCHED, TALKED = "listened", "reused", "in_use", "searched", "connected"
SOCKET = re.compile(rb"-?\d+<socket:\[(\d+)\]>")
UNIX = re.compile(rb'sa_family=AF_UNIX, sun_path=(@?)"((?:[^"\\]|\\.)*)"')
INTERNET = re.compile(rb'sa_family=AF_INET6?, sin6?_port=htons\((\d+)\).*?"([^"]*)"')
BOUND = re.compile(rb'sa_family=AF_INET6?, sin6?_port=htons\((\d+)\), (?:sin6_flowinfo=[^,]*, )?[^"]*"([^"]*)"')
GROUP = re.compile(rb'IPV?6?_(?:ADD_MEMBERSHIP|ADD_SOURCE_MEMBERSHIP|JOIN_GROUP)\b[^"]*"([0-9a-fA-F.:]+)"')
KEY = re.compile(rb"(0x[0-9a-f]+), ")
SHARED_KEYS = {b"shmget": "shared memory", b"semget": "semaphore", b"msgget": "message queue"}
DISCOVERY = ("224.0.0.251:5353/udp", "ff02::fb:5353/udp", "239.255.255.250:1900/udp")
"""Groups by which programs only look for devices and services of the network: mDNS and SSDP."""
MOST_CHANNELS = 1000
FILE_NAMES = ("/", "{", "@/")
"""The beginnings of names of files, and of displays and daemons.

A connection to a socket with such a name says nothing, unless another run has made it.
"""
NAME_SERVER = "127.0.0.1:53"


class Socket:
    """A socket of a run: `stream` is None if its type is unknown."""

    __slots__ = ("groups", "name", "pid", "port", "reuses", "stream")

    def __init__(self, *, stream: bool | None = None) -> None:
        self.stream, self.reuses, self.port = stream, False, 0
        self.name: str | None = None
        self.pid = b""
        """The process that has bound it."""
        self.groups: set[str] = set()


class Channels:
    """The names by which a run may exchange data with others on this host, and how it has used them.

    - `listened`: the run has bound a name that it, or its author, has chosen. Nobody else can have it at the same time, but
      another run that fails to bind it may use this run's server.
    - `reused`: the same with an option by which several programs may bind a name at the same time (SO_REUSEPORT, and for UDP
      SO_REUSEADDR), a multicast group, or a System V key or a message queue, which belong to all.
    - `in_use`: the name was bound by another program (EADDRINUSE), and not by an earlier program of the run.
    - `searched`: so was this one, but then the same process bound another one, and no process of the run connected to the
      first. The one that it bound in this way has this use, too.
    - `connected`: the run has connected to a name that no process of its own has bound. UDP sockets are left out: the C library
      connects them to find its own address, and whether they were used is not seen.

    All addresses of this host count as 127.0.0.1. A port that the kernel chooses (0), and a socket in a folder that the run has
    made itself, are the run's own.
    """

    def __init__(self) -> None:
        self._sockets: dict[bytes, Socket] = {}
        self._bound: set[str] = set()
        self._in_use: dict[str, set[bytes]] = {}
        self._moved_on: set[bytes] = set()
        """Processes that have bound something after they could not bind something else."""
        self._connected: set[tuple[str, str]] = set()
        """Names to which it has connected, with the address."""
        self._shared: set[str] = set()

    def _socket(self, call: Call) -> Socket:
        """Return the socket in the first argument of a call."""
        match = SOCKET.match(call.words)
        return self._sockets.setdefault(match.group(1), Socket()) if match else Socket()

    def make(self, call: Call) -> None:
        """A socket is made."""
        number = (call.path or b"").partition(b"socket:[")[2].rstrip(b"]")
        if number and b"AF_INET" in call.words:
            self._sockets[number] = Socket(stream=b"SOCK_STREAM" in call.words)

    def set_option(self, call: Call) -> None:
        if call.error:
            return
        socket = self._socket(call)
        if b", SO_REUSEPORT, [1" in call.words or (socket.stream is False and b", SO_REUSEADDR, [1" in call.words):
            socket.reuses = True
        elif match := GROUP.search(call.words):
            socket.groups.add(match.group(1).decode())

    def bind(self, call: Call, pid: bytes, unix: str | None) -> None:
        """A process binds a socket; `unix` is the name of a Unix socket that others can have, too."""
        socket, match = self._socket(call), BOUND.search(call.words)
        name = unix
        if match is not None:
            socket.port = int(match.group(1))
            name = "127.0.0.1:%d%s" % (socket.port, "/udp" if socket.stream is False else "") if socket.port else None
        if call.error == b"EADDRINUSE":
            self._fail(name, pid)
        elif not call.error and (match or unix):
            self._moved_on.add(pid)
            socket.name, socket.pid = name, pid
            self._bound.update([name] if name else [])

    def listen(self, call: Call, pid: bytes) -> None:
        """A bound socket listens: with SO_REUSEADDR, only this may fail."""
        socket = self._socket(call)
        if call.error == b"EADDRINUSE" and socket.name:
            if not any(other.name == socket.name for other in self._sockets.values() if other is not socket):
                self._bound.discard(socket.name)
            self._fail(socket.name, pid)
            socket.name = None

    def _fail(self, name: str | None, pid: bytes) -> None:
        if name is not None and name not in self._bound:
            self._in_use.setdefault(name, set()).add(pid)
            self._moved_on.discard(pid)

    def connect(self, call: Call, unix: str | None, remote: re.Match[bytes] | None) -> None:
        """A socket is connected, or will be."""
        socket = self._socket(call)
        if unix is not None:
            self._connected.add((unix, ""))
        elif remote is not None and socket.stream is not False and int(remote.group(1)):
            self._connected.add(("127.0.0.1:%d" % int(remote.group(1)), remote.group(2).decode()))

    def share(self, call: Call) -> None:
        """A System V key or a message queue is used."""
        if call.name == b"mq_open":
            name = call.words.partition(b'"')[2].partition(b'"')[0]
            self._shared.add("message queue /" + os.fsdecode(without_escapes(name)).lstrip("/"))
        elif match := KEY.match(call.words):
            self._shared.add("%s %s" % (SHARED_KEYS[call.name], match.group(1).decode()))

    def used(self) -> tuple[tuple[str, str], ...]:
        """Return the names and their uses, sorted."""
        uses = {(name, REUSED) for name in self._shared}
        sockets = self._sockets.values()
        bound = {socket.name for socket in sockets if socket.name} | self._bound
        talked = {name for name, address in self._connected if name not in bound and (not address or is_own_address(address))}
        looking = {pid for name, pids in self._in_use.items() if name not in talked for pid in pids & self._moved_on}
        uses |= {(socket.name, SEARCHED) for socket in sockets if socket.name and socket.pid in looking}
        uses |= {(name, TALKED) for name in talked}
        for socket in sockets:
            if socket.groups and socket.port:
                bound.discard(socket.name)
                uses |= {("%s:%d/udp" % (group, socket.port), REUSED) for group in socket.groups}
            elif socket.name and socket.reuses:
                uses.add((socket.name, REUSED))
        uses |= {(name, LISTENED) for name in bound if name and not uses & {(name, REUSED), (name, SEARCHED)}}
        for name, pids in self._in_use.items():
            uses.add((name, SEARCHED if pids <= self._moved_on and name not in talked else IN_USE))
        return tuple(sorted((name, use) for name, use in uses if name not in DISCOVERY)[:MOST_CHANNELS])


def is_own_address(address: str) -> bool:
    """Return whether an IP address is one of this host: a socket can be bound to it."""
    import socket

    address = address[7:] if address.startswith("::ffff:") else address
    if address.startswith("127.") or address in ("::1", "0.0.0.0", "::"):  # noqa: S104 - compared, not bound
        return True
    try:
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((address, 0))
    except OSError:
        return False
    return True


DIGITS = re.compile("[0-9]+")
DISCOVERY_OF_GAZEBO = "239.255.0.7:"


def with_channels(trace: Trace, ports: Iterable[int], theirs: Iterable[str], environment: Mapping[str, str]) -> Trace:
    """Return a trace without the channels that are a run's own, or that are shared on purpose.

    These are names with numbers in `ports`, those of shared services (`theirs`), and Gazebo's group if a partition is declared.
    """
    numbers, names = set(map(str, ports)), set(theirs)
    parted = "GZ_PARTITION" in environment or "IGN_PARTITION" in environment

    def is_own(name: str) -> bool:
        return name in names or (parted and name.startswith(DISCOVERY_OF_GAZEBO)) or bool(numbers & set(DIGITS.findall(name)))

    return trace._replace(channels=tuple(channel for channel in trace.channels if not is_own(channel[0])))


def is_doubtful(channels: Iterable[tuple[str, str]]) -> bool:
    """Return whether a second run must be observed, to know whether it uses one of these names, too."""
    return any(
        use not in (SEARCHED, TALKED) or (use == TALKED and not name.startswith(FILE_NAMES) and name != NAME_SERVER)
        for name, use in channels
    )
