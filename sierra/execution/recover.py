"""Recovery of dead sessions: their processes are gone, but runs still execute or are not recorded."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import traceback
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from sierra.errors import Damaged, DamagedFile, Missing, SierraError
from sierra.execution import sessions, unrecorded
from sierra.execution.observer import Observer
from sierra.ingest.changed_files import Doubt
from sierra.ingest.recording_context import Context
from sierra.model import LateFiles, Result, Status
from sierra.runners.journal_reader import Event, Journal, Row, Started
from sierra.store.layout import RUN_OUTPUT, SessionPaths
from sierra.store.store import Store
from sierra.util.fs import inside
from sierra.util.lazy_logger import Log
from sierra.util.regular_files import NOT_REGULAR
from sierra.util.shortage import lacking, system_errors

log = Log(__name__)

OF_FILES = frozenset(
    (errno.ENAMETOOLONG, errno.EINVAL, errno.EILSEQ, errno.ENOENT, errno.ENOTDIR, errno.ELOOP, *NOT_REGULAR),
)
"""The system's errors about the files of a session. Any other may come from a file system that fails for a moment."""


class Recovered(NamedTuple):
    """The result of recovering dead sessions."""

    executions: int
    """Executions that were recorded."""
    left_out: tuple[str, ...]
    """A message about each session that cannot be recorded."""


def finish_dead(store: Store, observer: Observer) -> Recovered:
    """End the runs that dead sessions left, and record finished ones.

    A session that cannot be recorded is moved away. `observer` receives a notice about each.
    """
    recovered, left_out = 0, []
    with sessions.dead(store.paths) as dead:
        for paths in list(dead):
            from sierra.runners import local  # what recovers sessions is loaded only if one has died

            try:
                local.end_orphans([paths])
                _sweep(paths)
                count = recover(store, paths)
            except Exception as error:
                dead.remove(paths)
                message = _left_out(store, paths, error)
                log.warning("%s", message)
                log.debug("".join(traceback.format_exception(error)))
                observer.notice(message)
                left_out.append(message)
                continue
            recovered += count
            log.warning("session %s has died; recorded %d of its finished executions", paths.root.name, count)
    return Recovered(recovered, tuple(left_out))


def _left_out(store: Store, paths: SessionPaths, error: Exception) -> str:
    """Leave out a session that cannot be recorded, and return a message about it.

    If the session itself is the reason, it is moved away. If it is not this user's, or takes too much memory, it stays. Raises
    the error if it concerns all sessions.
    """
    if lacking(error) in (errno.EACCES, errno.EPERM, errno.ENOMEM):
        return f"session {paths.root.name} has died and cannot be recorded by this process ({error})"
    if not is_at_fault(error, store):
        raise error
    return str(unrecorded.put_aside(store.paths, paths, error))


def is_at_fault(error: Exception, store: Store) -> bool:
    """Check whether a session itself is the reason why it cannot be recorded, and not the store or a lack of anything."""
    if isinstance(error, Missing | DamagedFile) and not _is_of_name(error):
        return False
    if lacking(error) is not None or system_errors(error) - OF_FILES:
        return False
    try:
        store.values(str, "SELECT execution FROM executions LIMIT 0")
    except SierraError:
        return False
    return True


def _is_of_name(error: BaseException) -> bool:
    """Check whether an error is the system's refusal of a name, which no attempt can change."""
    return isinstance(error.__cause__, OSError) and error.__cause__.errno in (errno.ENAMETOOLONG, errno.EINVAL, errno.EILSEQ)


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
    from sierra.ingest.consistency import find_inconsistent
    from sierra.ingest.recorder import Recorder

    events = list(Journal(paths.journal).read())
    ended = (_own(paths, event) for event in events if isinstance(event, Result))
    results = [result for result in ended if result is not None]
    late = [event for event in events if isinstance(event, LateFiles) and _is_here(paths, event)]
    if not (results or late):
        return 0
    context = Context.load(paths.context)
    recorded = set(store.values(str, "SELECT execution FROM executions WHERE session = $s", s=context.session))
    recorder = Recorder(store, paths, context, doubt=lambda: _doubt(paths))
    missing = [result for result in results if result.execution not in recorded]
    new = {result.execution for result in missing}
    rows = [(event.table, event.row) for event in events if isinstance(event, Row)]
    recorder.add_rows([(table, row) for table, row in rows if row.get("execution", "") in (*new, "")], ())
    recorder.add_late(late)
    added = [recorder.add(result) for result in missing]
    recorder.flush()
    # nobody compares runs that may share a file any more
    find_inconsistent(store, paths, context, min(recorder.lost, _lost(events)), final=True)
    return sum(status is not Status.INTERRUPTED for status in added)


def _doubt(paths: SessionPaths) -> Doubt | None:
    """Return the doubt that the session itself has noted; nobody knows which files changed later, so it concerns all."""
    return Doubt(paths.doubt.read_text()) if paths.doubt.is_file() else None


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
