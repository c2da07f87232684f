"""The address of a host, as users write it: a name of their OpenSSH configuration, or `user@host:port`."""

from __future__ import annotations

import shlex
from pathlib import Path

from sierra.errors import UsageError
from sierra.util.lazy_definitions import dataclass, regex

NAME = regex(r"([^\s@:-][^\s@:]*@)?[^\s@-][^\s@]*")
PORTS = range(1, 1 << 16)


@dataclass(frozen=True, slots=True)
class Address:
    """A host, and the configuration of OpenSSH that counts."""

    host: str
    """`host` or `user@host`."""
    port: str
    """Empty: that of the configuration."""
    config: str
    """The path of the configuration; empty: that of the user."""

    @property
    def arguments(self) -> list[str]:
        """Return the options and the operand of `ssh` for this host."""
        return [*(["-F", self.config] if self.config else []), *(["-p", self.port] if self.port else []), "--", self.host]

    @property
    def by_hand(self) -> str:
        """Return the command with which a user connects to the host."""
        return shlex.join(["ssh", *(word for word in self.arguments if word != "--")])


def parse(text: str, config: str) -> Address:
    """Return the address of a host. Raises UsageError for what is none, or if the configuration is not a file."""
    host, _, port = text.rpartition(":") if text.count(":") == 1 else (text, "", "")  # several colons are an IPv6 address
    if not NAME.fullmatch(host) or (":" in text and not port and text.count(":") == 1):
        raise UsageError(f"{text!r} is not a host; use a name of your OpenSSH configuration, or user@host:port")
    if port and not (port.isdecimal() and int(port) in PORTS):
        raise UsageError(f"{text!r} has the port {port!r}; use a number from 1 to {PORTS[-1]}")
    if config and not Path(config).expanduser().is_file():
        raise UsageError(
            f"ssh_config of the link is {config}, which is not a file; correct it, or leave it out for ~/.ssh/config"
        )
    return Address(host, port, str(Path(config).expanduser()) if config else "")
