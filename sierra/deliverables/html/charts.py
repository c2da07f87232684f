"""Charts that readers can explore: lines with bands, or points with intervals, from the rows of a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from sierra.deliverables.html.escaping import Data
from sierra.deliverables.html.tables import Cell, Table, exact
from sierra.util.html_elements import Markup, element
from sierra.util.lazy_definitions import dataclass


@dataclass(frozen=True, slots=True)
class ChartAxis:
    """One axis of a chart."""

    column: int
    """The place of the column in the table; -1 for an x axis with one place only."""
    label: str
    log: Literal[0, 2, 10] = 0
    """The base of a logarithmic axis; 0 for a linear one."""
    limits: tuple[float, float] | None = None
    ticks: tuple[float, ...] = ()
    """The positions of the ticks; default: round numbers."""
    names: tuple[Cell, ...] = ()
    """The values of an axis of names, which are side by side; empty for an axis of numbers."""


@dataclass(frozen=True, slots=True)
class Series:
    """One line of a chart: the rows from `start` to before `stop`, in the order of x."""

    name: str
    colour: str
    start: int
    stop: int
    dark: str = ""
    """The colour on a dark background; default: the same."""
    dashes: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart of some rows of a table. The columns are given by their places; -1 for one that the table does not have."""

    table: Table
    x: ChartAxis
    y: ChartAxis
    series: Sequence[Series]
    title: str = ""
    group: str = ""
    """The label of the names of the series."""
    low: int = -1
    high: int = -1
    n: int = -1
    never: int = -1
    """The column of the numbers of runs that have no value, because they never reached a threshold."""
    form: Literal["lines", "points"] = "lines"
    joined: bool = True
    """True if lines join the points."""


def chart_element(chart: Chart, index: int, heading: str = "h3") -> Markup:
    """Return the element that a chart is drawn in; `index` is its number in the section."""
    about = f"{chart.title or chart.y.label}: {chart.y.label} over {chart.x.label}, {len(chart.series)} series. "
    keys = "Arrow keys move the cursor, + and - zoom, 0 shows everything."
    title = element(heading, chart.title, dir="auto") if chart.title else None
    plot = element("div", class_="plot", tabindex=0, role="group", aria_label=about + keys)
    return element("div", title, plot, class_="chart", data_chart=index)


def as_data(chart: Chart, tables: Sequence[Table]) -> Data:
    """Return the chart as data for scripts; `tables` are those of its section, one of which is its own."""
    return {
        "table": next(index for index, table in enumerate(tables) if table is chart.table),
        "x": _axis(chart.x),
        "y": _axis(chart.y),
        "group": chart.group,
        "columns": {"low": chart.low, "high": chart.high, "n": chart.n, "never": chart.never},
        "form": chart.form,
        "joined": chart.joined,
        "series": list(map(_series, chart.series)),
    }


def _series(series: Series) -> Data:
    colours = (series.colour, series.dark or series.colour)
    return {"name": series.name, "colours": colours, "dashes": series.dashes, "rows": (series.start, series.stop)}


def _axis(axis: ChartAxis) -> Data:
    return {
        "column": axis.column,
        "label": axis.label,
        "log": axis.log,
        "limits": axis.limits,
        "ticks": axis.ticks,
        "names": list(map(exact, axis.names)),
    }
