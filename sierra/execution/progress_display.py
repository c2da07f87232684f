"""Progress of a session in words, and its display in notebooks: one line that is drawn again.

Scripts print no progress unless they ask for it. A notebook is found by the modules of its kernel, which this never imports.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Protocol

from sierra.execution.observer import Observer, Progress
from sierra.util.text import counted

EVERY_S = 0.5
"""Seconds between two updates."""


def in_notebook() -> bool:
    """Check whether this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return "ipykernel" in sys.modules and hasattr(shell, "kernel")


def observer(wanted: bool | None = None) -> Observer:
    """Return an observer that shows progress in a notebook, or anywhere if `wanted`, and otherwise ignores it."""
    if not (in_notebook() if wanted is None else wanted):
        return Observer()
    return _Line(_display() if in_notebook() else _print)


class Handle(Protocol):
    """IPython's handle of something that is displayed."""

    def update(self, data: dict[str, str], *, raw: bool) -> None: ...


def _display() -> Callable[[str], None]:
    """Return a function that shows a text in the place of the one before."""
    display: Callable[..., Handle] | None = getattr(sys.modules.get("IPython.display"), "display", None)
    if display is None:
        return _print
    handle: Handle | None = None

    def show(text: str) -> None:
        nonlocal handle
        data = {"text/plain": text}
        if handle is None:
            handle = display(data, raw=True, display_id=True)
        else:
            handle.update(data, raw=True)

    return show


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class _Line(Observer):
    """The latest progress, shown now and then, and in any case when all runs are done."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show = show
        self._began = time.monotonic()
        self._shown = 0.0
        self._last = ""

    def progress(self, progress: Progress) -> None:
        now = time.monotonic()
        whole = progress.reused + progress.done >= progress.total
        if not whole and now - self._shown < EVERY_S:
            return
        line = text(progress, now - self._began)
        if line != self._last:
            self._show(line)
        self._shown, self._last = now, line


def text(progress: Progress, seconds: float) -> str:
    """Return progress in words: numbers of done, failed and running runs, speed, and remaining time."""
    done = progress.reused + progress.done
    parts = [f"{done}/{progress.total} runs"]
    if progress.failed:
        parts.append(f"{progress.failed} failed")
    if progress.running:
        parts.append(f"{progress.running} running")
    if progress.queued:
        why = f" ({progress.waits})" if progress.waits else ""
        parts.append(f"{counted(progress.queued, 'array task')} queued{why}")
    if progress.elsewhere:
        parts.append(f"{progress.elsewhere} in another session")
    if progress.done and seconds > 0:
        parts.append(f"{progress.done / seconds:.1f}/s")
        if progress.share:
            parts.append(f"{duration(seconds * max(0.0, 1 / progress.share - 1))} left")
    return ", ".join(parts)


def duration(seconds: float) -> str:
    """Return a time as hours, minutes and seconds, or as minutes and seconds."""
    whole = round(seconds)
    hours, rest = divmod(whole, 3600)
    minutes, seconds_left = divmod(rest, 60)
    return f"{hours}:{minutes:02}:{seconds_left:02}" if hours else f"{minutes}:{seconds_left:02}"
