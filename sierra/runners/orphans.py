"""What a worker that died left running: found by its mark and by its journal, and ended.

Every process of a session has SIERRA_SESSION in its environment, unless it took that away; then the journal
still has the process that its program began with. (Linux only: elsewhere nothing is found.)
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from sierra.errors import Missing
from sierra.model import Result
from sierra.runners.journal import Journal, Started
from sierra.store.layout import SessionPaths
from sierra.worker import processes, worker

PATIENCE_S = 10.0


def end(sessions: Sequence[SessionPaths]) -> None:
    """Kill all that these sessions left running, and wait until it is gone: their files are at rest then.

    Raises Missing where a process can't be ended.
    """
    give_up = time.monotonic() + PATIENCE_S
    while left := _left(sessions):
        if time.monotonic() > give_up:
            raise Missing(f"process {min(left)}, which an asking that died has left, cannot be ended; end it and ask again")
        for pid in left:
            for kill in (os.killpg, os.kill):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    kill(pid, signal.SIGKILL)
        time.sleep(0.01)


def _left(sessions: Iterable[SessionPaths]) -> set[int]:
    marks = {f"SIERRA_SESSION={paths.root.name}".encode() for paths in sessions}
    started = {pid for paths in sessions for pid in _started(paths.journal)}
    return (processes.marked(marks) | started) - {os.getpid()}


def _started(journal: Path) -> list[int]:
    """Processes that a journal says were started, that have no end there, and still live."""
    started: dict[str, Started] = {}
    for event in Journal(journal).read():
        match event:
            case Started():
                started[event.execution] = event
            case Result():
                started.pop(event.execution, None)
    return [one.pid for one in started.values() if one.born is not None and worker.birth(one.pid) == one.born]
