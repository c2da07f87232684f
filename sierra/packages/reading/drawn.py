"""The figures, tables and videos in a package, as they were made: a list of them, and their files, of which each is checked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from sierra.errors import NotFound
from sierra.packages.archive import Archive
from sierra.packages.layout import DRAWN
from sierra.packages.reading.received import Received
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import like

RECORDED = """
SELECT DISTINCT unnest(sha256s) AS sha256, kind, name, batch FROM deliverables
ORDER BY sha256, name, kind, batch
"""
UNKNOWN = "not recorded"
"""The kind of files that no record of the package knows."""


class _File(NamedTuple):
    sha256: str
    kind: str
    name: str
    batch: str


@dataclass(frozen=True, slots=True)
class Drawn:
    """A figure, table or video of a package."""

    name: str
    kind: str
    """`figure`, `comparison`, …, or `not recorded`."""
    batch: str
    """The id of its batch; "" if it is not recorded."""
    files: tuple[str, ...]
    """The names of its members."""


def find(package: Received, names: Sequence[str] = (), kind: str = "") -> list[Drawn]:
    """Return the figures, tables and videos of a package: those with these names, by default all. Raises NotFound for another.

    `kind`: only those of this kind.
    """
    known = {row.sha256: row for row in package.store.select(_File, RECORDED)}
    grouped: dict[tuple[str, str, str], list[str]] = {}
    with Archive(package.path) as archive:
        for member in archive.names(DRAWN):
            row = known.get(archive.hashes[member])
            key = (row.batch, row.name, row.kind) if row else ("", PurePosixPath(member).stem, UNKNOWN)
            grouped.setdefault(key, []).append(member)
    drawn = [Drawn(name, of, batch, tuple(files)) for (batch, name, of), files in grouped.items() if kind in ("", of)]
    for name in names:
        if name not in (has := sorted({figure.name for figure in drawn})):
            raise NotFound(f"the package has no {kind or 'figure'} {name!r}; {like(name, has) if has else 'it has none'}")
    return [figure for figure in drawn if not names or figure.name in names]


def write(package: Received, drawn: Sequence[Drawn], folder: Path) -> list[Path]:
    """Write the files of figures below `folder`. Raises UsageError for a file that exists, Damaged for one that was changed."""
    with Archive(package.path) as archive:
        return archive.extract([file for one in drawn for file in one.files], folder)
