"""Statistics in SQL: for each column of an output and each experiment, over its runs.

Each statistic is one file in `statistics/`: an expression over exact sums, or over `x`, the sorted finite values, and over the
statistics before it; names that begin with `_` are intermediate steps and not in the result. Each measure reduces a run to one
value and is one file in `measures/`. A statement is put together from them:

    observations    one value per run (a measure), or per run and time
    counted         n, the smallest and the largest value, per experiment (and time), and the list x, if used (`group_by_….sql`)
    ranges, sums    the sums of their values as whole numbers of a `unit`, for the mean and sd (`unit.sql`, `sums.sql`)
    (… SELECT *, n) SELECT *, mean) …    one statistic after the other; each may use those before it

No value is averaged silently: missing (NULL or NaN) and infinite values are left out and counted, and so are runs that
never reached a threshold. One run has a mean but no interval.

The statements run on a `Column`, which has one relation. The store makes it from one column of one output of one batch:

    samples(experiment INTEGER, run VARCHAR, number INTEGER, t DOUBLE, shared_t DOUBLE, value DOUBLE,
            file VARCHAR, place BIGINT)

`shared_t` is the time that a row shares with rows of other runs: times that differ by rounding only are one.
`place` is the place of a row in its file, or NULL if the rows have no order.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Protocol, TypeAlias, cast

from sierra.config.deliverable_tables import Figure
from sierra.config.field_types import RawTable
from sierra.errors import SierraError, UsageError
from sierra.stats import student_t, words
from sierra.stats.base import LEVEL, Parameter
from sierra.stats.needs import Needs
from sierra.stats.order_statistics import ranks
from sierra.store.rounded_times import PART
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import counted, n_of, verb

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    import pyarrow as pa

    from sierra.stats.selection import Selection

HERE = Path(__file__).parent
GRID = 500
"""The largest number of points of a common time axis, used if the runs' own times differ."""
MEANS = ("mean", "time_mean")
"""The measures that are means of a run's values."""
TIMES = ("own", "carry", "linear")
"""The times at which statistics are computed: the runs' own times, or common ones by one of two methods."""

STATISTICS: Mapping[str, tuple[str, ...]] = {
    "n": (),
    "mean": ("n",),
    "max_deviation": ("mean",),
    "sd": ("n",),
    "is_rate": ("n",),
    "interval": ("mean", "sd", "is_rate"),
    "kurtosis": ("mean", "max_deviation"),
    "sd_interval": ("sd", "kurtosis"),
    "median": ("n",),
    "median_interval": ("median",),
    "quartiles": ("n",),
    "mad": ("median",),
    "whiskers": ("quartiles",),
    "range": ("n",),
    "iqm": ("n",),
    "iqm_max_deviation": ("iqm",),
    "iqm_half": ("iqm_max_deviation",),
    "iqm_interval": ("iqm_half", "is_rate"),
}
"""The statistics, and the others that each formula uses."""
USUAL = tuple(name for name in STATISTICS if name != "mad")
"""The statistics of `sierra stats` if none are chosen; `mad` would sort all values once more."""

ROWS = "SELECT experiment, shared_t AS t, value FROM samples"
LIST = "coalesce(list_sort(list(value) FILTER (isfinite(value))), []) AS x"
"""The sorted values of a group, for statistics that need each value; sorted, so that the order of rows has no effect."""
BOTH = "coalesce(bool_and(value IN (0, 1)), false) AND min(value) = 0 AND max(value) = 1"
"""True if values are 0 or 1 and both occur, in SQL."""
ROUNDING = 1e-6
"""The limit for rounding errors in n times the mean of n values of 0 and 1."""
STEP = r" AS (_\w+|x\b)"
"""Intermediate steps in SQL, as a regular expression."""

Statistics: TypeAlias = "tuple[pa.Table, str]"
Wanted: TypeAlias = "Iterable[str] | Selection"
"""Statistics by the names of their files, or chosen ones."""


class Column(Protocol):
    """One column of an output over the runs: a connection that executes statements and has the relation `samples`."""

    def sql(self, text: str, /, **params: Parameter) -> pa.Table:
        """Return the rows of a statement as a pyarrow.Table; `$name` in it stands for the parameter of that name."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """The amount of data for statistics; it is the same for all columns of an output."""

    runs: Mapping[int, int]
    """The number of runs that wrote at least one row, by experiment."""
    rows: int
    """The number of rows of all runs."""
    most: int
    """The largest number of rows of one run."""
    first: float
    last: float
    untimed: int
    """The number of rows whose time is not a finite number; they are left out."""
    selected: bool = False
    """True if a condition or a statement chose the rows, so that a successful run may have none."""
    doubled: int = 0
    """The number of runs with more than one row at the same time, for which statistics over runs are not defined."""
    backward: int = 0
    """The number of runs whose time goes back from one row to the next."""
    ends: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    """The times at which the first and the last of an experiment's runs end, by experiment."""
    accepted: Mapping[int, Mapping[str, int]] = field(default_factory=dict)
    """The number of runs by an end that is a result but no success, such as `exit 3`, by experiment; they have no such rows."""

    def about_ends(self) -> list[str]:
        """Return a note if runs of an experiment end at different times."""
        rounding = PART * (self.last - self.first) / max(1, self.most - 1)
        apart = [ends for ends in self.ends.values() if ends[1] - ends[0] > rounding]
        if not apart:
            return []
        first, last = min(first for first, _ in apart), max(last for _, last in apart)
        return [
            f"runs of an experiment end at different times, from {first:.12g} to {last:.12g}: final has each at its own end"
        ]


@dataclass(frozen=True, slots=True)
class Computed:
    """The computed content of a figure.

    `tables` holds, by column of the output, a pyarrow.Table with a row per experiment (and per time `t`): `experiment`,
    `missing`, `infinite`, for measures `never`, and the statistics under the names in their files. `runs` holds the
    values that the runs were reduced to (`experiment`, `run`, `value`, finite only), if the figure shows them.
    """

    tables: Mapping[str, pa.Table]
    runs: pa.Table | None
    sql: str
    note: str


def coverage(column: Column, *, several: bool = False) -> Coverage:
    """Return the amount of data. Raises SierraError if there is none.

    Raises UsageError for several rows at the same time of a run and for a time that goes back, unless `several`.
    """
    rows = column.sql(_file("coverage")).to_pylist()
    if not rows or all(row["first"] is None for row in rows):
        raise SierraError("no run has written any row of this output yet; there is nothing to compute")
    ascending = all(row["ascending"] for row in rows)
    timed = [row for row in rows if row["first"] is not None]
    amount = Coverage(
        runs={row["experiment"]: row["runs"] for row in rows},
        rows=sum(row["rows"] for row in rows),
        most=max(row["most"] for row in rows),
        first=min(row["first"] for row in timed),
        last=max(row["last"] for row in timed),
        untimed=sum(row["untimed"] for row in rows),
        doubled=0 if ascending else _number_of(column, "doubled"),
        backward=0 if ascending else _number_of(column, "backward"),
        ends={row["experiment"]: (row["earliest"], row["last"]) for row in timed},
    )
    if not several:
        check_times(amount)
    return amount


def _number_of(column: Column, name: str) -> int:
    """Return the one number of a statement that counts runs."""
    return int(column.sql(_file(name)).column(name)[0].as_py())


def check_times(seen: Coverage) -> None:
    """Raise UsageError for several rows at the same time of a run, and for a time that goes back."""
    if seen.doubled:
        raise UsageError(
            f"{counted(seen.doubled, 'run')} with more than one row at the same time; statistics over runs need one value"
            " per run and time: name the right column as `time`, or let the run write one row for each time"
        )
    if seen.backward:
        raise UsageError(
            f"{counted(seen.backward, 'run')} whose time goes back, as after a restart from a checkpoint: name the right column"
            ' as `time`, or set time_order = "any" to take the rows in the order of their times'
        )


def compute(
    figure: Figure,
    columns: Mapping[str, Column],
    needs: Needs,
    *,
    planned: Mapping[int, int] | None = None,
    known: Coverage | None = None,
    rates: Container[str] = (),
    options: Mapping[str, RawTable] | None = None,
) -> Computed:
    """Compute what a figure `needs` from these columns, by name.

    `planned` is the number of runs that each experiment should have, to report absent runs. `known` is the coverage of the
    same output, if it was computed before. `rates` has the columns whose values 0 and 1 are a rate. `options` are the tables
    `[statistics.NAME]`. Raises SierraError if there is nothing to show, UsageError if the figure does not fit the batch.
    """
    _check(figure, needs, columns)
    seen = known or coverage(next(iter(columns.values())))
    statistics = _wanted(needs, options or {})
    notes: dict[str, None] = {}
    tables, texts = {}, []
    for name, column in columns.items():
        samples = ColumnStatistics(column, seen, name in rates)
        if needs.over == "time":
            table, text, how = samples.at_times(figure.times, statistics)
            notes |= dict.fromkeys(how)
        else:
            table, text = samples.by_experiment(figure.measure, statistics, figure.threshold, steps=figure.times == "carry")
        tables[name] = table
        texts.append(text)
    if not any(_total(table, "n") for table in tables.values()):
        raise SierraError(_nothing(figure, tables, seen))
    runs = _values(columns, figure) if needs.runs else None
    if needs.over != "time" or needs.runs:
        notes |= dict.fromkeys(samples.about(figure.measure))
    shown = _note(figure, needs, tables.values(), seen, planned)
    return Computed(tables, runs, "\n\n".join(dict.fromkeys(texts)), "; ".join([*shown, *notes]))


@dataclass(frozen=True, slots=True)
class ColumnStatistics:
    """The statistics of one column over the runs; each method returns a table, and the statement."""

    column: Column
    coverage: Coverage
    rate: bool = False
    """True if the column has flags, or is declared as a rate; if all values are 0 or 1, their mean is a rate."""

    def by_experiment(
        self, measure: str, statistics: Wanted, threshold: float | None = None, *, steps: bool = False
    ) -> Statistics:
        """Return statistics of each experiment, each run reduced by `measure`; `steps`: `time_mean` without trapezoids."""
        text = statement(_file(f"measures/{measure}"), "group_by_experiment", statistics)
        return self._run(text, statistics, rate=self.remains_rate(measure), threshold=threshold, steps=steps)

    def remains_rate(self, measure: str) -> bool:
        """Return whether the reduced values of a rate are still 0 or 1; the mean of several rows is a fraction."""
        return self.rate and (measure == "final" or (measure in MEANS and self.coverage.most == 1))

    def about(self, measure: str) -> list[str]:
        """Return notes on what a measure makes of runs that end at different times, or whose steps differ."""
        if self.coverage.most < 2:
            return []
        if measure == "final":
            return self.coverage.about_ends()
        if measure == "mean" and (uneven := _number_of(self.column, "uneven")):
            return [
                f"the steps of time differ by more than 1 % in {counted(uneven, 'run')}, and mean is the mean of the rows: "
                "time_mean is the mean over time"
            ]
        return []

    def by_time(self, statistics: Wanted) -> Statistics:
        """Return statistics of each experiment at each of its runs' times."""
        text = statement(ROWS, "group_by_time", statistics)
        return self._run(text, statistics, rate=self.rate)

    def at_times(self, times: str | None, statistics: Wanted) -> tuple[pa.Table, str, list[str]]:
        """Return a table with statistics over time, its SQL, and notes about the times.

        `times`: the runs' `own` times, or common ones with the last value of each run (`carry`) or with values between
        (`linear`). With None, the times are `own` if most runs share them, else `carry`.

        Common times are equally spaced, as many as the longest run has rows, at most `GRID`. If a common time differs from a
        run's own time by rounding only, the run's time replaces it. Raises UsageError for unknown `times`.
        """
        if times not in (*TIMES, None):
            raise UsageError(f"unknown times {times!r}; known are {', '.join(TIMES)}")
        if times in ("own", None):
            table, sql = self.by_time(statistics)
            runs = self.coverage.runs.values()
            runs_at_a_time, runs_of_an_experiment = self.coverage.rows / max(1, table.num_rows), sum(runs) / len(runs)
            times_differ = max(runs) > 1 and runs_at_a_time < runs_of_an_experiment / 2
            if times == "own" or not times_differ:
                return table, sql, ["times differ: each run has its own times"] if times_differ else _of_fewer_runs(table)
        grid = self._common_times()
        table, sql = self.resampled(grid, statistics, linear=times == "linear")
        how = "interpolated linearly" if times == "linear" else "last values carried forward"
        return table, sql, [f"{'times differ: ' if times is None else ''}{how} to {len(grid)} common times"]

    def resampled(self, grid: Sequence[float], statistics: Wanted, *, linear: bool = False) -> Statistics:
        """Return the result of `by_time` at the times of `grid`, which need not be times of any run."""
        text = statement(_file("resample"), "group_by_time", statistics)
        return self._run(text, statistics, rate=self.rate and not linear, grid=list(grid), linear=linear)

    def runs_over_time(self, grid: Sequence[float] | None = None) -> tuple[pa.Table, list[float]]:
        """Return the runs' values at common times, and these times: `experiment`, `run`, `number`, `t`, `value`.

        Last values are carried forward. The times are those of `grid`, or those of `at_times`. A time of another batch in
        `grid` that differs from a run's own time by rounding only is replaced by that time.
        """
        times = self._near_own(grid) if grid else self._common_times()
        return self.column.sql(_file("resample") + "\nORDER BY ALL", grid=times, linear=False), times

    def _common_times(self) -> list[float]:
        """Return the times of a common axis, in ascending order."""
        import numpy as np

        first, last = self.coverage.first, self.coverage.last
        even = np.linspace(first, last, max(2, min(self.coverage.most, GRID)))
        return sorted(set(self._close_to_own(even, 1e-9 * (last - first))))

    def _near_own(self, grid: Sequence[float]) -> list[float]:
        """Return the times of another batch, but with the own times of runs where they differ by rounding only."""
        import numpy as np

        return self._close_to_own(np.array(grid), PART * float(np.diff(grid).min(initial=0.0 if len(grid) < 2 else np.inf)))

    def _close_to_own(self, even: npt.NDArray[np.float64], limit: float) -> list[float]:
        """Return times, replaced by a run's own time if they differ from it by `limit` at most.

        If rounding put a time just before a run's own time, it would show the value of the previous row.
        """
        import numpy as np

        own = numpy_of(self.column.sql("SELECT DISTINCT shared_t AS t FROM samples WHERE isfinite(t) ORDER BY t").column("t"))
        after = np.clip(np.searchsorted(own, even), 1, max(1, len(own) - 1))
        near = np.where(even - own[after - 1] < own[after % len(own)] - even, own[after - 1], own[after % len(own)])
        times: list[float] = np.where(np.abs(near - even) <= limit, near, even).tolist()
        return times

    def _run(self, text: str, statistics: Wanted, *, rate: bool, **params: Parameter) -> Statistics:
        most = max(self.coverage.runs.values())
        selection = _selection(statistics)
        level = selection.level if selection else LEVEL
        params |= {"z": NormalDist().inv_cdf((1 + level) / 2), "rate": rate}
        lists: dict[str, Parameter] = {"t": _t(most, level), "median_rank": ranks(0.5, max(1, most), 1 - level)[0]}
        if selection:
            params |= selection.parameters(most)
        table = self.column.sql(text, **_used(text, **lists, **params))
        explained = _documented(text, most, level, **params)
        return (selection.complete(table), selection.documented() + explained) if selection else (table, explained)


def _of_fewer_runs(table: pa.Table) -> list[str]:
    """Return a note if statistics at some times are those of fewer runs than at other times of the same experiment."""
    import numpy as np

    experiments = numpy_of(table.column("experiment"))
    runs = sum(numpy_of(table.column(name)).astype(np.int64) for name in ("n", "missing", "infinite"))
    most = np.zeros(experiments.max() + 1 if len(experiments) else 0, np.int64)
    np.maximum.at(most, experiments, runs)
    times = numpy_of(table.column("t"))
    fewer = np.unique(times[runs < most[experiments]])
    if not len(fewer):
        return []
    every = counted(len(np.unique(times)), "time")
    return [f"{len(fewer)} of {every} {verb(len(fewer), 'has', 'have')} fewer runs than others, from {fewer[0]:.12g} on"]


def values_of_runs(column: Column, measure: str, threshold: float | None = None, *, steps: bool = False) -> pa.Table:
    """Return a value for each run: `experiment`, `run`, `value` (NULL: none), `never`, `last` (the time of its last value)."""
    text = f"WITH observations AS (\n{_file(f'measures/{measure}')})\n{_file('values_of_runs')}"
    return column.sql(text, **_used(text, threshold=threshold, steps=steps))


def reduced(column: Column, measure: str, threshold: float | None = None, *, steps: bool = False) -> pa.Table:
    """Return the finite values that the runs are reduced to: `experiment`, `run`, `value`."""
    text = (
        f"WITH observations AS (\n{_file(f'measures/{measure}')})\n"
        "SELECT experiment, run, value FROM observations WHERE isfinite(value) ORDER BY experiment, value, run"
    )
    return column.sql(text, **_used(text, threshold=threshold, steps=steps))


def statement(observations: str, grouping: str, statistics: Wanted) -> str:
    """Return a complete statement: the statistics of the rows of `observations`, in the groups of `grouping`."""
    keys = "experiment, t" if grouping == "group_by_time" else "experiment"
    selection = _selection(statistics)
    names = selection.uses if selection else cast("Iterable[str]", statistics)
    texts = [_file(f"statistics/{name}") for name in _ordered(names)]
    columns = selection.columns() if selection else []
    parts = _groups(grouping, keys, "".join(map(_code, (*texts, *columns))))
    if selection:
        never = () if grouping == "group_by_time" else ("never",)
        own = [name for formula in selection.formulas for name in _columns(formula)]
        shown = ",\n  ".join((keys, "n", "missing", "infinite", *never, *own, *columns))
    else:
        shown = f"* EXCLUDE ({', '.join(re.findall(STEP, _code(''.join((*parts.values(), *texts)))))})"
    values = f"ranges LEFT JOIN sums USING ({keys})" if "sums" in parts else "ranges"
    again = "NOT MATERIALIZED " if observations == ROWS else ""  # to read rows twice is cheaper than to keep a copy
    relations = [f"WITH observations AS {again}(\n{observations.rstrip()}\n)"]
    relations += [f"{name} AS (\n{text.rstrip()}\n)" for name, text in parts.items()]
    return (
        f"{f',{chr(10)}'.join(relations)}\n"
        f"{'FROM (' * len(texts)}FROM {values}\n{''.join(f'SELECT *,{chr(10)}{text})' + chr(10) for text in texts)}"
        f"SELECT {shown}\nORDER BY {keys}"
    )


def _groups(grouping: str, keys: str, formulas: str) -> dict[str, str]:
    """Return the SQL of each group's values, by the name of its relation. Lists and sums are there if `formulas` use them."""
    groups = _file(grouping)
    if re.search(r"\bx\b", formulas):
        groups = groups.replace("\nFROM", f",\n  {LIST}\nFROM", 1)
    sums = {"sums": _file("sums").format(keys=keys)} if "_sum" in formulas else {}
    return {"counted": groups, "ranges": _file("unit")} | sums


def _wanted(needs: Needs, options: Mapping[str, RawTable]) -> Wanted:
    """Return the statistics that a figure needs."""
    from sierra.stats.selection import Selection

    return Selection.of(needs.chosen, options, formulas=needs.statistics) if needs.chosen else _ordered(needs.statistics)


def _columns(formula: str) -> list[str]:
    """Return the columns of a formula that are not intermediate steps."""
    return re.findall(r" AS ([a-z]\w*)", _code(_file(f"statistics/{formula}")))


def _selection(statistics: Wanted) -> Selection | None:
    from sierra.stats.selection import Selection

    return statistics if isinstance(statistics, Selection) else None


def _used(text: str, **params: Parameter) -> dict[str, Parameter]:
    return {name: value for name, value in params.items() if re.search(rf"\${name}\b", _code(text))}


def _documented(text: str, most: int, level: float, **params: Parameter) -> str:
    """Return the statement after comments that explain its parameters."""
    texts = {
        "t": f"quantiles of Student's t, p = {(1 + level) / 2:.10g}, for 1 … {max(1, most - 1)} degrees of freedom",
        "median_rank": f"rank of the lower end of the interval of the median for each n = 1 … {max(1, most)}",
    }
    for name, value in params.items():
        texts[name] = _explained(name, value)
    return "".join(f"-- ${name}: {texts[name]}\n" for name in _used(text, **texts)) + text


def _explained(name: str, value: Parameter) -> str:
    if not isinstance(value, Sequence) or isinstance(value, str):
        return str(value)
    if name == "grid":
        return f"{len(value)} times from {value[0]} to {value[-1]}"
    return f"a number for each n = 1 … {len(value)}"


@cache
def _t(most: int, level: float) -> list[float]:
    """Return the quantiles for samples of up to `most` values; never empty, so that the list has a type in SQL."""
    return student_t.quantiles((1 + level) / 2, max(1, most - 1))


def _ordered(wanted: Iterable[str]) -> tuple[str, ...]:
    """Return the wanted statistics and those that their formulas use, in the order of `STATISTICS`; `n` always."""
    used = {"n"}
    queue = list(wanted)
    while queue:
        name = queue.pop()
        used.add(name)
        queue += STATISTICS[name]
    return tuple(name for name in STATISTICS if name in used)


@cache
def _file(name: str) -> str:
    return (HERE / f"{name}.sql").read_text(encoding="utf-8")


def _code(text: str) -> str:
    return re.sub(r"--[^\n]*", "", text)


def _check(figure: Figure, needs: Needs, columns: Mapping[str, Column]) -> None:
    if not columns:
        raise UsageError(f"a {figure.kind} figure needs a column; name one with `column`")
    if needs.columns is not None and len(columns) != needs.columns:
        wanted = "one column" if needs.columns == 1 else f"{needs.columns} columns"
        raise UsageError(f"a {figure.kind} figure shows {wanted}, not {len(columns)}: {', '.join(columns)}")


def _values(columns: Mapping[str, Column], figure: Figure) -> pa.Table:
    """Return the finite values of runs: `experiment`, `run`, `value`, and for further columns `value_2` and so on."""
    steps = figure.times == "carry"
    first, *others = (reduced(column, figure.measure, figure.threshold, steps=steps) for column in columns.values())
    for number, table in enumerate(others, 2):
        keys = ["experiment", "run"]
        first = first.join(table.rename_columns([*keys, f"value_{number}"]), keys, join_type="inner")
    return first.sort_by([("experiment", "ascending"), ("run", "ascending")]) if others else first


def _note(
    figure: Figure, needs: Needs, tables: Iterable[pa.Table], seen: Coverage, planned: Mapping[int, int] | None
) -> list[str]:
    """Return notes for the reader: what is shown, n, and everything that is not in the numbers."""
    tables = list(tables)
    counts = [numpy_of(table.column("n")) for table in tables]
    ends = [int(end) for n in counts for end in (n.min(), n.max())]
    center = needs.chosen[0] if needs.chosen and not needs.shows else ""
    shown = needs.shows or _shown(needs, tables)
    left = left_out(tables, seen, planned, figure.threshold, _marked(needs, tables[0]))
    return [f"{shown}, {n_of(ends)}", *_without_interval(tables, center), *left]


def left_out(
    tables: Iterable[pa.Table],
    seen: Coverage,
    planned: Mapping[int, int] | None = None,
    threshold: float | None = None,
    marked: str = "",
) -> list[str]:
    """Return notes on everything that is not in the numbers: runs, values, rows. `marked`: how a figure marks late runs."""
    tables, notes = list(tables), []
    wanted = sum((planned or {}).values())
    absent = sum(max(0, count - seen.runs.get(experiment, 0)) for experiment, count in (planned or {}).items())
    if absent:
        because = _accepted_ends(seen, planned or {})
        notes.append(f"{absent} of {counted(wanted, 'run')} missing{' or without such rows' if seen.selected else ''}{because}")
    for name, what in (("missing", "missing value"), ("infinite", "infinite value")):
        if count := sum(_total(table, name) for table in tables):
            notes.append(f"{counted(count, what)} left out")
    if never := sum(_total(table, "never") for table in tables if "never" in table.column_names):
        runs = counted(sum(seen.runs.values()), "run")
        notes.append(f"threshold {threshold:.12g} never reached in {never} of {runs}{marked}")
    if seen.untimed:
        notes.append(f"{counted(seen.untimed, 'row')} without a time left out")
    return notes


def _accepted_ends(seen: Coverage, experiments: Iterable[int]) -> str:
    """Return how runs have ended that are results without being successes, in parentheses; "" if there are none."""
    ends = Counter[str]()
    for experiment in experiments:
        ends.update(seen.accepted.get(experiment, {}))
    return f" ({', '.join(f'{count} with {end}' for end, count in sorted(ends.items()))})" if ends else ""


def _nothing(figure: Figure, tables: Mapping[str, pa.Table], seen: Coverage) -> str:
    """Return an error message that explains why there is nothing to draw."""
    columns, runs = ", ".join(tables), counted(sum(seen.runs.values()), "run")
    never = sum(_total(table, "never") for table in tables.values() if "never" in table.column_names)
    if not never:
        return f"no finite value in {columns}; there is nothing to draw"
    rest = sum(seen.runs.values()) - never
    missing = f", {rest} without any value of it" if rest else ""
    return f"{columns} reaches the threshold {figure.threshold:.12g} in none of {runs}{missing}; there is no time to draw"


def is_rate(table: pa.Table) -> bool:
    """Return whether the intervals of computed statistics are those of a rate."""
    return words.WILSON in methods_of_mean(table)


def methods_of_mean(table: pa.Table) -> set[str]:
    """Return the methods of the intervals of the mean in computed statistics."""
    names = {"interval", "mean_interval"} & set(table.column_names)
    return {method for name in names for method in table.column(name).unique().to_pylist() if method}


def may_be_rate(column: Column, measure: str | None, table: pa.Table | None = None) -> bool:
    """Return whether the only numbers of a column are 0 and 1, and both occur; None as measure: those of all rows.

    `table` has the computed statistics, if they are known: n values of 0 and 1 have the mean k / n, where k is a whole number.
    Statistics over time may be those of interpolated values.
    """
    if table is not None and {"n", "mean"} <= set(table.column_names) and "t" not in table.column_names:
        n, mean = (numpy_of(table.column(name)) for name in ("n", "mean"))
        ones = (n * mean)[n > 0]
        if not ((ones >= 0) & (abs(ones - ones.round()) < ROUNDING)).all():
            return False
    observations = "SELECT value FROM samples" if measure is None else _file(f"measures/{measure}")
    text = f"SELECT {BOTH} AS both FROM (\n{observations}\n) WHERE isfinite(value)"  # noqa: S608 - own statements
    return bool(column.sql(text, **_used(text, steps=False)).column("both")[0].as_py())


def _shown(needs: Needs, tables: Sequence[pa.Table]) -> str:
    """Return a description of the statistics of a figure and of their interval."""
    if needs.chosen:
        return f"{words.named(needs.chosen[0])}, {words.interval(_methods(tables, needs.chosen[0]))}"
    names = [words.named(name) for name in needs.statistics if name != "interval"]
    return ", ".join([*names, *([words.interval(_methods(tables))] if "interval" in needs.statistics else [])])


def _methods(tables: Iterable[pa.Table], center: str = "") -> set[str]:
    """Return the methods of the intervals of a center, or those of the formula `interval`."""
    name = f"{center}_interval" if center else "interval"
    return {method for table in tables for method in table.column(name).unique().to_pylist() if method}


def _without_interval(tables: Sequence[pa.Table], center: str) -> list[str]:
    """Return a note if only some centers have an interval, because n is too small for the others."""
    if not center or not _methods(tables, center):
        return []
    counts = [(table.column(center), table.column(f"{center}_interval")) for table in tables]
    known = sum(len(values) - values.null_count for values, _ in counts)
    lacking = known - sum(len(methods) - methods.null_count for _, methods in counts)
    return [f"n too small for an interval at {lacking} of {known} points"] if lacking else []


def _marked(needs: Needs, table: pa.Table) -> str:
    """Return how a figure marks the experiments of which some runs, or all, never reached the threshold."""
    if "never" not in table.column_names:
        return ""
    late = numpy_of(table.column("never")) > 0
    reached = numpy_of(table.column("n")) > 0
    some = [f"{needs.some}: not in all runs"] if needs.some and (late & reached).any() else []
    none = [f"{needs.none}: in none"] if (late & ~reached).any() else []
    return f" ({', '.join([*some, *none])})" if some or none else ""


def _total(table: pa.Table, column: str) -> int:
    return int(numpy_of(table.column(column)).sum())
