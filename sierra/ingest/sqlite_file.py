"""SQLite databases that runs wrote, opened for reading only and without their journal.

A statement can only read: an authorizer refuses everything else. Each page of the database is checked before.
"""

from __future__ import annotations

import os
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from sierra.ingest.base import UnreadableError
from sierra.ingest.rewriting import OriginalFile

ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE)
MAGIC, HEADER = b"SQLite format 3\0", 100
"""The first bytes of each database, and the size of its header: https://sqlite.org/fileformat.html"""
LIMIT = 1 << 28
"""The limit on steps of SQLite's virtual machine, so that a statement ends."""
REFUSED = (sqlite3.SQLITE_INTERRUPT, sqlite3.SQLITE_AUTH)
"""SQLite's errors for a statement that was refused or ended."""


def _check_size(file: Path) -> None:
    """Raise UnreadableError if pages are missing. SQLite takes missing bytes of the last page as zeros."""
    size = file.stat().st_size
    if size == 0:
        raise UnreadableError("is empty")
    with file.open("rb") as opened:
        header = opened.read(HEADER)
    page = int.from_bytes(header[16:18], "big")
    page = 1 << 16 if page == 1 else page
    pages = int.from_bytes(header[28:32], "big") if header[24:28] == header[92:96] else 0
    if header.startswith(MAGIC) and (len(header) < HEADER or page == 0 or size % page or size < pages * page):
        raise UnreadableError("is truncated")


class _Limits:
    """The limits on a statement, which SQLite asks for; it takes any error of these methods, also Ctrl-C, for a refusal."""

    def __init__(self) -> None:
        self.refused = False
        self._steps = iter(range(LIMIT // 100_000))

    def is_over(self) -> bool:
        self.refused = self.refused or next(self._steps, None) is None
        return self.refused

    def authorize(self, action: int, *_: str | None) -> int:
        if action in ALLOWED:
            return sqlite3.SQLITE_OK
        self.refused = True
        return sqlite3.SQLITE_DENY


@contextmanager
def opened(source: OriginalFile, *, whole: bool = True) -> Iterator[sqlite3.Connection]:
    """Open a database for reading. Raises UnreadableError for all errors of SQLite.

    `whole`: first check that no part of it is missing.
    """
    with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
        for ending in ("-wal", "-journal"):
            beside = Path(os.path.realpath(source.path) + ending)
            if beside.exists() and beside.stat().st_size:
                raise UnreadableError(f"has an unfinished journal (…{ending}); the run must close the database before it ends")
        copy = Path(folder, "copy.db")  # under a name without special characters, and without a journal beside it
        with copy.open("wb") as file:
            file.writelines(source.pieces())
        if whole:
            _check_size(copy)
        limits = _Limits()
        try:
            with closing(sqlite3.connect(f"file:{copy}?mode=ro&immutable=1", uri=True)) as database:
                # with writable_schema, SQLite opens a database whose end is missing
                check = "PRAGMA quick_check" if whole else "PRAGMA writable_schema = ON"
                [first, *_] = database.execute(check).fetchall() or [("ok",)]
                if first != ("ok",):
                    raise UnreadableError(f"is truncated or damaged ({' '.join(str(first[0]).split())})")
                database.set_progress_handler(limits.is_over, 100_000)
                database.set_authorizer(limits.authorize)
                yield database
        except (sqlite3.Error, sqlite3.Warning, OverflowError) as error:
            if getattr(error, "sqlite_errorcode", None) in REFUSED and not limits.refused:
                raise KeyboardInterrupt from error
            raise UnreadableError(f"SQLite cannot read it: {' '.join(str(error).split())}") from error
