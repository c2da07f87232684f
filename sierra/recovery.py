"""Finishing what died: a session whose process is gone, with runs still going or not yet recorded."""

from __future__ import annotations

import contextlib

from sierra import engines, sessions
from sierra.model import Result, Status
from sierra.paths import SessionPaths
from sierra.recording import Context, Recorder, find_odd
from sierra.runners import orphans
from sierra.runners.journal import Journal
from sierra.store import Store


def finish_dead(store: Store) -> int:
    """End what dead sessions left running, and record what had finished there; how many executions that were."""
    recovered = 0
    with sessions.dead(store.paths) as found:
        if found:
            orphans.end(found)
        for paths in found:
            _sweep(paths)
            recovered += recover(store, paths)
    return recovered


def _sweep(paths: SessionPaths) -> None:
    """Remove the containers that a session has left."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # it died before anything was started
        context = Context.load(paths.context)
        engines.find(context.engine).sweep([context.session])


def recover(store: Store, paths: SessionPaths) -> int:
    """Record what a session's journal says has finished, and the store does not have yet."""
    results = [event for event in Journal(paths.journal).read() if isinstance(event, Result)]
    if not results:
        return 0
    context = Context.load(paths.context)
    rows = store.rows("SELECT execution FROM executions WHERE session = $s", s=context.session)
    recorded = {row["execution"] for row in rows}
    recorder = Recorder(store, paths, context)
    missing = [result for result in results if result.execution not in recorded]
    added = [recorder.add(result) for result in missing]
    recorder.flush()
    find_odd(store, paths, context)
    return sum(status is not Status.INTERRUPTED for status in added)
