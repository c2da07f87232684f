"""Changing what is recorded, which only `gc`, `rm` and a repair do: alone, prepared beside the store, done at one moment."""

from __future__ import annotations

import contextlib
import itertools
import json
import time
from collections.abc import Callable, Iterator
from collections.abc import Set as AbstractSet
from pathlib import Path

from sierra.errors import Missing, SierraError
from sierra.execution import sessions
from sierra.execution.sessions import Session
from sierra.store.compaction import Compaction, tidy
from sierra.store.layout import SessionPaths, StorePaths
from sierra.store.segments import disk_errors, listed
from sierra.util.hashing import short

PATIENCE_S = 5.0
ATTEMPTS = 5


@contextlib.contextmanager
def changing(store: StorePaths) -> Iterator[Session]:
    """A session of one's own to write in; what a killed one leaves, the next asking or `gc` removes."""
    session = Session(store)
    try:
        yield session
    finally:
        session.close()


def names(store: StorePaths) -> set[str]:
    """The segments that count now."""
    return {segment.name for segment in listed(store.segments)}


def publish(
    store: StorePaths,
    session: Session,
    prepare: Callable[[Compaction], AbstractSet[str]],
    may: Callable[[], None] = lambda: None,
    keep: AbstractSet[str] = frozenset(),
) -> int:
    """Prepare and publish, again where something was recorded meanwhile; how many old segments are still to be removed.

    `prepare` writes, and gives the segments that it has seen. `may` raises where others are at work that must not be disturbed;
    nobody can begin while it looks. `keep` are replaced segments that are put aside, not removed. Raises Missing
    where the file system has no locks, so that nobody can be alone.
    """
    for attempt in range(ATTEMPTS):
        rewriting = Compaction(store, session.paths.root / f"new{attempt}", f"{session.id}.{attempt}")
        seen = prepare(rewriting)
        with sessions.exclusively(store) as locks:
            if not locks:
                raise Missing(
                    f"{store.root}: the file system has no locks, so nothing can be changed safely; copy it to one that has"
                )
            may()
            if names(store) == seen:
                with disk_errors(store.segments):
                    rewriting.publish()
                    for name in sorted(keep):
                        aside(store, store.segments / name)
                    tidy(store, session.paths.root / "old")
                    return left(store)
    raise SierraError("others record all the time; try again when they have ended")


def aside(store: StorePaths, path: Path) -> None:
    """Move a file or a folder of the store to `damaged/`, under a name that is free there."""
    store.damaged.mkdir(exist_ok=True)
    names = itertools.chain([path.name], (f"{path.name}.{number}" for number in itertools.count(1)))
    target = next(target for name in names if not (target := store.damaged / name).exists() and not target.is_symlink())
    path.rename(target)


def left(store: StorePaths) -> int:
    """How many segments do not count, and are still there."""
    from sierra.store.compaction import out_of_use

    return len(out_of_use(store))


def undisturbed(store: StorePaths, session: Session, batches: AbstractSet[str]) -> None:
    """Raises where a living session is of one of these batches, or may be: it has not said yet.

    To be called within `sessions.exclusively`. One that has only just begun says so before long.
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
            raise SierraError(f"another sierra is at work here (session {paths.root.name}); try again when it has ended")
        if batch in batches:
            raise SierraError(
                f"batch {short(str(batch))} is being executed (session {paths.root.name}); end that, or wait for it"
            )


def _batch(paths: SessionPaths) -> str | None:
    try:
        return str(json.loads(paths.context.read_bytes())["batch"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
