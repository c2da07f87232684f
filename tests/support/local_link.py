"""A link to robots that are folders of this machine: a double for tests without SSH."""

from __future__ import annotations

import contextlib
import os
import secrets
import select
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from sierra.config.field_types import Table
from sierra.errors import Missing
from sierra.runners.links.base import Ended, LinkOptions, Overdue, Unreachable
from sierra.runners.links.commands import Commands, Lines
from sierra.runners.links.process_stream import ProcessStream
from sierra.worker.processes import descendants, signal_process

LOCK = "sierra-robot"
"""The lock of a robot, as `sierra.extensions.robots.agent_link` names it: tests of the core do without that extension."""


def _content(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder, or of one with only this file, by path."""
    files = [folder] if folder.is_file() else [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder.parent if folder.is_file() else folder)): path.read_bytes() for path in files}


class LocalChannel:
    """A program on this machine."""

    def __init__(self, argv: Sequence[str], home: Path, variables: Mapping[str, str]) -> None:
        self.process = subprocess.Popen(
            argv,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=home,
            env={"PATH": os.environ["PATH"], "HOME": str(home), "USER": "robot", **variables},
            bufsize=0,
            start_new_session=True,
        )
        self.stalled = False
        self._unread = b""
        self._reading = self._closed = False

    def send(self, line: str) -> None:
        while self.stalled:
            time.sleep(0.01)
        assert self.process.stdin
        try:
            self.process.stdin.write(line.encode() + b"\n")
        except (OSError, ValueError) as error:
            raise Unreachable("the program has ended") from error

    def receive(self, timeout: float) -> str | None:
        self._reading = True
        try:
            return self._receive(timeout)
        finally:
            self._reading = False
            if self._closed:
                self._close_output()

    def _receive(self, timeout: float) -> str | None:
        assert self.process.stdout
        give_up = time.monotonic() + timeout
        while b"\n" not in self._unread:
            if self.process.stdout.closed:
                return None
            left = give_up - time.monotonic()
            if left <= 0:
                raise Overdue("no line")
            try:
                if self.stalled or not select.select([self.process.stdout], [], [], min(left, 0.05))[0]:
                    time.sleep(0.005 if self.stalled else 0)
                    continue
                data = os.read(self.process.stdout.fileno(), 1 << 16)
            except (ValueError, OSError):  # another thread has closed it meanwhile
                return None
            if not data:
                self.process.stdout.close()
                self.process.wait()
                return None
            self._unread += data
        line, _, self._unread = self._unread.partition(b"\n")
        return line.decode()

    def status(self) -> int | None:
        return self.process.poll()

    def errors(self) -> str:
        return ""

    def close(self) -> None:
        assert self.process.stdin
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self._closed = True
        if not self._reading:
            self._close_output()

    def _close_output(self) -> None:
        if self.process.poll() is not None and self.process.stdout:
            self.process.stdout.close()


class ProcessLink(Commands):
    """One robot on this machine, to which everything is sent as over SSH. `programs` comes first on the PATH there."""

    def __init__(self, name: str, home: Path, programs: Path) -> None:
        super().__init__(name, LinkOptions())
        self._lock = f"{LOCK}-{secrets.token_hex(6)}"
        self._environment = {"PATH": f"{programs}:{os.environ['PATH']}", "HOME": str(home), "USER": "robot"}
        home.mkdir()

    def channel(self, argv: Sequence[str]) -> Lines:
        return super().channel([self._lock if word == LOCK else word for word in argv])

    def _start(self, line: str) -> ProcessStream:
        return ProcessStream(["sh", "-c", f"cd\n{line}"], self._environment)

    def _disconnect(self) -> None:
        """There is no connection."""


class LocalLink:
    """One robot: `home` is its home folder. Its lock is its own."""

    Options = Table
    python = "python3"

    def __init__(self, name: str, home: Path, lock: str | None = None) -> None:
        """`lock` is that of another link to the same robot."""
        self.name = name
        self.home = home
        self.off = False
        """True: it does not answer."""
        self.variables: dict[str, str] = {}
        """The variables that each login gets."""
        self.channels: list[LocalChannel] = []
        self.pushed: list[str] = []
        self.lock = lock or f"{LOCK}-{secrets.token_hex(6)}"
        home.mkdir(parents=True, exist_ok=True)

    def run(self, argv: Sequence[str], *, stdin: bytes = b"", timeout: float = 30.0) -> Ended:
        self._answers()
        done = subprocess.run(argv, input=stdin, capture_output=True, cwd=self.home, timeout=timeout, check=False)
        return Ended(done.returncode, done.stdout, done.stderr)

    def channel(self, argv: Sequence[str]) -> LocalChannel:
        self._answers()
        self.channels.append(LocalChannel([self.lock if word == LOCK else word for word in argv], self.home, self.variables))
        return self.channels[-1]

    def push(
        self, folder: Path, target: str, *, timeout: float = 60.0, progress: Callable[[int], None] = lambda size: None
    ) -> object:
        self._answers()
        path = self.home / target
        if path.exists() and _content(path) != _content(folder):
            raise Missing(f"{self.name}: {target} is there already, with other contents")
        if not path.exists():
            self.pushed.append(target)
            if folder.is_file():
                path.mkdir(parents=True)
                shutil.copy(folder, path)
            else:
                shutil.copytree(folder, path, symlinks=True)
        return None

    def pull(self, folder: str, target: Path, *, timeout: float = 60.0) -> object:
        self._answers()
        if not (self.home / folder).is_dir():
            raise Missing(f"{self.name}: {folder} does not exist")
        shutil.copytree(self.home / folder, target, symlinks=True)
        return None

    def close(self) -> None:
        for channel in self.channels:
            channel.close()

    def kill(self) -> None:
        """Kill all processes of the robot, as a robot without power."""
        self.off = True
        for channel in self.channels:
            running = descendants(channel.process.pid) if channel.process.poll() is None else []
            for pid in running:  # none tells of another's end
                signal_process(pid, signal.SIGSTOP)
            for pid in reversed(running):  # the guard before its agent
                signal_process(pid, signal.SIGKILL)
            channel.process.wait()
            channel.close()

    def stall(self, *, stalled: bool = True) -> None:
        """Let nothing pass, as a radio that is out of reach."""
        self.off = stalled
        for channel in self.channels:
            channel.stalled = stalled

    def _answers(self) -> None:
        if self.off:
            raise Unreachable(f"{self.name}: no answer")
