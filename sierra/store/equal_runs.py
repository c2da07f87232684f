"""Runs that do not differ: every run of an experiment has another seed and the same data, so that no seed had any effect.

Such runs are no independent samples: an interval over them has the width 0, whatever n is. Data are compared by the hashes of
files where equal data make equal files, else by the rows. Columns with the seed itself and volatile columns do not count.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import PurePosixPath
from typing import NamedTuple

from sierra.store.clock_times import SECONDS
from sierra.store.samples import MEMBERS, NUMERIC, Frame, names_time
from sierra.store.sql_names import identifier, stored_name
from sierra.store.store import Store
from sierra.store.table_layout import TableLayout

NOTE = (
    "all runs of each experiment have the same data in all tables, although their seeds differ: they are not independent "
    "samples, so n and intervals mean nothing (does the program use its seed? if it needs none, set runs = 1)"
)
TEXTS = frozenset({".csv", ".tsv", ".jsonl", ".ndjson", ".json", ".xml", ".txt", ".dat"})
"""The endings of files that have nothing beside their rows, such as a date."""
Columns = Mapping[str, Collection[str]]
"""Names of columns by output."""

SEEDED = """
SELECT coalesce((SELECT bool_and(runs = seeds) FROM (
    SELECT count(*) AS runs, count(DISTINCT b.seed) AS seeds
    FROM batch_runs b WHERE batch = $b AND run IN (SELECT run FROM membership) GROUP BY ordinal HAVING count(*) > 1
)), false) AND (
    (SELECT bool_or(contains(concat_ws(' ', s.command::VARCHAR, s.variables, s.around, s.robots), '{seed}'))
        FROM specs s WHERE s.spec IN (SELECT spec FROM batch_runs WHERE batch = $b))
    OR (SELECT bool_or(inputs > 1) FROM (
        SELECT count(DISTINCT (input, other_inputs)) AS inputs FROM batch_runs WHERE batch = $b GROUP BY ordinal))
) AS value
"""
"""True if some experiment has several runs with different seeds in their inputs or commands, and none has equal seeds."""
FILES = f"""
SELECT a.output, a.path, bool_or(contains(lower(a.table_layout), 'seed')) AS seed,
    any_value(a.table_layout) AS table_layout FROM all_artifacts a
WHERE a.kind = 'table' AND a.rows > 0 AND a.execution IN ({MEMBERS}) GROUP BY a.output, a.path ORDER BY ALL
"""
SAME_FILES = """
SELECT coalesce(bool_and(contents = 1), true) AS value FROM (
    SELECT experiment, count(DISTINCT content) AS contents FROM (
        SELECT m.experiment, m.run, coalesce(list_sort(list((a.path, a.sha256)))::VARCHAR, '') AS content
        FROM membership m LEFT JOIN all_artifacts a
            ON a.execution = m.judgement AND a.kind IN ('table', 'file') AND a.output = $output
        GROUP BY ALL
    ) GROUP BY experiment
)
"""
SAME_ROWS = """
SELECT coalesce(bool_and(contents = 1), true) AS value FROM (
    SELECT experiment, count(DISTINCT content) AS contents FROM (
        SELECT m.experiment, m.run, (count(d.run), sum(hash({columns})::HUGEINT))::VARCHAR AS content
        FROM membership m LEFT JOIN data d ON d.run = m.run AND d."# experiment" = m.experiment GROUP BY ALL
    ) GROUP BY experiment
)
"""


class _File(NamedTuple):
    output: str
    path: str
    seed: bool
    """True if its table may have a column of seeds."""
    table_layout: str

    def tells(self, rates: Collection[str]) -> bool:
        """Return whether equal values are unlikely: flags and rates of independent runs are often equal."""
        columns = TableLayout.load(self.table_layout).columns
        return any(
            kind not in ("flag", "empty") and name not in rates and not names_time(name) for name, kind in columns.items()
        )


class _Flag(NamedTuple):
    value: bool


def note(frame: Frame, volatile: Columns, rates: Columns) -> str:
    """Return the note on runs that do not differ; "" if some do, if runs have no seeds, or if equal results are likely.

    `volatile` and `rates` are the columns that the project declares as such.
    """
    return frame.once("equal runs", lambda: NOTE if _are_equal(frame, volatile, rates) else "")


def of_batch(store: Store, batch: str, volatile: Columns, rates: Columns) -> Iterator[str]:
    """Yield the note on the runs of a batch, if they do not differ."""
    with Frame(store, batch) as frame:
        if found := note(frame, volatile, rates):
            yield found


def _are_equal(frame: Frame, volatile: Columns, rates: Columns) -> bool:
    if frame.select(_Flag, SEEDED, b=frame.batch) != [_Flag(True)]:
        return False
    files = frame.select(_File, FILES)
    plain = [output for output in dict.fromkeys(file.output for file in files) if _is_plain(files, output, volatile)]
    others = dict.fromkeys(file.output for file in files if file.output not in plain)
    return (
        any(file.tells(rates.get(file.output, ())) for file in files)
        and all(frame.select(_Flag, SAME_FILES, output=output) == [_Flag(True)] for output in plain)
        and all(_same_rows(frame, output, volatile.get(output, ())) for output in others)
    )


def _is_plain(files: Collection[_File], output: str, volatile: Columns) -> bool:
    """Return whether equal data of an output make equal files."""
    return not volatile.get(output) and all(
        PurePosixPath(file.path).suffix.lower() in TEXTS and not file.seed for file in files if file.output == output
    )


def _same_rows(frame: Frame, output: str, volatile: Collection[str]) -> bool:
    """Return whether the runs of each experiment have the same rows in an output."""
    frame.data(output, timed=False)
    described = frame.sql("DESCRIBE data").to_pylist()
    kinds = {row["column_name"]: row["column_type"] for row in described}
    left_out = {"run", "# experiment", "# number", "# rowid", "# t", *(stored_name(name, kinds) for name in volatile)}
    columns = [name for name in kinds if name not in left_out and not name.startswith(SECONDS)]
    numbers = [name for name in columns if re.fullmatch(NUMERIC, kinds[name]) and name != "# place"]
    seeds = _of_seeds(frame, numbers)
    counted = ", ".join(f"d.{identifier(name)}" for name in columns if name not in seeds)
    return bool(frame.sql(SAME_ROWS.format(columns=counted)).column("value")[0].as_py())


def _of_seeds(frame: Frame, columns: Collection[str]) -> set[str]:
    """Return the columns whose only value in each run is its seed."""
    if not columns:
        return set()
    tests = ", ".join(f"bool_and(d.{identifier(name)} IS NOT DISTINCT FROM b.seed) AS {identifier(name)}" for name in columns)
    [found] = frame.sql(
        f'SELECT {tests} FROM data d JOIN batch_runs b ON b.batch = $b AND b.run = d.run AND b.ordinal = d."# experiment"',
        b=frame.batch,
    ).to_pylist()
    return {name for name, same in found.items() if same}
