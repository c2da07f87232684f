"""Orphans: processes that a dead worker left running. They are found by a mark and by the worker's journal, and killed.

Every process of a session has SIERRA_SESSION in its environment, unless it removed the variable. Then the journal still has the
first process of its program. (Linux only: on other systems nothing is found.)
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
from sierra.runners.journal_reader import Journal, Started
from sierra.store.layout import SessionPaths
from sierra.worker import marked_processes, worker

PATIENCE_S = 10.0


def end(sessions: Sequence[SessionPaths]) -> None:
    """Kill all processes that these sessions left running, and wait until they are gone. Then no process changes their files.

    Raises Missing if a process cannot be killed.
    """
    give_up = time.monotonic() + PATIENCE_S
    while left := _left(sessions):
        if time.monotonic() > give_up:
            raise Missing(f"process {min(left)} of a dead session cannot be ended; end it and run the command again")
        for pid in left:
            for kill in (os.killpg, os.kill):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    kill(pid, signal.SIGKILL)
        time.sleep(0.01)


def _left(sessions: Iterable[SessionPaths]) -> set[int]:
    marks = {f"SIERRA_SESSION={paths.root.name}".encode() for paths in sessions}
    started = {pid for paths in sessions for pid in _started(paths.journal)}
    return (marked_processes.marked(marks) | started) - {os.getpid()}


def _started(journal: Path) -> list[int]:
    """Return the living processes that a journal records as started but not as ended."""
    started: dict[str, Started] = {}
    for event in Journal(journal).read():
        match event:
            case Started():
                started[event.execution] = event
            case Result():
                started.pop(event.execution, None)
    return [one.pid for one in started.values() if one.born is not None and worker.birth(one.pid) == one.born]
