"""The logical order of records: which of two records is later, independent of clocks.

Each session takes a *Lamport number* when it begins: 1 more than the highest number in the store or in the folder of a
living session (L. Lamport, "Time, clocks, and the ordering of events in a distributed system", 1978). So a session that
begins after another has ended has the higher number. Two sessions that begin at the same time may have the same number. Then
the session with the greater id is later. Within a session, executions have a position. A process that finishes another's
session, because that one died or was left on a cluster, records with that session's number. Times are only for people.

All three parts are recorded as one whole number in the column `lamport`. A greater number is later.

    23 bits   the session's number
    18 bits   the first bits of the session's id
    22 bits   the position, from 0; positions beyond the largest one share it

Imported records have the numbers of the store that they came from. A session that begins after an
import has a higher number than all imported records.
"""

from __future__ import annotations

NUMBER, TIE, POSITION = 23, 18, 22
"""The widths of the three parts in bits."""
HIGHEST = (1 << NUMBER) - 1


def stamp(number: int | None, session: str, position: int = 0) -> int:
    """Return the value of the column `lamport`; a session without a number comes first."""
    tie = int(session[:16], 16) >> (64 - TIE)
    return ((number or 0) << TIE | tie) << POSITION | min(position, (1 << POSITION) - 1)


def number_of(lamport: int) -> int:
    """Return the session's number from a value of the column `lamport`."""
    return lamport >> (TIE + POSITION)
