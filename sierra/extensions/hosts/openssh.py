"""Links by the user's OpenSSH client: for hosts that need what only it can do (ProxyCommand, 2FA, FIDO keys, Kerberos).

One connection to the host is made, by a ControlMaster, and all commands use it. Only this connection may ask the user
something, if there is a terminal. When it is lost, no command makes one of its own: the next command makes a new ControlMaster.
The keys of hosts on the way (ProxyJump) are checked as the user's configuration says.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
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
from sierra.runners.links.base import Interrupted, LinkOptions, Unreachable, UntrustedHost
from sierra.runners.links.commands import PAUSE_S, Commands, Stream, no_session
from sierra.runners.links.process_stream import ProcessStream
from sierra.util import terminal
from sierra.worker.temporary_folders import temporary_folders

PATIENCE = 3
"""The time for a connection without questions to the user, as a multiple of the option `connect`."""
UNTRUSTED = ("host key verification failed", "host key is known for", "remote host identification has changed")
REFUSED = "refused by peer"
"""The words of the client for a session that sshd refuses, because there are too many."""


def folder_of_sockets() -> str | None:
    """Return an existing folder for sockets: the user's, or a temporary folder with a short path; None if there is none."""
    own = os.environ.get("XDG_RUNTIME_DIR", "")
    return own if own and Path(own).is_dir() else next(iter(temporary_folders()), None)


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
        self._interruptions = terminal.interruptions()

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
            stream = ProcessStream([*argv, line], _quiet())
            if stream.has_begun(self._options.connect + self._options.lost):
                return stream
            said = stream.problem()
            stream.close()
            if REFUSED not in said:
                raise Unreachable(f"{self.name}: the connection is lost{f' ({said})' if said else ''}")
            if time.monotonic() > end:
                raise no_session(self.name)
            time.sleep(PAUSE_S)

    def _connect(self) -> None:
        """Make the connection if there is none. Callers that wait for it share its failure."""
        asked = time.monotonic()
        with self._connecting:
            if self._answers():
                return
            if self._own.control_path:
                raise Unreachable(
                    f"{self.name}: no ControlMaster answers at {self._own.control_path}; connect by {self._address.by_hand}"
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
            self._folder = Path(tempfile.mkdtemp(prefix="sierra-", dir=folder_of_sockets()))
        self._socket.unlink(missing_ok=True)
        asks = sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()
        alive = max(1, int(self._options.lost / 4))
        options = {
            "ControlMaster": "yes",
            "ControlPersist": str(self._own.persist),
            "BatchMode": "no" if asks else "yes",
            "StrictHostKeyChecking": "ask" if asks else "yes",
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
            with (
                terminal.reserved(self._interruptions) if asks else contextlib.nullcontext(),
                log.open("wb") as errors,
            ):  # a file, because the ControlMaster keeps it open
                done = subprocess.run(
                    self._argv("-N", "-f", *words),
                    stdin=None if asks else subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=errors,
                    timeout=None if asks else PATIENCE * self._options.connect,
                    check=False,
                    env=_quiet(),
                )
                if done.returncode == -signal.SIGINT:
                    terminal.interrupt()  # before another one may ask: this process may hear of Ctrl-C later than its child
                    raise terminal.Interrupted
        except terminal.Interrupted:
            raise Interrupted(f"{self.name}: the login was interrupted") from None
        except FileNotFoundError:
            raise Missing(
                "the link openssh needs the program ssh; install the OpenSSH client, or use the link fabric"
            ) from None
        except subprocess.TimeoutExpired:
            limit = PATIENCE * self._options.connect
            raise Unreachable(f"{self.name}: no login within {limit:g} s; test it by {self._address.by_hand}") from None
        if done.returncode or not self._answers():
            raise self._refusal(log.read_text(errors="replace"))

    def _refusal(self, said: str) -> SierraError:
        lines = [" ".join(line.split()).rstrip(".") for line in said.splitlines() if line.strip(" \r@")]
        reason = lines[-1] if lines else "no reason given"
        if any(words in said.lower() for words in UNTRUSTED):
            what = next((line for line in lines if re.search("host key (is known )?for", line, re.I)), reason)
            return UntrustedHost(f"{self.name}: {what}; connect once by {self._address.by_hand}, and compare the fingerprint")
        return Unreachable(f"{self.name}: not reachable ({reason}); test it by {self._address.by_hand}")

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
        *options, end, host = self._address.arguments
        return ["ssh", *options, "-S", str(self._socket), *words, end, host]


def _quiet() -> dict[str, str]:
    """Return this process's variables without those that configurations of OpenSSH send to hosts."""
    return {name: value for name, value in os.environ.items() if name != "LANG" and not name.startswith("LC_")}
