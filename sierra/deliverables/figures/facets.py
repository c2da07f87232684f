"""Small multiples: one panel for each value of a variable, all with the same axes, colours and legend."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sierra.deliverables.figures import style
from sierra.errors import UsageError
from sierra.model import Axis, Value
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import dataclass, replace

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing

MOST = 36
"""The largest number of panels."""
WIDE = 8
"""The largest number of columns of panels."""


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
    rest = combinations(drawing, grouped)
    whole = replace(drawing, axes=kept)
    facet = next((axis for axis in drawing.axes if axis.name == drawing.figure.facet), None)
    if facet is None:
        figure, (plot,) = style.panels(1)
        return Panels(figure, (Panel(plot, whole),), first, _joined(grouped, rest), tuple(rest), grouped)
    check(len(facet.values))
    figure, plots = style.panels(len(facet.values))
    facet_panels = []
    for plot, value in zip(plots, facet.values, strict=True):
        within = [ordinal for ordinal, cell in drawing.cells.items() if cell[facet.name] == value]
        facet_panels.append(Panel(plot, _only(whole, within)))
        style.title(plot, style.point([facet], drawing.cells[within[0]]))
    return Panels(figure, tuple(facet_panels), first, _joined(grouped, rest), tuple(rest), grouped)


def unnamed(drawing: Drawing, *, numbers: bool = True, beside: float = 0) -> list[str]:
    """Return a note if an x axis with values side by side lacks the names of some.

    `numbers`: numbers are side by side too. `beside`: the width of a colour bar in inches.
    """
    within = panels(drawing)
    return style.unnamed(within.plots[0], within.first, beside) if numbers or not within.first.numeric else []


def combinations(drawing: Drawing, axes: Sequence[Axis], ordinals: Iterable[int] | None = None) -> list[tuple[Value, ...]]:
    """Return the combinations of values of some variables that experiments (default: all) have, in the order of the values."""
    present = {_values(drawing, axes, ordinal) for ordinal in (drawing.cells if ordinals is None else ordinals)}

    def order(values: tuple[Value, ...]) -> list[int]:
        return [axis.values.index(value) for axis, value in zip(axes, values, strict=True)]

    return sorted(present, key=order) or [()]


def multiples(drawing: Drawing, axes: Sequence[Axis], shown: Sequence[tuple[Value, ...]]) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each of these combinations of values, and the panels; see `check_multiples`.

    Columns of panels have their value above them and rows have theirs beside them; other panels have a title each.
    """
    columns = check_multiples(drawing, axes, shown)
    cells = [dict(zip((axis.name for axis in axes), values, strict=True)) for values in shown]
    if columns is None:
        figure, plots = style.panels(len(shown))
        for plot, cell in zip(plots, cells, strict=True):
            style.title(plot, style.point(axes, cell))
        return figure, plots
    figure, plots = _in_columns(axes, columns, shown)
    others = [axis for axis in axes if axis is not columns]
    style.strips(plots, [style.point([columns], cell) for cell in cells], [style.point(others, cell) for cell in cells])
    return figure, plots


def check_multiples(drawing: Drawing, axes: Sequence[Axis], shown: Sequence[tuple[Value, ...]]) -> Axis | None:
    """Return the variable of the columns of panels: `facet`, or of several the one with most values that have room.

    Raises UsageError for too many panels.
    """
    check(len(shown))
    if len(shown) == 1:
        return None
    columns = next((axis for axis in axes if axis.name == drawing.figure.facet), None)
    if columns and (count := len(_used(axes, columns, shown))) > WIDE:
        raise UsageError(f"facet: {columns.name} has {count} values, but at most {WIDE} columns of panels are possible")
    several = [axis for axis in axes if len(_used(axes, axis, shown)) > 1]
    counts = {axis: len(_used(axes, axis, shown)) for axis in reversed(several)}
    narrow = [axis for axis in counts if counts[axis] <= min(WIDE, style.most_in_grid())]
    return columns or (max(narrow, key=lambda axis: counts[axis]) if len(several) > 1 and narrow else None)


def _used(axes: Sequence[Axis], columns: Axis, shown: Sequence[tuple[Value, ...]]) -> list[Value]:
    at = axes.index(columns)
    return [value for value in columns.values if any(values[at] == value for values in shown)]


def experiments(drawing: Drawing, ordinals: Iterable[int]) -> tuple[Figure, dict[int, Axes]]:
    """Return a figure with a titled panel for each of these experiments, in the order of `ordered`."""
    placed = ordered(drawing, ordinals)
    figure, plots = multiples(drawing, drawing.axes, [_values(drawing, drawing.axes, ordinal) for ordinal in placed])
    return figure, dict(zip(placed, plots, strict=True))


def ordered(drawing: Drawing, ordinals: Iterable[int]) -> list[int]:
    """Return experiments in the order of the values of their variables, which is that of their panels."""
    places = {_values(drawing, drawing.axes, ordinal): ordinal for ordinal in ordinals}
    return [places[values] for values in combinations(drawing, drawing.axes, places.values())] if places else []


def check(count: int) -> None:
    """Raise UsageError if there are too many panels."""
    if count > MOST:
        raise UsageError(
            f"the figure needs {count} panels, but at most {MOST} are possible; choose some with where, or draw a summary or a "
            "heatmap"
        )


def _in_columns(axes: Sequence[Axis], columns: Axis, shown: Sequence[tuple[Value, ...]]) -> tuple[Figure, list[Axes]]:
    """Return panels in a grid: a column for each value of one variable, and a row for each combination of the others."""
    at, used = axes.index(columns), _used(axes, columns, shown)
    rows = list(dict.fromkeys((*values[:at], *values[at + 1 :]) for values in shown))
    places = [rows.index((*values[:at], *values[at + 1 :])) * len(used) + used.index(values[at]) for values in shown]
    return style.grid(places, len(used))


def _values(drawing: Drawing, axes: Sequence[Axis], ordinal: int) -> tuple[Value, ...]:
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
