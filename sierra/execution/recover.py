"""Recovery of dead sessions: their processes are gone, but runs still execute or are not recorded."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from sierra.errors import Damaged, SierraError
from sierra.execution import sessions
from sierra.ingest.recording_context import Context
from sierra.model import LateFiles, Result, Status
from sierra.runners.journal_reader import Event, Journal, Row, Started
from sierra.store.layout import RUN_OUTPUT, SessionPaths
from sierra.store.store import Store
from sierra.util.fs import inside
from sierra.util.lazy_logger import Log

log = Log(__name__)


def finish_dead(store: Store) -> int:
    """End the runs that dead sessions left, and record finished ones; return the number of recovered executions."""
    recovered = 0
    with sessions.dead(store.paths) as found:
        if found:
            from sierra.runners import local  # what recovers sessions is loaded only if one has died

            local.end_orphans(found)
        for paths in found:
            _sweep(paths)
            count = recover(store, paths)
            recovered += count
            log.warning("session %s has died; recorded %d of its finished executions", paths.root.name, count)
    return recovered


def _sweep(paths: SessionPaths) -> None:
    """Remove the containers that a session has left."""
    from sierra.containers import engines

    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, SierraError):  # it died before anything was started
        context = Context.load(paths.context)
        engines.find(context.engine, context.engines).sweep([paths.root.name])


def recover(store: Store, paths: SessionPaths) -> int:
    """Record executions that are finished in a session's journal and missing in the store.

    Returns the number of recorded executions that were not interrupted.
    """
    from sierra.ingest.consistency import find_odd
    from sierra.ingest.recorder import Recorder

    events = list(Journal(paths.journal).read())
    ended = (_own(paths, event) for event in events if isinstance(event, Result))
    results = [result for result in ended if result is not None]
    late = [event for event in events if isinstance(event, LateFiles) and _is_here(paths, event)]
    if not (results or late):
        return 0
    context = Context.load(paths.context)
    recorded = set(store.values(str, "SELECT execution FROM executions WHERE session = $s", s=context.session))
    recorder = Recorder(store, paths, context)
    missing = [result for result in results if result.execution not in recorded]
    new = {result.execution for result in missing}
    rows = [(event.table, event.row) for event in events if isinstance(event, Row)]
    recorder.add_rows([(table, row) for table, row in rows if row.get("execution", "") in (*new, "")], ())
    recorder.add_late(late)
    added = [recorder.add(result) for result in missing]
    recorder.flush()
    find_odd(store, paths, context, min(recorder.lost, _lost(events)))
    return sum(status is not Status.INTERRUPTED for status in added)


def _lost(events: Iterable[Event]) -> float:
    """Return the time before which all runs that have no result were started, or infinity if there is none.

    It is the end of the last run that had ended when the first of them was started.
    """
    last, since = 0.0, {}
    for event in events:
        if isinstance(event, Started):
            since[event.execution] = last
        elif isinstance(event, Result):
            since.pop(event.execution, None)
            last = max(last, event.ended)
    return min(since.values(), default=math.inf)


def _is_here(paths: SessionPaths, late: LateFiles) -> bool:
    """Return whether the folder of late files is one of this session."""
    folder = Path(late.directory)
    return folder.name.isdigit() and folder.parent.resolve() == paths.runs.resolve() and folder.is_dir()


def _own(paths: SessionPaths, result: Result) -> Result | None:
    """Return a result with its folder in this session, wherever the journal says it is; None if its files are not there.

    The journal may come from somebody else, or the project may have been moved: no other folder is ever read or removed.
    """
    name = Path(result.directory).name
    folder = paths.runs / name if name.isdigit() else paths.runs
    try:
        files = [inside(folder, f"{RUN_OUTPUT}/{file.path}") for file in result.outputs]
        inside(paths.runs, f"{name}/{RUN_OUTPUT}")
    except Damaged:
        return None
    return replace(result, directory=str(folder)) if all(os.path.lexists(file) for file in files) else None
