"""The Link contract: one host over SSH, on which programs are started, and with which folders are exchanged.

SIERRA ships `fabric` and `openssh`. Others are entry points of the group `sierra.links` (see `sierra.plugin`).
`sierra.testing.links` has the conformance suite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

from sierra.config.field_types import Table
from sierra.errors import Missing

Folder = Mapping[str, str]
"""The SHA-256 of each file in a folder, by its path relative to that folder, with `/` between the parts."""


class Unreachable(Missing):
    """A host that does not answer, or refuses the login. The command may have been executed or not."""


class UntrustedHost(Missing):
    """A host whose key is unknown, or differs from the known one. Nothing was sent to it."""


class Overdue(Missing):
    """A command that did not end in time. It may still execute on the host."""


@dataclass(frozen=True, slots=True)
class Ended:
    """A command that ended on a host."""

    status: int
    """The exit status; as in a shell, 128 and the signal if one ended the command."""
    stdout: bytes
    """The beginning of the output, at most `LIMIT` bytes."""
    stderr: bytes


LIMIT = 1 << 20
"""The limit on the bytes of a command's output that are kept. The rest is read and dropped."""


class Channel(Protocol):
    """A command that is executing on a host, for an exchange of lines. If the link is lost, the command's input ends."""

    def send(self, line: str) -> None:
        """Send a line. Raises Unreachable."""

    def receive(self, timeout: float) -> str | None:
        """Return the next line without its line feed; None at the end. Raises Overdue after `timeout` s, and Unreachable."""

    def close(self) -> None:
        """Close the command's input and forget the command. It may be called again."""


class Link(Protocol):
    """One host. All methods may be called from several threads at once, and connect if there is no connection.

    Each of them raises Unreachable within `timeout` seconds, or within those of the options, if the host does not answer. A
    host's key is always checked: UntrustedHost. Arguments reach the host as they are, because the link quotes them.
    """

    name: str
    """The name by which the user knows the host."""
    Options: ClassVar[type[Table]]
    """The model of `[links.NAME]`."""

    def __init__(self, host: str, options: Table) -> None:
        """Make a link. `host` is a name of the user's OpenSSH configuration, or `user@host:port`. Nothing is sent yet."""

    def run(self, argv: Sequence[str], *, stdin: bytes = b"", timeout: float = 30.0) -> Ended:
        """Execute a command, and return its end. Raises Overdue."""

    def channel(self, argv: Sequence[str]) -> Channel:
        """Start a command with which lines are exchanged."""

    def push(self, folder: Path, target: str) -> Folder:
        """Copy a local folder to a host; return its files. `target` is absolute, or relative to the home folder there.

        The target appears whole or not at all, and is verified by the hashes of its files. If it is there already with the same
        files, nothing is copied. Raises Missing if the disk is full or not writable, or if `target` has other files.
        """

    def pull(self, folder: str, target: Path) -> Folder:
        """Copy a folder of a host to a new local one; return its files.

        The target appears whole or not at all, and is verified. Only regular files and folders are copied, and nothing is
        written outside the target, whatever the host sends. Raises Missing if the folder is not there, or if the disk is full.
        """

    def close(self) -> None:
        """End the connection. It may be called again; the next call of another method connects again."""
