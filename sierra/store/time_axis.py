"""The time axis of an output: a column that has the name of a time, or that increases alike in all runs."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from sierra.store.rounded_times import PART
from sierra.store.sql_names import LOWER, identifier

Run: TypeAlias = "Callable[[str], Sequence[Sequence[Any]]]"
"""A function that executes a statement and returns its rows."""

TIMES = ("clock", "time", "tick", "t", "step", "iteration", "generation", "seconds")
"""Names of a first column that make it the time axis, if the project declares no time column."""
OTHER_TIMES = ("timestep", "timestamp", "stamp", "zeit", "temps", "tiempo", "tempo", "iter", "gen", "epoch", "frame", "sec")
BESIDE_TIME = ("s", "ms", "us", "ns", "min", "h", "in", "of", "sim", "simulation", "elapsed", "number", "no", "index")
"""Further words in names of times, and words beside them."""

LONGEST = """
SELECT run, "# experiment" FROM {data} GROUP BY ALL HAVING count(*) > 1 ORDER BY count(*) DESC, run, "# experiment" LIMIT 1
"""
ALIKE = """
SELECT 1 FROM (SELECT count(DISTINCT run) AS runs FROM {data}) WHERE runs > 1 AND NOT EXISTS (
    SELECT "# place" FROM {data} GROUP BY "# place"
    HAVING min({column}) <> max({column}) OR count({column}) < count(*)
)
"""
NEARLY_ALIKE = """
SELECT 1 FROM (
    SELECT max("# apart") AS "# apart", bool_and("# complete") AS "# complete" FROM (
        SELECT max({column}) - min({column}) AS "# apart", count({column}) = count(*) AS "# complete"
        FROM {data} GROUP BY "# place"
    )
) WHERE "# complete" AND (SELECT count(DISTINCT run) FROM {data}) > 1 AND "# apart" <= {part} * (
    SELECT min("# step") FROM (
        SELECT {column} - lag({column}) OVER (PARTITION BY run, "# experiment" ORDER BY "# place") AS "# step" FROM {data}
    )
)
"""


def names_time(column: str) -> bool:
    """Return whether a column has the name of a time; the store may have added `_` to it, or what tells `t` from `T`."""
    return column.lower().removesuffix(LOWER).rstrip("_") in TIMES


def is_called_time(column: str) -> bool:
    """Return whether a name may be that of a time, as in `[step]`, `timestamp` and `Zeit`; only its rows can tell."""
    words = {word.lower() for word in re.findall(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+", column)}
    return bool(words & {*TIMES, *OTHER_TIMES}) and words <= {*TIMES, *OTHER_TIMES, *BESIDE_TIME}


def shared_axis(run: Run, data: str, columns: Sequence[str]) -> str | None:
    """Return the first of these numeric columns of a relation that behaves like a time; None if none does.

    A time increases from row to row. It also has the same values in all runs, as far as each run goes. At least two runs
    are needed, because in a single run any increasing column would qualify.
    """
    increasing = _increasing(run, data, columns)
    return next((column for column in columns if column in increasing and _is_alike(run, data, identifier(column))), None)


def _is_alike(run: Run, data: str, column: str) -> bool:
    """Return whether a column has the same values in all runs, except for rounding."""
    return any(run(text.format(column=column, data=data, part=PART)) for text in (ALIKE, NEARLY_ALIKE))


def _increasing(run: Run, data: str, columns: Sequence[str]) -> set[str]:
    """Return the columns that increase from row to row in the longest run."""
    if not columns:
        return set()
    pairs = [(identifier(column), identifier(f"# before {column}")) for column in columns]
    steps = ", ".join(f"{c}::DOUBLE AS {c}, lag({c}::DOUBLE) OVER w AS {before}" for c, before in pairs)
    tests = ", ".join(
        f"bool_and(isfinite({c}) AND ({before} IS NULL OR {c} > {before})) AND count({c}) = count(*)" for c, before in pairs
    )
    longest = LONGEST.format(data=data)
    [results] = run(
        f'SELECT {tests} FROM (SELECT {steps} FROM {data} SEMI JOIN ({longest}) USING (run, "# experiment") '
        'WINDOW w AS (ORDER BY "# place"))'
    )
    return {column for column, increases in zip(columns, results, strict=True) if increases}
