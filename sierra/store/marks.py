"""What bears SIERRA's own mark, and so may be removed. All else is left alone, and `sierra fsck` names it.

.sierra/id                  the id of the store: 24 digits made by chance, and 8 of their SHA-256
.sierra/work/mark           the id of the store whose sessions these are
.sierra/work/<session>/     a session: named by 16 hexadecimal digits, and signed in `owner.0` by the process that made it
    elsewhere               the path of the folder where its runs execute, if that is not here
PATH/<id>/mark              the id of the store whose runs execute here: `[store] work = "PATH"`, which many stores may share
PATH/<id>/<session>/mark    the id of the session

Stores that were made before there were marks get theirs when something executes next. A work folder that is a symbolic link may
lead anywhere, so it needs more: it must be empty, or bear the mark of this very store.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path

from sierra.errors import Damaged, Missing
from sierra.store.layout import SessionPaths, StorePaths
from sierra.util.hashing import sha256
from sierra.worker import worker

ID = re.compile(rb"([0-9a-f]{32})\n")
SESSION = re.compile(r"[0-9a-f]{16}")
SIGNED = {"pid", "where"}
"""What the file of an owner says at least."""
MOST = 1 << 16
"""Bytes that are read of a mark."""
ADVICE = 'remove the link; to execute runs elsewhere, write in sierra.toml: [store] work = "PATH"'


def identity(store: StorePaths) -> str:
    """Return the store's id; make one where there is none. Raises Damaged for a file that holds no id."""
    if not os.path.lexists(store.identity):
        _write_once(store.identity, _checked(secrets.token_hex(12)))
    if (found := id_in(store.identity)) is None:
        raise Damaged(f"{store.identity}: holds no id of a store; move it and {store.work} away, and SIERRA makes both again")
    return found


def id_in(path: Path) -> str | None:
    """Return the id of a store that a file holds; None where it holds none."""
    matched = ID.fullmatch(_beginning(path))
    said = matched[1].decode() if matched else ""
    return said if said and said == _checked(said[:24]) else None


def _checked(digits: str) -> str:
    """Add to the digits of an id what tells whether one has changed."""
    return digits + sha256(digits.encode())[:8]


def mark_work(store: StorePaths) -> None:
    """Check that the work folder is this store's own, and mark it. Raises Missing where it may be somebody else's."""
    work = store.work
    if work.is_symlink() and not work.is_dir():
        raise Missing(f"{work} is a link to {str(work.readlink())!r}, which is no folder; {ADVICE}")
    work.mkdir(parents=True, exist_ok=True)
    own, said = identity(store), id_in(store.work_mark)
    if said == own:
        return
    if said is not None:
        raise Missing(f"{work} is the work folder of another store ({said[:8]}, not {own[:8]}); {ADVICE}")
    if work.is_symlink():
        _check_link(store)
    _write_once(store.work_mark, own)


def _check_link(store: StorePaths) -> None:
    """Raise Missing for a link to a folder where SIERRA cannot work, or that holds anything."""
    work = store.work
    if work.stat().st_dev != store.root.stat().st_dev:
        raise Missing(f"{work} is a link to another file system ({work.resolve()}); {ADVICE}")
    if held := _others(work):
        raise Missing(f"{work} is a link to {work.resolve()}, which holds other things ({held[0]!r}, …); {ADVICE}")


def _others(folder: Path) -> list[str]:
    """Return the names in a folder that are not those of its lock and its mark, written or still to be."""
    own = ("lock", StorePaths.MARK)
    return sorted(
        path.name for path in folder.iterdir() if path.name not in own and not path.name.startswith(f".{StorePaths.MARK}.")
    )


def is_session(folder: Path) -> bool:
    """Check that a folder is a session's, whether it was just made or is half removed. No file of a session is a link."""
    if not SESSION.fullmatch(folder.name) or not worker.is_folder(str(folder)):
        return False
    paths = SessionPaths(folder)
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        held = {entry.name: entry.is_symlink() for entry in entries if not entry.name.isdigit()}
        signed = _is_signed(paths.owner(0)) if paths.owner(0).name in held else held.keys() <= {paths.lock.name}
        return signed and not any(held.values())
    return False


def _is_signed(owner: Path) -> bool:
    """Check that a file names a process, or is empty: whoever began to write it was killed."""
    text = _beginning(owner)
    with contextlib.suppress(ValueError, RecursionError):
        said = json.loads(text or "{}")
        return stat.S_ISREG(owner.lstat().st_mode) and isinstance(said, dict) and (not text or said.keys() >= SIGNED)
    return False


def sessions(store: StorePaths) -> Iterator[SessionPaths]:
    """Yield all sessions of a store, each with the folder where its runs execute."""
    for path in _below(store.work):
        if is_session(path):
            yield SessionPaths(path, _elsewhere(store, path))


def strange(store: StorePaths) -> Iterator[Path]:
    """Yield what lies among the sessions and is none."""
    own = {store.work_lock, store.work_mark}
    yield from (path for path in _below(store.work) if path not in own and not is_session(path))


def _below(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []


# ---------------------------------------------------------------- elsewhere


def make_elsewhere(store: StorePaths, session: SessionPaths, folder: Path) -> SessionPaths:
    """Make a folder below `folder` where the runs of a session execute. Raises Missing where that is somebody else's."""
    own = identity(store)
    mine = folder / own
    mine.mkdir(parents=True, exist_ok=True)
    if mine.is_symlink() or (_others(mine) and not _is_marked(mine, own)):
        raise Missing(f"{mine} was not made by SIERRA; move it away, or change [store] work")
    _write_once(mine / StorePaths.MARK, own)
    runs = mine / session.root.name
    session.elsewhere_file.write_bytes(os.fsencode(runs))
    runs.mkdir()
    _write_once(runs / StorePaths.MARK, session.root.name)
    return SessionPaths(session.root, runs)


def _elsewhere(store: StorePaths, session: Path) -> Path | None:
    """Return where a session says that its runs execute; None where that is not said, or the folder does not bear its marks."""
    said = _beginning(SessionPaths(session).elsewhere_file)
    if not said or b"\0" in said:
        return None
    runs = Path(os.fsdecode(said))
    own = id_in(store.identity)
    placed = own is not None and runs.is_absolute() and (runs.parent.name, runs.name) == (own, session.name)
    marked = placed and worker.is_folder(str(runs)) and _is_marked(runs.parent, str(own)) and _is_marked(runs, session.name)
    return runs if marked else None


def _is_marked(folder: Path, text: str) -> bool:
    return _beginning(folder / StorePaths.MARK) == f"{text}\n".encode()


def _beginning(path: Path) -> bytes:
    """Return what a plain file begins with; nothing where there is none."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return b""
    try:
        return os.read(descriptor, MOST) if stat.S_ISREG(os.fstat(descriptor).st_mode) else b""
    finally:
        os.close(descriptor)


def _write_once(path: Path, text: str) -> None:
    """Write a line to a file that appears whole, and never replaces another."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.write_text(f"{text}\n")
        try:
            os.link(unfinished, path)
        except OSError:  # it is there already, or the file system has no hard links
            if not os.path.lexists(path):
                unfinished.rename(path)
    finally:
        unfinished.unlink(missing_ok=True)
