"""Sets of files that observed executions used, as the store has them.

The sets of a batch share most of their files. Therefore each file is read once (`FileSets.files`), and the files of single sets
only where something depends on the whole set.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import NamedTuple

from sierra.execution.observation.current_files import Current, located
from sierra.store.store import Snapshot
from sierra.util.lazy_definitions import dataclass

PROJECT = "{project}"
TABLES = ("executions", "observations", "files_read", "listings", "files_written", "environments")
NAMES = "SELECT DISTINCT files FROM files_read SEMI JOIN needed USING (files)"
FILES = "SELECT DISTINCT path, use, sha256 FROM files_read SEMI JOIN needed USING (files) ORDER BY ALL"
MEMBERS = """
SELECT files, path, use, sha256 FROM files_read SEMI JOIN needed USING (files) SEMI JOIN asked USING (files) ORDER BY ALL
"""
HAVING = """
SELECT f.files, f.path, f.use, f.sha256 FROM files_read f SEMI JOIN needed USING (files)
JOIN asked a ON a.path = f.path AND a.use = f.use AND a.sha256 IS NOT DISTINCT FROM f.sha256 ORDER BY ALL
"""
LISTINGS = "SELECT sha256, names FROM listings WHERE sha256 IN (SELECT sha256 FROM files_read SEMI JOIN needed USING (files))"
WRITTEN = """
SELECT DISTINCT path FROM files_written
WHERE execution IN (SELECT execution FROM observations SEMI JOIN needed USING (files))
"""
SEARCHED = """
SELECT DISTINCT o.files, json_extract_string(v.variables, '$.PATH') AS search
FROM observations o SEMI JOIN needed USING (files) JOIN executions e USING (execution) JOIN environments v USING (environment)
"""


class UsedFile(NamedTuple):
    """A file that an execution used, and how."""

    path: str
    use: str
    """As in the table `files_read`."""
    sha256: str | None

    @property
    def is_in_project(self) -> bool:
        return self.path == PROJECT or self.path.startswith(f"{PROJECT}/")


class _Member(NamedTuple):
    files: str
    path: str
    use: str
    sha256: str | None


class _Listing(NamedTuple):
    sha256: str
    names: list[str]


class _Search(NamedTuple):
    files: str
    search: str | None


@dataclass(frozen=True, slots=True)
class FileSets:
    """Some of the sets in a snapshot of the store; only one such object of a snapshot can be used at a time."""

    snapshot: Snapshot
    names: frozenset[str]
    """The ids of the sets that have files."""
    files: tuple[UsedFile, ...]
    """The files of all sets, each once."""
    listings: Mapping[str, frozenset[str]]
    """The names in listed folders, by the SHA-256 of the listing."""
    written: frozenset[str]
    """Files that the executions have written themselves; they are in no listing."""

    def members(self, names: Iterable[str]) -> dict[str, list[UsedFile]]:
        """Return the files of these sets."""
        wanted = sorted(names)
        if not wanted:
            return {}
        self.snapshot.add_table("asked", files=wanted)
        return _by_set(self.snapshot.select(_Member, MEMBERS))

    def having(self, files: Collection[UsedFile]) -> dict[str, list[UsedFile]]:
        """Return the sets that have any of these files, with those that they have."""
        if not files:
            return {}
        paths, uses, digests = zip(*files, strict=True)
        self.snapshot.add_table("asked", path=paths, use=uses, sha256=digests)
        return _by_set(self.snapshot.select(_Member, HAVING))

    def searched(self) -> dict[str, set[str | None]]:
        """Return the search paths (PATH) of the executions, by set; None for an unknown one."""
        found: dict[str, set[str | None]] = {}
        for one in self.snapshot.select(_Search, SEARCHED):
            found.setdefault(one.files, set()).add(one.search)
        return found


def load(snapshot: Snapshot, names: Iterable[str]) -> FileSets:
    """Return the sets with these ids."""
    snapshot.views.make(TABLES)
    snapshot.add_table("needed", files=sorted(names))
    return FileSets(
        snapshot,
        frozenset(snapshot.values(str, NAMES)),
        tuple(snapshot.select(UsedFile, FILES)),
        {listing.sha256: frozenset(listing.names) for listing in snapshot.select(_Listing, LISTINGS)},
        frozenset(snapshot.values(str, WRITTEN)),
    )


def located_paths(files: Iterable[UsedFile], current: Current, *uses: str) -> Iterator[str]:
    """Yield where the files with these uses are now, as far as that is known."""
    for one in files:
        if one.use in uses and (here := located(one.path, current.folders)) is not None:
            yield here


def _by_set(members: Iterable[_Member]) -> dict[str, list[UsedFile]]:
    found: dict[str, list[UsedFile]] = {}
    for files, *file in members:
        found.setdefault(files, []).append(UsedFile._make(file))
    return found
