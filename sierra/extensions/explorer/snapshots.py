"""Snapshots that stay open between questions, so that a question costs little more than its own statement.

A snapshot reads files that never change, so it is right as long as the store has the same segments. Files that were damaged
meanwhile are noticed. The lock on the segments is held only while a question is answered: in between, other processes can
remove segments, and then a new snapshot is opened. Statements can be interrupted while the snapshot exists.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar
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


class Open(Protocol):
    """A snapshot, or a frame that reads one."""

    def unlock(self) -> None: ...

    def verify(self) -> None: ...

    def __exit__(self, kind: None, error: None, trace: None, /) -> None: ...


T = TypeVar("T", bound=Open)


class Kept(Generic[T]):
    """The one thing that was opened last, with the key that says what it is right for; and a context manager for its use."""

    def __init__(self) -> None:
        self._key: object = None
        self._opened: T | None = None

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close what is open after an error; an interruption is one, too."""
        if kind is not None:
            self.close()

    def opened(self, key: object, opening: Callable[[], T]) -> T:
        """Return what is open for this key, or open it. The caller holds the lock of the segments. Raises Damaged."""
        if self._opened is None or self._key != key:
            self.close()
            self._opened, self._key = opening(), key
            self._opened.unlock()
        else:
            self._opened.verify()
        return self._opened

    def close(self) -> None:
        """Close what is open."""
        if (opened := self._opened) is not None:
            self._opened = None
            opened.__exit__(None, None, None)
