"""The results that an index holds, in a store with segments beside it.

Segments without records of the tables from which the results follow change none. Sessions that only executed something touch
their own batches, and all others with a run that they executed. The results of all other batches are those of the index, and
so are those of runs that no touched batch has. After anything else, such as another judgement or an import, no stored result
is used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet

from sierra.store.duckdb_file_io import read_parquet
from sierra.store.index_reader import DATABASE, STORED
from sierra.store.segments import Segment
from sierra.store.sql_names import quote

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
