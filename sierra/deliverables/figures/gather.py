"""Gather the data of a figure: what its kind needs, computed by SQL from a source."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

from sierra.config.deliverable_tables import Figure
from sierra.config.field_types import RawTable
from sierra.deliverables.figures import bands
from sierra.deliverables.figures.base import Request, kind_of
from sierra.deliverables.figures.drawing import Drawing
from sierra.errors import NotFound, SierraError, UsageError
from sierra.model import Axis, Value
from sierra.stats import aggregate as stats
from sierra.stats.needs import Needs
from sierra.store.batch_data import MIXED, BatchData, OutputTable, RecordedColumn
from sierra.store.union_files import TEXT
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import few, like, n_of

if TYPE_CHECKING:
    import pyarrow as pa


KEYS = ("experiment", "run")
"""The columns of results of `Needs.rows` that tell runs apart."""


class FigureSource(Protocol):
    """One output of one batch."""

    def check(self, columns: Sequence[str], *, numeric: bool) -> None:
        """Raise NotFound for a column that does not exist, UsageError for one that is not numeric but should be."""

    def samples(self, column: str) -> stats.Column:
        """Return one column, for statistics."""

    def rows(self, statement: str) -> pa.Table:
        """Return the result of a statement on the relation `data`: see `Needs.rows`."""

    def seeds(self) -> Mapping[tuple[int, str], int]:
        """Return the seed of each run, by the position of its experiment and its id."""


@dataclass(frozen=True, slots=True)
class OutputRows:
    """The rows of one output of a batch that count for a figure."""

    data: BatchData
    output: OutputTable
    time: str
    where: str = ""
    by_mean: bool = False
    experiments: tuple[int, ...] | None = None
    """The positions of the experiments that count; None: all."""

    @property
    def condition(self) -> str:
        """Return the SQL condition that rows must fulfil; "" if all rows count."""
        chosen = "" if self.experiments is None else f'"# ordinal" IN ({", ".join(map(str, self.experiments))})'
        return f"({self.where}\n) AND {chosen}" if self.where and chosen else self.where or chosen

    def check(self, columns: Sequence[str], *, numeric: bool) -> None:
        for column in columns:
            if numeric and column in self.output.mixed:
                raise UsageError(f"column {column!r} of output {self.name!r} {MIXED}; see {column + TEXT!r} in sierra sql")
            known = self.output.columns if numeric else self.output.all_columns
            if column not in known:
                what = "numeric column" if numeric else "column"
                raise NotFound(f"output {self.name!r} has no {what} {column!r}; it has {', '.join(known)}")

    @property
    def name(self) -> str:
        return self.output.name

    def samples(self, column: str, offset: int = 0) -> RecordedColumn:
        return RecordedColumn(self.data, self.name, column, self.time, self.condition, offset)

    def coverage(self, column: str) -> stats.Coverage:
        """Return the amount of data that fulfils `where`. Raises SierraError if there is none."""
        (row,) = self.rows("SELECT count(*) AS count FROM data").to_pylist()
        if not row["count"]:
            requirement = f"fulfils where = {self.where!r}" if self.where else "belongs to a run of the chosen groups"
            raise SierraError(f"no row of output {self.name!r} {requirement}")
        seen = stats.coverage(self.samples(column), several=True)
        return replace(seen, selected=True, accepted=self.data.accepted_beside(self.name))

    def rows(self, statement: str) -> pa.Table:
        self.data.data(self.name, self.time, self.condition, timed='"# t"' in statement)
        return self.data.sql(statement)

    def seeds(self) -> Mapping[tuple[int, str], int]:
        return self.data.seeds()


@dataclass(frozen=True, slots=True)
class Batch:
    """The variables and experiments of one batch, which its figures share."""

    axes: tuple[Axis, ...]
    cells: Mapping[int, Mapping[str, Value]]
    """By ordinal of the experiment: the value of each axis."""
    planned: Mapping[int, int]
    """The number of runs that each experiment should have."""
    id: str = ""

    def of_experiments(self, ordinals: Container[int]) -> Batch:
        """Return the batch without the other experiments, and without the values of variables that only they have."""
        cells = {ordinal: cell for ordinal, cell in self.cells.items() if ordinal in ordinals}
        axes = (
            replace(axis, values=tuple(v for v in axis.values if any(cell[axis.name] == v for cell in cells.values())))
            for axis in self.axes
        )
        planned = {ordinal: runs for ordinal, runs in self.planned.items() if ordinal in ordinals}
        return Batch(tuple(axes), cells, planned, self.id)

    def in_order(self, values: Mapping[str, Sequence[Value]]) -> Batch:
        """Return the batch with the values of some variables in this order."""
        return replace(
            self,
            axes=tuple(
                replace(axis, values=tuple(sorted(axis.values, key=values[axis.name].index))) if axis.name in values else axis
                for axis in self.axes
            ),
        )


def gather(
    name: str,
    figure: Figure,
    columns: tuple[str, ...],
    batch: Batch,
    source: FigureSource,
    seen: stats.Coverage,
    rates: Container[str] = (),
    options: Mapping[str, RawTable] | None = None,
) -> Drawing:
    """Return the drawing of a figure, without units. Raises SierraError if there is nothing to draw.

    `seen` is the coverage of the output, which may have several rows at the same time. `rates` has the columns
    whose values 0 and 1 are a rate. `options` are the tables `[statistics.NAME]`.
    """
    whole, batch = batch, labelled(arranged(batch, figure), figure.labels)
    needs = kind_of(figure).needs(Request(figure, batch.axes, len(seen.runs), seen.most, columns))
    source.check(columns, numeric=needs.numeric)
    source.check(needs.others, numeric=False)
    source.check(needs.numbers, numeric=True)
    computed = stats.Computed({}, None, "", "")
    if needs.statistics or needs.chosen or needs.runs or needs.single:
        stats.check_times(seen)
    if needs.statistics or needs.chosen or needs.runs:
        samples = {column: source.samples(column) for column in columns}
        computed = stats.compute(figure, samples, needs, planned=batch.planned, known=seen, rates=rates, options=options)
    rows = {key: source.rows(statement) for key, statement in needs.rows.items()}
    seen = _with_rows(rows[needs.sample], seen) if needs.sample else seen
    only = "; ".join((*_fixed(whole, batch.axes), *_only(figure)))
    return Drawing(
        name=name,
        figure=figure if figure.columns == columns else figure.model_copy(update={"columns": columns}),
        axes=batch.axes,
        cells=batch.cells,
        tables={column: bands.with_ends(table, figure) for column, table in computed.tables.items()},
        runs=_seeded(computed.runs, source) if needs.seeds else computed.runs,
        rows=rows,
        note=f"{computed.note or _note(needs, seen, batch.planned)}{only and f'; {only}'}",
        sql="\n\n".join(filter(None, (only and f"-- {only}", computed.sql, *needs.rows.values()))),
        batch=batch.id,
    )


def _seeded(runs: pa.Table, source: FigureSource) -> pa.Table:
    """Return the values of runs with their seeds."""
    seeds = source.seeds()
    keys = zip(runs.column("experiment").to_pylist(), runs.column("run").to_pylist(), strict=True)
    return runs.append_column("seed", [[seeds[key] for key in keys]])


def _only(figure: Figure) -> list[str]:
    """Return notes on the rows that a figure chooses."""
    where = [f"only rows where {' '.join(figure.where.split())}"] if figure.where else []
    groups = (("controller", figure.controllers), ("scenario", figure.scenarios))
    return [*where, *(f"only {noun}{'s' * (len(words) > 1)} {few(words, 6)}" for noun, words in groups if words)]


def arranged(batch: Batch, figure: Figure) -> Batch:
    """Return the batch with its variables in the order in which the figure uses them: `x`, `series`, others, `facet`.

    A variable with one value is left out, unless the figure names it or there is no other.
    """
    named = {axis.name: axis for axis in batch.axes}
    for key, name in (("x", figure.x), ("series", figure.series), ("facet", figure.facet)):
        if name and name not in named:
            raise UsageError(f"{key}: this batch has no variable {name!r}; {like(name, list(named))}")
    chosen = [name for name in (figure.x, figure.series, figure.facet) if name]
    if len(set(chosen)) < len(chosen):
        raise UsageError("x, series and facet are different variables; name each once")
    first = [named.pop(figure.x)] if figure.x else []
    second = [named.pop(figure.series)] if figure.series else []
    last = [named.pop(figure.facet)] if figure.facet else []
    rest = varied(named.values())
    if not (first or second or last or rest):
        rest = list(batch.axes[:1])
    if second and not first and "x" in kind_of(figure).uses:
        first, rest = rest[:1], rest[1:]
    return replace(batch, axes=(*first, *second, *rest, *last))


def varied(axes: Iterable[Axis]) -> list[Axis]:
    """Return the variables with several values."""
    return [axis for axis in axes if len(axis.values) > 1]


def _fixed(batch: Batch, axes: Sequence[Axis]) -> list[str]:
    """Return the value of each variable that is not among these axes."""
    names = {axis.name for axis in axes}
    return [f"{axis.name} = {value}" for axis in batch.axes if axis.name not in names for value in axis.values]


def labelled(batch: Batch, labels: Mapping[str, str]) -> Batch:
    """Return the batch with other names of categories."""
    axes = tuple(replace(axis, values=tuple(_label(value, labels) for value in axis.values)) for axis in batch.axes)
    cells = {k: {name: _label(value, labels) for name, value in cell.items()} for k, cell in batch.cells.items()}
    for old, new in zip(batch.axes, axes, strict=True):
        if len(set(new.values)) < len(old.values):
            raise UsageError(f"labels: two values of {old.name} would have the same name")
    return replace(batch, axes=axes, cells=cells) if labels else batch


def _label(value: Value, labels: Mapping[str, str]) -> Value:
    return labels.get(str(value), value)


def _with_rows(table: pa.Table, seen: stats.Coverage) -> stats.Coverage:
    """Return the coverage of the runs that have a row in a table."""
    runs = Counter(experiment for experiment, _ in set(zip(*(table.column(key).to_pylist() for key in KEYS), strict=True)))
    return replace(seen, runs=runs or {0: 0}, selected=True)


def _note(needs: Needs, seen: stats.Coverage, planned: Mapping[int, int]) -> str:
    """Return the small print of a figure that has no statistics: what it shows, n, and the runs that are not in it."""
    runs = n_of(seen.runs.values())
    if needs.run is not None:
        runs = f"run {needs.run} of {runs.removeprefix('n = ')}"
    return "; ".join([", ".join(filter(None, (needs.shows, runs))), *stats.left_out((), seen, planned)])
