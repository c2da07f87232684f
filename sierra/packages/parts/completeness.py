"""Notes on packed batches and studies that are not complete. This part has no members."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from sierra.packages.subject import Made, Member, Subject
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


def members(subject: Subject, found: Mapping[str, Member]) -> Made:
    """Return no members, but a fact for each batch without some results, and a note for each study without some looks."""
    batches = subject.store.select(_Batch, BATCHES)
    facts = (
        f"batch {short(one.batch)}: {one.runs - one.successful:,} of {counted(one.runs, 'run')} without a successful execution"
        for one in batches
    )
    studies = subject.store.select(_Study, LOOKS)
    notes = (
        f"study {short(one.study)}: {one.looks - one.packed} of {counted(one.looks, 'look')} not packed; name their batches too"
        for one in studies
    )
    return Made((), notes=tuple(notes), facts=tuple(facts))
