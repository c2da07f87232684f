"""Links by Fabric, a Python library for SSH: for hosts in the same network that accept keys, such as robots.

Fabric's defaults are not safe for experiments. It accepts any host key, also of the hosts on the way; it never notices that a
host has left the network; it waits an hour for a channel; it holds small packets back; and it captures output in quadratic
time. So connections are made by Fabric, which knows the configuration of OpenSSH and the hosts on the way, but keys are
checked here, sockets get limits of their own, and commands use the channels of the connection directly.
"""

from __future__ import annotations

import contextlib
import logging
import re
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from sierra.config.field_types import Table
from sierra.errors import NotInstalled, SierraError
from sierra.runners.links.address import Address
from sierra.runners.links.base import LinkOptions, Unreachable, UntrustedHost
from sierra.runners.links.commands import LEAVE_S, PAUSE_S, Commands, Stream, no_session
from sierra.util.regular_files import read_regular

if TYPE_CHECKING:
    import paramiko

KNOWN_HOSTS = {
    "userknownhostsfile": "~/.ssh/known_hosts ~/.ssh/known_hosts2",
    "globalknownhostsfile": "/etc/ssh/ssh_known_hosts /etc/ssh/ssh_known_hosts2",
}
"""The files with the keys of hosts, by the keys of a configuration of OpenSSH, and their defaults."""


class Fabric(Commands):
    """A host over a connection of Fabric."""

    contract = 1
    Options: ClassVar[type[Table]] = LinkOptions

    def __init__(self, host: str, options: LinkOptions) -> None:
        super().__init__(host, options)
        self._connection: Any = None
        self._connecting = threading.Lock()
        self._failed: tuple[float, SierraError] | None = None

    def _disconnect(self) -> None:
        with self._connecting:
            self._forget()

    def _start(self, line: str) -> Stream:
        import_fabric()
        import paramiko

        transport, again = self._transport(), True
        while True:
            try:
                channel = self._session(transport)
                again = False
                channel.exec_command(line)
                return ChannelStream(self.name, channel, transport)
            except (OSError, EOFError, paramiko.SSHException) as error:
                if transport.is_active() or not again:
                    reason = "it does not answer in time" if transport.is_active() else "the connection is lost"
                    raise Unreachable(f"{self.name}: {reason}") from error
            transport, again = self._transport(), False  # the host has started again; the command has not reached it

    def _session(self, transport: paramiko.Transport) -> paramiko.Channel:
        """Return a new channel. If sshd has no more sessions, try again: those of overdue commands last a little longer."""
        import paramiko

        end = time.monotonic() + self._options.connect
        while True:
            try:
                return transport.open_session(timeout=self._options.connect)
            except paramiko.SSHException as error:  # of refusals at once, some are no ChannelException
                if not transport.is_active() or "Timeout" in str(error):
                    raise
                if time.monotonic() > end:
                    raise no_session(self.name) from error
                time.sleep(PAUSE_S)

    def _transport(self) -> paramiko.Transport:
        """Return the transport of the connection; connect if there is none. Callers that wait for it share its failure."""
        asked = time.monotonic()
        with self._connecting:
            if self._connection is not None and self._connection.is_connected:
                return self._connection.transport
            if self._failed and self._failed[0] > asked:
                raise self._failed[1]
            try:
                return self._connect()
            except SierraError as error:
                self._failed = (time.monotonic(), error)
                self._forget()
                raise

    def _connect(self) -> paramiko.Transport:
        import_fabric()

        self._forget()
        with self._turned_into_ours():
            self._connection = _prepared(self.name, self._address, self._options)
            self._connection.open()
            sock = _on_the_way(self._connection)[-1].transport.sock
            if isinstance(sock, socket.socket):
                _limit_silence(sock, self._options.lost)
            transport: paramiko.Transport = self._connection.transport
            return transport

    def _forget(self) -> None:
        if self._connection is not None:
            for one in _on_the_way(self._connection):
                with contextlib.suppress(Exception):
                    one.client.close()
            self._connection = None

    @contextlib.contextmanager
    def _turned_into_ours(self) -> Iterator[None]:
        import_fabric()
        import paramiko

        try:
            yield
        except paramiko.BadHostKeyException as error:
            raise UntrustedHost(
                f"{self.name}: its host key differs from the one that is known for {error.hostname}; if the host was installed "
                f"again, remove the old key (ssh-keygen -R {error.hostname}) and connect once by {self._address.by_hand}"
            ) from error
        except paramiko.BadAuthenticationType as error:
            raise Unreachable(
                f"{self.name}: it accepts logins by {' or '.join(error.allowed_types)} only, and not by a key; "
                f"install a key there (ssh-copy-id {self._address.by_hand.removeprefix('ssh ')}), or use the link openssh"
            ) from error
        except paramiko.PasswordRequiredException as error:
            raise Unreachable(f"{self.name}: the key needs a passphrase; load it into an agent (ssh-add)") from error
        except (paramiko.AuthenticationException, paramiko.ssh_exception.IncompatiblePeer) as error:
            reason = " ".join(str(error).split()).rstrip(".")
            raise Unreachable(f"{self.name}: it refuses the login ({reason}); test it by {self._address.by_hand}") from error
        except (OSError, EOFError, paramiko.SSHException, ValueError) as error:
            if "No authentication methods" in str(error):
                raise Unreachable(
                    f"{self.name}: there is no key for the login; make one (ssh-keygen) or load it (ssh-add)"
                ) from error
            said = re.sub(r"^\[Errno \S+\] ", "", " ".join(str(error).split())).rstrip(".")
            reason = said or type(error).__name__
            raise Unreachable(f"{self.name}: not reachable ({reason}); test it by {self._address.by_hand}") from error


class ChannelStream:
    """The Stream of a channel of paramiko."""

    def __init__(self, name: str, channel: paramiko.Channel, transport: paramiko.Transport) -> None:
        self._name, self._channel, self._transport = name, channel, transport
        self._news = threading.Event()
        channel.in_buffer.set_event(self._news)
        channel.in_stderr_buffer.set_event(self._news)

    def send(self, data: bytes, timeout: float) -> None:
        view = memoryview(data)
        self._channel.settimeout(timeout)
        while view:
            try:
                view = view[self._channel.send(view[: 1 << 18]) :]
            except TimeoutError:
                raise
            except (OSError, EOFError) as error:
                self._check(error)
                raise BrokenPipeError from error

    def end_input(self) -> None:
        with contextlib.suppress(EOFError):  # the connection is lost; `read` reports it
            self._channel.shutdown_write()

    def read(self, timeout: float) -> tuple[int, bytes] | None:
        channel, end = self._channel, time.monotonic() + timeout
        while True:
            if channel.recv_ready():
                return 1, channel.recv(1 << 18)
            if channel.recv_stderr_ready():
                return 2, channel.recv_stderr(1 << 18)
            if channel.eof_received or channel.closed:
                if channel.recv_ready() or channel.recv_stderr_ready():
                    continue
                self._check(None)
                return None
            if not self._news.wait(max(0.0, end - time.monotonic())):
                self._check(None)
                raise TimeoutError

    def close(self, *, ended: bool = False) -> None:
        if ended:
            self._channel.status_event.wait(LEAVE_S)  # then sshd has room for another session
        with contextlib.suppress(EOFError):
            self._channel.close()

    def problem(self) -> str:
        return ""

    def _check(self, error: BaseException | None) -> None:
        if not self._transport.is_active():
            raise Unreachable(f"{self._name}: the connection is lost") from error


def import_fabric() -> Any:
    """Return the module of Fabric. Raises NotInstalled."""
    try:
        import fabric
    except ModuleNotFoundError as error:
        raise NotInstalled("links to hosts need Fabric; pip install 'sierra-experiments[robots]'") from error
    logging.getLogger("paramiko").addHandler(logging.NullHandler())  # every loss of a connection would be printed
    return fabric


def _prepared(host: str, address: Address, options: LinkOptions) -> Any:
    """Return a connection that is not open yet, and checks the keys of all hosts on the way."""
    fabric = import_fabric()
    limits = {f"{name}_timeout": options.connect for name in ("banner", "auth", "channel")}
    config = fabric.Config(
        system_prefix="/nonexistent/",  # no configuration files of Fabric
        user_prefix="/nonexistent/",
        runtime_ssh_path=address.config or None,
        overrides={"connect_kwargs": limits, "timeouts": {"connect": options.connect}},
    )
    connection = fabric.Connection(host, config=config)
    way = connection.ssh_config.get("proxyjump", "none")
    if way.lower() != "none":
        connection.gateway = None
        for hop in way.split(","):  # OpenSSH passes them in this order, Fabric in the opposite one
            connection.gateway = fabric.Connection(hop.strip(), config=config.clone(), gateway=connection.gateway)
    for connected in _on_the_way(connection):
        if isinstance(connected.gateway, str):
            raise Unreachable(f"{host}: its ProxyCommand needs the OpenSSH client; use the link openssh")
        _check_host_keys(host, address, connected)
    return connection


def _on_the_way(connection: Any) -> list[Any]:
    """Return a connection, and those that it passes through, the first of them last."""
    found = [connection]
    while hasattr(found[-1].gateway, "client"):
        found.append(found[-1].gateway)
    return found


def _check_host_keys(name: str, way: Address, connection: Any) -> None:
    """Load the known keys of a host, as OpenSSH does, and refuse all others."""
    if connection.ssh_config.get("revokedhostkeys", "none").lower() != "none":
        raise UntrustedHost(f"{name}: only the OpenSSH client reads the file of RevokedHostKeys; use the link openssh")
    files = [
        Path(file).expanduser()
        for key, default in KNOWN_HOSTS.items()
        for file in connection.ssh_config.get(key, default).split()
        if file.lower() != "none"
    ]
    client, (known, revoked) = connection.client, _known_keys(file for file in files if file.is_file())
    alias = connection.ssh_config.get("hostkeyalias")
    address = connection.host if connection.port == 22 else f"[{connection.host}]:{connection.port}"
    for kind, key in (known.lookup(alias or address) or {}).items():
        client.get_host_keys().add(address, kind, key)

    class Refuse:
        def missing_host_key(self, client: object, hostname: str, key: paramiko.PKey) -> None:
            on = "" if name in (hostname, connection.original_host) else f" on the way to {name}"
            which = f"{name}: the host key of {hostname}{on} is"
            if key.get_base64() in revoked:
                raise UntrustedHost(f"{which} revoked in your known_hosts ({key.get_name()} {key.fingerprint})")
            raise UntrustedHost(
                f"{which} not known ({key.get_name()} {key.fingerprint}); "
                f"connect once by {way.by_hand}, and compare the fingerprint"
            )

    client.set_missing_host_key_policy(Refuse())


def _known_keys(files: Iterable[Path]) -> tuple[paramiko.HostKeys, set[str]]:
    """Return the keys of hosts in some files without revoked ones, and those that are revoked, for whatever host.

    paramiko itself takes marks (`@revoked`, `@cert-authority`) for names. It ends with an error at lines that OpenSSH ignores.
    """
    import paramiko

    lines = [line.strip() for file in files for line in read_regular(file).decode(errors="replace").splitlines()]
    revoked = {key for line in lines if line.startswith("@revoked") for key in line.split()[3:4]}
    known = paramiko.HostKeys()
    for line in lines:
        if line and not line.startswith(("#", "@")):
            with contextlib.suppress(paramiko.SSHException, paramiko.hostkeys.InvalidHostKey):
                entry = paramiko.hostkeys.HostKeyEntry.from_line(line)
                for host in entry.hostnames or () if entry and entry.key.get_base64() not in revoked else ():
                    known.add(host, entry.key.get_name(), entry.key)
    return known, revoked


def _limit_silence(sock: socket.socket, lost: float) -> None:
    """Let the kernel end a connection without answers after about `lost` seconds, and send small packets at once."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    part = max(1, int(lost / 4))
    for option, value in (
        (socket.TCP_KEEPIDLE, part),
        (socket.TCP_KEEPINTVL, part),
        (socket.TCP_KEEPCNT, 3),
        (socket.TCP_USER_TIMEOUT, int(lost * 1000)),
    ):
        sock.setsockopt(socket.IPPROTO_TCP, option, value)
