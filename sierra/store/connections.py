"""Connections to DuckDB, in memory, that never reach for the network; the last one that answered answers again.

Making one takes longer than most questions do (DuckDB enters thousands of functions into a catalogue), so the last is
kept for the next snapshot on the same store. No snapshot finds anything of another: what is temporary or registered goes
with the question's cursor, its views are dropped, its settings reset, and one that failed, or that was so large that it
wrote to the disk, is not kept at all.
"""

from __future__ import annotations

import os
import re
import secrets
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sierra.store.scans import steady


class Connection:
    """A cursor on a DuckDB of its own, which may read some folders and nothing else; for one snapshot at a time."""

    def __init__(self, *folders: Path) -> None:
        self._folders = tuple(steady(f"{folder}/") for folder in folders)
        kept = _idle.pop(os.getpid(), None)
        if kept is not None and kept[0] != self._folders:
            kept[1].close()
            kept = None
        self._database = _locked(self._folders) if kept is None else kept[1]
        self._settings: list[str] = []
        self.cursor = self._database.cursor()

    def note(self, statement: str) -> None:
        """A statement is about to be executed; if it sets something, that is reset in the end."""
        if setting := re.match(r"SET (\w+)", statement):
            self._settings.append(setting[1])

    def keep(self, views: Iterable[str]) -> None:
        """Close the cursor, and keep its DuckDB for the next snapshot, emptied of these views."""
        import duckdb

        try:
            for statement in (*(f"DROP VIEW {view}" for view in views), *(f"RESET {name}" for name in self._settings)):
                self.cursor.execute(statement)
            [(spilled,)] = self.cursor.execute("SELECT current_setting('temp_directory')").fetchall()
        except duckdb.Error:
            self.close()
            return
        self.cursor.close()
        absolute = all(Path(folder).is_absolute() for folder in self._folders)
        if absolute and not Path(spilled).exists() and os.getpid() not in _idle:
            _idle[os.getpid()] = (self._folders, self._database)
        else:
            self._database.close()

    def close(self) -> None:
        self.cursor.close()
        self._database.close()


_idle: dict[int, tuple[tuple[str, ...], Any]] = {}
"""By process, as what another has forked from has threads that are not there: folders, and the DuckDB that may read them."""


def _locked(folders: tuple[str, ...]) -> Any:
    database = connect()
    database.execute("SET allowed_directories = $folders", {"folders": list(folders)})
    database.execute("SET enable_external_access = false")
    return database


def connect() -> Any:
    """A DuckDB connection in memory that never reaches for the network."""
    import duckdb

    return duckdb.connect(
        ":memory:",
        config={
            "autoinstall_known_extensions": "false",
            "autoload_known_extensions": "false",
            # DuckDB allows to read what lies there, so it is nobody's; made and removed where it is needed.
            "temp_directory": steady(str(Path(tempfile.gettempdir(), f"sierra-{secrets.token_hex(8)}"))),
            "python_enable_replacements": "false",
        },
    )
