"""Differences of the files that observed executions used: programs, libraries, data, and names that they looked for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from sierra.errors import Damaged, NotFound
from sierra.explain.diff.load_sides import ComparedRuns
from sierra.explain.diff.model import Difference
from sierra.provenance import source
from sierra.store.store import Snapshot, Store
from sierra.util.text import few

NAMED = 4


class _Used(NamedTuple):
    path: str
    use: str
    contents: list[str]


USED = """
SELECT f.path, f.use, list_sort(list(DISTINCT coalesce(f.sha256, ''))) AS contents
FROM {table} t JOIN observations o ON o.execution = t.own JOIN files_read f USING (files)
WHERE f.use IN ('executed', 'read') GROUP BY ALL
"""
OBSERVED = "SELECT 1 FROM {table} t JOIN observations o ON o.execution = t.own WHERE o.reason IS NULL LIMIT 1"


def is_known(snapshot: Snapshot, side: ComparedRuns) -> bool:
    """Check whether an execution of this side was observed completely."""
    if not snapshot.holds("observations"):
        return False
    snapshot.views.make(("observations", "files_read"))
    return bool(snapshot.run(OBSERVED.format(table=side.table)))


def files(snapshot: Snapshot, store: Store, before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield the difference of the files that the executions of two sides executed or read; at most one.

    Files in which the sources differ are left out: they are reported as such.
    """
    was, now = (
        {row.path: row.contents for row in snapshot.select(_Used, USED.format(table=side.table))} for side in (before, after)
    )
    known = _of_source(store, before, after)
    groups = {
        "other content": {path for path in was.keys() & now.keys() if was[path] != now[path]} - known,
        "only used before": was.keys() - now.keys() - known,
        "only used after": now.keys() - was.keys() - known,
    }
    parts = list(_parts(groups))
    if parts:
        yield Difference("files", "used", "files that executions used: " + "; ".join(parts))


def _of_source(store: Store, before: ComparedRuns, after: ComparedRuns) -> set[str]:
    """Return the names of the files in which the sources of two sides differ; none if that is unknown."""
    if before.source is None or after.source is None:
        return set()
    try:
        manifests = [store.object(side.source.files) for side in (before, after) if side.source is not None]
        return {f"{{project}}/{path}" for path in source.changed(*manifests)}
    except (NotFound, Damaged):
        return set()


def _parts(groups: Mapping[str, Iterable[str]]) -> Iterator[str]:
    for what, paths in groups.items():
        if names := sorted(paths):
            yield f"{what}: {few(names, NAMED)}"
