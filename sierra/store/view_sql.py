"""The queries of views: one file in `sql/` each, with the conditions that several of them share.

An index holds results of views.
Segments without records of the tables from which the results follow change none. Sessions that only executed something touch
their own batches, and all others with a run that they executed. The results of all other batches are those of the index, and
so are those of runs that no touched batch has. After anything else, such as another judgement or an import, no stored result
is used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from functools import cache
from pathlib import Path

from sierra.store.duckdb_file_io import read_parquet
from sierra.store.index_reader import DATABASE, STORED
from sierra.store.schema import TABLE_NAMES
from sierra.store.segments import Segment
from sierra.store.sql_names import quote
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

PART = regex(r"\{(\w+)\}")
READ = regex(r"\b(?:FROM|JOIN) (\w+)\b")


@cache
def _text(name: str) -> str:
    """Return the query in a file, without the comment at its beginning."""
    lines = (HERE / f"{name}.sql").read_text(encoding="utf-8").splitlines()
    return "\n".join(line for line in lines if not line.startswith("--"))


def query(name: str, **parts: str) -> str:
    """Return the query in `sql/NAME.sql`, with these texts in the place of `{part}`."""
    return PART.sub(lambda found: parts.get(found[1], found[0]), _text(name))


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


LARGE = 100_000
"""The number of rows from which it is faster to look for what is touched than to compute all results."""
ADDED = frozenset(("batches", "batch_runs", "experiments", "executions", "reused_executions", "sessions", "stale_sessions"))
"""The tables to which a session adds that only executes something."""
BATCHES, RUNS = f"{DATABASE}_batches", f"{DATABASE}_runs"
"""Temporary tables: the batches that are touched, and their runs. Nobody else's statement can guess these names either."""
BY_BATCH = f"SELECT * FROM batch_runs SEMI JOIN {BATCHES} USING (batch)"
JUDGEMENTS = f"""
SELECT * FROM all_judgements WHERE run IN (FROM {RUNS}) OR batch IN (FROM {BATCHES})
    OR execution IN (SELECT execution FROM reused_executions SEMI JOIN {RUNS} USING (run))
"""
"""All judgements that can be effective for these runs, and all that tell which sessions the batches had."""
BY_RUN = f"SELECT * FROM {{table}} SEMI JOIN {RUNS} USING (run)"


def only_added(rest: Iterable[Segment], needed: AbstractSet[str]) -> bool:
    """Return whether these segments have nothing but what sessions add that only execute something.

    `needed`: the tables of records from which the results follow.
    """
    return all(needed & segment.files.keys() <= ADDED for segment in rest)


def touched(rest: Sequence[Segment]) -> Iterable[str]:
    """Yield the statements that make the two tables; the views of `batch_runs` and `reused_executions` must exist."""
    executed, reused = (
        [segment.files[table] for segment in rest if table in segment.files] for table in ("executions", "reused_executions")
    )
    runs = [f"SELECT run FROM {read_parquet(files)}" for files in (executed, reused) if files]
    if executed:
        runs.append(f"SELECT run FROM reused_executions WHERE execution IN (SELECT execution FROM {read_parquet(executed)})")
    own = ", ".join(sorted(quote(segment.batch) for segment in rest)) or "NULL"
    known = f"left(batch, 12) IN ({own})" + (f" OR run IN ({' UNION ALL '.join(runs)})" if runs else "")
    yield f"CREATE OR REPLACE TEMP TABLE {BATCHES} AS SELECT DISTINCT batch FROM batch_runs WHERE {known}"
    yield f"CREATE OR REPLACE TEMP TABLE {RUNS} AS SELECT DISTINCT run FROM ({BY_BATCH})"


def joined(name: str, query: str, **tables: str) -> str:
    """Return the query for a result: what is stored of batches and runs that are not touched, and the others by `query`.

    `tables`: queries for the rows of tables that matter to touched batches and runs; `query` reads them in place of the tables.
    """
    key = f"{BATCHES} USING (batch)" if name == "effective" else f"{RUNS} USING (run)"
    with_tables = ", ".join(f"{table} AS ({rows})" for table, rows in tables.items())
    return (
        f"SELECT * FROM {DATABASE}.{STORED}{name} ANTI JOIN {key} "
        f"UNION ALL BY NAME SELECT * FROM (WITH {with_tables} SELECT * FROM ({query}))"
    )
