"""The file by which a run shows that its results are complete."""

from __future__ import annotations

import os
import stat

from sierra.worker.layout import LOGS

TYPE_CHECKING = False  # each run starts a conductor, and importing `typing` is a tenth of its time
if TYPE_CHECKING:
    from typing import IO, Mapping

LOOK_S = 0.25
CHUNK = 1 << 16
WHOLE = 1 << 20  # a marker up to this size is read as a whole, because it may have been written again


class Marker:
    """A marker: the file exists, or it contains a text."""

    def __init__(self, folder: str, limits: Mapping[str, object]) -> None:
        """`folder` is the run's folder. The limits `marker`, `contains` and `after_marker_s` say what is awaited."""
        name = str(limits["marker"])
        self.seconds = float(str(limits["after_marker_s"]))
        self._log = name in LOGS
        self._path = os.path.join(folder, name if self._log else os.path.join("output", name))
        self._text = str(limits.get("contains") or "").encode()
        self._read = 0
        self._end = b""
        self._met: float | None = None

    def due(self, now: float) -> float:
        """Look at the file, at the time `now`; return when the run is over, or when to look again."""
        if self._met is None and self._is_met():
            self._met = now
        return now + LOOK_S if self._met is None else self._met + self.seconds

    def is_over(self, now: float) -> bool:
        """Return whether the marker was met so many seconds ago."""
        return self.due(now) <= now

    def _is_met(self) -> bool:
        try:
            descriptor = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
        except OSError:
            return False
        with open(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                return False
            return not self._text or self._has_text(file, status.st_size)

    def _has_text(self, file: IO[bytes], size: int) -> bool:
        """Return whether the file has the text. Of a log, and of a large file, only what is new is read."""
        if size < self._read or (not self._log and size <= WHOLE):
            self._read, self._end = 0, b""
        file.seek(self._read)
        for chunk in iter(lambda: file.read(CHUNK), b""):
            self._read += len(chunk)
            self._end += chunk
            if self._text in self._end:
                return True
            self._end = self._end[-len(self._text) :]
        return False
