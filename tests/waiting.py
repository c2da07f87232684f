"""Waiting for what another process will have done."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

PATIENCE_S = 300.0
"""Longer than anything takes on a busy machine; who waits so long has found a fault."""


def until(there: Callable[[], Any], what: Any = "it is so", seconds: float = PATIENCE_S) -> None:
    """Wait for something to come true; `what` says what it is, or is called to say how things are instead.

    A file or a process that comes or goes while it is looked at is not there yet.
    """
    give_up = time.monotonic() + seconds
    while not _quietly(there):
        assert time.monotonic() < give_up, f"waited in vain until {what() if callable(what) else what}"
        time.sleep(0.02)


def _quietly(there: Callable[[], Any]) -> Any:
    try:
        return there()
    except (FileNotFoundError, ProcessLookupError):
        return False
