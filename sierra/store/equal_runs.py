"""Runs that do not differ: they have other seeds and the same data, because no seed had any effect, or some count as one seed.

Such runs are no independent samples: an interval over them has the width 0, whatever n is. Data are compared by the hashes of
files where equal data make equal files, else by the rows. Columns with the seed itself and volatile columns do not count.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import PurePosixPath
from typing import NamedTuple

from sierra.store.batch_data import FLAG, NUMERIC, BatchData
from sierra.store.clock_times import SECONDS
from sierra.store.sql_names import identifier, stored_name
from sierra.store.store import Store
from sierra.store.table_layout import TableLayout
from sierra.store.time_axis import names_time
from sierra.util.text import counted

NOTE = (
    "all runs of each experiment have the same data in all tables, although their seeds differ: they are not independent "
    "samples, so n and intervals mean nothing (does the program use its seed? if it needs none, set runs = 1)"
)
TEXTS = frozenset({".csv", ".tsv", ".jsonl", ".ndjson", ".json", ".xml", ".txt", ".dat"})
"""The endings of files that have nothing beside their rows, such as a date."""
Columns = Mapping[str, Collection[str]]
"""Names of columns by output."""

Groups = tuple[tuple[str, ...], ...]
"""Groups of runs that have the same data."""
OWN_COLUMNS = frozenset({"run", "file", "# experiment", "# number", "# rowid", "# t"})
"""Columns of the view `data` that are no data of a run."""
LARGEST_SEEDS = (900_000_000, 65_535, 2**16, 32_767, 10**9, 10**8, 10**6)
"""Largest seeds of programs: LAMMPS and Pythia, and numbers of 16 bits; and round numbers."""
VALUES_AT_MOST = 1_000
EXPERIMENTS_AT_MOST, GROUPS_AT_MOST = 20, 5
"""The number of experiments, and of groups of equal runs in each, whose values are read."""
MANY = 10
"""The number of different values in a column from which on equal columns are unlikely."""
DIGITS = 5
"""The number of digits of a value from which on equal values are unlikely,"""
SMALL, ROUNDED = 100, 1e-6
"""unless it is a fraction of numbers up to SMALL, written with six digits."""

SUCCESSFUL = "(FROM membership WHERE outcome = 'success')"
SIZES = f"SELECT experiment, count(*) AS runs FROM {SUCCESSFUL} GROUP BY experiment ORDER BY experiment"
VALUES = """
SELECT DISTINCT {column} AS value FROM data WHERE "# experiment" = $experiment AND run = $run AND (
    SELECT count(DISTINCT content) > 1 FROM (
        SELECT run, sum(hash({column})::HUGEINT) AS content FROM data WHERE "# experiment" = $experiment GROUP BY run))
ORDER BY value LIMIT $most
"""
"""The different values of a run in a column that is not the same in all runs of the experiment."""
SEVERAL = "SELECT ordinal FROM batch_runs WHERE batch = $b GROUP BY ordinal HAVING count(*) > 1 LIMIT 1"
"""An experiment that has several runs."""
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
WHERE a.kind = 'table' AND a.rows > 0 AND a.execution IN (SELECT judgement FROM {SUCCESSFUL})
GROUP BY a.output, a.path ORDER BY ALL
"""
OF_FILES = f"""
SELECT m.experiment, m.run, coalesce(list(a.sha256 ORDER BY a.path)::VARCHAR, '') AS content
FROM {SUCCESSFUL} m LEFT JOIN all_artifacts a
    ON a.execution = m.judgement AND a.kind IN ('table', 'file') AND a.output = $output
GROUP BY ALL
"""
OF_ROWS = """
SELECT m.experiment, m.run, (count(d.run), sum(hash({columns})::HUGEINT))::VARCHAR AS content
FROM {successful} m LEFT JOIN data d ON d.run = m.run AND d."# experiment" = m.experiment GROUP BY ALL
"""
SHARED = """
SELECT experiment, run, content FROM ({contents})
QUALIFY count(*) OVER (PARTITION BY experiment, content) > 1 ORDER BY ALL
"""
"""The runs that have the content of an output in common with another run of their experiment."""


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


class _Run(NamedTuple):
    experiment: int
    run: str
    content: str


class _Size(NamedTuple):
    experiment: int
    runs: int


def note(frame: BatchData, volatile: Columns, rates: Columns) -> str:
    """Return the note on runs that do not differ; "" if all do, if runs have no seeds, or if equal results are likely.

    `volatile` and `rates` are the columns that the project declares as such.
    """
    return frame.once("equal runs", lambda: _note(frame, volatile, rates))


def of_batch(store: Store, batch: str, volatile: Columns, rates: Columns) -> Iterator[str]:
    """Yield the note on the runs of a batch that do not differ."""
    if not store.values(int, SEVERAL, b=batch):
        return
    with BatchData(store, batch) as frame:
        if found := note(frame, volatile, rates):
            yield found


def _note(frame: BatchData, volatile: Columns, rates: Columns) -> str:
    if frame.select(_Flag, SEEDED, b=frame.batch) != [_Flag(True)]:
        return ""
    files = frame.select(_File, FILES)
    if not any(file.tells(rates.get(file.output, ())) for file in files):
        return ""
    groups = _equal_runs(frame, files, volatile)
    if not groups:
        return ""
    sizes = dict(frame.select(_Size, SIZES))
    if all(len(groups.get(experiment, ((),))[0]) == runs for experiment, runs in sizes.items() if runs > 1):
        return NOTE
    left_out = {output: {*volatile.get(output, ()), *rates.get(output, ())} for output in {file.output for file in files}}
    first = itertools.islice(groups.items(), EXPERIMENTS_AT_MOST)
    unlikely = {experiment: _unlikely(frame, experiment, some[:GROUPS_AT_MOST], left_out) for experiment, some in first}
    unlikely = {experiment: some for experiment, some in unlikely.items() if some}
    return _said(frame, unlikely, sizes) if unlikely else ""


def _equal_runs(frame: BatchData, files: Collection[_File], volatile: Columns) -> dict[int, Groups]:
    """Return the runs that are equal in all outputs, by experiment; the largest group first."""
    plain = [output for output in dict.fromkeys(file.output for file in files) if _is_plain(files, output, volatile)]
    others = dict.fromkeys(file.output for file in files if file.output not in plain)
    equal: dict[_Run, tuple[str, ...]] | None = None
    for output in (*plain, *others):
        shared = _shared(frame, output, None if output in plain else volatile.get(output, ()))
        contents = {row._replace(content=""): row.content for row in shared}
        if equal is None:
            equal = {run: (content,) for run, content in contents.items()}
        else:
            equal = {run: (*before, contents[run]) for run, before in equal.items() if run in contents}
        if not equal:
            break
    groups: dict[tuple[int, tuple[str, ...]], list[str]] = {}
    for run, content in (equal or {}).items():
        groups.setdefault((run.experiment, content), []).append(run.run)
    same: dict[int, list[tuple[str, ...]]] = {}
    for (experiment, _), runs in groups.items():
        if len(runs) > 1:
            same.setdefault(experiment, []).append(tuple(runs))
    return {experiment: tuple(sorted(some, key=len, reverse=True)) for experiment, some in sorted(same.items())}


def _is_plain(files: Collection[_File], output: str, volatile: Columns) -> bool:
    """Return whether equal data of an output make equal files."""
    return not volatile.get(output) and all(
        PurePosixPath(file.path).suffix.lower() in TEXTS and not file.seed for file in files if file.output == output
    )


def _shared(frame: BatchData, output: str, volatile: Collection[str] | None) -> list[_Run]:
    """Return the runs that have the content of an output in common; compared by its files if `volatile` is None."""
    if volatile is None:
        return frame.select(_Run, SHARED.format(contents=OF_FILES), output=output)
    frame.data(output, timed=False)
    kinds = _kinds(frame)
    left_out = {*OWN_COLUMNS, *(stored_name(name, kinds) for name in volatile)}
    columns = [name for name in kinds if name not in left_out]
    seeds = _of_seeds(frame, [name for name in columns if re.fullmatch(NUMERIC, kinds[name]) and name != "# place"])
    named = ", ".join(f"d.{identifier(name)}" for name in columns if name not in seeds)
    rows = frame.sql(SHARED.format(contents=OF_ROWS.format(columns=named, successful=SUCCESSFUL))).to_pylist()
    return [_Run(row["experiment"], row["run"], row["content"]) for row in rows]


def _kinds(frame: BatchData) -> dict[str, str]:
    """Return the types of the columns of the view `data`, without the seconds that are computed from other columns."""
    described = frame.sql("DESCRIBE data").to_pylist()
    return {row["column_name"]: row["column_type"] for row in described if not row["column_name"].startswith(SECONDS)}


def _unlikely(frame: BatchData, experiment: int, groups: Groups, left_out: Columns) -> Groups:
    """Return the groups of runs that most likely are equal because their seeds count as one.

    Coarse data, such as counts, are often equal by chance. So the runs of a group need values in common that differ in other
    runs of their experiment, and that are many, or have many digits and are no fractions of small numbers.
    """
    return tuple(
        group
        for group in groups
        if any(_tells(frame, output, experiment, group[0], names) for output, names in left_out.items())
    )


def _tells(frame: BatchData, output: str, experiment: int, run: str, left_out: Collection[str]) -> bool:
    frame.data(output, timed=False)
    kinds = _kinds(frame)
    without = {*OWN_COLUMNS, "# place", *(stored_name(name, kinds) for name in left_out)}
    columns = [
        name
        for name, kind in kinds.items()
        if name not in without and not names_time(name) and re.fullmatch(NUMERIC, kind) and kind != FLAG
    ]
    for name in columns:
        rows = frame.sql(VALUES.format(column=identifier(name)), experiment=experiment, run=run, most=VALUES_AT_MOST)
        values = [float(value) for value in rows.column("value").to_pylist() if value is not None]
        if len(values) >= MANY or any(map(_is_fine, values)):
            return True
    return False


def _is_fine(value: float) -> bool:
    """Return whether a value has many digits, and is no fraction of small numbers, such as a rate."""
    if not math.isfinite(value) or len(f"{value:.6g}".replace("-", "").replace(".", "").lstrip("0")) < DIGITS:
        return False
    return all(abs(value * number - round(value * number)) > number * ROUNDED for number in range(1, SMALL + 1))


def _said(frame: BatchData, groups: Mapping[int, Groups], sizes: Mapping[int, int]) -> str:
    """Return the note on experiments in which some runs are equal."""
    experiment = next(iter(groups))
    runs, cells = sum(map(len, groups[experiment])), frame.cells()
    values = " ".join(f"{name}={value}" for name, value in cells.get(experiment, {}).items()) or "the experiment"
    same = "the same data" if len(groups[experiment]) == 1 else "the data of another run"
    more = f" (and so have runs of {counted(len(groups) - 1, 'more experiment')})" if len(groups) > 1 else ""
    return (
        f"{runs} of {sizes[experiment]} runs of {values} have {same} although their seeds differ{more}: "
        f"they are not independent samples, so n and intervals are wrong ({_cure(frame, groups)})"
    )


def _cure(frame: BatchData, groups: Mapping[int, Groups]) -> str:
    """Return what may make the runs differ; the seeds show if the program has a largest one."""
    equal = {(experiment, run) for experiment, found in groups.items() for group in found for run in group}
    seeds = {(ordinal, run): seed for (ordinal, run), seed in frame.seeds().items() if ordinal in groups}
    theirs = [seed for run, seed in seeds.items() if run in equal]
    others = [seed for run, seed in seeds.items() if run not in equal]
    if others and theirs and min(theirs) > max(others):
        most = next((known for known in LARGEST_SEEDS if max(others) <= known < min(theirs)), max(others))
        return f"their seeds are all above {most}, those of the other runs are not: set max = {most} in [seed]"
    return "does the program use all digits of its seed? max in [seed] sets the largest seed"


def _of_seeds(frame: BatchData, columns: Collection[str]) -> set[str]:
    """Return the columns whose only value in each run is its seed."""
    if not columns:
        return set()
    tests = ", ".join(f"bool_and(d.{identifier(name)} IS NOT DISTINCT FROM b.seed) AS {identifier(name)}" for name in columns)
    [found] = frame.sql(
        f'SELECT {tests} FROM data d JOIN batch_runs b ON b.batch = $b AND b.run = d.run AND b.ordinal = d."# experiment"',
        b=frame.batch,
    ).to_pylist()
    return {name for name, same in found.items() if same}
