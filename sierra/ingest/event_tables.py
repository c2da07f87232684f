"""Tables of events, such as trips or collisions: their numbers of rows differ between runs by nature.

A table is taken as one of events if no number of rows is usual among the runs of an experiment, and if no column shows that the
runs recorded the same moments. Such a column never falls, and has the same value in the same row of all runs, as far as each
run goes. A table with one is a series, and a shorter one is probably cut short.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from sierra.store.rounded_times import PART
from sierra.store.sql_names import identifier
from sierra.store.sql_result import NUMBER
from sierra.store.store import Snapshot, Store

ALIKE_BY_CHANCE = 10
"""The number of rows from which on equal numbers of events in all runs of an experiment are unlikely."""
SUSPECTED = 10
"""The number of rows of all others from which on a run with less than half of them is suspected to be cut short."""
OWN = frozenset(("run", "execution", "file", "number", "row"))


class TableSize(NamedTuple):
    """The table of one output that one run of an experiment wrote: its first file and its number of rows."""

    ordinal: int
    output: str
    run: str
    path: str
    rows: int


Sizes = Mapping[int, Sequence[int]]
"""The numbers of rows of one output by experiment: one for each run."""


def of_events(store: Store, batch: str, sizes: Mapping[str, Sizes]) -> set[str]:
    """Return the outputs that are taken as tables of events."""
    uneven = [name for name, of_output in sizes.items() if is_uneven(of_output)]
    if not uneven:
        return set()
    with store.snapshot(batch) as snapshot:
        return {name for name in uneven if not _is_series(snapshot, name, batch)}


def is_uneven(sizes: Sizes) -> bool:
    """Check that no number of rows is usual among the runs of most experiments."""
    counts = [Counter(rows) for rows in sizes.values() if len(rows) > 1]
    telling = [count for count in counts if len(count) > 1 or min(count) >= ALIKE_BY_CHANCE]
    if not any(len(count) > 2 for count in telling) and sum(len(count) > 1 for count in telling) < 3:
        return False
    total, usual = sum(count.total() for count in telling), sum(max(count.values()) for count in telling)
    return 2 * usual <= total < 2 * sum(map(len, telling))


def _is_series(snapshot: Snapshot, output: str, batch: str) -> bool:
    """Check if the runs of each experiment recorded the same moments; true also if there is nothing to compare."""
    snapshot.views.make((output, "effective"))
    described = snapshot.run(f"DESCRIBE {identifier(output)}")
    if not described:
        return True
    axes = {axis.lower() for axis in snapshot.views.axes()} | OWN
    numeric = [identifier(name) for name, kind, *_ in described if name.lower() not in axes and re.fullmatch(NUMBER, kind)]
    order = ", ".join(identifier(name) for name, *_ in described if name in ("file", "row"))
    placed = PLACED.format(output=identifier(output), order=order)
    [(shared,)] = snapshot.run(SHARED.format(placed=placed), {"batch": batch})
    return not shared or any(
        snapshot.run(SERIES.format(placed=placed, column=column, part=PART), {"batch": batch}) for column in numeric
    )


PLACED = """
SELECT e.ordinal, o.*, row_number() OVER (PARTITION BY e.ordinal, o.run ORDER BY {order}) AS "# place"
FROM {output} o JOIN (SELECT DISTINCT ordinal, run FROM effective WHERE batch = $batch) e ON e.run = o.run
"""
SHARED = """SELECT count(*) FROM (SELECT 1 FROM ({placed}) GROUP BY ordinal, "# place" HAVING count(*) > 1)"""
SERIES = """
WITH moments AS (
    SELECT ordinal, "# place" AS place, min({column}) AS least, max({column}) AS most, count({column}) = count(*) AS complete
    FROM ({placed}) GROUP BY ALL
), steps AS (
    SELECT *, lag(least) OVER (PARTITION BY ordinal ORDER BY place) AS before FROM moments
)
SELECT 1 FROM steps
HAVING bool_and(complete AND (before IS NULL OR least >= before)) AND max(least) > min(least)
    AND max(most - least) <= {part} * min(least - before) FILTER (least > before)
"""
"""True for a column whose values are the same in all runs, or differ by rounding only."""


def short(sizes: Iterable[TableSize]) -> Iterator[tuple[TableSize, int, int]]:
    """Yield the tables that have less than half of the rows of all others of their experiment, with the range of these."""
    experiments: dict[tuple[str, int], list[TableSize]] = {}
    for table in sizes:
        experiments.setdefault((table.output, table.ordinal), []).append(table)
    for tables in experiments.values():
        least, *others = sorted(tables, key=lambda table: table.rows)
        if len(others) > 1 and others[0].rows >= max(SUSPECTED, 2 * least.rows + 1):
            yield least, others[0].rows, others[-1].rows
