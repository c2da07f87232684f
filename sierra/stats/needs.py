"""The data that a kind of figure needs, and the words for its marks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from sierra.util.lazy_definitions import dataclass, field

Over = Literal["experiments", "time"]


@dataclass(frozen=True, slots=True)
class Needs:
    """The data that SQL computes for a figure."""

    statistics: tuple[str, ...] = ()
    """Formulas for each column, over the runs of each experiment: names of files in `sierra/stats/statistics/`."""
    chosen: tuple[str, ...] = ()
    """Statistics by the names that `sierra stats --statistic` has: each has the columns `NAME`, `NAME_low`, `NAME_high` and
    `NAME_interval`. The first is the center."""
    over: Over = "experiments"
    """`experiments`: each run is reduced by the figure's measure; `time`: statistics at each time."""
    runs: bool = False
    """True if the figure shows the values that the runs are reduced to."""
    seeds: bool = False
    """True if these values have the seed of their run, as the column `seed`: runs with the same seed belong together."""
    single: bool = False
    """True if `rows` needs runs with at most one row at each time, as all statistics do."""
    rows: Mapping[str, str] = field(default_factory=dict)
    """SQL statements on the relation `data`, by name; a figure gets their results under these names.

    `data` has all rows of the output: its own columns, `run`, and the number of the experiment `"# experiment"`, of the run
    `"# number"`, of the row in its run `"# place"`, and the time `"# t"`. The order of rows must be said by ORDER BY.
    """
    columns: int | None = 1
    """The number of columns that the figure shows; None for one or more."""
    others: tuple[str, ...] = ()
    """Further columns that `rows` uses, besides those of the key `column`."""
    numeric: bool = True
    """False if the columns may hold text."""
    numbers: tuple[str, ...] = ()
    """Columns that must hold numbers, of those that may otherwise hold text."""
    sample: str = ""
    """The statement of `rows` whose runs are the sample, because it leaves rows out; empty: all runs with a row."""
    shows: str = ""
    """The meaning of the marks, for the small print; empty: the center and its interval."""
    run: int | None = None
    """The number of the one run of each experiment that the figure shows; None: all runs."""
    some: str = ""
    """The mark of an experiment of which some runs never reached the threshold, as in `hollow`."""
    none: str = "△"
    """The mark of an experiment of which no run reached the threshold."""
