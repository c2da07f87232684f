"""The records of sequential studies: their ids, and the looks that count."""

from __future__ import annotations

import json
from collections.abc import Iterable
from enum import StrEnum

from sierra.store.row_types import LookIntervalRow, LookRow, StudyRow
from sierra.store.store import Store
from sierra.util.hashing import digest
from sierra.util.json_types import JsonView


class Decision(StrEnum):
    """The decision of a look."""

    reached = "reached"
    more = "continue"
    missed = "not reached"
    """At the last look."""
    stopped = "stopped"
    """The look shows nothing about the rule, so that it may be repeated."""


IDENTIFYING = ("batch", "rule", "schedule", "alpha", "correction")
"""The columns of a study that its id is made from."""
DECIDED = ("study", "number", "batch", "runs", "level", "decision", "reason")
"""The columns of a look that its id is made from, besides its intervals."""
LOOKS = """
SELECT * FROM looks WHERE study = $study
QUALIFY row_number() OVER (PARTITION BY number ORDER BY decision = 'stopped', lamport, decided) = 1 ORDER BY number
"""
"""One look of each number: the first that decided. Two processes may have made the same one."""
INTERVALS = """
SELECT DISTINCT * FROM look_intervals WHERE list_contains($looks, look) ORDER BY look, condition, ordinal
"""


def study_id(row: StudyRow) -> str:
    """Return the id that follows from a study's columns."""
    return digest("study", {name: getattr(row, name) for name in IDENTIFYING})


def look_id(row: LookRow, intervals: Iterable[LookIntervalRow]) -> str:
    """Return the id that follows from a look's columns and its intervals."""
    fields: dict[str, JsonView] = {name: getattr(row, name) for name in DECIDED}
    listed = [list(one[1:]) for one in sorted(intervals, key=lambda one: (one.condition, one.ordinal))]
    return digest("look", {**fields, "intervals": listed})


def find(store: Store, study: str) -> StudyRow | None:
    """Return a recorded study."""
    rows = store.select(StudyRow, "SELECT * FROM studies WHERE study = $study ORDER BY lamport LIMIT 1", study=study)
    return rows[0] if rows else None


def looks(store: Store, study: str) -> list[LookRow]:
    """Return the looks of a study that count, in their order."""
    return store.select(LookRow, LOOKS, study=study)


def intervals(store: Store, looks: Iterable[LookRow]) -> dict[str, list[LookIntervalRow]]:
    """Return the intervals of looks, by look."""
    found: dict[str, list[LookIntervalRow]] = {look.look: [] for look in looks}
    for row in store.select(LookIntervalRow, INTERVALS, looks=list(found)):
        found[row.look].append(row)
    return found


def schedule(row: StudyRow) -> list[int]:
    """Return the numbers of runs per experiment at the looks of a study."""
    found: list[int] = json.loads(row.schedule)
    return found
