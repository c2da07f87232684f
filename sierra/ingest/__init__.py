"""Recording: what workers say becomes segments of the store, checked on the way.

An execution is judged here and nowhere else: by its exit status, the outputs and the marker that the project
asks for (`judging`), and by the tables it wrote (`assigning` says which files these are, `tabled` reads them by
`sierra.ingest.read`). What is only known once its siblings, the other runs of its experiment, are there too (other
row counts or columns than theirs, a table that it alone lacks or has) becomes a *finding*, and so does a column that
holds something else than theirs (`siblings`). What is allowed and yet hardly meant is said (`remarks`). Where the project's
rules change, what is recorded is judged by them (`anew`).

Recording may be repeated: what is in the store already is not recorded again, so a session that died is
finished by reading its journal once more.
"""

from __future__ import annotations

from sierra.ingest.consistency import find_odd
from sierra.ingest.context import UNREAD, Context, rules_of
from sierra.ingest.recorder import Recorder, result_hash
from sierra.ingest.rejudge import Anew, Foreseen, foresee, judge_anew, judgement_id

__all__ = [
    "UNREAD",
    "Anew",
    "Context",
    "Foreseen",
    "Recorder",
    "find_odd",
    "foresee",
    "judge_anew",
    "judgement_id",
    "result_hash",
    "rules_of",
]
