"""Compare groups of recorded runs: batches, or the values of variables within one batch.

The groups are compared in *cells*: the combinations of the values of all variables that are not compared. Batches are compared
in the cells that they have in common.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import Comparison
from sierra.config.project_file import LoadedProject
from sierra.deliverables.record import other_version, parsing
from sierra.deliverables.run_statistics import RunSeries, RunTable, runs_over_time, values_of_runs
from sierra.errors import NotFound, SierraError, UsageError
from sierra.execution import targets
from sierra.model import Value
from sierra.stats.comparison.model import VERSION, Analysis, Cell, Effect, Omnibus, Pair, Question, Sample
from sierra.stats.words import of_run
from sierra.store.row_types import BatchRow, DeliverableRow, SpecRow
from sierra.store.sql_names import column_names
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, field, replace
from sierra.util.text import counted, few, like

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.execution.batches_of_queries import BatchesOfQueries
    from sierra.stats.comparison.over_time import Band

KIND = "comparison"
"""The kind of the records of comparisons, among deliverables."""
AGAIN = "draw it again with: sierra compare"
MOST = 20
"""The largest number of groups that are compared each with each."""


@dataclass(frozen=True, slots=True)
class Compared:
    """The result of a comparison."""

    name: str
    """The name of its files."""
    batches: Mapping[str, str]
    """The id of each batch, by the name of the group; of a single batch, by its short id."""
    table: str
    column: str
    measure: str
    unit: str
    analysis: Analysis
    text: str
    """The conclusions as a paragraph, for a paper."""
    brief: str
    """The most important sentences of it."""
    asked: Comparison
    """The options of the comparison."""
    notes: tuple[str, ...] = ()
    """Notes on the data for the reader, which the text does not contain."""
    bands: tuple[Band, ...] = ()
    """The differences over time, if they were requested."""
    time: str = ""
    """The name of the time, with its unit."""
    packaged: tuple[str, ...] = ()
    """The names of the groups whose runs are in packages."""
    names: Mapping[str, str] = field(default_factory=dict)
    """The groups by the names of their controllers or scenarios, which are shown by their labels."""

    def group(self, word: str) -> str:
        """Return the group that a word names, by its label or its name. Raises NotFound."""
        known = dict.fromkeys(group for pair in self.pairs for group in (pair.first, pair.second))
        return _group(word, list(known), self.names) or ""

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """Return the comparisons of two groups."""
        return self.analysis.pairs

    @property
    def omnibus(self) -> tuple[Omnibus, ...]:
        """Return the tests of whether any of more than two groups differs."""
        return self.analysis.omnibus

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return the main effects and interactions of a factorial comparison."""
        return self.analysis.effects

    def arrow(self) -> pa.Table:
        """Return all results as an Arrow table: a row for each test, the values of the variables first."""
        import pyarrow as pa

        tests: list[Omnibus | Pair | Effect] = [*self.omnibus, *self.pairs, *self.effects]
        points = [test.point if not isinstance(test, Effect) else {} for test in tests]
        rows = [_row(test, self.analysis.title) for test in tests]
        variables = list(dict.fromkeys(name for point in points for name in point))
        shown = [name for name in COLUMNS if any(row.get(name) is not None for row in rows)]
        values: list[list[object]] = [[point.get(name) for point in points] for name in variables]
        values += [[row.get(name) for row in rows] for name in shown]
        names = column_names([*variables, *shown], taken=())
        return pa.table({name: pa.array(column) for name, column in zip(names, values, strict=True)})


COLUMNS = (
    *("effect", "first", "second", "n_first", "n_second", "never_first", "never_second", "test", "statistic", "df", "df_error"),
    *("critical_difference", "difference", "low", "high", "a12", "cliffs_delta", "partial_eta_squared"),
    *("p", "p_adjusted", "p_equivalent", "p_equivalent_adjusted", "verdict"),
)
"""The columns of the table of results, after those of the variables; columns without any value are left out."""


def compare(
    project: LoadedProject,
    store: Store,
    name: str,
    batches: Mapping[str, str],
    asked: Comparison,
    packaged: Mapping[str, Store] | None = None,
) -> Compared:
    """Compare batches, by the name of each group; of one batch, the values of `asked.by`. Without a name, the files get one.

    `packaged` has the stores of the groups whose batches are in packages.

    Raises NotFound for an unknown output, column or variable, UsageError for options that do not fit, SierraError if there is
    nothing to compare.
    """
    from sierra.stats.comparison.analyse import analyse
    from sierra.stats.comparison.wording import brief, paragraph

    stores = {group: (packaged or {}).get(group, store) for group in batches}
    tables, cells, factors, notes = gather_cells(project, stores, batches, asked)
    first = next(iter(tables.values()))
    groups = cells[0].samples if cells else ()
    if len(groups) > MOST and asked.against is None and not factors:
        raise UsageError(
            f"{len(groups)} groups are too many to compare each with each; name one of them as against (--against)"
        )
    names = {} if factors else _names(asked.by, tables.values())
    question = Question(
        asked.alpha, asked.margin, asked.paired, _group(asked.against, [sample.group for sample in groups], names)
    )
    result = analyse(cells, question, factors, asked.method, project.config.comparison_methods)
    if factors and asked.over_time:
        raise UsageError("main effects and interactions cannot be computed over time; leave out --over-time")
    time, bands = _bands(project, stores, batches, first, cells, result) if asked.over_time else ("", ())
    subject = _subject(first)
    words = (*map(short, batches.values()), *asked.by, first.column, "over_time" if asked.over_time else first.measure)
    return Compared(
        name or re.sub(r"[^\w.-]+", "_", "-".join(words)),
        dict(batches),
        first.output,
        first.column,
        first.measure,
        first.unit,
        result,
        paragraph(result, subject),
        brief(result, subject),
        asked,
        (
            *dict.fromkeys(note for table in tables.values() for note in table.notes),
            *notes,
            *_differences(stores, batches, details=not packaged),
        ),
        bands,
        time,
        tuple(packaged or ()),
        names,
    )


def gather_cells(
    project: LoadedProject, stores: Mapping[str, Store], batches: Mapping[str, str], asked: Comparison
) -> tuple[Mapping[str, RunTable], list[Cell], tuple[str, ...], tuple[str, ...]]:
    """Return the runs of each batch, the cells with the groups to compare, the factors, and notes on what is left out.

    `stores` has the store of each group. Raises NotFound, UsageError, as `compare` does.
    """
    return cells_of(runs_of_groups(project, stores, batches, asked), asked)


def runs_of_groups(
    project: LoadedProject, stores: Mapping[str, Store], batches: Mapping[str, str], asked: Comparison
) -> dict[str, RunTable]:
    """Return the runs of all experiments of each batch. Raises NotFound, UsageError, as `compare` does."""
    if len(batches) > 1 and asked.by:
        raise UsageError("--by compares the values of a variable within one batch; leave it out for several batches")
    measure = asked.measure or ("mean" if asked.over_time else None)
    return {
        group: values_of_runs(project, stores[group], batch, asked.table, asked.column, measure, asked.threshold, asked.where)
        for group, batch in batches.items()
    }


def cells_of(
    runs: Mapping[str, RunTable], asked: Comparison
) -> tuple[Mapping[str, RunTable], list[Cell], tuple[str, ...], tuple[str, ...]]:
    """Return what `gather_cells` returns, from the runs of all experiments."""
    tables = {group: table.among(asked.experiments) for group, table in runs.items()}
    first = next(iter(tables.values()))
    tables = {group: table.minus(first.offset) for group, table in tables.items()}
    if len({(table.output, table.measure) for table in tables.values()}) > 1:
        each = ", ".join(f"{group}: {table.measure} of {table.output}" for group, table in tables.items())
        raise UsageError(f"the batches differ in the output or the measure ({each}); name both")
    if len(tables) > 1:
        cells, notes = _cells_of_batches(tables)
        return tables, _with_rates(cells, tables), (), notes
    cells, factors = _cells_within(first, asked)
    return tables, _with_rates(cells, tables), factors, ()


def _with_rates(cells: Sequence[Cell], tables: Mapping[str, RunTable]) -> list[Cell]:
    """Return the cells, marked if all their values are those of a rate."""
    values = (run.value for cell in cells for sample in cell.samples for run in sample.values)
    rate = all(table.rate for table in tables.values()) and all(value in (0, 1) for value in values)
    return [replace(cell, rate=rate) for cell in cells]


def _bands(
    project: LoadedProject,
    stores: Mapping[str, Store],
    batches: Mapping[str, str],
    runs: RunTable,
    cells: Sequence[Cell],
    result: Analysis,
) -> tuple[str, tuple[Band, ...]]:
    """Return the name of the time, and the difference over time for each pair of the result."""
    import numpy as np

    from sierra.stats.comparison import over_time

    series: dict[str, RunSeries] = {}
    for group, batch in batches.items():
        grid = next(iter(series.values())).times if series else None
        series[group] = runs_over_time(project, stores[group], batch, runs.output, runs.column, grid)
    first = next(iter(series.values()))
    samples = {(*cell.point.items(), sample.group): sample for cell in cells for sample in cell.samples}
    compute = over_time.of_pairs if result.pairing.paired else over_time.of_samples
    bands = []
    for pair in result.pairs:
        before, after = (
            series.get(group, first).values[samples[(*pair.point.items(), group)].experiment]
            for group in (pair.first, pair.second)
        )
        apart = series.get(pair.second, first).offset - series.get(pair.first, first).offset
        numbers = (numbers + float(apart) for numbers in compute(before, after, result.question.alpha))
        bands.append(over_time.Band(pair.point, pair.first, pair.second, np.array(first.times), *numbers))
    return first.time, tuple(bands)


def labelled(
    project: LoadedProject, store: Store, named: Sequence[tuple[str, str]], remedy: str = "LABEL=HASH"
) -> dict[str, str]:
    """Return batches by label, from pairs of a label and a batch; "" as a label is replaced by a name that fits the batch.

    Raises UsageError if two have the same label; it can be mended by `remedy`.
    """
    proposed = labels(project, store, [batch for _, batch in named])
    chosen = [label or other for (label, _), other in zip(named, proposed, strict=True)]
    if twice := next((label for label in chosen if chosen.count(label) > 1), None):
        raise UsageError(f"two groups have the name {twice!r}; give them different ones: {remedy}")
    return {label: batch for label, (_, batch) in zip(chosen, named, strict=True)}


def of_queries(queries: BatchesOfQueries, words: Sequence[str]) -> dict[str, str]:
    """Return the last batches of queries by label. Raises NotFound for a query that was not run, UsageError for equal ones."""
    from sierra.execution.batches_of_queries import labelled as of_word  # loads the grammar of queries

    named = [(of_word(queries.project.config, word)[0], queries.last(word)) for word in words]
    if len({batch for _, batch in named}) < len(named):
        raise UsageError(f"query: two of {', '.join(words)} are the same query; name each once")
    return labelled(queries.project, queries.store, named, "LABEL=NAME")


def labels(project: LoadedProject, store: Store, batches: Sequence[str]) -> list[str]:
    """Return a name for each batch: what differs between them, if one word says it, else the short ids."""
    rows = {row.batch: row for row in store.select(BatchRow, "SELECT * FROM batches WHERE batch IN $b", b=list(batches))}
    proposed = (
        [rows[batch].controller for batch in batches],
        [rows[batch].scenario for batch in batches],
        [targets.recorded(store, batch) if project.targets else None for batch in batches],
    )
    for names in proposed:
        told = [name for name in names if name]
        if len(set(told)) == len(batches):
            return told
    return [short(batch) for batch in batches]


def _subject(runs: RunTable) -> str:
    """Return what is compared, in words."""
    unit = f" [{runs.unit}]" if runs.unit not in ("", "1") else ""
    if runs.threshold is not None:
        return f"the time{unit} until {runs.column} reaches {runs.threshold:g}"
    if runs.measure == "final":
        return f"the final value of {runs.column}{unit}"
    return f"the {of_run(runs.measure, runs.column)}{unit}"


def _cells_of_batches(tables: Mapping[str, RunTable]) -> tuple[list[Cell], tuple[str, ...]]:
    """Return the cells that batches have in common, and notes on the others."""
    axes = {group: tuple(runs.axes) for group, runs in tables.items()}
    (first, names), *others = axes.items()
    for group, other in others:
        if set(other) != set(names):
            lone = sorted(set(names) ^ set(other))[0]
            raise UsageError(
                f"the batches have different variables: {lone!r} varies only in {first if lone in names else group}; "
                "compare batches of the same variables"
            )
    places = {
        group: {tuple(runs.cells[ordinal][name] for name in names): ordinal for ordinal in runs.cells}
        for group, runs in tables.items()
    }
    every = dict.fromkeys(point for points in places.values() for point in points)
    common = [point for point in every if all(point in points for points in places.values())]
    if not common:
        raise UsageError("the batches have no experiment with the same values of the variables in common")
    left = len(every) - len(common)
    notes = (f"left out, because not in all batches: {left} of {counted(len(every), 'experiment')}",) if left else ()
    cells = [
        Cell(
            tables[first].shown(places[first][point]),
            tuple(_sample(group, runs, [places[group][point]]) for group, runs in tables.items()),
        )
        for point in common
    ]
    return cells, notes


def _cells_within(runs: RunTable, asked: Comparison) -> tuple[list[Cell], tuple[str, ...]]:
    """Return the cells of one batch, and the factors of a factorial comparison."""
    by = asked.by or (runs.axes if len(runs.axes) == 1 else ())
    if not by:
        has = f"it has the variables {', '.join(runs.axes)}" if runs.axes else "it has no variable"
        raise UsageError(f"name a second batch, or what to compare within this one by --by VARIABLE; {has}")
    for name in by:
        if name not in runs.axes:
            raise NotFound(f"this batch has no variable {name!r}; {like(name, runs.axes)}")
    rest = [name for name in runs.axes if name not in by]
    if len(by) > 1:
        if rest := [name for name in rest if len({values[name] for values in runs.cells.values()}) > 1]:
            raise UsageError(f"a factorial comparison needs all variables of the batch; add {', '.join(rest)} to --by")
        if asked.groups:
            raise UsageError("a factorial comparison takes all values of its variables; leave out groups")
        ordinals = list(runs.cells)
        samples = tuple(_sample(str(ordinal), runs, [ordinal]) for ordinal in ordinals)
        return [Cell({}, samples, tuple(tuple(runs.cells[ordinal][name] for name in by) for ordinal in ordinals))], tuple(by)
    (name,) = by
    groups = _chosen(name, runs, asked)
    cells: dict[tuple[Value, ...], dict[str, int]] = {}
    for ordinal, values in runs.cells.items():
        cells.setdefault(tuple(values[variable] for variable in rest), {})[_named(name, runs.shown(ordinal)[name])] = ordinal
    return [
        Cell(
            {variable: runs.shown(next(iter(places.values())))[variable] for variable in rest},
            tuple(_sample(group, runs, [places[group]]) for group in groups),
        )
        for places in cells.values()
    ], ()


def _chosen(name: str, runs: RunTable, asked: Comparison) -> list[str]:
    """Return the groups within a batch: those that were named, in this order, or else all values of the variable."""
    every = list(dict.fromkeys(_named(name, runs.shown(ordinal)[name]) for ordinal in runs.cells))
    chosen = [_group(word, every, _names((name,), (runs,))) or "" for word in asked.groups]
    if len(set(chosen)) < len(chosen):
        raise UsageError(f"a group is named twice: {', '.join(asked.groups)}")
    return chosen or every


def _named(variable: str, value: Value) -> str:
    """Return the name of a group; a number alone says nothing. Different numbers have different names."""
    if isinstance(value, str):
        return value
    short_form = f"{value:.6g}"
    return f"{variable}={short_form if isinstance(value, float) and float(short_form) == value else repr(value)}"


def _names(by: Sequence[str], tables: Iterable[RunTable]) -> dict[str, str]:
    """Return the groups by the values of their variable, which may be shown by labels."""
    return {
        str(runs.cells[ordinal][name]): _named(name, runs.shown(ordinal)[name])
        for runs in tables
        for name in by
        if name in runs.axes
        for ordinal in runs.cells
    }


def _group(word: str | None, groups: Sequence[str], names: Mapping[str, str]) -> str | None:
    """Return the group that a word names: the whole label, the name or, of a number, the value. Raises NotFound."""
    if word is None:
        return None
    matching = next((group for group in groups if word in (group, group.partition("=")[2])), names.get(word))
    if matching is None:
        raise NotFound(f"there is no group {word!r}; {like(word, groups)}")
    return matching


def _sample(group: str, runs: RunTable, ordinals: Iterable[int]) -> Sample:
    values = [value for ordinal in ordinals for value in runs.values.get(ordinal, ())]
    return Sample(group, tuple(values), sum(runs.planned[ordinal] for ordinal in ordinals), next(iter(ordinals)))


def _differences(stores: Mapping[str, Store], batches: Mapping[str, str], *, details: bool) -> Iterator[str]:
    """Yield a note on everything that differs between batches, because it may be what makes results differ."""
    if len(batches) < 2:
        return
    rows: list[BatchRow] = []
    specs: dict[str, SpecRow] = {}
    for group, batch in batches.items():
        store = stores[group]
        rows += (own := store.select(BatchRow, "SELECT * FROM batches WHERE batch = $b", b=batch))
        chosen = store.select(SpecRow, "SELECT * FROM specs WHERE spec IN $s", s=[row.spec for row in own])
        specs |= {row.spec: row for row in chosen}
    facts = [
        {
            **{name: getattr(row, name) for name in FACTS},
            "content of the template": row.template_sha256,
            **{field: getattr(specs[row.spec], field) for field in SPEC if row.spec in specs},
        }
        for row in rows
    ]
    names = {"overrides": "--set", "base_seed": "base seed", "shared_files": "shared files", "around": "services"}
    differing = [names.get(name, name) for name in facts[0] if any(known.get(name) != facts[0][name] for known in facts)]
    if differing:
        first, second = next(combinations(map(short, batches.values()), 2))
        yield f"the batches differ in {', '.join(differing)}{f'; for details: sierra diff {first} {second}' if details else ''}"


FACTS = ("controller", "scenario", "overrides", "platform", "base_seed", "template")
SPEC = ("command", "variables", "source", "image", "host_access", "shared_files", "around")
"""The columns of batches and of specs that are compared."""


def _row(test: Pair | Omnibus | Effect, title: str) -> dict[str, object]:
    """Return the values of one row of the table of results, by column."""
    row = {name: getattr(test, name) for name in COLUMNS if hasattr(test, name)}
    match test:
        case Pair():
            never = {} if test.statistic is not None else {"never_first": None, "never_second": None}
            return row | never | {"cliffs_delta": test.delta, "verdict": test.verdict.value}
        case Omnibus():
            return row | {"first": "all groups", "n_first": test.n}
        case Effect():
            return row | {"effect": test.name, "test": title, "statistic": test.f, "partial_eta_squared": test.eta}


def again(project: LoadedProject, store: Store, row: DeliverableRow) -> Compared:
    """Return a recorded comparison, made again from the data that the store has now. Raises the errors of `compare`.

    Raises SierraError for one that another version of the method made.
    """
    if other := other_version(row, VERSION, AGAIN):
        raise SierraError(f"{other}; its recorded figure is {few(row.files, 1)}")
    with parsing(row.name):
        definition = json.loads(row.definition)
        asked = Comparison.model_validate(definition["comparison"])
        groups = dict(zip(definition["groups"], row.batches, strict=True))
    return compare(project, store, row.name, groups, asked)
