"""Snapshots that stay open between questions, so that a question costs little more than its own statement.

A snapshot reads files that never change, so it is right as long as the store has the same segments. The lock on the segments is
held only while a question is answered: in between, other processes can remove segments, and then a new snapshot is opened.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Generic, Protocol, TypeVar

from sierra.deliverables.explorer.limit import Limit


class Open(Protocol):
    """A snapshot, or a frame that reads one."""

    def unlock(self) -> None: ...

    def __exit__(self, kind: None, error: None, trace: None, /) -> None: ...


T = TypeVar("T", bound=Open)


class Kept(Generic[T]):
    """The one thing that was opened last, with the key that says what it is right for."""

    def __init__(self) -> None:
        self._key: object = None
        self._opened: T | None = None

    @contextmanager
    def opened(self, key: object, opening: Callable[[], T], limit: AbstractContextManager[Limit]) -> Iterator[T]:
        """Yield what is open for this key, or open it; `limit` is for what the caller does.

        The caller holds the lock of the segments. What is open is closed after an error; an interruption is one, too.
        """
        if self._opened is None or self._key != key:
            self.close()
            self._opened, self._key = opening(), key
            self._opened.unlock()
        try:
            with limit:
                yield self._opened
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close what is open."""
        if (opened := self._opened) is not None:
            self._opened = None
            opened.__exit__(None, None, None)
