"""The limits of the runs of a batch: `[limits]`, where each may depend on variables, as in `"{population_size * 4} MiB"`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from sierra.config.execution_tables import LimitsTable, Varying
from sierra.config.project_file import Project
from sierra.config.validate import options
from sierra.errors import ConfigError
from sierra.execution.row_queries import axis_values, required_row
from sierra.model import Experiment, Limits, Value
from sierra.store.row_types import BatchRow
from sierra.store.store import Store
from sierra.templates import arithmetic
from sierra.util.lazy_definitions import dataclass, field, replace

SIZES = ("memory", "output")
"""The limits that are texts such as `4 MiB`; all others are numbers."""


@dataclass(frozen=True, slots=True)
class RunLimits:
    """The limits of the runs of a batch."""

    most: Limits
    """The limits of all runs; of those that depend on variables, the largest value of each."""
    by_experiment: Mapping[int, Limits] = field(default_factory=dict)
    """The limits by the position of the experiment; empty if all runs have the same."""

    def of(self, experiment: int) -> Limits:
        """Return the limits of the runs of an experiment, by its position in the batch."""
        return self.by_experiment[experiment] if self.by_experiment else self.most

    @property
    def of_containers(self) -> Limits:
        """The limits for the containers of all runs, which have the same settings: without one that differs between runs.

        The worker enforces that one. The wall time is the largest: a container ends by it only if nothing else ends it.
        """
        differs = any(limits.memory_bytes != self.most.memory_bytes for limits in self.by_experiment.values())
        return replace(self.most, memory_bytes=None) if differs else self.most

    def changed(self, change: Callable[[Limits], Limits]) -> RunLimits:
        """Return these limits with the same change of all."""
        others = {limits: change(limits) for limits in {self.most, *self.by_experiment.values()}}
        return RunLimits(others[self.most], {number: others[limits] for number, limits in self.by_experiment.items()})


def of_experiments(project: Project, experiments: Iterable[Experiment]) -> RunLimits:
    """Return the limits of the runs of experiments. Raises ConfigError for one that has no valid value."""
    return _limits(project, ((experiment.ordinal, experiment.values) for experiment in experiments))


def recorded(project: Project, store: Store, batch: str) -> RunLimits:
    """Return the limits of the runs of a recorded batch, as the project has them now. Raises as `of_experiments`."""
    if not _varying(project.limits):
        return _limits(project, ())
    with store.snapshot(batch) as snapshot:
        axes = required_row(BatchRow, snapshot, "SELECT * FROM batches WHERE batch = $b", b=batch).axes
        return _limits(project, ((ordinal, axis_values(axes, cell)) for ordinal, cell in snapshot.cells(batch).items()))


def _limits(project: Project, experiments: Iterable[tuple[int, Mapping[str, Value]]]) -> RunLimits:
    """Return the limits of experiments with these positions and values, which are only read if a limit depends on them."""
    varying = _varying(project.limits)
    if not varying:
        return RunLimits(_of_table(project, project.limits))
    tables: dict[tuple[str, ...], Limits] = {}
    by_experiment = {}
    for ordinal, given in experiments:
        filled = {name: _filled(name, text, given) for name, text in varying.items()}
        key = tuple(filled.values())
        if key not in tables:
            tables[key] = _of_table(project, _checked(project.limits, filled))
        by_experiment[ordinal] = tables[key]
    distinct = tuple(tables.values())
    return RunLimits(_largest(distinct), by_experiment if len(set(distinct)) > 1 else {})


def _varying(table: LimitsTable) -> dict[str, Varying]:
    return {name: value for name in type(table).model_fields if isinstance(value := getattr(table, name), Varying)}


def _filled(name: str, text: Varying, values: Mapping[str, Value]) -> str:
    """Return a limit with the values of an experiment. Raises ConfigError."""
    try:
        if unknown := sorted(arithmetic.names(text) - values.keys()):
            varies = f"the query varies {', '.join(values)}" if values else "the query varies nothing"
            raise ConfigError(
                f"{{{unknown[0]}}} has no value, because {varies}; add {unknown[0]} to the query, or give a number"
            )
        return arithmetic.fill(text, values)
    except ConfigError as error:
        raise ConfigError(f"[limits] {name} = {str(text)!r}: {error}") from error


def _checked(table: LimitsTable, filled: Mapping[str, str]) -> LimitsTable:
    """Return the table with the values of an experiment. Raises ConfigError for one that is no valid limit."""
    texts: dict[str, object] = {**table.model_dump(exclude_unset=True), **filled}
    for name in filled.keys() - set(SIZES):
        try:
            texts[name] = float(filled[name])
        except ValueError:
            raise ConfigError(f"[limits] {name}: {filled[name]!r} should be a number") from None
    return options(LimitsTable, texts, "[limits]")


def _of_table(project: Project, table: LimitsTable) -> Limits:
    """Return the limits of a table in which none depends on variables."""
    given = dict[str, Any](table)
    cores = None if given["cores"] is None else math.ceil(given["cores"])
    bounds = Limits(
        given["wall"], given["cpu"], given["memory"], given["output"], given["grace"], gpus=given["gpus"], cores=cores
    )
    if table.after_marker is None:
        return bounds
    success = project.success
    return replace(bounds, after_marker_s=table.after_marker, marker=success.marker, contains=success.contains or None)


def _largest(limits: Sequence[Limits]) -> Limits:
    """Return limits of which each is the largest one. Either all of them have a limit, or none has it."""
    names = ("wall_s", "cpu_s", "memory_bytes", "output_bytes", "gpus", "cores")
    all_values = {name: [getattr(each, name) for each in limits] for name in names}
    return replace(limits[0], **{name: max(values) for name, values in all_values.items() if values[0] is not None})
