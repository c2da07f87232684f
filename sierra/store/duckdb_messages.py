"""DuckDB's error messages in one line."""

from __future__ import annotations

import errno
import json
from pathlib import Path

from sierra.errors import Missing
from sierra.store.duckdb_file_io import plain
from sierra.util.lazy_definitions import regex
from sierra.util.shortage import lacking, shortage

NESTED = regex(r'"exception_message":("(?:[^"\\]|\\.)*")')
"""The pattern of a writing thread's error, which is JSON within another error."""
OF_INDEX = regex(r' Did you mean "index_[0-9a-f]{16}\.[^?]*\?')
"""The pattern of a proposal to use a table of the index, whose name is `sierra.store.index_reader.DATABASE`."""
MOST = 400


def duckdb_error() -> type[Exception]:
    """Return the class of all errors that DuckDB raises; this imports DuckDB."""
    import duckdb

    return duckdb.Error


def explain(error: Exception) -> str:
    """Return an error's message without lines that show a position in the statement, and proposals to use the index."""
    lines = [line.strip() for line in _plain(error).splitlines() if line.strip()]
    kept = [line for line in lines if not line.startswith(("LINE ", "^"))]
    return OF_INDEX.sub("", " ".join(kept))[:MOST]


def first_line(error: Exception) -> str:
    return _plain(error).splitlines()[0][:MOST]


def disk_error(folder: Path, error: Exception) -> Missing:
    """Return the error for a disk that DuckDB cannot write to, with the reason but without the file's name."""
    _, _, reason = first_line(error).rpartition('": ')
    return Missing(f"cannot write to {folder}: {reason}")


def check_shortage(error: Exception) -> None:
    """Raise Missing if an error shows a lack of something, after which nothing is known about the files that were read."""
    if (lack := shortage(error)) is not None:
        where = f" ({first_line(error)})" if lacking(error) in (errno.EACCES, errno.EPERM) and str(error) else ""
        raise Missing(f"the store cannot be read: {lack}{where}") from error


def _plain(error: Exception) -> str:
    found = NESTED.search(str(error))
    return plain(str(json.loads(found[1], strict=False)) if found else str(error))
