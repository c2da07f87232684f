"""The intervals that a look at a batch sees, and whether they are narrow enough."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import Figure
from sierra.config.project_file import LoadedProject
from sierra.deliverables.gallery import Gallery
from sierra.design.query.until import Condition, Rule
from sierra.errors import NotFound, UsageError
from sierra.stats.looks import estimate
from sierra.stats.selection import PARTS, Selection
from sierra.stats.shipped import ORDER_STATISTICS
from sierra.store.batch_data import BatchData
from sierra.store.row_types import LookIntervalRow
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import like

if TYPE_CHECKING:
    import pyarrow as pa

HOLDS_FOR_EQUAL_VALUES = (ORDER_STATISTICS,)
"""Methods whose interval may have no width. Others take the spread of the runs for the true one; equal values have none."""


@dataclass(frozen=True, slots=True)
class Seen:
    """The intervals of all conditions and experiments, without the id of the look; and notes on what is not in them."""

    intervals: tuple[LookIntervalRow, ...]
    notes: tuple[str, ...]


def check(rule: Rule, project: LoadedProject, level: float) -> None:
    """Raise UsageError for a statistic that is unknown or has no interval of this confidence."""
    for one in rule.conditions:
        selection = Selection.of([one.statistic], project.config.statistics, level)
        if not (selection.definitions and selection.statistics[one.statistic].interval):
            raise UsageError(f"statistic {one.statistic!r} has no interval that could become narrow; see sierra stats --help")


def find_columns(store: Store, batch: str, rule: Rule) -> None:
    """Raise NotFound for a condition that does not name one column of a batch's runs. Values are not looked at."""
    with BatchData(store, batch) as frame:
        for condition in rule.conditions:
            _table(frame, condition)


def see(project: LoadedProject, store: Store, batch: str, rule: Rule, level: float) -> Seen:
    """Return the intervals of a batch's runs at this confidence. Raises NotFound, UsageError for a column that does not fit."""
    intervals: list[LookIntervalRow] = []
    notes: dict[str, None] = {}
    with BatchData(store, batch) as frame:
        gallery = Gallery(project, store, frame, only=frame.names)
        for condition in rule.conditions:
            figure = Figure(table=_table(frame, condition), column=(condition.column,))
            output, samples = gallery.output(figure), gallery.column(figure)
            measure = "mean" if gallery.takes_mean(output) else "final"
            selection = Selection.of([condition.statistic], project.config.statistics, level)
            table, _ = samples.by_experiment(measure, selection)
            intervals += _rows(condition, table, sorted(gallery.planned))
            of_rates = gallery.about_rates(samples, table, measure)
            notes.update(dict.fromkeys((*gallery.notes, *of_rates, *samples.about(measure))))
    return Seen(tuple(intervals), tuple(notes))


def _table(frame: BatchData, condition: Condition) -> str:
    """Return the table that a condition means. Raises NotFound for an unknown table or column, or for several such tables."""
    if condition.table and condition.table not in frame.names:
        raise NotFound(
            f"--until: the runs have no table {condition.table!r}; {like(condition.table, frame.names, 'they have')}"
        )
    outputs = frame.outputs({condition.table} if condition.table else None)
    having = [one for one in outputs if condition.column in one.columns]
    having = [one for one in having if one.name in frame.written] or having
    if len(having) == 1:
        return having[0].name
    if having:
        names = ", ".join(one.name for one in having)
        raise NotFound(f"--until: several tables have a column {condition.column!r} ({names}); write TABLE.{condition.column}")
    columns = list(dict.fromkeys(column for one in outputs for column in one.columns))
    of = f"table {condition.table!r} has" if condition.table else "the runs have"
    raise NotFound(f"--until: {of} no numeric column {condition.column!r}; {like(condition.column, columns, 'there are')}")


def _rows(condition: Condition, table: pa.Table, ordinals: list[int]) -> Iterator[LookIntervalRow]:
    names = ("experiment", "n", *(f"{condition.statistic}{part}" for part in PARTS))
    columns = zip(*(table.column(name).to_pylist() for name in names), strict=True)
    found = {experiment: values for experiment, *values in columns}
    for ordinal in ordinals:
        n, value, low, high, method = found.get(ordinal, (0, None, None, None, None))
        wanted = None if value is None else condition.wanted(value)
        half_width = None if low is None else (high - low) / 2
        holds, needed = False, None
        if half_width is not None and wanted is not None and (half_width > 0 or method in HOLDS_FOR_EQUAL_VALUES):
            holds = half_width < wanted
            needed = None if holds else estimate(n, half_width, wanted)
        yield LookIntervalRow(
            "", str(condition), ordinal, n, value, low, high, method, half_width, wanted, holds=holds, needed=needed
        )
