"""The cores of a worker, which it lends to runs that hold several: `[limits] cores`."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from typing import Callable, Iterator

from sierra.worker.processes import POLL_S


class Cores:
    """So many cores. The run that asks first gets its cores first, so that one that needs many is not passed by others."""

    def __init__(self, count: int) -> None:
        self._count = self._free = count
        self._turn = threading.Lock()
        self._changed = threading.Condition()

    @contextmanager
    def held(self, wanted: int, is_stopping: Callable[[], bool]) -> Iterator[bool]:
        """Hold cores for a run, all of them if there are fewer; True, or False if the worker was told to stop meanwhile."""
        count = min(wanted, self._count)
        has_cores = self._take(count, is_stopping)
        try:
            yield has_cores
        finally:
            if has_cores:
                with self._changed:
                    self._free += count
                    self._changed.notify_all()

    def _take(self, count: int, is_stopping: Callable[[], bool]) -> bool:
        with self._turn, self._changed:
            while self._free < count:
                if is_stopping():
                    return False
                self._changed.wait(POLL_S)
            self._free -= count
        return True
