"""Marks of files that SIERRA made and therefore may remove. All other files are left alone, and `sierra fsck` names them.

.sierra/id                  the id of the store: 24 random digits, and the first 8 of their SHA-256
.sierra/work/mark           the id of the store that owns these sessions
.sierra/work/<session>/     a session: its name has 16 hexadecimal digits, and the process that made it signed `owner.0`
    elsewhere               the path of the folder where its runs execute, if it is not this one
.sierra/checkpoints/<run>.<programs>/mark  its own name; see `sierra.worker.checkpoints`
PATH/<id>/mark              the id of the store that executes runs here; `PATH` is `[store] work_folder`, for many stores
PATH/<id>/<session>/mark    the id of the session

Stores that are older than marks get them when something executes next. A work folder that is a symbolic link may lead
anywhere. Therefore it must be empty, or have the mark of this very store.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from sierra.errors import Damaged, Missing
from sierra.store.layout import SessionPaths, StorePaths
from sierra.util.fs import write_once
from sierra.util.hashing import sha256
from sierra.util.lazy_definitions import regex
from sierra.worker.files import is_folder

ID = regex(rb"([0-9a-f]{32})\n")
SESSION = regex(r"[0-9a-f]{16}")
SIGNED = {"pid", "where"}
"""The fields that an owner file has at least."""
MOST = 1 << 16
"""The limit on the bytes that are read from a mark."""
ADVICE = 'remove the link; to execute runs elsewhere, set in sierra.toml: [store] work_folder = "PATH"'


def identity(store: StorePaths) -> str:
    """Return the store's id; create one if there is none. Raises Damaged if the file does not contain a valid id."""
    if not os.path.lexists(store.identity):
        write_once(store.identity, f"{_checked(os.urandom(12).hex())}\n".encode())
    if (found := id_in(store.identity)) is None:
        raise Damaged(f"{store.identity}: contains no store id; move it and {store.work} away, and SIERRA creates both again")
    return found


def id_in(path: Path) -> str | None:
    """Return the store id in a file; None if the file does not contain a valid id."""
    matched = ID.fullmatch(_beginning(path))
    said = matched[1].decode() if matched else ""
    return said if said and said == _checked(said[:24]) else None


def _checked(digits: str) -> str:
    """Append a checksum to the digits of an id."""
    return digits + sha256(digits.encode())[:8]


def mark_work(store: StorePaths) -> None:
    """Check that the work folder belongs to this store, and mark it. Raises Missing if it may belong to something else."""
    work = store.work
    if work.is_symlink() and not work.is_dir():
        raise Missing(f"{work} is a link to {str(work.readlink())!r}, which is not a folder; {ADVICE}")
    work.mkdir(parents=True, exist_ok=True)
    own, said = identity(store), id_in(store.work_mark)
    if said == own:
        return
    if said is not None:
        raise Missing(f"{work} is the work folder of another store ({said[:8]}, not {own[:8]}); {ADVICE}")
    if work.is_symlink():
        _check_link(store)
    write_once(store.work_mark, f"{own}\n".encode())


def _check_link(store: StorePaths) -> None:
    """Raise Missing if the link leads to another file system, or to a folder that is not empty."""
    work = store.work
    if work.stat().st_dev != store.root.stat().st_dev:
        raise Missing(f"{work} is a link to another file system ({work.resolve()}); {ADVICE}")
    if held := _other_names(work):
        raise Missing(f"{work} is a link to {work.resolve()}, which contains other files ({held[0]!r}, …); {ADVICE}")


def _other_names(folder: Path) -> list[str]:
    """Return the names in a folder, without its lock and its mark, complete or unfinished."""
    own = ("lock", StorePaths.MARK)
    return sorted(
        path.name for path in folder.iterdir() if path.name not in own and not path.name.startswith(f".{StorePaths.MARK}.")
    )


def is_session(folder: Path) -> bool:
    """Check that a folder is a session's, even if it is new or half removed. No file of a session is a symbolic link."""
    if not SESSION.fullmatch(folder.name) or not is_folder(str(folder)):
        return False
    paths = SessionPaths(folder)
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        held = {entry.name: entry.is_symlink() for entry in entries if not entry.name.isdigit()}
        signed = _is_signed(paths.owner(0)) if paths.owner(0).name in held else held.keys() <= {paths.lock.name}
        return signed and not any(held.values())
    return False


def _is_signed(owner: Path) -> bool:
    """Check that a file names a process, or is empty because the process that began to write it was killed."""
    text = _beginning(owner)
    with contextlib.suppress(ValueError, RecursionError):
        said = json.loads(text or "{}")
        return stat.S_ISREG(owner.lstat().st_mode) and isinstance(said, dict) and (not text or said.keys() >= SIGNED)
    return False


def sessions(store: StorePaths) -> Iterator[SessionPaths]:
    """Yield all sessions of a store, each with the folder where its runs execute."""
    for path in _below(store.work):
        if is_session(path):
            yield SessionPaths(path, elsewhere(store, path, path.name))


def strange(store: StorePaths) -> Iterator[Path]:
    """Yield the paths among the sessions that are not sessions."""
    own = {store.work_lock, store.work_mark}
    yield from (path for path in _below(store.work) if path not in own and not is_session(path))


def _below(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []


def make_elsewhere(store: StorePaths, session: SessionPaths, folder: Path) -> SessionPaths:
    """Make a folder below `folder` for the runs of a session. Raises Missing if the store's folder there is not SIERRA's."""
    own = identity(store)
    mine = folder / own
    mine.mkdir(parents=True, exist_ok=True)
    if mine.is_symlink() or (_other_names(mine) and not _is_marked(mine, own)):
        raise Missing(f"{mine} was not made by SIERRA; move it away, or change [store] work_folder")
    write_once(mine / StorePaths.MARK, f"{own}\n".encode())
    runs = mine / session.root.name
    session.elsewhere_file.write_bytes(os.fsencode(runs))
    runs.mkdir()
    write_once(runs / StorePaths.MARK, f"{session.root.name}\n".encode())
    return SessionPaths(session.root, runs)


def elsewhere(store: StorePaths, folder: Path, session: str) -> Path | None:
    """Return the folder where a session's runs execute; None if none is named, or if that folder lacks its marks."""
    said = _beginning(SessionPaths(folder).elsewhere_file)
    if not said or b"\0" in said:
        return None
    runs = Path(os.fsdecode(said))
    own = id_in(store.identity)
    placed = own is not None and runs.is_absolute() and (runs.parent.name, runs.name) == (own, session)
    marked = placed and is_folder(str(runs)) and _is_marked(runs.parent, str(own)) and _is_marked(runs, session)
    return runs if marked else None


def executes_in(store: StorePaths, folder: Path) -> bool:
    """Return whether a path is one in which this store executes runs, here or below a `[store] work_folder`."""
    return folder.is_relative_to(store.work) or id_in(store.identity) in folder.parts


def _is_marked(folder: Path, text: str) -> bool:
    return _beginning(folder / StorePaths.MARK) == f"{text}\n".encode()


def _beginning(path: Path) -> bytes:
    """Return the beginning of a regular file; empty if there is no such file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return b""
    try:
        return os.read(descriptor, MOST) if stat.S_ISREG(os.fstat(descriptor).st_mode) else b""
    finally:
        os.close(descriptor)
