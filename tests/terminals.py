"""Programs in a terminal of their own, for tests: what they show is waited for, and keys are typed."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import select
import signal
import subprocess
import termios
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from tests.waiting import PATIENCE_S


class Terminal:
    """A program that has a terminal; leaving the context kills it if it still runs."""

    def __init__(self, folder: Path, *argv: str, environment: Mapping[str, str] | None = None) -> None:
        self._master, slave = pty.openpty()
        self.process = subprocess.Popen(
            argv,
            cwd=folder,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # Ctrl-C needs it
            env={**os.environ, "TERM": "xterm", "COLUMNS": "120", "PYTHONUTF8": "1", **(environment or {})},
        )
        os.close(slave)
        self.shown = ""
        """Everything that was shown."""
        self._seen = 0

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self._master)

    def expect(self, text: str) -> str:
        """Wait until a text is shown that was not waited for before; return everything up to it."""
        give_up = time.monotonic() + PATIENCE_S
        while (at := self.shown.find(text, self._seen)) < 0:
            assert time.monotonic() < give_up, f"{text!r} is not shown, but {self.shown[self._seen :]!r}"
            assert self._read(), f"ended without showing {text!r}, but {self.shown[self._seen :]!r}"
        found = self.shown[self._seen : at + len(text)]
        self._seen = at + len(text)
        return found

    def type(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def answer(self, prompt: str, keys: str = "") -> str:
        """Wait for a prompt, and answer it with a line; return everything up to the prompt."""
        found = self.expect(prompt)
        self.type(f"{keys}\n")
        return found

    def hang_up(self) -> None:
        """Close the terminal, as the end of a connection does."""
        os.kill(self.process.pid, signal.SIGHUP)

    def mode(self) -> int:
        """Return the local modes of the terminal."""
        modes: int = termios.tcgetattr(self._master)[3]
        return modes

    def end(self) -> int:
        """Wait for the program to end; return its exit status."""
        while self._read():
            pass
        return self.process.wait(PATIENCE_S)

    def _read(self) -> bool:
        """Read what is shown; return False at the end."""
        if not select.select([self._master], [], [], PATIENCE_S)[0]:
            return False
        more = b""
        with contextlib.suppress(OSError):  # its last process has ended
            more = os.read(self._master, 65536)
        self.shown += more.decode("utf-8", "replace")
        return bool(more)
