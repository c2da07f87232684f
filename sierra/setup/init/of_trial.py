"""Settings that a tried run shows: tables that need a declaration, files that it lacks, columns of 0 and 1."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config.output_tables import ROTATION, Key, with_rotation
from sierra.ingest import open_names
from sierra.model import Status
from sierra.setup.init import folder, named_files
from sierra.store.layout import RUN_STDERR, RUN_STDOUT
from sierra.util.text import numbered

if TYPE_CHECKING:
    from sierra.config.output_tables import Keys
    from sierra.execution.trial import Trial, TriedFile
    from sierra.setup.init.write import Guess

LOGS = (RUN_STDERR, RUN_STDOUT)
LAST = 1 << 14
"""The number of bytes at the end of a log that are searched for the names of files."""
RATES, TIME, RAGGED = "rates", "time", "mismatch"


def with_outputs(guess: Guess, tried: Trial) -> Guess | None:
    """Return the guess with the keys that read the tables of a run, as it is to be tried again; None if it needs none.

    These tables are not plain ones: of some, no run would make a table, or a run would fail because of them.
    """
    added: dict[str, Keys] = {}
    declared = {keys["file"] for keys in guess.outputs.values()}
    for unread in tried.unread:
        if unread.keys and unread.path not in declared:
            path, name = str(unread.keys["file"]), unread.name
            if pattern := open_names.with_date(path) or open_names.with_values(path, tried.seed, tried.values.values()):
                path, name = pattern, open_names.name_of(pattern)
            added[name] = {**unread.keys, "file": path}
    tables = [table for table in tried.files if table.table and table.table not in guess.outputs]
    of_robots = open_names.of_robots({table.path: tuple(table.columns) for table in tables})
    for table in tables:
        of_robot = of_robots.get(table.path)
        name = open_names.name_of(of_robot) if of_robot else str(table.table)
        if (of_robot or table.keys) and name not in added:
            added[name] = {"file": of_robot or table.path, **table.keys}
    return replace(guess, outputs={**guess.outputs, **added}) if added else None


def with_lacking(root: Path, guess: Guess, tried: Trial) -> Guess | None:
    """Return the guess with the files that a failed run lacked beside its input; None if it names none of the project."""
    log = "\n".join(_end(tried.folder / name) for name in LOGS) if tried.folder else ""
    known = (*guess.files, *guess.template_paths)
    lacking = named_files.lacking(root.resolve(), log, known, tuple(folder.INTERPRETERS))
    return replace(guess, files=(*guess.files, *lacking)) if lacking else None


def with_findings(guess: Guess, first: Trial, second: Trial | None = None) -> Guess:
    """Return the guess with the declarations that tables need although they are read: patterns, times, rates.

    `second` is a run with another seed. One run alone shows dates in names only.
    """
    outputs = dict(guess.outputs)
    names: dict[str, str] = {}
    open_files = _patterns(first, second)
    for file in first.files:
        if file.table is None or file.table in names.values():
            continue
        is_open = "*" in str(outputs.get(file.table, {}).get("file", ""))
        pattern = None if is_open else open_files.get(file.path)
        name = file.table
        if pattern and not pattern.endswith(ROTATION) and pattern not in names:
            name = next(free for free in numbered(open_names.name_of(pattern)) if free not in outputs)
        name = names.setdefault(pattern or name, name)
        declared = outputs.get(name, {})
        keys = {**_keys_of(file, second, open_files, has_events="rows" in declared and not file.time), **declared}
        if pattern or keys:
            outputs[name] = {"file": pattern or file.path, **keys}
    return replace(guess, outputs=outputs)


def _keys_of(file: TriedFile, second: Trial | None, patterns: Mapping[str, str], *, has_events: bool) -> dict[str, Key]:
    """Return the keys of a table that rows show: the time if no rule finds it, and rates, and another number of rows.

    `has_events`: each element of a list is an event, so that their number differs between runs.
    """
    from sierra.store.time_axis import names_time

    keys: dict[str, Key] = {}
    if file.time and not (names_time(file.time) and file.time == next(iter(file.columns))):
        keys |= {TIME: file.time}
    other = _other(file, second, patterns)
    if other is not None:
        rates = [name for name, value in other.flags.items() if file.flags.get(name) == 1 - value]
        keys |= {RATES: rates} if rates else {}
        has_events |= (file.rows, list(file.columns)) != (other.rows, list(other.columns))
    return keys | ({RAGGED: "ragged"} if has_events else {})


def _other(file: TriedFile, second: Trial | None, patterns: Mapping[str, str]) -> TriedFile | None:
    """Return the table of the second run that belongs to one of the first."""
    own = patterns.get(file.path, file.path)
    others = second.files if second is not None and second.status is Status.OK else ()
    same = [other for other in others if other.table and patterns.get(other.path, other.path) == own]
    return next((other for other in same if other.table == file.table or file.path in patterns), None)


def _patterns(first: Trial, second: Trial | None) -> dict[str, str]:
    """Return the patterns for tables of rotated files, and of files with another name in each run, by path."""
    runs = [[file.path for file in trial.files if file.table] for trial in (first, second) if trial is not None]
    found = {path: with_rotation(path, (file.path for file in first.files)) for path in runs[0]}
    found |= {path: open_names.with_date(path) or found[path] for path in runs[0] if second is None}
    found |= open_names.patterns(runs)
    return {path: pattern for path, pattern in found.items() if pattern != path}


def _end(log: Path) -> str:
    """Return the last words that a program printed."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LAST))
            return file.read().decode("utf-8", "replace")
    except OSError:
        return ""
