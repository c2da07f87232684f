"""Messages between a program and Gazebo classic, over TCP connections, with Python's standard library alone.

SIERRA lays this file beside the driver of each run, which imports it. The format is that of Gazebo 2.2 to 11:

- A message is its length, as eight hexadecimal digits, and then its bytes in the wire format of Protocol Buffers.
- The master says `version_init`, `topic_namepaces_init` (so spelt) and `publishers_init` when a program connects. A packet
  is a message with the fields 1: time, 2: type, 3: the bytes of another message.
- To receive a topic, a program sends `subscribe` to the master, which answers with the address of the publisher. The program
  connects to it and sends `sub`. All that follows on this connection are messages of the topic.
- To send a topic, a program sends `advertise` to the master. Subscribers then connect to the program and send `sub`.

The numbers of fields are those in the folder `gazebo/msgs` of Gazebo's source.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any

HOST = "127.0.0.1"


class TransportError(Exception):
    """Gazebo ended a connection, or sent something that is no message."""


class Fields:
    """The fields of a message, by their number. Bytes stay bytes: they are a text, or another message."""

    def __init__(self, data: bytes) -> None:
        self._found: dict[int, list[Any]] = {}
        try:
            for number, value in _fields(data):
                self._found.setdefault(number, []).append(value)
        except (IndexError, struct.error) as error:
            raise TransportError("Gazebo sent a message that is cut off") from error

    def all(self, number: int) -> list[Any]:
        """Return all values of a repeated field."""
        return self._found.get(number, [])

    def number(self, number: int) -> float:
        """Return a number; 0 if there is none, as in Protocol Buffers."""
        values = self.all(number)
        return values[-1] if values else 0

    def text(self, number: int) -> str:
        """Return a text; empty if there is none."""
        return self.bytes(number).decode("utf-8", "replace")

    def inner(self, number: int) -> Fields:
        """Return a message inside of this one; an empty one if there is none."""
        return Fields(self.bytes(number))

    def bytes(self, number: int) -> bytes:
        """Return the bytes of a field; none if it is absent."""
        values = self.all(number)
        if values and not isinstance(values[-1], bytes):
            raise TransportError(f"Gazebo sent a number in the field {number}, where a text should be")
        return values[-1] if values else b""


def message(**fields: int | str | bytes) -> bytes:
    """Return the bytes of a message; the names of its fields end with their numbers, as in `topic_1="…"`."""
    return b"".join(_field(int(name.rpartition("_")[2]), value) for name, value in fields.items())


class Gazebo:
    """The connections to one Gazebo, whose master listens on a port of this computer."""

    def __init__(self, port: int, timeout: float) -> None:
        """Connect to the master; wait up to `timeout` seconds for each part of a message. Raises TransportError."""
        self._timeout = timeout
        self._server = socket.socket()
        self._server.bind((HOST, 0))
        self._server.listen()
        self._port = int(self._server.getsockname()[1])
        self._master = self._connected(port)
        self._new: list[_Connection] = []
        self._sending: dict[str, _Connection] = {}
        self._receiving: dict[_Connection, str] = {}
        self._wanted: set[str] = set()
        started = dict(self._master.packet() for _ in range(3))
        if "version_init" not in started:
            raise TransportError(f"port {port} does not belong to Gazebo's master")
        self.version = started["version_init"].text(1)

    def advertise(self, topic: str, kind: str) -> None:
        """Announce that this program sends messages of a topic."""
        self._master.send_packet("advertise", message(topic_1=topic, type_2=kind, host_3=HOST, port_4=self._port))

    def subscribe(self, topic: str, kind: str) -> None:
        """Ask for the messages of a topic."""
        self._wanted.add(topic)
        self._master.send_packet("subscribe", self._subscription(topic, kind))

    def connected(self) -> set[str]:
        """Return the topics that have a connection, in either direction."""
        return {*self._sending, *self._receiving.values()}

    def publish(self, topic: str, content: bytes) -> None:
        """Send a message to the subscriber of an announced topic."""
        self._sending[topic].send(content)

    def receive(self, seconds: float) -> Iterator[tuple[str, Fields]]:
        """Yield the messages that arrive, with their topics; wait up to some seconds for the first one."""
        connections = [self._master, *self._new, *self._receiving]
        ready, _, _ = select.select([self._server.fileno(), *(one.fileno() for one in connections)], [], [], seconds)
        if self._server.fileno() in ready:
            self._new.append(_Connection(self._server.accept()[0], self._timeout))
        for one in [one for one in connections if one.fileno() in ready]:
            if one is self._master:
                self._answer(*self._master.packet())
            elif one in self._receiving:
                yield self._receiving[one], Fields(one.message())
            else:
                self._new.remove(one)
                self._sending[one.packet()[1].text(1)] = one

    def _answer(self, kind: str, content: Fields) -> None:
        """Connect to a publisher that the master has named."""
        topic, port = content.text(1), int(content.number(4))
        if kind not in ("publisher_subscribe", "publisher_advertise") or topic not in self._wanted:
            return
        if topic not in self._receiving.values() and port != self._port:
            publisher = self._connected(port)
            publisher.send_packet("sub", self._subscription(topic, content.text(2)))
            self._receiving[publisher] = topic

    def _subscription(self, topic: str, kind: str) -> bytes:
        return message(topic_1=topic, host_2=HOST, port_3=self._port, type_4=kind, latching_5=0)

    def _connected(self, port: int) -> _Connection:
        try:
            return _Connection(socket.create_connection((HOST, port), self._timeout), self._timeout)
        except OSError as error:
            raise TransportError(f"port {port} of Gazebo: {error.strerror or error}") from error


class _Connection:
    """A TCP connection that carries messages."""

    def __init__(self, connected: socket.socket, timeout: float) -> None:
        connected.settimeout(timeout)
        self._socket = connected

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, content: bytes) -> None:
        try:
            self._socket.sendall(b"%08X" % len(content) + content)
        except OSError as error:
            raise TransportError(f"Gazebo has ended a connection: {error.strerror or error}") from error

    def send_packet(self, kind: str, content: bytes) -> None:
        self.send(message(stamp_1=message(sec_1=int(time.time()), nsec_2=0), type_2=kind, data_3=content))

    def message(self) -> bytes:
        header = self._read(8)
        try:
            return self._read(int(header, 16))
        except ValueError:
            raise TransportError(f"Gazebo sent {header!r} in the place of a length") from None

    def packet(self) -> tuple[str, Fields]:
        fields = Fields(self.message())
        return fields.text(2), fields.inner(3)

    def _read(self, size: int) -> bytes:
        found = bytearray()
        while len(found) < size:
            try:
                part = self._socket.recv(size - len(found))
            except OSError as error:
                raise TransportError(f"Gazebo has ended a connection: {error.strerror or error}") from error
            if not part:
                raise TransportError("Gazebo has ended a connection")
            found += part
        return bytes(found)


def _field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    content = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    """Return a whole number of 0 or more, seven bits a byte; all bytes but the last have the highest bit."""
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    found.append(value)
    return bytes(found)


def _fields(data: bytes) -> Iterator[tuple[int, float | bytes]]:
    """Yield the numbers and values of the fields of a message."""
    at = 0
    while at < len(data):
        key, at = _read_varint(data, at)
        kind = key & 7
        if kind == 0:
            value, at = _read_varint(data, at)
            yield key >> 3, value
        elif kind in (1, 5):
            yield key >> 3, struct.unpack_from("<d" if kind == 1 else "<f", data, at)[0]
            at += 8 if kind == 1 else 4
        elif kind == 2:
            size, at = _read_varint(data, at)
            if at + size > len(data):
                raise IndexError
            yield key >> 3, data[at : at + size]
            at += size
        else:
            raise TransportError(f"Gazebo sent a field of the unknown kind {kind}")


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        value |= (data[at] & 127) << shift
        shift += 7
        at += 1
        if data[at - 1] < 128:
            return value, at
