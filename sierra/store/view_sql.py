"""The queries of views: one file in `sql/` each, with the conditions that several of them share."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from sierra.store.schema import TABLE_NAMES
from sierra.util.lazy_definitions import regex

HERE = Path(__file__).parent / "sql"

RESULT = "e.status IN ('ok', 'accepted')"
FITS = """e.purpose = 'run' AND e.ingest_rules = l.ingest_rules
    AND CASE WHEN e.reusing IS NULL THEN e.packages IS NOT DISTINCT FROM l.packages AND e.programs = l.programs
        AND NOT coalesce(list_contains(l.stale, e.session), false)
        ELSE e.reusing = l.session END"""
COUNTS = f"{RESULT} AND {FITS}"
"""The SQL condition that a candidate e may be effective in a batch with `latest` l. Of all such candidates of a run, the last
judgement of the last execution is effective.
"""

SUCCESS = "success"
"""The outcome of a run that was successful."""
OUTCOME = f"CASE WHEN e.status = 'accepted' THEN e.reason ELSE '{SUCCESS}' END"
"""The SQL expression for the outcome of a judgement e that may be effective: the end that [success] accepts, or `SUCCESS`."""

_PLACES = ("e.lamport", "e.place", "e.judgement")
ORDER = f"({', '.join(_PLACES)})"
"""The order of judgements e: by their executions, then by their own positions."""
LAST_FIRST = ", ".join(f"{place} DESC NULLS FIRST" for place in _PLACES)
"""The same order reversed, for ORDER BY. To sort by one row of these columns takes half as much memory again."""

BY_ITSELF = "e.status = 'failed' AND (e.signal IS NOT NULL OR e.exit_code <> 0)"
"""The SQL condition that a program has ended with an error; limits and missing outputs are other failures."""

READ = regex(r"\b(?:FROM|JOIN) (\w+)\b")


@cache
def _text(name: str) -> str:
    """Return the query in a file, without the comment at its beginning."""
    lines = (HERE / f"{name}.sql").read_text(encoding="utf-8").splitlines()
    return "\n".join(line for line in lines if not line.startswith("--"))


def query(name: str, **parts: str) -> str:
    """Return the query in `sql/NAME.sql`, with these texts in the place of `{part}`."""
    text = _text(name)
    for part, inserted in parts.items():
        text = text.replace(f"{{{part}}}", inserted)
    return text


def latest() -> str:
    """Return the beginning of queries that read the relation `latest`."""
    return query("latest")


def effective() -> str:
    return query("effective", latest=latest(), outcome=OUTCOME, counts=COUNTS, last_first=LAST_FIRST)


def ended() -> str:
    return query("ended", latest=latest(), result=RESULT, by_itself=BY_ITSELF, fits=FITS, last_first=LAST_FIRST)


def tables_in(text: str) -> list[str]:
    """Return the tables of the store that a query of ours reads, in their order."""
    return [name for name in dict.fromkeys(READ.findall(text)) if name in TABLE_NAMES]
