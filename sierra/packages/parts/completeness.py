"""Notes on packed batches and studies that are not complete. This part has no members."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from sierra.packages.subject import Member, PartResult, Subject
from sierra.util.hashing import short
from sierra.util.text import counted

BATCHES = """
SELECT m.batch, count(DISTINCT m.run) AS runs, count(DISTINCT f.run) FILTER (f.outcome = 'success') AS successful
FROM batch_runs m LEFT JOIN effective f ON f.run = m.run AND f.batch = m.batch
GROUP BY m.batch HAVING runs > successful ORDER BY m.batch
"""
LOOKS = "SELECT study, count(*) AS packed, max(number) AS looks FROM looks GROUP BY study HAVING looks > packed ORDER BY study"


class _Batch(NamedTuple):
    batch: str
    runs: int
    successful: int


class _Study(NamedTuple):
    study: str
    packed: int
    looks: int
    """The number of the last packed look."""


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return no members, but a fact for each batch without some results, and a note for each study without some looks."""
    batches = subject.store.select(_Batch, BATCHES)
    facts = (
        f"batch {short(row.batch)}: {row.runs - row.successful:,} of {counted(row.runs, 'run')} without a successful execution"
        for row in batches
    )
    studies = subject.store.select(_Study, LOOKS)
    notes = (
        f"study {short(row.study)}: {row.looks - row.packed} of {counted(row.looks, 'look')} not packed; name their batches too"
        for row in studies
    )
    return PartResult((), notes=tuple(notes), facts=tuple(facts))
