"""Progress of videos: the count of frames that all threads have read or drawn."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from sierra.errors import SierraError

if TYPE_CHECKING:
    from sierra.extensions.videos.encode import Image

Progress = Callable[[int, int, str], None]
"""A function that receives the number of frames that are done, and of all frames; and what is done: `READ`, or `DRAWN`."""
READ, DRAWN = "frames read", "frames drawn"


def no_progress(done: int, frames: int, what: str) -> None:
    """Show no progress."""


class Counter:
    """The count of frames of all threads; it stops them if one has failed."""

    def __init__(self, frames: int, progress: Progress, what: str) -> None:
        self.stop = False
        self._done, self._frames, self._progress, self._what, self._lock = 0, frames, progress, what, threading.Lock()

    def add(self) -> None:
        with self._lock:
            self._done += 1
            self._progress(self._done, self._frames, self._what)

    def each(self, images: Iterator[Image]) -> Iterator[Image]:
        for image in images:
            if self.stop:
                raise SierraError("stopped")
            yield image
            self.add()
