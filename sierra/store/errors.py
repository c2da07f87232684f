"""What DuckDB complains of, in one line."""

from __future__ import annotations

import json
import re

from sierra.store.scans import plain

NESTED = re.compile(r'"exception_message":("(?:[^"\\]|\\.)*")')
"""Where a thread that writes complains, within another complaint, as JSON."""
MOST = 400


def duckdb_error() -> type[Exception]:
    """Return the class of all errors that DuckDB raises; this imports DuckDB."""
    import duckdb

    return duckdb.Error


def explain(error: Exception) -> str:
    """All of it that is not about where in a statement."""
    lines = [line.strip() for line in _plain(error).splitlines() if line.strip()]
    kept = [line for line in lines if not line.startswith(("LINE ", "^"))]
    return " ".join(kept)[:MOST]


def first_line(error: Exception) -> str:
    return _plain(error).splitlines()[0][:MOST]


def _plain(error: Exception) -> str:
    found = NESTED.search(str(error))
    return plain(str(json.loads(found[1], strict=False)) if found else str(error))
