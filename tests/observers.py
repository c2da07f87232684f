"""An observer made of functions."""

from __future__ import annotations

from collections.abc import Callable

from sierra.execution.observer import Observer, Progress


class Observing(Observer):
    """Calls the given functions for progress and notices."""

    def __init__(
        self, progress: Callable[[Progress], None] = lambda progress: None, notice: Callable[[str], None] = lambda text: None
    ) -> None:
        self._progress = progress
        self._notice = notice

    def progress(self, progress: Progress) -> None:
        self._progress(progress)

    def notice(self, text: str) -> None:
        self._notice(text)
