"""Executions on which remarks are lost: they do not count until somebody judges them again.

Remarks that an execution does not count (tables `trials` and `findings`) take a success back. If the file with them is damaged,
nobody knows which executions it named. So each success of its batch gets a new remark: it is kept, and it does not count.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from datetime import UTC, datetime
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from sierra.store import session_numbers
from sierra.store.lamport_clock import stamp
from sierra.store.layout import StorePaths
from sierra.store.row_types import TrialRow
from sierra.store.segments import MANIFEST, SUFFIX, Segment
from sierra.store.store import Snapshot

REMARKS = ("findings", "trials")
"""The tables of remarks that take back successes of executions."""
REASON = "remarks on executions of its batch were lost in a damaged file"
SUCCESSES = """
SELECT batch, execution FROM executions
WHERE status IN ('ok', 'accepted') AND purpose = 'run' AND (
    batch[:12] IN (SELECT value FROM doubtful)
    OR run IN (SELECT run FROM batch_runs WHERE batch[:12] IN (SELECT value FROM doubtful))
) ORDER BY ALL
"""
"""SQL: the successful executions of batches, and of their runs in other batches, by the beginnings of the batches' ids."""
LAST = "SELECT * FROM trials WHERE list_contains($executions, execution)"


class Doubtful(NamedTuple):
    """A successful execution on which a remark may be lost."""

    batch: str
    execution: str


def doubtful(paths: StorePaths, sound: Sequence[Segment], broken: Mapping[str, AbstractSet[str]]) -> list[Doubtful]:
    """Return the successful executions of batches of which a file with remarks is lost, by batch.

    `sound` are all segments with their sound files, `broken` the names of lost files by segment.
    """
    batches = {part.batch for part in sound if _has_lost(paths.segments / part.name, broken.get(part.name, frozenset()))}
    if not batches:
        return []
    with Snapshot(paths.root, sound) as snapshot:
        snapshot.add_table("doubtful", value=sorted(batches))
        return snapshot.select(Doubtful, SUCCESSES)


def _has_lost(folder: Path, broken: AbstractSet[str]) -> bool:
    """Check if a segment has lost remarks. Without its MANIFEST, no file in it is sound."""
    files = [f"{name}{SUFFIX}" for name in REMARKS]
    return any(file in broken or (MANIFEST in broken and (folder / file).exists()) for file in files)


def by_batch(found: Iterable[Doubtful]) -> Iterator[tuple[str, list[str]]]:
    """Yield the batches, each with its executions."""
    for batch, members in groupby(found, key=attrgetter("batch")):
        yield batch, [one.execution for one in members]


def remarks(root: Path, sound: Sequence[Segment], executions: Sequence[str], session: str) -> list[TrialRow]:
    """Return a remark on each execution: it does not count. It is later than all sound records, and repeats the last remark."""
    with Snapshot(root, sound) as snapshot:
        last = {row.execution: row for row in snapshot.select(TrialRow, LAST, executions=list(executions))}
        lamport = stamp(session_numbers.highest_of(snapshot, sound) + 1, session)
    now = datetime.now(UTC)
    return [
        last.get(execution, TrialRow(execution, now, None))._replace(marked=now, valid=False, reason=REASON, lamport=lamport)
        for execution in executions
    ]
