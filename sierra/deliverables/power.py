"""The number of runs that a comparison needs to find a difference, from recorded runs as a pilot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import Comparison
from sierra.config.project_file import LoadedProject
from sierra.deliverables.comparison import gather_cells
from sierra.deliverables.run_statistics import RunTable, values_of_runs
from sierra.errors import SierraError, UsageError
from sierra.model import Value
from sierra.stats.comparison.model import Cell, Sample
from sierra.store.sql_names import column_names
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.stats.power import Floats, Pilot

SMALL = 20
"""The number of runs of a pilot below which its spread is rather uncertain."""
FIELDS = ("first", "second", "pilot", "test", "difference", "alpha", "runs", "power", "power_with")


@dataclass(frozen=True, slots=True)
class Powered:
    """The runs that one comparison of two groups needs."""

    point: Mapping[str, Value]
    first: str
    second: str
    pilot: int
    """The number of recorded runs of each group, or of pairs, that were drawn from; the smaller one of both groups."""
    test: str
    difference: float
    """The difference that is to be found, in the column's unit."""
    alpha: float
    """The significance level of this test, corrected for all tests of the comparison."""
    runs: int | None
    """The number of runs of each group with the wanted power; None: more than 2000."""
    power: float | None
    """The power with these runs."""
    power_with: float | None
    """The power with the number of runs that was asked about."""


@dataclass(frozen=True, slots=True)
class RunsForPower:
    """The number of runs that all comparisons of a batch, or of two batches, need."""

    table: str
    column: str
    measure: str
    alpha: float
    wanted: float
    """The power that is wanted."""
    asked: int | None
    """The number of runs whose power was asked about."""
    resamples: int
    seed: int
    """The seed of the resampling."""
    comparisons: tuple[Powered, ...]
    notes: tuple[str, ...]

    @property
    def runs(self) -> int | None:
        """Return the number of runs of each group that is enough for each comparison; None if it is above 2000."""
        needed = [comparison.runs for comparison in self.comparisons]
        return None if None in needed else max(runs for runs in needed if runs is not None)

    def arrow(self) -> pa.Table:
        """Return an Arrow table with a row for each comparison; `power_with` only if it was asked about."""
        import pyarrow as pa

        variables = list(dict.fromkeys(name for comparison in self.comparisons for name in comparison.point))
        fields = FIELDS if self.asked is not None else FIELDS[:-1]
        columns: list[list[object]] = [[comparison.point.get(name) for comparison in self.comparisons] for name in variables]
        columns += [[getattr(comparison, name) for comparison in self.comparisons] for name in fields]
        names = column_names([*variables, *fields], taken=())
        return pa.table({name: pa.array(values) for name, values in zip(names, columns, strict=True)})


@dataclass(frozen=True, slots=True)
class Wanted:
    """The question: a difference (None: that of the pilot), and the power with which it is to be found."""

    difference: float | None
    power: float = 0.8
    runs: int | None = None
    """The number of runs whose power is asked about too."""

    def check(self) -> None:
        """Raise UsageError for a question without an answer."""
        if self.difference is not None and not 0 < abs(self.difference) < float("inf"):
            raise UsageError(f"a difference must be a number other than 0, not {self.difference:g}")
        if not 0 < self.power < 1:
            raise UsageError(f"a power must be above 0 and below 1, not {self.power:g}")
        if self.runs is not None and self.runs < 2:
            raise UsageError(f"the power of {self.runs} run is not known; ask about 2 or more (--runs)")


def runs_for_power(
    project: LoadedProject, store: Store, batches: Mapping[str, str], asked: Comparison, wanted: Wanted
) -> RunsForPower:
    """Return the runs of each group with which the comparison finds the difference with the wanted power.

    With one batch and no `by`, each experiment is the pilot of a group, and another group differs from it by the difference.
    Raises the errors of a comparison, and UsageError without a difference or with more than two groups.
    """
    from sierra.stats import power

    wanted.check()
    if len(batches) == 1 and not asked.by:
        runs, pairs, notes = _one_group(project, store, batches, asked, wanted)
    else:
        runs, pairs, notes = _two_groups(project, store, batches, asked, wanted)
    alpha = asked.alpha / len(pairs)
    if len(pairs) > 1:
        notes.append(f"alpha is {asked.alpha:g} / {len(pairs)}, because a comparison corrects for all its {len(pairs)} tests")
    if min(pair.count for pair in pairs) < SMALL:
        notes.append("the spread of a small pilot is uncertain; plan again with more runs")
    return RunsForPower(
        runs.output,
        runs.column,
        runs.measure,
        asked.alpha,
        wanted.power,
        wanted.runs,
        power.RESAMPLES,
        power.SEED,
        tuple(pair.powered(alpha, wanted) for pair in pairs),
        tuple(dict.fromkeys([*runs.notes, *notes])),
    )


@dataclass(frozen=True, slots=True)
class _Groups:
    """Two groups of one comparison, with their pilot."""

    point: Mapping[str, Value]
    first: str
    second: str
    pilot: Pilot
    difference: float
    count: int
    """The number of recorded runs of each group, or of pairs."""

    def powered(self, alpha: float, wanted: Wanted) -> Powered:
        """Return the runs that the comparison needs."""
        runs = self.pilot.runs(wanted.power, alpha)
        return Powered(
            self.point,
            self.first,
            self.second,
            self.count,
            self.pilot.test,
            self.difference,
            alpha,
            runs,
            None if runs is None else self.pilot.power(runs, alpha),
            None if wanted.runs is None else self.pilot.power(wanted.runs, alpha),
        )


def _one_group(
    project: LoadedProject, store: Store, batches: Mapping[str, str], asked: Comparison, wanted: Wanted
) -> tuple[RunTable, list[_Groups], list[str]]:
    from sierra.stats import power

    if wanted.difference is None:
        raise UsageError("name the difference to find (--difference D), or two groups: a second batch, or --by VARIABLE")
    if asked.paired is True:
        raise UsageError("one group has no pairs; name a second batch, or --by VARIABLE, or leave out --paired")
    [batch] = batches.values()
    runs = values_of_runs(project, store, batch, asked.table, asked.column, asked.measure, asked.threshold)
    pairs: list[_Groups] = []
    for ordinal in runs.cells:
        values = _values(Sample("", tuple(runs.values.get(ordinal, ())), 0, ordinal))
        if len(values) > 1:
            rate = runs.rate and all(run.value in (0, 1) for run in runs.values[ordinal])
            pilot = power.of_one_group(values, wanted.difference, rate=rate)
            name = f"{wanted.difference:+g}"
            pairs.append(_Groups(runs.shown(ordinal), "pilot", f"pilot {name}", pilot, wanted.difference, len(values)))
    if not pairs:
        raise SierraError("no experiment of this batch has two or more runs with a value")
    notes = ["the groups are taken as independent; if their runs are pairs by seed, fewer runs are enough"]
    if len(pairs) < len(runs.cells):
        notes.append(f"left out: {counted(len(runs.cells) - len(pairs), 'experiment')} with fewer than two values")
    return runs, pairs, notes


def _two_groups(
    project: LoadedProject, store: Store, batches: Mapping[str, str], asked: Comparison, wanted: Wanted
) -> tuple[RunTable, list[_Groups], list[str]]:
    from sierra.stats.comparison import pairing

    tables, cells, factors, left = gather_cells(project, dict.fromkeys(batches, store), batches, asked)
    groups = cells[0].samples if cells else ()
    if factors or len(groups) != 2:
        raise UsageError(f"the power is that of two groups, not of {len(groups)}; name two of them (--groups A,B)")
    cells = [cell for cell in cells if all(len(sample.values) > 1 for sample in cell.samples)]
    if not cells:
        raise SierraError("no two groups have two or more runs with a value each")
    decided = pairing.decide(cells, asked.paired)
    notes = [*left, decided.reason]
    if wanted.difference is None:
        notes.append("the difference is that of the pilot, which is uncertain too; --difference is the smallest that matters")
    pairs = [pair for cell in cells if (pair := _pair(cell, wanted, paired=decided.paired))]
    if not pairs:
        raise SierraError("no two groups have two or more seeds in common")
    return next(iter(tables.values())), pairs, notes


def _pair(cell: Cell, wanted: Wanted, *, paired: bool) -> _Groups | None:
    """Return the pilot of the two groups of a cell; None if there are fewer than two pairs."""
    from sierra.stats import power
    from sierra.stats.comparison import pairing

    first, second = map(_values, cell.samples)
    if paired:
        blocks = pairing.blocks(cell.samples)
        if len(blocks) < 2:
            return None
        first, second = blocks[:, 0], blocks[:, 1]
    pilot = power.of_groups(first, second, wanted.difference, paired=paired, rate=cell.rate)
    difference = power.difference_of(first, second, paired=paired) if wanted.difference is None else wanted.difference
    names = [sample.group for sample in cell.samples]
    return _Groups(cell.point, names[0], names[1], pilot, difference, min(len(first), len(second)))


def _values(sample: Sample) -> Floats:
    import numpy as np

    if any(not run.reached for run in sample.values):
        raise UsageError("some runs never reached the threshold; the power of a comparison of censored times is not known")
    return np.array([run.value for run in sample.values], dtype=float)
