"""The Link contract: one host over SSH, on which programs are started, and with which folders are exchanged.

SIERRA ships `fabric` and `openssh`. Others are entry points of the group `sierra.links` (see `sierra.plugin`).
`sierra.testing.links` has the conformance suite. `sierra.runners.links.commands` has all but the connection; a back end that
starts command lines inherits from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Protocol

from pydantic import Field

from sierra.config.field_types import Table
from sierra.errors import Missing
from sierra.util.lazy_definitions import dataclass, field


class Unreachable(Missing):
    """A host that does not answer, or refuses the login. A command may have been executed, in part or not at all."""


class Interrupted(Unreachable):
    """A login that the user has interrupted, or that would have asked something after Ctrl-C."""

    exit_code = 130


class UntrustedHost(Missing):
    """A host whose key is unknown, or differs from the known one. Nothing was sent to it."""


class Overdue(Missing):
    """A command that did not end in time."""


class NoSession(Overdue):
    """A command that was not executed, because the host, or the link, had no session for it in time."""


class LinkOptions(Table):
    """The options of all links that SIERRA ships."""

    ssh_config: str = Field("", description="configuration file of OpenSSH to use instead of ~/.ssh/config; ~ is your home")
    connect: float = Field(5.0, gt=0, le=600, description="time within which a host must accept a connection, in seconds")
    lost: float = Field(8.0, ge=2, le=600, description="time without an answer until a connection counts as lost, in seconds")
    sessions: int = Field(8, ge=1, description="most commands at once on a host; sshd accepts 10 by default (MaxSessions)")


@dataclass(frozen=True, slots=True)
class Ended:
    """A command that ended on a host."""

    status: int
    """The exit status; as in a shell, 128 and the signal if one ended the command, and 127 if there is no such program."""
    stdout: bytes
    """The beginning of the output, at most `LIMIT` bytes."""
    stderr: bytes


LIMIT = 1 << 20
"""The limit on the bytes of a command's output that are kept. The rest is read and dropped."""


@dataclass(frozen=True, slots=True)
class Folder:
    """The contents of a folder. All names are relative to it, with `/` between the parts."""

    files: Mapping[str, str]
    """The SHA-256 of each file."""
    links: Mapping[str, str] = field(default_factory=dict)
    """The targets of symbolic links that stay within the folder."""
    left_out: tuple[str, ...] = ()
    """The names of whatever was not copied: links that lead outside, sockets, devices."""


class Channel(Protocol):
    """A command that is executing on a host, for an exchange of lines. It occupies one of the link's sessions.

    The command's input ends with `close`, and with this process. It may last long after the loss of the network, because sshd
    notices that late or never: the command needs a time limit of its own for silence.
    """

    def send(self, line: str) -> None:
        """Send a line. Raises Unreachable, also if the command has ended."""

    def receive(self, timeout: float) -> str | None:
        """Return the next line without its line feed; None at the end. Raises Overdue after `timeout` s, and Unreachable."""

    def status(self) -> int | None:
        """Return the exit status after `receive` returned None; None before that."""

    def errors(self) -> str:
        """Return the beginning of what the command wrote to standard error, as far as it has arrived with `receive`."""

    def close(self) -> None:
        """Close the command's input and forget the command: what it writes from then on is lost. It may be called again."""


class Link(Protocol):
    """One host. All methods may be called from several threads at once, and connect if there is no connection.

    Each of them raises Unreachable within the time of the options if the host does not answer. A host's key is always
    checked, also those of the hosts that a connection passes (ProxyJump): UntrustedHost. Arguments reach the command as they
    are, whatever the login shell is. What a login shell prints is dropped.
    """

    name: str
    """The name by which the user knows the host."""
    python: str
    """The command for Python 3.8 or newer there, by which folders are copied: `python3`, unless another one is set."""
    Options: ClassVar[type[Table]]
    """The model of `[links.NAME]`."""

    def __init__(self, host: str, options: Table) -> None:
        """Make a link. `host` is a name of the user's OpenSSH configuration, or `user@host:port`. Nothing is sent yet."""

    def run(self, argv: Sequence[str], *, stdin: bytes = b"", timeout: float = 30.0) -> Ended:
        """Execute a command, and return its end. Raises Overdue after `timeout` seconds.

        The host ends an overdue command, also without a connection. Processes that it started in sessions of their own
        (`setsid`) go on, and so does what it started in the background: such a command ends here as soon as it ends there.
        """

    def channel(self, argv: Sequence[str]) -> Channel:
        """Start a command with which lines are exchanged."""

    def push(
        self, folder: Path, target: str, *, timeout: float = 60.0, progress: Callable[[int], None] = lambda size: None
    ) -> Folder:
        """Copy a local folder to a host; return its contents. `target` is absolute, or relative to the home folder there.

        If `folder` is a file, the target is a folder with only this file. `progress` gets the size of each part in bytes after
        it was sent.

        The target appears whole or not at all, and is verified by the hashes of its files. If it is there already with the same
        contents, nothing is copied. Executable files stay executable, and empty folders and links within the folder are kept.
        Raises Missing if the disk is full or not writable, if `target` has other contents, or if `folder` has other things than
        files, folders and links that stay within. Raises Overdue after `timeout` seconds without progress.
        """

    def pull(self, folder: str, target: Path, *, timeout: float = 60.0) -> Folder:
        """Copy a folder of a host to a local one; return its contents, with what could not be copied.

        As with `push`, the target appears whole or not at all and is verified, and may be there with the same contents. Nothing
        is written outside the target, whatever the host sends. Raises Missing if the folder is not there, or if the disk is
        full, or if a file changed while it was copied; Overdue after `timeout` seconds without progress.
        """

    def close(self) -> None:
        """End the connection and all channels. It may be called again; the next call of another method connects again."""
