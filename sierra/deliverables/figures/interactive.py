"""Figures as pages of HTML: charts that readers can explore, or the figure as it is printed, with its data and its origin."""

from __future__ import annotations

import colorsys
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from matplotlib.typing import ColorType, LineStyleType

from sierra.deliverables import html
from sierra.deliverables.figures import axis_limits, bands, facets, style, thinning, timeseries
from sierra.deliverables.figures.style import Look
from sierra.deliverables.html import Chart, ChartAxis, SectionContent, Series, tables
from sierra.deliverables.html.tables import Table
from sierra.model import Axis
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.version import __version__

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing

POINTS = 5000
"""The largest number of points of a series that is not thinned, and of rows of a table that is not that of a chart."""
DARK = "#14181d"
"""The dark background of pages: see `page.css`."""
CONTRAST = 4.0
"""The smallest ratio of contrast of a line to the dark background."""
DASHES: Mapping[str, tuple[float, ...]] = {"--": (7, 4), ":": (2, 3), "-.": (8, 3, 2, 3)}
NAME = 60
"""The largest length of the name of a series."""


@dataclass(frozen=True, slots=True)
class _Line:
    """A series: the numbers of its rows in the order of x."""

    name: str
    look: Look
    rows: Sequence[int]


@dataclass(frozen=True, slots=True)
class _Panel:
    title: str
    lines: Sequence[_Line]


def page(drawing: Drawing, svg: bytes, origin: str) -> bytes:
    """Return the page of a figure; `svg` is the same figure as it is printed, for kinds without charts."""
    shown = content(drawing, b"" if drawing.charts else svg, origin)
    metadata = {"generator": f"SIERRA {__version__}", "description": drawing.note, "sierra": origin}
    return html.page(shown.title, [html.section(shown)], metadata | {"sierra:sql": drawing.sql})


def content(drawing: Drawing, svg: bytes, origin: str) -> SectionContent:
    """Return the content of the section of a figure on a page."""
    charts = drawing.charts
    return SectionContent(
        drawing.title,
        charts,
        svg,
        tuple(filter(None, (drawing.note, *_thinned(charts), drawing.figure.footnote))),
        (charts[0].table,) if charts else tuple(_tables(drawing)),
        drawing.sql,
        _origin(drawing, origin),
    )


def over_time(drawing: Drawing) -> list[Chart]:
    """Return a chart for each combination of the other variables, with a line for each value of the first."""
    (table,) = drawing.tables.values()
    facets.check_multiples(drawing, drawing.axes[1:], timeseries.others(drawing))
    _check_y(drawing)
    first, slices = timeseries.first_axis(drawing), timeseries.by_experiment(table)
    entries = dict(zip(first.values, zip(style.names(first.values, NAME), style.looks(first), strict=True), strict=True))
    ordered = sorted(slices, key=lambda ordinal: first.values.index(timeseries.value_of(drawing, ordinal)))
    panels = []
    for values in timeseries.others(drawing):
        own = [ordinal for ordinal in ordered if timeseries.rest_of(drawing, ordinal) == values]
        lines = [
            _Line(*entries[timeseries.value_of(drawing, ordinal)], _thinned_rows(drawing, slices[ordinal])) for ordinal in own
        ]
        if lines:
            panels.append(_Panel(style.point(drawing.axes[1:], drawing.cells[own[0]]), lines))
    form: Literal["lines", "points"] = "lines" if any(part.stop - part.start > 1 for part in slices.values()) else "points"
    x = ChartAxis(len(drawing.axes), style.time_label(drawing), 10 if drawing.figure.log_x else 0, drawing.figure.xlim)
    return _charts(drawing, panels, x, style.axis_label(first) if drawing.axes else "", form=form, joined=True)


def over_variable(drawing: Drawing) -> list[Chart]:
    """Return a chart for each value of `facet`, with points for each combination of the other variables."""
    (table,) = drawing.tables.values()
    within = facets.panels(drawing)
    style.check_x(within.first, log=drawing.figure.log_x)
    _check_y(drawing)
    entries, first = list(zip(style.names(within.groups.values, NAME), style.looks(within.groups), strict=True)), within.first
    ordinals = table.column("experiment").to_pylist()
    facet = [axis for axis in drawing.axes if axis.name == drawing.figure.facet]
    panels = []
    for panel in within.panels:
        groups: list[list[int]] = [[] for _ in entries]
        own = [row for row, ordinal in enumerate(ordinals) if ordinal in panel.drawing.cells]
        for row in sorted(own, key=lambda row: within.place(drawing, ordinals[row])):
            groups[within.group(drawing, ordinals[row])].append(row)
        lines = [_Line(*entry, rows) for entry, rows in zip(entries, groups, strict=True) if rows]
        if lines:
            panels.append(_Panel(style.point(facet, drawing.cells[ordinals[own[0]]]) if facet else "", lines))
    x = _variable(drawing, first, [axis.name for axis in drawing.axes].index(first.name) if drawing.axes else -1)
    return _charts(drawing, panels, x, style.axis_label(within.groups), form="points", joined=first.numeric)


def _check_y(drawing: Drawing) -> None:
    (table,) = drawing.tables.values()
    style.check_y(drawing, style.span(style.column(table, bands.columns(drawing.figure)[0]))[1])


def _variable(drawing: Drawing, axis: Axis, column: int) -> ChartAxis:
    """Return the x axis of an independent variable."""
    label = drawing.figure.xlabel or style.axis_label(axis)
    if not axis.numeric:
        return ChartAxis(column, label, names=axis.values)
    log = style.is_log(axis, drawing.figure.log_x)
    ticks = tuple(style.numbers(axis)) if log or len(axis.values) <= 6 else ()
    return ChartAxis(column, label, 2 if log else 0, drawing.figure.xlim, ticks)


def _charts(
    drawing: Drawing, panels: Sequence[_Panel], x: ChartAxis, group: str, *, form: Literal["lines", "points"], joined: bool
) -> list[Chart]:
    """Return the charts of all panels, which share one table: the rows of the first line, of the second, and so on."""
    (source,) = drawing.tables.values()
    lines = [line for panel in panels for line in panel.lines]
    table = _table_of(drawing, [row for line in lines for row in line.rows])
    stops = list(accumulate((len(line.rows) for line in lines), initial=0))
    series = iter([_series(line, start, stop) for line, (start, stop) in zip(lines, pairwise(stops), strict=True)])
    places = {column: index + len(drawing.axes) for index, column in enumerate(_shown(source))}
    center, low, high = (places[column] for column in bands.columns(drawing.figure))
    limits = _limits(drawing, panels=len(panels))
    y = ChartAxis(center, style.value_label(drawing), 10 if drawing.figure.log_y else 0, limits)
    return [
        Chart(
            table,
            x,
            y,
            [next(series) for _ in panel.lines],
            title=panel.title,
            group=group,
            low=low,
            high=high,
            n=places["n"],
            never=places.get("never", -1),
            form=form,
            joined=joined,
        )
        for panel in panels
    ]


def _table_of(drawing: Drawing, rows: Sequence[int]) -> Table:
    """Return the table of these rows of the only table, in this order; its note counts the others."""
    ((name, source),) = drawing.tables.items()
    table = _table(name, source.take(rows), drawing, most=len(rows))
    left_out = source.num_rows - len(rows)
    return replace(table, note=f"{left_out:,} of {source.num_rows:,} rows are left out" if left_out else "")


def _series(line: _Line, start: int, stop: int) -> Series:
    colour = to_hex(line.look["color"])
    return Series(line.name, colour, start, stop, on_dark(colour), _dashes(line.look.get("linestyle", "-")))


def _dashes(linestyle: LineStyleType) -> tuple[float, ...]:
    if isinstance(linestyle, str):
        return DASHES.get(linestyle, ())
    return tuple(2.0 * length for length in linestyle[1] or ())


def on_dark(colour: ColorType) -> str:
    """Return a colour, made lighter until it can be seen on the dark background (contrast as in WCAG 2.2)."""
    hue, lightness, saturation = colorsys.rgb_to_hls(*to_rgb(colour))
    lighter = [colour, *(colorsys.hls_to_rgb(hue, step / 20, saturation) for step in range(int(20 * lightness) + 1, 21))]
    return to_hex(next(shade for shade in lighter if (_luminance(shade) + 0.05) / (_luminance(DARK) + 0.05) >= CONTRAST))


def _luminance(colour: ColorType) -> float:
    """Return the relative luminance of a colour as WCAG 2.2 defines it."""
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in to_rgb(colour)]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))


def _thinned_rows(drawing: Drawing, rows: slice) -> list[int]:
    """Return the numbers of the rows of a series in its chart: all, or those of a long series that `thinning` keeps."""
    places = np.arange(rows.start, rows.stop)
    if len(places) > POINTS:
        (table,) = drawing.tables.values()
        t, *lines = (style.column(table, name)[rows] for name in ("t", *bands.columns(drawing.figure)))
        places = places[thinning.kept(t, *lines, log=drawing.figure.log_x)]
    numbers: list[int] = places.tolist()
    return numbers


def _thinned(charts: Sequence[Chart]) -> list[str]:
    """Return what charts leave out to be fast."""
    notes = dict.fromkeys(chart.table.note for chart in charts if chart.table.note)
    return [f"of each 1/{thinning.PARTS:,} of the x axis, the extremes are shown: {note}" for note in notes]


def _limits(drawing: Drawing, *, panels: int) -> tuple[float, float] | None:
    """Return the limits of the values: those that the figure declares, those of its print, or those that panels share."""
    if drawing.figure.ylim:
        return drawing.figure.ylim
    if limits := axis_limits.cut(drawing):
        return limits.low, limits.high
    if panels == 1:
        return None
    (table,) = drawing.tables.values()
    ends = [style.drawable(style.column(table, name), drawing) for name in bands.columns(drawing.figure)]
    low, high = float(np.nanmin(ends)), float(np.nanmax(ends))
    margin = (high - low) * axis_limits.MARGIN or 1.0
    return (low, high * 1.05) if drawing.figure.log_y else (low - margin, high + margin)


def _tables(drawing: Drawing) -> Iterator[Table]:
    """Yield the data of a figure without charts."""
    for name, table in drawing.tables.items():
        yield _table(name, table, drawing)
    if drawing.runs is not None:
        yield _table("runs", drawing.runs, drawing)
    for name, table in drawing.rows.items():
        yield _table(name, table, drawing)
    for model in drawing.models:
        yield _table(f"model {model.label}", model.table, drawing)


def _table(name: str, table: pa.Table, drawing: Drawing, most: int = POINTS) -> Table:
    """Return a table with the values of the variables instead of the numbers of experiments."""
    headers = {"t": _header(drawing.time, drawing), **{column: _header(column, drawing) for column in drawing.tables}}
    whole = tables.of_arrow(name, table.select(_shown(table)), most=most, headers=headers)
    if "experiment" not in table.column_names or not drawing.cells:
        return whole
    ordinals = numpy_of(table.column("experiment"))[:most].tolist()
    values = tuple([drawing.cells[ordinal][axis.name] for ordinal in ordinals] for axis in drawing.axes)
    variables = tuple(f"{axis.name} [{axis.unit}]" if axis.unit else axis.name for axis in drawing.axes)
    return Table(name, (*variables, *whole.headers), (*values, *whole.columns), whole.note)


def _header(name: str, drawing: Drawing) -> str:
    unit = drawing.units.get(name, "")
    return f"{name} [{unit}]" if unit else name


def _shown(table: pa.Table) -> list[str]:
    return [name for name in table.column_names if name != "experiment"]


def _origin(drawing: Drawing, origin: str) -> dict[str, str]:
    """Return the facts about where the numbers come from."""
    batches = [f"{batch} ({target})" for target, batch in drawing.together.items()] or [drawing.batch]
    return {"batch": ", ".join(batches), "record": origin}
