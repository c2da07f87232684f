"""Figures that show several batches together: their drawings, merged into one with a further axis.

The axis is `target` or `batch`. For targets, the batches are the last ones of a query, one for each target, and their runs must
be pairs: the same values and seeds. Other batches, such as those of several controllers, have the same variables.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, NamedTuple

from sierra.config.deliverable_tables import Figure
from sierra.deliverables.figures.drawing import Drawing
from sierra.errors import Missing, NotFound, SierraError, UsageError
from sierra.model import Axis, Value
from sierra.store.store import Store
from sierra.util.hashing import sha256, short
from sierra.util.quoted_values import words
from sierra.util.text import few

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.models.predicted import Predicted

KINDS = ("timeseries", "summary", "box", "violin")
"""Kinds of figures that can show several batches."""
Word = Literal["target", "batch"]
"""The name of the axis: what the batches differ in."""
TARGET: Word = "target"
BATCH: Word = "batch"
LONGEST = 100
"""The largest number of characters of a name with labels."""
PLURALS = {TARGET: "targets", BATCH: "batches"}


class _Request(NamedTuple):
    """The parts of a request that batches of one query have in common."""

    query: str
    controller: str | None
    scenario: str | None
    overrides: list[str]
    base_seed: int


class _Batch(NamedTuple):
    target: str
    batch: str


class _Members(NamedTuple):
    batch: str
    runs: list[tuple[int, int, int]]


REQUEST = """
SELECT s.query, b.controller, b.scenario, b.overrides, b.base_seed FROM sessions s JOIN batches b USING (batch)
ANTI JOIN imported_sessions USING (session)
WHERE list_contains($targets, s.target) AND ($batch = '' OR s.batch = $batch) ORDER BY s.lamport DESC LIMIT 1
"""
LAST = """
SELECT s.target, arg_max(s.batch, s.lamport) AS batch FROM sessions s JOIN batches b USING (batch)
ANTI JOIN imported_sessions USING (session)
WHERE list_contains($targets, s.target) AND s.query = $query AND b.overrides = $overrides AND b.base_seed = $base_seed
AND b.controller IS NOT DISTINCT FROM $controller AND b.scenario IS NOT DISTINCT FROM $scenario GROUP BY s.target
"""
MEMBERS = """
SELECT batch, list(row(ordinal, number, seed) ORDER BY ordinal, number) AS runs FROM batch_runs
WHERE list_contains($batches, batch) GROUP BY batch
"""


def batches(store: Store, targets: Sequence[str], batch: str | None = None) -> dict[str, str]:
    """Return the last batches of one query by target: the query of a batch, or the last query for any of the targets.

    Raises NotFound or Missing if there are none, UsageError if their runs are no pairs.
    """
    asked = store.select(_Request, REQUEST, targets=list(targets), batch=batch or "")
    if not asked and batch:
        raise NotFound(f"batch {short(batch)} was not requested for target {' or '.join(targets)}")
    if not asked:
        raise Missing(f"no batch is recorded for target {' or '.join(targets)} yet; record them with sierra run")
    last = {row.target: row.batch for row in store.select(_Batch, LAST, targets=list(targets), **asked[0]._asdict())}
    if lacking := [target for target in targets if target not in last]:
        command = _command(asked[0], targets)
        raise Missing(f"{asked[0].query} was not run for target {few(lacking, 3)}; record all batches with: {command}")
    chosen = {target: last[target] for target in targets}
    members = {row.batch: row.runs for row in store.select(_Members, MEMBERS, batches=sorted(set(chosen.values())))}
    first = members[chosen[targets[0]]]
    for target in targets[1:]:
        if members[chosen[target]] != first:
            raise UsageError(
                f"the runs for targets {targets[0]!r} and {target!r} are no pairs: their seeds or numbers differ; "
                f"run the query for both at once: {_command(asked[0], targets)}"
            )
    return chosen


def _command(asked: _Request, targets: Sequence[str]) -> str:
    return shlex.join(["sierra", "run", *words(asked.query), "--target", ",".join(targets)])


def fitting(figure: Figure, *, declared: bool) -> Figure:
    """Return the figure for several batches: a default map becomes a summary. Raises SierraError for other kinds."""
    if figure.kind == "heatmap" and not declared:
        return figure.model_copy(update={"kind": "summary"})
    if figure.series or figure.facet:
        raise SierraError("series and facet choose the lines and panels of one batch; leave them out to draw several batches")
    if figure.kind not in KINDS:
        raise SierraError(f"a figure of kind {figure.kind} shows one batch; kinds for several are {', '.join(KINDS)}")
    return figure


def together_in(definition: Mapping[str, object]) -> tuple[Word, list[str]] | None:
    """Return the targets or labels of a recorded figure that shows several batches; None for another one."""
    for word, plural in PLURALS.items():
        if isinstance(names := definition.get(plural), list):
            return word, list(map(str, names))
    return None


def name_of(name: str, labels: Iterable[str]) -> str:
    """Return the name of a figure or table of several batches, by which it differs from that of one batch."""
    whole = "_".join((name, *(re.sub(r"[^\w.-]+", "_", label) for label in labels)))
    return whole if len(whole) <= LONGEST else f"{name}_{sha256(whole.encode())[:10]}"


def merged(drawings: Mapping[str, Drawing], word: Word = TARGET) -> Drawing:
    """Return one drawing of the drawings by target or label; that is a further axis, and the first one in figures over time.

    Raises SierraError if the values, their units or the name of the time differ.
    """
    first = next(iter(drawings.values()))
    _check(drawings, word)
    name: str = word
    while any(axis.name == name for axis in first.axes):
        name += "_"
    axis = Axis(name, tuple(drawings), label=word)
    over_time = first.figure.kind == "timeseries"
    step = 1 + max((max(drawing.cells, default=0) for drawing in drawings.values()), default=0)
    places = {target: number * step for number, target in enumerate(drawings)}
    cells: dict[int, Mapping[str, Value]] = {
        ordinal + places[target]: {**values, name: target}
        for target, drawing in drawings.items()
        for ordinal, values in drawing.cells.items()
    }
    runs = {target: drawing.runs for target, drawing in drawings.items() if drawing.runs is not None}
    return replace(
        first,
        axes=(axis, *first.axes) if over_time else (*first.axes, axis),
        cells=cells,
        tables={
            column: _stacked({target: drawing.tables[column] for target, drawing in drawings.items()}, places)
            for column in first.tables
        },
        runs=_stacked(runs, places) if runs else None,
        models=_models(drawings, places),
        failed_models={name: problem for drawing in drawings.values() for name, problem in drawing.failed_models.items()},
        note="; ".join(together({target: drawing.note for target, drawing in drawings.items()})),
        sql="\n\n".join(f"-- {word} {target}\n{drawing.sql}" for target, drawing in drawings.items()),
        together={target: drawing.batch for target, drawing in drawings.items()},
        together_by=word,
    )


def _models(drawings: Mapping[str, Drawing], places: Mapping[str, int]) -> tuple[Predicted, ...]:
    """Return the models of all targets, each with its values for those that have it."""
    names = dict.fromkeys(model.name for drawing in drawings.values() for model in drawing.models)
    models = []
    for name in names:
        own = {target: model for target, drawing in drawings.items() for model in drawing.models if model.name == name}
        tables = {target: model.table for target, model in own.items()}
        facts = {target: model.definition for target, model in own.items()}
        models.append(replace(next(iter(own.values())), table=_stacked(tables, places), facts=facts))
    return tuple(models)


def together(notes: Mapping[str, str]) -> list[str]:
    """Return the notes of all batches, by target or label; one that not all have names its batch."""
    parts = {target: note.split("; ") for target, note in notes.items()}
    own = {target: [part for part in some if part and part != f"{TARGET} {target}"] for target, some in parts.items()}
    shared = [part for part in next(iter(own.values())) if all(part in some for some in own.values())]
    return [*shared, *(f"{target}: {part}" for target, some in own.items() for part in some if part not in shared)]


def _check(drawings: Mapping[str, Drawing], word: Word) -> None:
    (label, first), *others = drawings.items()
    for target, other in others:
        for what, mine, theirs in (
            ("columns", ", ".join(first.tables), ", ".join(other.tables)),
            ("values", _values(first), _values(other)),
            ("time columns", first.time, other.time),
            ("units", _units(first), _units(other)),
        ):
            if mine != theirs:
                both = f"{PLURALS[word]} {label!r} and {target!r}"
                raise SierraError(f"{both} have different {what}: {mine or 'none'} and {theirs or 'none'}")


def _values(drawing: Drawing) -> str:
    """Return the values of all variables, also of those with one value, which are no axes of the drawing."""
    values: dict[str, dict[str, None]] = {}
    for cell in drawing.cells.values():
        for name, value in cell.items():
            values.setdefault(name, {})[str(value)] = None
    return "; ".join(f"{name} = {', '.join(texts)}" for name, texts in values.items())


def _units(drawing: Drawing) -> str:
    """Return the units that the figure shows, with their columns."""
    shown = (*drawing.tables, drawing.time)
    return ", ".join(f"{name} in {unit}" for name, unit in drawing.units.items() if name in shown and unit)


def _stacked(tables: Mapping[str, pa.Table], places: Mapping[str, int]) -> pa.Table:
    """Return the tables of all targets as one; the experiments of each begin at its place."""
    import pyarrow as pa
    import pyarrow.compute as pc

    def moved(table: pa.Table, by: int) -> pa.Table:
        column = table.schema.get_field_index("experiment")
        return table.set_column(column, "experiment", pc.add(table.column(column), by))

    return pa.concat_tables([moved(table, places[target]) for target, table in tables.items()], promote_options="permissive")
