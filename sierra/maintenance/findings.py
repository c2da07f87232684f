"""Problems that a check of the store can find, and the records that they affect."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import StrEnum

from sierra.store.store import Snapshot
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import counted, spans


class Kind(StrEnum):
    """The kinds of findings, the worst first; those from `DEAD` on are not faults and are only reported."""

    DAMAGED = "damaged"
    """A file has other bytes than were written, or cannot be read."""
    ABSENT = "absent"
    """A file is missing."""
    INCONSISTENT = "inconsistent"
    """A record's id does not follow from its content, or the record contradicts another."""
    LOST = "lost"
    """A record refers to something that is not in the store."""
    STRAY = "stray"
    """The store contains something that does not belong to a store."""
    UNRECORDED = "unrecorded"
    """A session cannot be recorded, and was moved to `damaged/`."""
    GONE = "gone"
    """A recorded source is no longer in git: nothing here is damaged, but its runs cannot be replayed here."""
    UNCHECKED = "unchecked"
    """It may not be read or locked by this user, or cannot be for lack of something: nobody knows if it is sound."""
    DEAD = "dead"
    """A session died; `sierra run` or `sierra gc` finishes it."""
    LEFT = "left over"
    """Nothing needs it any more; `sierra gc` removes it."""
    FOREIGN = "foreign"
    """SIERRA did not make it, and leaves it alone."""
    UNKNOWN = "unknown"
    """The environment of executions is not recorded: their session was killed before its end."""

    @property
    def fine(self) -> bool:
        return self in (Kind.DEAD, Kind.LEFT, Kind.FOREIGN, Kind.UNKNOWN)

    @property
    def wrong(self) -> bool:
        """True if something is wrong with the store itself."""
        return not self.fine and self is not Kind.UNCHECKED

    @property
    def repairable(self) -> bool:
        return self.wrong and self not in (Kind.UNRECORDED, Kind.GONE)


@dataclass(frozen=True, slots=True)
class Affected:
    """The part of the record that a finding affects."""

    batches: tuple[str, ...] = ()
    experiments: tuple[str, ...] = ()
    runs: tuple[str, ...] = ()
    executions: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    text: str = ""


NOTHING = Affected()


@dataclass(frozen=True, slots=True)
class Finding:
    """One problem: its place (a path in the store, or the table that shows it), and its description."""

    kind: Kind
    path: str
    what: str
    affected: Affected = field(default=NOTHING)

    def __str__(self) -> str:
        problem = f"{self.kind}: {self.path}: {self.what}"
        return f"{problem}: {self.affected.text}" if self.affected.text else problem


SHOWN = 3
"""The largest number of batches, and of experiments of each batch, that a line names."""
PLACES = """
SELECT DISTINCT m.batch, x.experiment, m.ordinal, m.number, m.run
FROM batch_runs m LEFT JOIN experiments x USING (batch, ordinal) JOIN concerned c ON c.run = m.run
ORDER BY m.batch, m.ordinal, m.number
"""


def of(snapshot: Snapshot, executions: Iterable[str] = (), runs: Iterable[str] = (), batches: Iterable[str] = ()) -> Affected:
    """Return the runs, experiments and batches that these executions, runs and batches belong to, and a text about them."""
    ended = sorted(set(executions))
    snapshot.views.make(("batch_runs", "experiments", "batches", "all_judgements", "all_artifacts"))
    snapshot.add_table("named", execution=ended)
    rows = snapshot.run(
        "SELECT DISTINCT run FROM all_judgements e SEMI JOIN named n ON n.execution = e.judgement UNION "
        "SELECT DISTINCT run FROM all_artifacts SEMI JOIN named USING (execution)"
    )
    concerned = sorted({*runs, *(row[0] for row in rows if row[0] is not None)})
    snapshot.add_table("concerned", run=concerned)
    places = snapshot.run(PLACES)
    named = sorted({*batches, *(row[0] for row in places)})
    return Affected(
        tuple(named),
        tuple(dict.fromkeys(row[1] for row in places if row[1])),
        tuple(concerned),
        tuple(ended),
        text=_text(snapshot, named, places, len(ended), len(concerned)),
    )


def _text(
    snapshot: Snapshot, batches: Sequence[str], places: Sequence[tuple[str, str, int, int, str]], ended: int, runs: int
) -> str:
    count = counted(ended, "execution") if ended else counted(runs, "run") if runs else ""
    parts = []
    for batch in batches[:SHOWN]:
        where = _experiments(snapshot, batch, [row for row in places if row[0] == batch])
        parts.append(f"batch {short(batch)}{f' ({where})' if where else ''}")
    if len(batches) > SHOWN:
        parts.append(f"{len(batches) - SHOWN} more batches")
    return " of ".join(filter(None, (count, ", ".join(parts))))


def _experiments(snapshot: Snapshot, batch: str, places: Sequence[tuple[str, str, int, int, str]]) -> str:
    numbers: dict[int, list[int]] = {}
    for _, _, ordinal, number, _ in places:
        numbers.setdefault(ordinal, []).append(number)
    values = _values(snapshot, batch) if numbers else {}
    texts = [f"{values.get(ordinal, f'experiment {ordinal}')}: {_ranges(repeats)}" for ordinal, repeats in numbers.items()]
    more = [f"{len(texts) - SHOWN} more experiments"] if len(texts) > SHOWN else []
    return "; ".join(texts[:SHOWN] + more)


def _values(snapshot: Snapshot, batch: str) -> dict[int, str]:
    """Return a label for each experiment of a batch, by ordinal: the values of its axes."""
    own = ("experiment", "batch", "ordinal")
    return {
        place: ", ".join(f"{n}={v}" for n, v in row.items() if n not in own and v is not None) or "its experiment"
        for place, row in snapshot.cells(batch).items()
    }


def _ranges(numbers: Sequence[int]) -> str:
    """Format run numbers as ranges: `runs 3–9, 12`."""
    found = spans(sorted(set(numbers)))
    ranges = ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in found[:5]) + (", …" if len(found) > 5 else "")
    return f"run{'s' if len(set(numbers)) > 1 else ''} {ranges}"


def worst_first(findings: Iterable[Finding]) -> list[Finding]:
    order = {kind: place for place, kind in enumerate(Kind)}
    return sorted(findings, key=lambda finding: (order[finding.kind], finding.path))
