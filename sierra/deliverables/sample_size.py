"""The number of runs that each experiment needs, from the recorded runs of a batch as a pilot."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import TYPE_CHECKING

from sierra.config.project_file import LoadedProject
from sierra.deliverables.run_statistics import values_of_runs
from sierra.errors import SierraError, UsageError
from sierra.model import Value
from sierra.stats import sample_size
from sierra.store.sql_names import column_names
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class Needed:
    """The runs that one experiment needs."""

    point: Mapping[str, Value]
    pilot: int
    """The number of recorded runs with a value."""
    sd: float
    """Their standard deviation."""
    runs: int | None
    """The number of runs for the interval, if this is the true standard deviation; None: more than ten million."""
    safe_runs: int | None
    """The number of runs that is enough with a probability of 80 %, because what a pilot shows is uncertain."""


@dataclass(frozen=True, slots=True)
class RunsNeeded:
    """The number of runs that a batch's experiments need for the interval of a mean."""

    table: str
    column: str
    measure: str
    half_width: float
    experiments: tuple[Needed, ...]
    notes: tuple[str, ...]

    @property
    def runs(self) -> int | None:
        """Return the number of runs that is enough for all experiments, with a probability of 80 % for each."""
        needed = [experiment.safe_runs for experiment in self.experiments]
        return max((runs for runs in needed if runs is not None), default=None) if None not in needed else None

    def arrow(self) -> pa.Table:
        """Return an Arrow table with a row for each experiment."""
        import pyarrow as pa

        variables = list(dict.fromkeys(name for experiment in self.experiments for name in experiment.point))
        columns: list[list[object]] = [[experiment.point.get(name) for experiment in self.experiments] for name in variables]
        fields = ("pilot", "sd", "runs", "safe_runs")
        columns += [[getattr(experiment, name) for experiment in self.experiments] for name in fields]
        names = column_names([*variables, *fields], taken=())
        return pa.table({name: pa.array(values) for name, values in zip(names, columns, strict=True)})


def runs_needed(
    project: LoadedProject,
    store: Store,
    batch: str,
    half_width: float,
    table: str,
    column: str,
    measure: str | None,
    threshold: float | None,
) -> RunsNeeded:
    """Return the runs that each experiment needs for a 95 % interval of the mean of this half-width. Raises UsageError."""
    if not 0 < half_width < float("inf"):
        raise UsageError(f"the half-width of an interval must be a number above 0, not {half_width:g}")
    runs = values_of_runs(project, store, batch, table, column, measure, threshold)
    needed, notes = [], list(runs.notes)
    rate = runs.rate and all(run.value in (0, 1) for values in runs.values.values() for run in values)
    if rate:
        notes.append("the interval is Wilson's, because the column is a rate")
    for ordinal, values in runs.values.items():
        if any(not run.reached for run in values):
            raise UsageError("some runs never reached the threshold; the mean of their times is not known")
        if len(values) < 2:
            notes.append(f"experiment {ordinal} has {counted(len(values), 'run')} with a value, but two or more are needed")
            continue
        numbers = [run.value for run in values]
        sd = statistics.stdev(numbers)
        if rate:
            mean = statistics.fmean(numbers)
            enough = sample_size.runs_for_rate(mean, half_width)
            safe = sample_size.runs_for_rate(sample_size.doubtful_rate(mean, len(numbers)), half_width)
        else:
            enough = sample_size.runs_needed(sd, half_width)
            safe = sample_size.runs_needed(sample_size.upper_sd(sd, len(numbers)), half_width)
        needed.append(Needed(runs.shown(ordinal), len(numbers), sd, enough, safe))
    if not needed:
        raise SierraError("no experiment of this batch has two or more runs with a value")
    if not rate and any(cell.sd == 0 for cell in needed):
        notes.append("all runs of an experiment have the same value; if that is by chance, more runs are needed than shown")
    return RunsNeeded(runs.output, runs.column, runs.measure, half_width, tuple(needed), tuple(notes))
