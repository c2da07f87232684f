"""Expected duration of runs: measured with the same values, or estimated from other values.

An estimate is rather too long than too short. Between two timed values of a variable, a run takes as long as the slower of
the two. Beyond them its duration grows by a power of the variable, fitted to neighbouring values; with fewer than three
timed values, it grows at least in proportion. Variables that are text, or were not varied, do not scale the estimate. Runs
whose values were never timed are listed, so that some of them can be executed first.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet

from sierra.errors import SierraError
from sierra.execution import commands
from sierra.execution.plan import Plan
from sierra.model import Batch, Times, Value
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass, replace

STEEPEST = 4.0
"""Highest power with which a run's duration may grow; `MOST` is the greatest factor."""
MOST = 1e6
AT_MOST = 1_000_000
"""The number of pairs of an experiment and a timed one from which runs keep their order: about a second."""


@dataclass(frozen=True, slots=True)
class Timed:
    """Mean duration of successful runs with these values."""

    values: Mapping[str, Value | None]
    """Values by variable; None for a variable with the template's value."""
    seconds: float
    there: float | None = None
    """The seconds where the runs are to execute; None if none executed there."""


@dataclass(frozen=True, slots=True)
class Order:
    """A batch whose experiments are in the order in which their runs are executed."""

    batch: Batch
    seconds: Mapping[int, float]
    """The expected seconds of a run, by the ordinal of its experiment; empty if no comparable run was timed."""

    def by_run(self, runs: AbstractSet[str]) -> dict[str, float]:
        """Return the expected seconds of each of these runs; nothing if all take as long, or if that is not known."""
        if len(set(self.seconds.values())) < 2:
            return {}
        return {run.id: self.seconds[run.experiment] for run in self.batch.runs if run.id in runs}


class _Known:
    """Timed runs, all with the same variables."""

    def __init__(self, runs: Sequence[Timed]) -> None:
        self.runs = runs
        self.slowest = max((timed.seconds for timed in runs), default=0.0)
        self.slowest_by: dict[str, dict[Value | None, float]] = {}
        """The seconds of the slowest run with each value, by variable."""
        self._exact: dict[tuple[Value | None, ...], float] = {}
        self._there: dict[tuple[Value | None, ...], float] = {}
        for timed in runs:
            for name, value in timed.values.items():
                by_value = self.slowest_by.setdefault(name, {})
                by_value[value] = max(timed.seconds, by_value.get(value, 0.0))
            values = tuple(timed.values.values())
            self._exact[values] = max(timed.seconds, self._exact.get(values, 0.0))
            if timed.there is not None:
                self._there[values] = max(timed.there, self._there.get(values, 0.0))
        self.numbers = {
            name: sorted(value for value in durations if value is not None and not isinstance(value, str))
            for name, durations in self.slowest_by.items()
        }
        """The numeric values, by variable."""

    def measured(self, values: Mapping[str, Value]) -> float | None:
        """Return the duration of runs with all of these values; None if there are none."""
        return self._exact.get(tuple(values[name] for name in self.slowest_by))

    def there(self, values: Mapping[str, Value]) -> float | None:
        """Return the duration of runs with all of these values where runs are to execute; None if there are none."""
        return self._there.get(tuple(values[name] for name in self.slowest_by))

    def near(self, name: str, value: Value) -> AbstractSet[Value | None]:
        """Return the timed values of a variable that are this one, or next to it; all if none can be next to it."""
        timed = self.slowest_by[name]
        if isinstance(value, str):
            return {None, value} if value in timed else timed.keys()
        texts = () if value in timed else (other for other in timed if isinstance(other, str))
        numbers = self.numbers[name]
        below, above = [other for other in numbers if other <= value], [other for other in numbers if other >= value]
        return {None, value, *below[-1:], *above[:1], *texts}


def expected(
    plan: Plan, store: Store | None, runs: AbstractSet[str], most: float = math.inf, *, runner: str = ""
) -> tuple[Order, Times | None]:
    """Return the order in which runs that take longer come first, and the expected durations of these runs in that order.

    `runner` is where they are to execute.

    Experiments whose runs are not known to differ keep their order. The durations are None if no comparable run was timed, or
    if there are more than `most` pairs of an experiment and a timed one.
    """
    known = _Known(tuple(_timed(plan, store, runner)) if store and runs else ())
    wanted = {run.experiment for run in plan.batch.runs if run.id in runs}
    if not known.runs or len(known.runs) * len(wanted) > most:
        return Order(plan.batch, {}), None
    exact = _exact(plan, known, wanted)
    order = _sorted(plan.batch, _seconds(plan, known, exact))
    ordered = list({run.id: run for run in order.batch.runs if run.id in runs}.values())
    each = tuple(order.seconds[run.experiment] for run in ordered)
    new = tuple(position for position, run in enumerate(ordered) if exact[run.experiment] is None)
    timed = sum(duration is not None for duration in exact.values())
    there = (known.there(plan.batch.experiments[ordinal].values) for ordinal in wanted)
    longest = max((seconds for seconds in there if seconds is not None), default=None)
    continues = commands.has_checkpoint(plan.batch.spec, plan.files(ordered[0]))
    return order, Times(each, new, _description(timed, len(exact), plan.batch.axes), longest, continues)


def longest_first(plan: Plan, store: Store, runs: AbstractSet[str]) -> Order:
    """Return the order of `expected`, in which nothing changes if it cannot be found, or not in a second."""
    if len({run.experiment for run in plan.batch.runs if run.id in runs}) > 1:
        with contextlib.suppress(SierraError):  # of other batches, and whoever reads them says so
            return expected(plan, store, runs, AT_MOST)[0]
    return Order(plan.batch, {})


def _sorted(batch: Batch, seconds: Mapping[int, float]) -> Order:
    """Return a batch with the experiments in the order of the seconds of their runs, the longest first."""
    experiments = sorted(batch.experiments, key=lambda experiment: -seconds.get(experiment.ordinal, 0.0))
    return Order(replace(batch, experiments=tuple(experiments)), seconds)


def _exact(plan: Plan, known: _Known, experiments: Iterable[int]) -> dict[int, float | None]:
    """Return for each of these experiments how long a run with the same values took; None if there was none."""
    return {ordinal: known.measured(plan.batch.experiments[ordinal].values) for ordinal in sorted(experiments)}


def _seconds(plan: Plan, known: _Known, exact: Mapping[int, float | None]) -> dict[int, float]:
    """Return the expected seconds of a run of each of these experiments."""
    return {
        ordinal: found if found is not None else _estimate(plan.batch.experiments[ordinal].values, known)
        for ordinal, found in exact.items()
    }


def recorded(store: Store, runs: Sequence[str]) -> Times | None:
    """Return the recorded mean durations of these runs; None if none of them succeeded."""
    with store.snapshot() as snapshot:
        snapshot.views.make(("executions", "endings"))
        snapshot.add_table("asked", run=runs)
        took: dict[str, float] = dict(snapshot.run(RECORDED))
    if not took:
        return None
    greatest = max(took.values())
    return Times(tuple(took.get(run, greatest) for run in runs), (), "recorded durations")


def estimate(values: Mapping[str, Value], known: Sequence[Timed]) -> float:
    """Return the duration in seconds of a run with values that were never timed, estimated from timed runs."""
    return _estimate(values, _Known(tuple(known)))


def _estimate(values: Mapping[str, Value], known: _Known) -> float:
    near = {name: known.near(name, value) for name, value in values.items()}
    slow = (one.seconds for one in known.runs if all(one.values[name] in some for name, some in near.items()))
    slowest = max(slow, default=known.slowest)
    return slowest * math.prod(_growth(name, value, known) for name, value in values.items())


# no variable has a blank in its name; executions that continued took only the rest of a run's time
TIMED = """
SELECT b.controller AS "of controller", b.scenario AS "of scenario", b.overrides AS "of overrides", avg(e.wall_s) AS "took s",
       avg(e.wall_s) FILTER (WHERE e.session IN (SELECT session FROM sessions WHERE runner = $runner)) AS "took there s",
       x.* EXCLUDE (batch, ordinal, experiment)
FROM executions e ANTI JOIN (FROM endings WHERE kind = 'resumed') n USING (execution) JOIN batch_runs m USING (batch, run)
     JOIN experiments x USING (batch, ordinal) JOIN batches b USING (batch) JOIN specs r ON r.spec = b.spec
WHERE e.status IN ('ok', 'accepted') AND e.purpose = 'run' AND r.command = $command
GROUP BY ALL
"""
RECORDED = """
SELECT run, avg(wall_s) FROM executions SEMI JOIN asked USING (run)
ANTI JOIN (FROM endings WHERE kind = 'resumed') USING (execution)
WHERE status IN ('ok', 'accepted') AND purpose = 'run' GROUP BY run
"""


def _timed(plan: Plan, store: Store, runner: str) -> Iterator[Timed]:
    """Yield the durations of runs with the same command, controller, scenario and settings, or else with others."""
    project, query, batch = plan.project.config, plan.query, plan.batch
    with store.snapshot() as snapshot:
        snapshot.views.make(("executions", "endings", "batch_runs", "experiments", "batches", "specs", "sessions"))
        rows = snapshot.rows(TIMED, command=list(batch.spec.command), runner=runner)
    settings = {
        "of controller": query.controller or project.controller,
        "of scenario": query.scenario or project.scenario,
        "of overrides": [f"{change.path}={change.value}" for change in query.sets],
    }
    alike = [row for row in rows if {name: row[name] for name in settings} == settings]
    for row in alike or rows:
        if isinstance(seconds := row["took s"], float):
            values = {axis.name: _plain(row.get(axis.name), numeric=axis.numeric) for axis in batch.axes}
            there = row["took there s"]
            yield Timed(values, seconds, there if isinstance(there, float) else None)


def _plain(value: object, *, numeric: bool) -> Value | None:
    """Return a value as an axis has it; numbers may have become text in a column of several batches."""
    if value is None:
        return None
    if not numeric:
        return str(value)
    try:
        return float(str(value))
    except ValueError:
        return str(value)


def _growth(name: str, value: Value, known: _Known) -> float:
    """Return the factor by which a run takes longer than runs with the nearest timed value; 1.0 within the timed range."""
    numbers = known.numbers[name]
    if isinstance(value, str) or not numbers or numbers[0] <= value <= numbers[-1]:
        return 1.0
    slowest = {number: known.slowest_by[name][number] for number in numbers}
    end = numbers[-1] if value > numbers[-1] else numbers[0]
    if min(end, value, *numbers) <= 0:
        return _linear(slowest, end, value)
    powers = [
        math.log(slowest[b] / slowest[a]) / math.log(b / a)
        for a, b in itertools.pairwise(numbers)
        if slowest[a] > 0 and slowest[b] > 0
    ]
    least = 1.0 if value > end and len(numbers) < 3 else 0.0
    steepest = max([least, *(power if value > end else -power for power in powers)])
    grown = abs(math.log(value) - math.log(end)) * min(steepest, STEEPEST)
    return math.exp(min(grown, math.log(MOST)))


def _linear(slowest: Mapping[float, float], end: float, value: float) -> float:
    """Return the factor of `_growth` along a straight line, for values that have no logarithm."""
    slopes = [abs(slowest[b] - slowest[a]) / (b - a) for a, b in itertools.pairwise(sorted(slowest))]
    return min(1.0 + max([0.0, *slopes]) * abs(value - end) / slowest[end], MOST) if slowest[end] > 0 else 1.0


def _description(timed: int, of: int, axes: Sequence[object]) -> str:
    if timed == of:
        return "runs with the same values were timed"
    if timed == 0:
        return "estimated from runs with other values" if axes else "estimated from runs with other settings"
    return f"{timed} of {of} experiments were timed; the others are estimated from them"
