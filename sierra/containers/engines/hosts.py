"""The hosts on which engines start containers: this one, and others over a link."""

from __future__ import annotations

import json
import os
import posixpath
import re
import subprocess
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

from sierra.errors import Missing
from sierra.store.layout import user_apptainer
from sierra.util.lazy_definitions import dataclass
from sierra.util.lazy_logger import Log
from sierra.worker import on_host

log = Log(__name__)
LOADER = "import json, sys; exec(json.loads(sys.stdin.buffer.readline()))"
Notice = Callable[[str], None]
SPARE_S = 60.0
"""The seconds that a link may take in addition to a function that executes on a host."""
SLOWEST = 5_000_000
"""The bytes per second at which each host can hash and unpack files."""


@dataclass(frozen=True, slots=True)
class Facts:
    """The facts about a host and the user there on which the start of a container depends."""

    user: int
    machine: str
    """The processor's architecture, in the kernel's terms."""
    environment: Mapping[str, str]
    home: str
    """The folder in which commands start over a link."""
    boot: str
    most: Mapping[str, int | None]
    """The greatest limits that the user may set, by the names of the kernel: NOFILE, NPROC."""
    systemd: bool
    unified: bool
    """True if the host has control groups of version 2."""
    mounts: Mapping[str, str]
    """The mounts with which the host's shell works in a container: host paths by their path inside."""


class Host(Protocol):
    """A host on which an engine starts containers."""

    name: str
    """The name by which the user knows it; empty for this one."""

    def __hash__(self) -> int: ...

    @property
    def facts(self) -> Facts: ...

    @property
    def variables(self) -> Mapping[str, str]:
        """Return the environment of commands there."""
        ...

    @property
    def folder(self) -> str:
        """Return the folder for the engine's own files."""
        ...

    def call(self, function: str, *values: Any, timeout: float = SPARE_S) -> Any:
        """Execute a function of `on_host` there, and return its value. Raises OSError, or Missing of another host."""


class ThisHost:
    """The host of this process."""

    name = ""

    @property
    def facts(self) -> Facts:
        return Facts(**on_host.facts())

    @property
    def variables(self) -> Mapping[str, str]:
        return os.environ

    @property
    def folder(self) -> str:
        return str(user_apptainer())

    def call(self, function: str, *values: Any, timeout: float = SPARE_S) -> Any:
        return getattr(on_host, function)(*values)


HERE = ThisHost()


class Link(Protocol):
    """The part of a link to a host that engines need: see `sierra.runners.links.base`."""

    def run(self, argv: Sequence[str], *, stdin: bytes, timeout: float) -> Any:
        """Execute a command; return its `status`, `stdout` and `stderr`."""

    def push(self, folder: Path, target: str, *, timeout: float, progress: Callable[[int], None]) -> object: ...


class OtherHost:
    """Another host. It needs Python 3.8 or newer."""

    def __init__(self, name: str, link: Link, root: str, python: str = "python3") -> None:
        """`root` is the folder there for everything that this class writes: absolute, or within the home folder."""
        self.name = name
        self._link, self._root, self._python = link, root, python
        self.known: dict[str, Any] = {}
        """The abilities of engines there, by the engine's name."""

    @cached_property
    def facts(self) -> Facts:
        return Facts(**self.call("facts"))

    @property
    def variables(self) -> Mapping[str, str]:
        return self.facts.environment

    @cached_property
    def root(self) -> str:
        return posixpath.join(self.facts.home, self._root)

    @property
    def folder(self) -> str:
        return f"{self.root}/engines"

    def call(self, function: str, *values: Any, timeout: float = SPARE_S) -> Any:
        lines = (Path(on_host.__file__).read_text("utf-8"), (function, *values))
        request = b"".join(json.dumps(line).encode() + b"\n" for line in lines)
        done = self._link.run((self._python, "-I", "-S", "-c", LOADER), stdin=request, timeout=timeout + SPARE_S)
        try:
            answer = json.loads(done.stdout)
            failed, value = answer.get("error"), answer.get("value")
        except (ValueError, AttributeError):
            said = (done.stderr.decode(errors="replace").strip().splitlines() or [f"status {done.status}"])[-1]
            raise Missing(f"{self.name}: {self._python} cannot examine its containers: {said}") from None
        if failed is not None:
            raise Missing(f"{self.name}: {failed}")
        return value

    def place(self, file: Path, sha256: str, kind: str, notice: Notice) -> Placed:
        """Copy a file to `root`/`kind`/SHA256 there, unless it is there. Return its path and state after a check of its hash.

        `notice` gets messages for the user. Raises Missing, Unreachable, Overdue.
        """
        folder = f"{self.root}/{kind}/{sha256}"
        path, size = f"{folder}/{file.name}", file.stat().st_size
        hashing = size / SLOWEST
        for _ in range(2):
            hashed = self.call("hashed", path, timeout=hashing)
            if hashed and hashed[0] == sha256:
                return Placed(path, tuple(hashed[1:]))
            if hashed:
                notice(f"{self.name}: {path} was damaged, and is copied again")
            self.call("remove", folder)
            progress = _Progress(f"{self.name}: copying the image", size, notice)
            self._link.push(file, folder, timeout=SPARE_S + hashing, progress=progress)
        raise Missing(f"{self.name}: {path} has other contents than {file} after it was copied; check its disk")


@dataclass(frozen=True, slots=True)
class Placed:
    """A verified file on a host."""

    path: str
    state: tuple[int, ...]
    """The kernel's data about it when it was verified."""


class _Progress:
    """Messages about a copy, one for each quarter of a large one."""

    LARGE = 50_000_000
    PARTS = 4

    def __init__(self, words: str, size: int, notice: Notice) -> None:
        self._words, self._size, self._notice = words, size, notice
        self._sent = self._part = 0
        if size >= self.LARGE:
            notice(f"{words} ({size / 1e6:.0f} MB)")

    def __call__(self, sent: int) -> None:
        self._sent += sent
        part = self.PARTS * self._sent // self._size if self._size else 0
        if self._size >= self.LARGE and self._part < part < self.PARTS:
            self._part = part
            self._notice(f"{self._words}: {self._sent / 1e6:.0f} of {self._size / 1e6:.0f} MB")


def handed_on(host: Host, pattern: re.Pattern[str]) -> dict[str, str]:
    """Return the variables of the user's environment on a host whose names match."""
    return {name: value for name, value in host.variables.items() if pattern.fullmatch(name)}


def run(
    host: Host, command: Sequence[str], environment: Mapping[str, str] | None = None, timeout: float | None = 20.0
) -> subprocess.CompletedProcess[str]:
    """Run a command on a host to its end, or until the timeout, which counts as a failure."""
    done = host.call("run", tuple(command), environment, timeout, timeout=timeout or SPARE_S)
    return completed(command, done)


def completed(command: Sequence[str], done: Sequence[Any]) -> subprocess.CompletedProcess[str]:
    """Return an answer of `on_host.run`."""
    status, stdout, stderr = done
    log.command(command, status or 0, stderr)
    return subprocess.CompletedProcess(command, 1 if status is None else status, stdout, stderr)
