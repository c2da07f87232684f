"""Exclusive changes to recorded data (`gc`, `rm`, repair, imports): prepared outside the segments, published at one moment."""

from __future__ import annotations

import contextlib
import itertools
import json
import operator
import time
from collections.abc import Callable, Iterator
from collections.abc import Set as AbstractSet
from pathlib import Path

from sierra.errors import Busy, Missing
from sierra.execution import sessions
from sierra.execution.sessions import Session
from sierra.store import index_files
from sierra.store.compaction import Compaction, out_of_use, tidy
from sierra.store.layout import SessionPaths, StorePaths
from sierra.store.segments import disk_errors, on_disk, out_of_date
from sierra.util.hashing import short
from sierra.util.regular_files import read_regular

PATIENCE_S = 5.0
ATTEMPTS = 5


@contextlib.contextmanager
def changing(store: StorePaths) -> Iterator[Session]:
    """Yield a new session to write in. If its process is killed, the next session or `gc` removes what it leaves."""
    session = Session(store, logged=False)
    try:
        yield session
    finally:
        session.close()


def names(store: StorePaths) -> set[str]:
    """Return the names of the current segments, without replaced ones. No file is verified: a repair needs them, too."""
    found = list(on_disk(store.segments))
    return {segment.name for segment in found} - out_of_date(found)


def publish(
    store: StorePaths,
    session: Session,
    prepare: Callable[[Compaction], AbstractSet[str]],
    may: Callable[[], None] = lambda: None,
    keep: AbstractSet[str] = frozenset(),
    valid: Callable[[AbstractSet[str], AbstractSet[str]], bool] = operator.eq,
) -> int:
    """Prepare and publish a change; return the number of old segments that still must be removed.

    If something was recorded meanwhile, prepare again, at most `ATTEMPTS` times. `prepare` writes the new segments and returns
    the names of the segments that it has read. `may` raises if other sessions must not be disturbed; no session can begin while
    it checks. `keep` names replaced segments that are put aside, not removed. `valid` decides from the names of the segments
    now, and of those that were read, whether the change is still right; by default, both must be the same. Raises Missing if
    the file system has no locks, so that exclusive access is impossible, and Busy if the store changed in each attempt.
    """
    for attempt in range(ATTEMPTS):
        rewriting = Compaction(store, session.paths.root / f"new{attempt}", f"{session.id}.{attempt}")
        seen = prepare(rewriting)
        with sessions.exclusively(store) as locks:
            if not locks:
                raise Missing(
                    f"{store.root}: the file system has no locks, so changes are not safe; copy the store to one with locks"
                )
            may()
            if valid(names(store), seen):
                with disk_errors(store.segments):
                    rewriting.publish()
                    if keep:  # an index may have their rows
                        index_files.remove_all(store)
                    for name in sorted(keep):
                        aside(store, store.segments / name)
                    tidy(store, session.paths.root / "old")
                    return len(out_of_use(store))
    raise Busy("the store is busy; retry when other sierra processes have finished")


def aside(store: StorePaths, path: Path) -> None:
    """Move a file or a folder of the store to `damaged/`, under a name that is free there."""
    store.damaged.mkdir(exist_ok=True)
    names = itertools.chain([path.name], (f"{path.name}.{number}" for number in itertools.count(1)))
    target = next(target for name in names if not (target := store.damaged / name).exists() and not target.is_symlink())
    path.rename(target)


def undisturbed(store: StorePaths, session: Session, batches: AbstractSet[str]) -> None:
    """Raise Busy if a living session executes one of these batches, or if its batch stays unknown.

    Call this within `sessions.exclusively`. A session that has just begun has not recorded its batch yet, so wait for that up
    to `PATIENCE_S` seconds in total.
    """
    give_up = time.monotonic() + PATIENCE_S
    for paths in sessions.alive(store):
        if paths.root == session.paths.root:
            continue
        batch = _batch(paths)
        while batch is None and paths.root.exists() and time.monotonic() < give_up:
            time.sleep(0.05)
            batch = _batch(paths)
        if batch is None and paths.root.exists():
            raise Busy(f"the store is busy (session {paths.root.name}); retry when other sierra processes have finished")
        if batch in batches:
            raise Busy(
                f"batch {short(str(batch))} is being executed (session {paths.root.name}); stop this session, or wait for it"
            )


def _batch(paths: SessionPaths) -> str | None:
    try:
        return str(json.loads(read_regular(paths.context))["batch"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
