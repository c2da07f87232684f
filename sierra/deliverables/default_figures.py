"""The figures to draw of a batch: the declared ones, or default figures of the columns that differ most between experiments."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from math import isfinite

from sierra.config import figure_options
from sierra.config.deliverable_tables import Figure
from sierra.deliverables import bound, kinds, suggest_tables
from sierra.deliverables.figures.gather import varied
from sierra.deliverables.gallery import Gallery
from sierra.errors import DamagedFile, NotFound, SierraError
from sierra.model import Axis
from sierra.store.batch_data import MIXED, AllFailed, BatchData, NoRuns, OutputTable
from sierra.store.sql_names import identifier
from sierra.util.fs import fitting
from sierra.util.lazy_definitions import regex
from sierra.util.text import few, numbered

AT_MOST = 16
"""The largest number of default figures of one batch; others are reported, and drawn on request."""
SHOWN = 6
"""The largest number of columns that a note names."""
OF_RUN = regex(r"\W*(run|seed|repetition|replicate|replication)s?([ _-]?(id|no|nr|num|number|index))?\W*", re.I)
"""The names of columns with the number of a run."""


def wanted(gallery: Gallery, name: str | None, *, together: bool = False) -> tuple[Mapping[str, Figure], list[str]]:
    """Return the figures of a batch to draw, by name, and notes about them.

    Without `name`, those that are bound to another query, and those about something that only other batches have, are not
    among them. `together`: several batches are drawn, so those that are bound to any query are not.
    """
    declared = gallery.config.figures
    figure_options.check(declared)
    if why := gallery.frame.failure():
        if name is not None:
            raise AllFailed(why)
        return {}, [why]
    if name is not None:
        known = {**_default(gallery)[0], **declared}
        if name not in known:
            raise NotFound(f"this batch has no figure {name!r}; its figures: {', '.join(known) or 'none'}")
        return {name: known[name]}, []
    if declared:
        return _declared(gallery, declared, together)
    figures, notes = _default(gallery)
    best = _best(gallery.frame, figures)
    if left := [name for name in figures if name not in best]:
        notes.append(f"{len(left)} more figures can be drawn, for example: sierra figures HASH {left[0]}")
    return best, notes


def _declared(gallery: Gallery, declared: Mapping[str, Figure], together: bool) -> tuple[dict[str, Figure], list[str]]:
    """Return the declared figures that show this batch, and notes on those whose query is invalid."""
    if together:
        return bound.unbound(declared), []
    of_batch, invalid = bound.of_batch(declared, gallery.queries, gallery.frame.batch)
    shown = {name: figure for name, figure in of_batch.items() if not gallery.is_of_others(figure)}
    return shown, [f"figure {note}" for note in invalid]


def _best(data: BatchData, figures: Mapping[str, Figure]) -> Mapping[str, Figure]:
    """Return as many figures as are drawn by default: those of columns that differ most between experiments."""
    if len(figures) <= AT_MOST:
        return figures
    columns: dict[str, dict[str, None]] = {}
    for figure in figures.values():
        columns.setdefault(figure.table, {}).update(dict.fromkeys(figure.columns))
    shares = {table: differing(data, table, list(names)) for table, names in columns.items()}
    share = {
        name: max((shares[figure.table].get(column, 0.0) for column in figure.columns), default=0.0)
        for name, figure in figures.items()
    }
    best = set(sorted(figures, key=lambda name: -share[name])[:AT_MOST])
    return {name: figure for name, figure in figures.items() if name in best}


def _default(gallery: Gallery) -> tuple[dict[str, Figure], list[str]]:
    """Return the default figures that fit each output; and notes on outputs and columns without one, and why.

    Outputs that another declared deliverable shows need no figure, and no note.
    """
    shown = kinds.shown_tables(gallery.config)
    problems = gallery.frame.problems
    notes = [f"no figure of table {name!r}: {error}" for name, error in problems.items() if not isinstance(error, NoRuns)]
    if not gallery.outputs and not problems:
        notes.append("no run wrote a table, so there is no figure; see: sierra sql 'FROM artifacts'")
    figures: dict[str, Figure] = {}
    for output in gallery.outputs.values():
        if gallery.frame.is_of_accepted(output.name):
            continue
        proposed, about_output = _of_output(gallery, output, noted=output.name not in shown)
        notes += about_output
        for name, figure in proposed.items():
            figures[_file_name(name, figures)] = figure
    return figures, notes


def _of_output(gallery: Gallery, output: OutputTable, *, noted: bool) -> tuple[dict[str, Figure], list[str]]:
    """Return the default figures of an output; and, if `noted`, notes on what has none."""
    time = gallery.time(output)
    columns = [column for column in output.columns if column != time]
    notes: list[str] = []
    if noted:
        notes += [f"no figure of column {column!r} of output {output.name!r}: it {MIXED}" for column in output.mixed]
        notes += suggest_tables.notes(gallery.frame, output, time)
    try:
        seen = gallery.coverage(output)
    except DamagedFile:
        raise
    except SierraError as error:
        return {}, [*notes, f"no figure of output {output.name!r}: {error}"] if noted else []
    gallery.note_rows(output, seen)
    series = output.rows > 1 and not gallery.takes_mean(output)
    measures = _measures(gallery, output, columns)
    if noted and (left := [repr(column) for column in columns if column not in measures]):
        which = f"no figure of {few(left, SHOWN)} of output {output.name!r}"
        notes.append(f"{which}: {'it is' if len(left) == 1 else 'they are'} the same in all runs, or the number of a run")
    return of_columns(output.name, measures, varied(gallery.axes), series=series), notes


def _measures(gallery: Gallery, output: OutputTable, columns: Sequence[str]) -> Sequence[str]:
    """Return the columns that are worth a figure: not those that are the same everywhere, or the number of a run."""
    same = _constant(gallery.frame, output.name, columns) - {*gallery.rates(output), *output.flags}
    return [column for column in columns if column not in same and not OF_RUN.fullmatch(column)] or columns


def of_columns(table: str, columns: Iterable[str], axes: Sequence[Axis], *, series: bool) -> dict[str, Figure]:
    """Return the default figures of these columns by name, which is also that of files.

    `series`: whether there is something to show over time.
    """
    shown = ["timeseries"] if series else []
    shown += ["heatmap", "summary"] if len(axes) == 2 else ["summary"]
    return {
        fitting(f"{table}_{column}_{kind}"): Figure.model_validate({"kind": kind, "table": table, "column": column})
        for column in columns
        for kind in shown
    }


def _constant(data: BatchData, table: str, columns: Sequence[str]) -> set[str]:
    """Return the columns that have the same value in all rows of all runs."""
    if not columns:
        return set()
    tests = ", ".join(f"coalesce(min({c}) = max({c}) AND count({c}) = count(*), false)" for c in map(identifier, columns))
    [row] = data.run(f"SELECT {tests} FROM {data.rows(table)}")  # noqa: S608 - own statement
    return {column for column, is_constant in zip(columns, row, strict=True) if is_constant}


def differing(data: BatchData, table: str, columns: Sequence[str]) -> dict[str, float]:
    """Return by column which part of the variance of the runs' means is between experiments: 0 is nothing, 1 is all."""
    if not columns:
        return {}
    names = [(f"c{number}", identifier(column)) for number, column in enumerate(columns)]
    means = ", ".join(f"avg({column}::DOUBLE) FILTER (isfinite({column}::DOUBLE)) AS {name}" for name, column in names)
    parts = ", ".join(f"avg({name}) AS m{name}, coalesce(var_pop({name}), 0) AS v{name}" for name, _ in names)
    shares = ", ".join(f"var_pop(m{name}) / nullif(var_pop(m{name}) + avg(v{name}), 0)" for name, _ in names)
    of_runs = f'SELECT "# experiment" AS e, run, {means} FROM {data.rows(table)} GROUP BY ALL'  # noqa: S608 - own statement
    [row] = data.run(f"SELECT {shares} FROM (SELECT e, {parts} FROM ({of_runs}) GROUP BY e)")  # noqa: S608
    known = zip(columns, row, strict=True)  # the variance of very large numbers is not finite
    return {column: share if share is not None and isfinite(share) else 0.0 for column, share in known}


def _file_name(name: str, taken: Mapping[str, Figure]) -> str:
    """Return a file name for a figure that is valid on all systems and not taken."""
    plain = re.sub(r"[^\w.-]+", "_", name).strip("_.") or "figure"
    return next(free for free in numbered(plain) if free not in taken)
