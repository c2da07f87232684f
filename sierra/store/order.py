"""The logical order of what is recorded: which of two records is the later one, whatever any clock said.

Each session takes a *Lamport number* when it begins: 1 more than the highest that is in the store or in the folder of a
session that lives (L. Lamport, "Time, clocks, and the ordering of events in a distributed system", 1978). So a session that
begins when another has ended has the higher number. Two that begin at once may have the same; then the one with the greater
id is the later. Within a session, executions have a position. Whoever finishes another's session, because that has died or
was left on a cluster, records by that session's number. Times are for people.

All three are recorded as one whole number, the column `lamport`: the greater, the later.

    23 bits   the session's number
    18 bits   the first bits of the session's id
    22 bits   the position, from 0; those beyond have the last one

Records of before there were such numbers come before all others, and among themselves by their time: SQL sees a negative
`lamport` there. What is brought from another store was numbered in that store: `STAMPED` is where it must be ranked below
what was recorded here.
"""

from __future__ import annotations

NUMBER, TIE, POSITION = 23, 18, 22
"""Bits."""
HIGHEST = (1 << NUMBER) - 1
STAMPED = "coalesce(lamport, epoch_us({time}) - 4611686018427387904)"
"""The SQL of a record's place in the order; `time` is the column that orders old records."""
TIMES = {
    "batches": "created",
    "executions": "ended",
    "findings": "found",
    "judgements": "judged",
    "replays": "ended",
    "sessions": "ended",
}
"""The tables that are ordered, each with that column."""


def stamp(number: int | None, session: str, position: int = 0) -> int | None:
    """Return what stands in the column `lamport`; None for a session without a number, which an older SIERRA began."""
    if number is None:
        return None
    tie = int(session[:16], 16) >> (64 - TIE)
    return (number << TIE | tie) << POSITION | min(position, (1 << POSITION) - 1)


def number_of(lamport: int) -> int:
    """Return the session's number."""
    return lamport >> (TIE + POSITION)
