"""Rewritten rows of the records whose ids follow from their columns: environments, sources, isolations and sets of files.

Names of hosts and folders are replaced by pseudonyms, the same one for the same name everywhere in a store.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from itertools import groupby
from operator import attrgetter
from pathlib import PurePosixPath
from typing import Any, TypeVar

from sierra.ingest.observations import file_set
from sierra.model import REDACTED
from sierra.provenance import environment, source
from sierra.store.row_types import TABLES, EnvironmentRow, FileReadRow, IsolationRow, SourceRow
from sierra.store.store import Snapshot
from sierra.util.hashing import digest
from sierra.util.lazy_definitions import regex

HIDDEN = "redacted"
SYSTEM = regex(r"/(usr|lib|lib32|lib64|libx32|bin|sbin|etc|proc|sys|dev)(/|\Z)")
"""Folders that belong to the operating system."""
PLACEHOLDERS = regex(r"\{(project|prefix|gpu|run|mount)\}(/|\Z)")
"""The beginnings of paths in folders that the records name no further."""
ROBOT = regex(r"\{robot ([^}]*)\}")
"""The beginning of the name of a file on a robot."""
LOCAL = regex(r"LANG|LANGUAGE|LC_.*|TZ")
"""Environment variables that show where somebody lives."""
LEFT_OUT = "redacted: files outside the project and the operating system are not listed"
LOADED = ("executed", "read", "linked")
"""The uses of files that are named wherever they were; of other uses, only files of the project and the system."""
HOSTS = """
SELECT host FROM executions UNION SELECT host FROM environments UNION SELECT host FROM builds UNION SELECT node FROM attempts
UNION SELECT host FROM robots WHERE host IS NOT NULL
"""
ROBOTS = r"""
SELECT robot FROM robots UNION
SELECT regexp_extract(path, '^\{robot ([^}]*)\}', 1) FROM files_read WHERE starts_with(path, '{robot ')
"""
ATTEMPTS = """
SELECT attempt FROM attempts UNION SELECT attempt FROM duplicates
UNION SELECT attempt FROM executions WHERE attempt IS NOT NULL
"""
PACKAGES = "SELECT package FROM imports UNION SELECT unnest(packages) FROM imported_sessions"
PATHS = """
SELECT name FROM programs UNION SELECT name FROM unused_changes UNION SELECT path FROM programs WHERE path IS NOT NULL
UNION SELECT path FROM files_read UNION SELECT path FROM files_written UNION SELECT name FROM channels
UNION SELECT path FROM stale_sessions UNION SELECT file FROM images WHERE file IS NOT NULL
"""
FILES = "SELECT DISTINCT * FROM files_read ORDER BY files, path, use, sha256"
R = TypeVar("R", EnvironmentRow, SourceRow, IsolationRow)
Row = dict[str, Any]


class Pseudonyms:
    """Names by number, in the order of the sorted originals."""

    def __init__(self, form: str, originals: Iterable[str]) -> None:
        self._names = {name: form.format(number) for number, name in enumerate(sorted(set(originals)), 1)}

    def __call__(self, original: str) -> str:
        return self._names[original]


class RowRedactor:
    """The rewritten rows of a store, and their ids by the original ids."""

    def __init__(self, snapshot: Snapshot) -> None:
        self.host = Pseudonyms("host-{}", snapshot.values(str, HOSTS))
        self.robot = Pseudonyms("robot-{}", snapshot.values(str, ROBOTS))
        self.package = Pseudonyms("package-{}", snapshot.values(str, PACKAGES))
        self.attempt = Pseudonyms("attempt-{}", snapshot.values(str, ATTEMPTS))
        paths = (_on_robot(part)[1] for path in snapshot.values(str, PATHS) for part in path.split(":"))
        self._folder = Pseudonyms(f"{REDACTED}{{}}", (_folder(path) for path in paths if not _is_general(path)))
        self._environments = _by_id(snapshot, EnvironmentRow, self._environment)
        self._sources = _by_id(snapshot, SourceRow, _source)
        self._isolations = _by_id(snapshot, IsolationRow, _isolation)
        self._listings: set[str] = set()
        self._reduced: set[str] = set()
        self._files: dict[str, str] = {}
        for identity, rows in groupby(snapshot.select(FileReadRow, FILES), attrgetter("files")):
            self._add_set(identity, list(rows))
        self.by_table: Mapping[str, Callable[[Row], Row | None]] = {
            "environments": lambda row: self._environments[row["environment"]]._asdict(),
            "sources": lambda row: self._sources[row["source"]]._asdict(),
            "isolations": lambda row: self._isolations[row["isolation"]]._asdict(),
            "observations": self._observation,
            "files_read": self._file,
            "listings": lambda row: row if row["sha256"] in self._listings else None,
        }
        """The function that rewrites a row of a table; it returns None for a row that is left out."""

    def environment(self, identity: str) -> str:
        return self._environments[identity].environment if identity in self._environments else identity

    def source(self, identity: str) -> str:
        return self._sources[identity].source if identity in self._sources else identity

    def isolation(self, identity: str) -> str:
        return self._isolations[identity].isolation if identity in self._isolations else identity

    def place(self, path: str) -> str:
        """Return a path, or several separated by colons, with pseudonyms for folders that may identify.

        The last part stays, because programs are identified by it.
        """
        return ":".join(self._robot_of(robot) + self._place(part) for robot, part in map(_on_robot, path.split(":")))

    def _place(self, path: str) -> str:
        return path if _is_general(path) else f"{self._folder(_folder(path))}/{_name(path)}"

    def _robot_of(self, name: str | None) -> str:
        return "" if name is None else f"{{robot {self.robot(name)}}}"

    def _environment(self, row: EnvironmentRow) -> EnvironmentRow:
        row = row._replace(
            host=self.host(row.host),
            container=row.container and HIDDEN,
            locale=None,
            timezone=None,
            modules=[HIDDEN] if row.modules else [],
            variables=_variables(row.variables),
            workspaces=row.workspaces and HIDDEN,
        )
        return row._replace(environment=environment.identity(row._asdict()))

    def _add_set(self, identity: str, rows: list[FileReadRow]) -> None:
        """Remember the new id of a set of files, and the listings that it needs."""
        kept = [redacted for row in rows if (redacted := self._file_read(row)) is not None]
        if len(kept) < len(rows):
            self._reduced.add(identity)
        self._listings.update(redacted.sha256 for redacted in kept if redacted.use == "listed" and redacted.sha256 is not None)
        self._files[identity] = file_set(redacted[1:] for redacted in kept)

    def _file_read(self, row: FileReadRow) -> FileReadRow | None:
        if not _is_general(_on_robot(row.path)[1]) and row.use not in LOADED:
            return None
        return row._replace(path=self.place(row.path), sha256=None if row.use == "link" else row.sha256)

    def _file(self, row: Row) -> Row | None:
        kept = self._file_read(FileReadRow(**row))
        return None if kept is None else {**kept._asdict(), "files": self._files[row["files"]]}

    def _observation(self, row: Row) -> Row:
        reason = row["reason"] or (LEFT_OUT if row["files"] in self._reduced else None)
        return {**row, "files": self._files.get(row["files"], row["files"]), "reason": reason}


def _by_id(snapshot: Snapshot, kind: type[R], change: Callable[[R], R]) -> dict[str, R]:
    return {row[0]: change(row) for row in snapshot.select(kind, f"SELECT * FROM {TABLES[kind]}")}  # noqa: S608 - our own name


def _source(row: SourceRow) -> SourceRow:
    """Return a source without its repository: its files are in the store, as those of a project outside git."""
    row = SourceRow(row.source, row.tree, "none", None, None, None, None, None, None, None, row.files)
    return row._replace(source=digest("source", _fields(row, source.RECORDED)))


def _isolation(row: IsolationRow) -> IsolationRow:
    mounts = row.mounts and json.dumps(dict.fromkeys(json.loads(row.mounts), HIDDEN), sort_keys=True)
    row = row._replace(user=row.user and HIDDEN, mounts=mounts, argv=[HIDDEN])
    return row._replace(isolation=digest("isolation", _fields(row, IsolationRow._fields[1:])))


def _fields(row: EnvironmentRow | SourceRow | IsolationRow, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(row, name) for name in names}


def _variables(text: str) -> str:
    """Return environment variables as JSON without values that contain paths, or that show where somebody lives."""
    variables = json.loads(text or "{}")
    kept = {name: HIDDEN if "/" in value or LOCAL.fullmatch(name) else value for name, value in variables.items()}
    return json.dumps(kept, sort_keys=True)


def _on_robot(path: str) -> tuple[str | None, str]:
    """Return the robot on which a file is, None for this machine, and the rest of its name."""
    match = ROBOT.match(path)
    return (match[1], path[match.end() :]) if match else (None, path)


def _is_general(path: str) -> bool:
    """Return whether a path shows nothing about a machine: it is in the project, or of the operating system."""
    if ".." in PurePosixPath(path).parts:
        return False
    relative = not path.removeprefix("@").startswith(("/", "{"))
    return relative or PLACEHOLDERS.match(path) is not None or SYSTEM.match(path) is not None


def _folder(path: str) -> str:
    return path.rpartition("/")[0]


def _name(path: str) -> str:
    return path.rpartition("/")[2]
