"""Waiting for conditions that other processes fulfil."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

PATIENCE_S = 300.0
"""Longer than any wait on a busy machine; a longer wait shows a fault."""


def until(there: Callable[[], Any], what: Any = "the condition is true", seconds: float = PATIENCE_S) -> None:
    """Wait until a condition is true; `what` describes it, or is called to describe the actual state.

    A file or a process that appears or disappears during the check counts as missing.
    """
    give_up = time.monotonic() + seconds
    while not _quietly(there):
        assert time.monotonic() < give_up, f"gave up waiting until {what() if callable(what) else what}"
        time.sleep(0.02)


def _quietly(there: Callable[[], Any]) -> Any:
    try:
        return there()
    except (FileNotFoundError, ProcessLookupError):
        return False


def soon(seconds: Callable[[], float], limit: float, tries: int = 9) -> bool:
    """Return whether something takes less than a limit in one of several measurements: a busy machine only makes it longer."""
    return any(seconds() < limit for _ in range(tries))
