"""Copies of folders to and from a host: the part on this machine; `sierra.worker.remote_folder` is the part on the host."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

from sierra.errors import Missing
from sierra.runners.links.base import Folder, Overdue, Unreachable
from sierra.worker import remote_folder


class Conversation(Protocol):
    """A command on a host, as bytes: see `sierra.runners.links.commands.Exchange`."""

    name: str

    def send(self, data: bytes, timeout: float) -> None: ...

    def read(self, timeout: float) -> tuple[int, bytes] | None: ...


Entry = list[Any]
"""See `sierra.worker.remote_folder`."""
LONGEST = 1 << 28
"""The greatest size in bytes of the list of a folder that a host may send."""
LOADER = "import json, sys; exec(json.loads(sys.stdin.buffer.readline()))"


def program(way: str, python: str) -> tuple[str, ...]:
    """Return the command that executes the part on the host, whose text is its first line of input."""
    return (python, "-I", "-S", "-c", LOADER, way)  # only the standard library, which starts faster alone


def listed(folder: Path) -> list[Entry]:
    """Return the entries of a local folder, or of one with only a file, if `folder` is a file.

    Raises Missing if there are other things than files, folders and links within.
    """
    try:
        if folder.is_file():
            return [remote_folder.file_entry(os.fsencode(folder), remote_folder.text(os.fsencode(folder.name)))]
        entries, left_out = remote_folder.entries(os.fsencode(folder))
    except OSError as error:
        raise Missing(f"{error.filename!r} cannot be read: {error.strerror}") from error
    if left_out:
        raise Missing(f"{folder}: only files, folders, and links that stay within can be copied, not {_few(left_out)}")
    return entries


def push(
    exchange: Conversation, folder: Path, entries: list[Entry], target: str, timeout: float, progress: Callable[[int], None]
) -> Folder:
    """Send a folder, unless the host has it already."""
    host = _Host(exchange, timeout, f"{exchange.name}: {_shown(target)} cannot be written")
    host.request(target, entries)
    if host.answer().get("state") == "send":
        for data in _contents(folder, entries):
            host.send(data)
            progress(len(data))
        host.answer()
    return _folder(entries)


def pull(exchange: Conversation, folder: str, target: Path, timeout: float, *, started: bool = False) -> Folder:
    """Receive a folder, unless the target has its contents already.

    `started`: the part on the host has its program already, so that the first line is the request.
    """
    host = _Host(exchange, timeout, f"{exchange.name}: {_shown(folder)} cannot be copied", started=started)
    is_there = os.path.lexists(target)
    host.request(folder, "compare" if is_there else "copy")
    answer = host.answer()
    entries = _checked(exchange.name, answer.get("entries"), hashed=is_there)
    left_out = tuple(_shown(str(name)) for name in answer.get("left_out", ()))
    try:
        if is_there:
            _compare(target, entries)
        else:
            with remote_folder.unfinished(os.fsencode(target.absolute())) as unfinished:
                digests = remote_folder.write(unfinished, entries, host.read)
                remote_folder.verify(entries, digests, _digests(host, len(digests)))
                remote_folder.finish(unfinished, os.fsencode(target.absolute()))
            entries = _with_digests(entries, digests)
    except remote_folder.Problem as error:
        raise Missing(f"{exchange.name}: {_shown(folder)}: {error}") from error
    except OSError as error:
        raise Missing(f"{target} cannot be written: {error.strerror}") from error
    return _folder(entries, left_out)


def _compare(target: Path, entries: list[Entry]) -> None:
    """Raise Missing if a target that is there has other contents."""
    if not (target.is_dir() and remote_folder.entries(os.fsencode(target)) == (entries, [])):
        raise Missing(f"{target} is there already, with other contents; remove it or choose another name")


def _digests(host: _Host, count: int) -> list[Any]:
    """Return the hashes of the files that a host has sent. Raises Missing."""
    digests = host.answer().get("digests")
    if not isinstance(digests, list) or len(digests) != count:
        raise Missing(f"{host.failure}: it sends no list of hashes")
    return digests


def _with_digests(entries: list[Entry], digests: list[str]) -> list[Entry]:
    """Return entries with the hashes of their files."""
    left = iter(digests)
    return [[*entry[:2], next(left), *entry[3:]] if entry[0] == "file" else entry for entry in entries]


class _Host:
    """The part on the host, with a limit on its silence."""

    def __init__(self, exchange: Conversation, timeout: float, failure: str, *, started: bool = False) -> None:
        self._exchange, self._timeout, self.failure, self._started = exchange, timeout, failure, started
        self._held, self._errors = b"", b""

    def request(self, *words: object) -> None:
        for line in (*(() if self._started else (Path(remote_folder.__file__).read_text(),)), words):
            self.send(json.dumps(line).encode() + b"\n")

    def send(self, data: bytes) -> None:
        try:
            self._exchange.send(data, self._timeout)
        except TimeoutError:
            raise self._overdue() from None
        except OSError:
            self.answer()  # the reason
            raise Unreachable(f"{self.failure}: the connection ended") from None

    def answer(self) -> dict[str, Any]:
        """Return the next answer. Raises Missing if it is a problem."""
        line = b""
        while not line.strip():
            while b"\n" not in self._held:
                self._receive()
                if len(self._held) > LONGEST:
                    raise Missing(f"{self.failure}: the host sends a list of more than {LONGEST >> 20} MiB")
            line, _, self._held = self._held.partition(b"\n")
        try:
            message = json.loads(line)
        except (ValueError, RecursionError):
            message = None
        if isinstance(message, dict) and "error" in message:
            raise Missing(f"{self.failure}: {_shown(str(message['error']))}")
        if not isinstance(message, dict) or not message.keys() & {"state", "entries"}:
            raise Missing(f"{self.failure}: it sends no answer of the protocol")
        return message

    def read(self, size: int) -> bytes:
        """Return at most this number of bytes of contents; at least one."""
        while not self._held:
            self._receive()
        data, self._held = self._held[:size], self._held[size:]
        return data

    def _receive(self) -> None:
        try:
            piece = self._exchange.read(self._timeout)
        except TimeoutError:
            raise self._overdue() from None
        if piece is None:
            said = self._errors.decode(errors="replace").strip().splitlines()[-1:]
            raise Missing(f"{self.failure}: {said[0] if said else 'Python ended'} (Python 3.8 or newer is needed there)")
        if piece[0] == 1:
            self._held += piece[1]
        else:
            self._errors = (self._errors + piece[1])[-(1 << 14) :]

    def _overdue(self) -> Overdue:
        return Overdue(f"{self.failure}: no progress within {self._timeout:g} s")


def _contents(folder: Path, entries: list[Entry]) -> Iterator[bytes]:
    """Yield the contents of all files, with exactly their sizes. Raises Missing if a file is gone."""
    for entry in entries:
        if entry[0] == "file":
            try:
                yield from remote_folder.contents(os.fsencode(folder) + b"/" + remote_folder.raw(entry[1]), entry[3])
            except OSError as error:
                raise Missing(f"{folder}/{_shown(entry[1])} changed while it was copied: {error.strerror}") from error


def _checked(host: str, entries: Any, *, hashed: bool) -> list[Entry]:
    """Return entries that a host sent, if none leads out of a folder, and files have hashes as expected. Raises Missing."""
    if not isinstance(entries, list):
        raise Missing(f"{host}: sends no list of a folder")
    folders, seen = {""}, set()
    for entry in entries:
        match entry:
            case ["folder", str(path)]:
                folders.add(path)
            case ["file", str(path), digest, int(size), bool()] if size >= 0 and _is_digest(digest, hashed=hashed):
                pass
            case ["link", str(path), str(to)] if remote_folder.stays_within(path, to) and _is_name(to):
                pass
            case _:
                raise Missing(f"{host}: sends {_shown(repr(entry))}, which is no entry of a folder")
        parts = path.split("/")
        if {"", ".", ".."} & set(parts) or not _is_name(path) or path in seen or "/".join(parts[:-1]) not in folders:
            raise Missing(f"{host}: sends the name {_shown(path)!r}, which does not stay within the folder")
        seen.add(path)
    return list(entries)


def _is_name(text: str) -> bool:
    """Return whether a text stands for the bytes of a path."""
    try:
        return b"\0" not in remote_folder.raw(text)
    except UnicodeEncodeError:
        return False


def _is_digest(digest: Any, *, hashed: bool) -> bool:
    return isinstance(digest, str) and bool(re.fullmatch("[0-9a-f]{64}", digest)) if hashed else digest is None


def _folder(entries: list[Entry], left_out: tuple[str, ...] = ()) -> Folder:
    files = {entry[1]: entry[2] for entry in entries if entry[0] == "file"}
    return Folder(files, {entry[1]: entry[2] for entry in entries if entry[0] == "link"}, left_out)


def _shown(name: str) -> str:
    """Return a name on one line."""
    return name if name.isprintable() else ascii(name)[1:-1]


def _few(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(map(_shown, names[:3])) + more
