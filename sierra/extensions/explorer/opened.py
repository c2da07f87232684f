"""The snapshots that a store has opened and that still exist, so that their statements can be interrupted."""

from __future__ import annotations

import threading
from weakref import WeakSet

from sierra.store.store import Snapshot


class Opened:
    """Snapshots, which may be added by one thread while another one interrupts them."""

    def __init__(self) -> None:
        self._every: WeakSet[Snapshot] = WeakSet()
        self._one = threading.Lock()

    def add(self, snapshot: Snapshot) -> None:
        with self._one:
            self._every.add(snapshot)

    def interrupt(self) -> None:
        """End the statements that other threads execute on these snapshots; they raise SqlError there."""
        with self._one:
            every = list(self._every)
        for snapshot in every:
            snapshot.interrupt()
