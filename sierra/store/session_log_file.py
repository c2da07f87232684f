"""Log files of sessions: `.sierra/logs/<session>.log`, and `.old` before it if a session logs much.

A log is for people who look into a failure. It is no record: nothing reads it, losing it loses nothing, and failing to write it
(a full disk, a store that is read-only) never fails a command. It is opened by its first message. A session's log has at most
two files of `LARGEST` bytes, and a store has at most `KEPT` files; `sierra gc` removes those that no recorded session has.
"""

from __future__ import annotations

import contextlib
import logging
import os
import stat
from collections.abc import Callable
from pathlib import Path

from sierra.store.layout import StorePaths
from sierra.util.lazy_definitions import regex
from sierra.util.log_handlers import Lines, listen

LARGEST = 1 << 19
KEPT = 100


def open_log(store: StorePaths, session: str) -> Callable[[], None]:
    """Write all messages from now on to a session's log file; return a function that ends this."""
    handler = _File(store, session)
    end = listen(handler)

    def close() -> None:
        end()
        handler.close()

    return close


class _File(logging.Handler):
    """Appends messages to the log file of one session. All errors are ignored; the first one ends the log."""

    def __init__(self, store: StorePaths, session: str) -> None:
        super().__init__(logging.DEBUG)
        self.setFormatter(Lines())
        self._store, self._path = store, store.log(session)
        self._file: int | None = None
        self._size = 0
        self._failed = False

    def emit(self, record: logging.LogRecord) -> None:
        if self._failed:
            return
        try:
            line = f"{self.format(record)}\n".encode("utf-8", "backslashreplace")
            if self._file is not None and self._size + len(line) > LARGEST:
                self.close()
                self._path.replace(old(self._path))
            if self._file is None:
                self._open()
            self._size += os.write(self._file or -1, line)
        except (OSError, ValueError, TypeError):
            self._failed = True

    def _open(self) -> None:
        logs = self._store.logs
        if not self._store.format.exists():
            raise FileNotFoundError(self._store.format)
        logs.mkdir(exist_ok=True)
        if not stat.S_ISDIR(logs.lstat().st_mode):
            raise NotADirectoryError(logs)
        _trim(self._store)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        file = os.open(self._path, flags, 0o666)
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode):
            os.close(file)
            raise OSError(f"{self._path} is not a file")
        self._file, self._size = file, status.st_size

    def close(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                os.close(self._file)
            self._file = None
        super().close()


def old(path: Path) -> Path:
    """Return the path of the earlier part of a long log."""
    return path.with_suffix(".old")


NAME = regex(r"[0-9a-f]{16}\.(log|old)")


def logs(store: StorePaths) -> list[Path]:
    """Return the log files of a store, the oldest first. Files that are no logs of sessions are left out."""
    found: list[tuple[float, Path]] = []
    with contextlib.suppress(OSError):
        if stat.S_ISDIR(store.logs.lstat().st_mode):
            with os.scandir(store.logs) as entries:
                for entry in entries:
                    if NAME.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                        found.append((entry.stat(follow_symlinks=False).st_mtime, Path(entry.path)))
    return [path for _, path in sorted(found)]


def find(store: StorePaths, session: str) -> Path | None:
    """Return the log file of a session; None if it has none."""
    path = store.log(session)
    return path if path in logs(store) else None


def _trim(store: StorePaths) -> None:
    """Remove the oldest log files, so that a new one can be added."""
    for path in logs(store)[: -(KEPT - 1)]:
        path.unlink(missing_ok=True)
