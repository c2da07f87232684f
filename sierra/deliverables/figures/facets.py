"""Small multiples: one panel for each value of a variable, all with the same axes, colours and legend."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sierra.deliverables.figures import style
from sierra.errors import UsageError
from sierra.model import Axis, Value
from sierra.util.arrow_columns import numpy_of

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing

MOST = 36
"""The largest number of panels."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel: the data of the experiments in it, and where it is drawn."""

    plot: Axes
    drawing: Drawing
    """The data of its experiments; its variables are those of the figure without `facet`."""


@dataclass(frozen=True, slots=True)
class Panels:
    """The panels of a figure, and what they share."""

    figure: Figure
    panels: tuple[Panel, ...]
    first: Axis
    """The variable of the x axis, or of the colours of a kind whose x axis shows something else."""
    groups: Axis
    """The other variables as one: a colour for each combination of their values."""
    combinations: tuple[tuple[Value, ...], ...]
    grouped: tuple[Axis, ...]

    @property
    def plots(self) -> list[Axes]:
        return [panel.plot for panel in self.panels]

    def group(self, drawing: Drawing, ordinal: int) -> int:
        """Return the place of an experiment's combination of values among all."""
        return self.combinations.index(_values(drawing, self.grouped, ordinal))

    def place(self, drawing: Drawing, ordinal: int) -> int:
        """Return the place of an experiment's value on the first axis."""
        return self.first.values.index(drawing.cells[ordinal][self.first.name]) if drawing.axes else 0


def panels(drawing: Drawing, *, over_first: bool = True) -> Panels:
    """Return the panels: one for each value of `facet`, or one. If not `over_first`, colours also show the first variable."""
    kept = tuple(axis for axis in drawing.axes if axis.name != drawing.figure.facet)
    first = kept[0] if kept and over_first else Axis("", ("",))
    grouped = kept[1:] if over_first else kept
    rest = list(dict.fromkeys(_values(drawing, grouped, ordinal) for ordinal in sorted(drawing.cells))) or [()]
    whole = replace(drawing, axes=kept)
    facet = next((axis for axis in drawing.axes if axis.name == drawing.figure.facet), None)
    if facet is None:
        figure, (plot,) = style.panels(1)
        return Panels(figure, (Panel(plot, whole),), first, _joined(grouped, rest), tuple(rest), grouped)
    if len(facet.values) > MOST:
        raise UsageError(f"{facet.name} needs {len(facet.values)} panels, but at most {MOST} are possible; use `where`")
    figure, plots = style.panels(len(facet.values))
    made = []
    for plot, value in zip(plots, facet.values, strict=True):
        within = [ordinal for ordinal, cell in drawing.cells.items() if cell[facet.name] == value]
        made.append(Panel(plot, _only(whole, within)))
        style.title(plot, style.point(drawing, [facet], within[0]))
    return Panels(figure, tuple(made), first, _joined(grouped, rest), tuple(rest), grouped)


def _values(drawing: Drawing, axes: tuple[Axis, ...], ordinal: int) -> tuple[Value, ...]:
    return tuple(drawing.cells[ordinal][axis.name] for axis in axes)


def _joined(axes: tuple[Axis, ...], combinations: list[tuple[Value, ...]]) -> Axis:
    """Return several variables as one whose values are names."""
    if len(axes) == 1:
        return replace(axes[0], values=tuple(value for (value,) in combinations))
    label = ", ".join(style.axis_label(axis) for axis in axes)
    words = [dict(zip(axis.values, style.names(axis.values, 12), strict=True)) for axis in axes]
    names = (", ".join(known[value] for known, value in zip(words, values, strict=True)) for values in combinations)
    return Axis(label, tuple(names), label=label)


def _only(drawing: Drawing, ordinals: list[int]) -> Drawing:
    """Return the part of a drawing that belongs to some experiments."""
    return replace(
        drawing,
        cells={ordinal: drawing.cells[ordinal] for ordinal in ordinals},
        tables={name: _rows(table, ordinals) for name, table in drawing.tables.items()},
        runs=None if drawing.runs is None else _rows(drawing.runs, ordinals),
        rows={name: _rows(table, ordinals) for name, table in drawing.rows.items()},
        models=tuple(replace(model, table=_rows(model.table, ordinals)) for model in drawing.models),
    )


def _rows(table: pa.Table, ordinals: list[int]) -> pa.Table:
    """Return the rows of some experiments; all rows, if the table does not name experiments."""
    if "experiment" not in table.column_names:
        return table
    return table.filter(np.isin(numpy_of(table.column("experiment")), ordinals))
