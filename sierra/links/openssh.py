"""Links by the user's OpenSSH client: for hosts that need what only it can do (ProxyCommand, 2FA, FIDO keys, Kerberos).

One connection to the host is made, by a ControlMaster, and all commands use it. Only this connection may ask the user
something, if there is a terminal. When it is lost, no command makes one of its own: the next command makes a new ControlMaster.
The keys of hosts on the way (ProxyJump) are checked as the user's configuration says.
"""

from __future__ import annotations

import contextlib
import os
import re
import selectors
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from sierra.config.field_types import Table
from sierra.errors import Missing, SierraError
from sierra.links.base import LinkOptions, Unreachable, UntrustedHost
from sierra.links.commands import LEAVE_S, PAUSE_S, Commands, Stream, too_many_sessions

PATIENCE = 3
"""The time for a connection without questions to the user, as a multiple of the option `connect`."""
UNTRUSTED = ("host key verification failed", "host key is known for", "remote host identification has changed")
REFUSED = "refused by peer"
"""The words of the client for a session that sshd refuses, because there are too many."""


class OpenSshOptions(LinkOptions):
    """The options of `openssh`."""

    persist: int = Field(60, ge=1, description="time for which the connection outlives a killed sierra, in seconds")
    control_path: str = Field("", description="socket of a ControlMaster connection that you opened; default: one of its own")


class OpenSsh(Commands):
    """A host over one ControlMaster connection of the OpenSSH client."""

    contract = 1
    Options: ClassVar[type[Table]] = OpenSshOptions

    def __init__(self, host: str, options: OpenSshOptions) -> None:
        super().__init__(host, options)
        self._own = options
        self._folder: Path | None = None
        self._connecting = threading.Lock()
        self._failed: tuple[float, SierraError] | None = None

    def _disconnect(self) -> None:
        with self._connecting:
            if self._folder is not None:
                with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                    ask = self._argv("-O", "exit")
                    subprocess.run(ask, stdin=subprocess.DEVNULL, capture_output=True, timeout=5, check=False, env=_quiet())
                shutil.rmtree(self._folder, ignore_errors=True)
                self._folder = None

    def _start(self, line: str) -> Stream:
        self._connect()
        # without its ControlMaster, the client would make a connection of its own, with this ProxyCommand
        argv = self._argv("-T", "-o", "ControlMaster=no", "-o", "BatchMode=yes", "-o", "ProxyCommand=false")
        end = time.monotonic() + self._options.connect
        while True:
            stream = ClientStream(self.name, [*argv, line])
            if stream.has_begun(self._options.connect + self._options.lost):
                return stream
            said = stream.problem()
            stream.close()
            if REFUSED not in said:
                raise Unreachable(f"{self.name}: the connection is lost{f' ({said})' if said else ''}")
            if time.monotonic() > end:
                raise Unreachable(too_many_sessions(self.name))
            time.sleep(PAUSE_S)

    def _connect(self) -> None:
        """Make the connection if there is none. Callers that wait for it share its failure."""
        asked = time.monotonic()
        with self._connecting:
            if self._answers():
                return
            if self._own.control_path:
                raise Unreachable(
                    f"{self.name}: no ControlMaster answers at {self._own.control_path}; connect by ssh {self.name}"
                )
            if self._failed and self._failed[0] > asked:
                raise self._failed[1]
            try:
                self._log_in()
            except SierraError as error:
                self._failed = (time.monotonic(), error)
                raise

    def _log_in(self) -> None:
        if self._folder is None:
            # short, because the path of a socket has at most 104 characters; private, as all that mkdtemp makes
            self._folder = Path(tempfile.mkdtemp(prefix="sierra-", dir=os.environ.get("XDG_RUNTIME_DIR") or None))
        self._socket.unlink(missing_ok=True)
        terminal = sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()
        alive = max(1, int(self._options.lost / 4))
        options = {
            "ControlMaster": "yes",
            "ControlPersist": str(self._own.persist),
            "BatchMode": "no" if terminal else "yes",
            "StrictHostKeyChecking": "ask" if terminal else "yes",
            "ConnectTimeout": str(max(1, int(self._options.connect))),
            "ServerAliveInterval": str(alive),
            "ServerAliveCountMax": "3",
            "ForwardAgent": "no",
            "ForwardX11": "no",
            "PermitLocalCommand": "no",
            "ExitOnForwardFailure": "no",
        }
        words = [word for key, value in options.items() for word in ("-o", f"{key}={value}")]
        log = self._folder / "log"
        try:
            with log.open("wb") as errors:  # a file, because the ControlMaster keeps it open
                done = subprocess.run(
                    self._argv("-N", "-f", *words),
                    stdin=None if terminal else subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=errors,
                    timeout=None if terminal else PATIENCE * self._options.connect,
                    check=False,
                    env=_quiet(),
                )
        except FileNotFoundError:
            raise Missing(
                "the link openssh needs the program ssh; install the OpenSSH client, or use the link fabric"
            ) from None
        except subprocess.TimeoutExpired:
            limit = PATIENCE * self._options.connect
            raise Unreachable(f"{self.name}: no login within {limit:g} s; test it by ssh {self.name}") from None
        if done.returncode or not self._answers():
            raise self._refusal(log.read_text(errors="replace"))

    def _refusal(self, said: str) -> SierraError:
        lines = [" ".join(line.split()).rstrip(".") for line in said.splitlines() if line.strip(" \r@")]
        reason = lines[-1] if lines else "no reason given"
        if any(words in said.lower() for words in UNTRUSTED):
            what = next((line for line in lines if re.search("host key (is known )?for", line, re.I)), reason)
            return UntrustedHost(f"{self.name}: {what}; connect once by ssh {self.name}, and compare the fingerprint")
        return Unreachable(f"{self.name}: not reachable ({reason}); test it by ssh {self.name}")

    @property
    def _socket(self) -> Path:
        if self._own.control_path:
            return Path(self._own.control_path).expanduser()
        return (self._folder or Path("/nonexistent")) / "s"

    def _answers(self) -> bool:
        try:
            with socket.socket(socket.AF_UNIX) as connection:
                connection.connect(str(self._socket))
        except OSError:
            return False
        return True

    def _argv(self, *words: str) -> list[str]:
        file = ["-F", str(Path(self._options.ssh_config).expanduser())] if self._options.ssh_config else []
        user_host, _, port = self.name.rpartition(":")
        if not user_host or not port.isdecimal() or user_host.count(":"):
            user_host, port = self.name, ""
        return ["ssh", *file, "-S", str(self._socket), *words, *(["-p", port] if port else []), "--", user_host]


class ClientStream:
    """The Stream of a client that uses the connection of a ControlMaster."""

    def __init__(self, name: str, argv: list[str]) -> None:
        self._name = name
        self._process = subprocess.Popen(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True, env=_quiet()
        )
        assert self._process.stdin and self._process.stdout and self._process.stderr  # noqa: PT018, S101 - all are pipes
        self._input, self._outputs = self._process.stdin, {1: self._process.stdout, 2: self._process.stderr}
        os.set_blocking(self._input.fileno(), False)
        self._open = selectors.DefaultSelector()
        for number, pipe in self._outputs.items():
            self._open.register(pipe, selectors.EVENT_READ, number)
        self._first: list[tuple[int, bytes]] = []
        self._lock = threading.Lock()

    def has_begun(self, timeout: float) -> bool:
        """Wait for standard output; return whether there is some. What comes is kept for `read`."""
        end = time.monotonic() + timeout
        with contextlib.suppress(TimeoutError):
            while found := self._read(max(0.0, end - time.monotonic())):
                self._first.append(found)
                if found[0] == 1:
                    return True
        return False

    def send(self, data: bytes, timeout: float) -> None:
        view = memoryview(data)
        with selectors.DefaultSelector() as writable:
            writable.register(self._input, selectors.EVENT_WRITE)
            while view:
                if not writable.select(timeout):
                    raise TimeoutError
                view = view[os.write(self._input.fileno(), view[: 1 << 16]) :]

    def end_input(self) -> None:
        with self._lock:
            self._input.close()

    def read(self, timeout: float) -> tuple[int, bytes] | None:
        return self._first.pop(0) if self._first else self._read(timeout)

    def _read(self, timeout: float) -> tuple[int, bytes] | None:
        while self._open.get_map():
            ready = self._open.select(timeout)
            if not ready:
                raise TimeoutError
            for key, _ in ready:
                data = os.read(key.fd, 1 << 18)
                if data:
                    return key.data, data
                self._open.unregister(key.fileobj)
        return None

    def close(self, *, ended: bool = False) -> None:
        try:
            self._process.wait(LEAVE_S if ended else 0)  # then sshd has room for another session
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with contextlib.suppress(OSError):
            self.end_input()
        self._open.close()
        for pipe in self._outputs.values():
            pipe.close()

    def problem(self) -> str:
        said = b"".join(data for number, data in self._first if number == 2).decode(errors="replace")
        return next((" ".join(line.split()).rstrip(".") for line in said.splitlines() if line.strip()), "")


def _quiet() -> dict[str, str]:
    """Return this process's variables without those that configurations of OpenSSH send to hosts."""
    return {name: value for name, value in os.environ.items() if name != "LANG" and not name.startswith("LC_")}
