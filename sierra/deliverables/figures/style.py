"""The look of figures: as wide as one column of a paper, 8 pt, colours for colour-blind readers, literal text.

No text is read as TeX, so `$` and `_` are printed as they are. The legend is above the data, never on them; a colour bar
replaces it for more than `FEW` numbers or more than `NAMES` names.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap, LogNorm, Normalize, is_color_like
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.textpath import text_to_path
from matplotlib.ticker import AutoLocator, EngFormatter, FixedLocator, FuncFormatter, LogLocator, NullLocator, ScalarFormatter
from matplotlib.transforms import Bbox
from matplotlib.typing import ColorType, LineStyleType, RcKeyType

from sierra.config.deliverable_tables import Figure as FigureTable
from sierra.deliverables.figures import font
from sierra.errors import UsageError
from sierra.model import Axis, Value
from sierra.stats.words import of_run
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import few, visible

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing

Floats = npt.NDArray[np.float64]

WIDTHS = {
    "ieee-column": 3.5,
    "ieee-page": 7.16,
    "acm-column": 3.33,
    "acm-page": 7.0,
    "lncs": 4.8,
    "elsevier-column": 3.54,
    "elsevier-page": 7.48,
    "neurips": 5.5,
    "slide": 5.0,
}
"""The widths of columns and pages in inches, as templates of papers have them."""
SLIDE = (5.0, 2.8)


@dataclass(frozen=True, slots=True)
class Page:
    """The choices of one figure about size and colours."""

    width: float | None = None
    """In inches; None: a column, or a page for many panels."""
    height: float | None = None
    """The complete height in inches; None: as much as the content needs."""
    colours: tuple[ColorType, ...] = ()
    """The colours of categories; empty: the palette of Okabe and Ito."""
    legend: str = "above"
    titles: str = "values"


_page: ContextVar[Page | None] = ContextVar("_page", default=None)


def chosen() -> Page:
    """Return the choices for the figure that is being drawn."""
    return _page.get() or Page()


class Look(TypedDict, total=False):
    """The look of a line, as matplotlib's keyword arguments."""

    color: ColorType
    linestyle: LineStyleType
    linewidth: float
    marker: str
    markevery: float
    markersize: float


COLUMN = 3.5
PAGE = 7.16
HEIGHT = 2.4
STRIP = "strip"
"""The mark of the texts beside rows of panels."""
UPRIGHT = 0.75
"""The width of such a text in inches, if the row is too low for a turned one."""
GAP = 0.05
"""The space around texts and legends above and below the plots, in inches."""
MARGIN = 0.55
"""The width of the labels and ticks beside the plots, about, in inches."""
SMALLEST = 4.3
"""The size of the smallest ticks, in points. If even these have no room, some are left out."""
FEW = 8
"""The largest number of lines with an entry each in a legend."""
FAINT = "#777777"
NAMED = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#8C8C8C")
"""Okabe and Ito's palette without its yellow, which is too light for lines on white."""
MARKERS = "osD^vPX*"
DASHES: tuple[LineStyleType, ...] = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (1, 3)), (0, (3, 1, 1, 1)))
"""Line styles, so that lines differ in more than colour."""
MOST = 200
"""The largest number of lines or groups in a figure."""
HATCHES = ("", "////", "\\\\\\\\", "....", "xxxx", "----", "++++", "oooo")
"""Patterns of surfaces, so that they differ in more than colour."""
NAMES = 24
"""The largest number of names with an entry each in a legend, if they differ in colour only; more become a scale of colours."""
STYLED = 64
"""The largest number of names with an entry each in a legend, if they differ in colour and dashes."""
ENTRY = 0.12
"""The height of an entry of a legend in inches."""

BASE = frozenset({"s", "m", "g", "J", "W", "V", "A", "N", "Pa", "Hz", "F", "H", "C", "T", "Ω", "K", "B"})
"""The units that take prefixes, such as ms and kJ."""

SETTINGS = Path(__file__).with_name("sierra.mplstyle")


@contextmanager
def applied(figure: FigureTable | None = None) -> Iterator[None]:
    """Apply matplotlib's defaults and these settings, whatever the user's settings are; restore them afterwards.

    `figure`: the table whose size and palette are used.
    """
    before = _page.set(page(figure) if figure else None)
    try:
        with settings():
            yield
    finally:
        _page.reset(before)


def page(figure: FigureTable) -> Page:
    """Return the choices of a figure. Raises UsageError for a colour that does not exist."""
    width, height = None, None
    if isinstance(figure.size, tuple):
        width, height = figure.size
    elif figure.size == "slide":
        width, height = SLIDE
    elif "size" in figure.model_fields_set:
        width = WIDTHS[figure.size]
    return Page(width, height, _palette(figure.palette), figure.legend, figure.panel_titles)


def _palette(given: str | tuple[str, ...]) -> tuple[ColorType, ...]:
    match given:
        case "okabe-ito":
            return ()
        case "petroff":
            return tuple(mpl.color_sequences["petroff8"])
        case "grey":
            return tuple(str(level) for level in (0.0, 0.45, 0.65, 0.25, 0.8, 0.55, 0.35, 0.72))
        case str():
            return tuple(map(tuple, mpl.colormaps[given](np.linspace(0, 0.85, FEW))))
        case _:
            if wrong := [colour for colour in given if not is_color_like(colour)]:
                raise UsageError(f"palette: {wrong[0]!r} is not a colour; use a name or #RRGGBB")
            return given


@contextmanager
def settings() -> Iterator[None]:
    """Apply the settings alone, for as long as a video takes."""
    font.register()
    with mpl.rc_context(), warnings.catch_warnings():
        mpl.rcParams.update(_defaults())
        # A character that the font lacks is drawn as a box; the figure is still drawn.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def choose_fonts(text: str) -> list[str]:
    """Choose fonts for all letters of a figure, until its settings end. Return a note on letters that no font has."""
    families, lacking = font.others(text)
    mpl.rcParams["font.family"] = [font.FAMILY, "DejaVu Sans", *families]
    codes = [f"U+{ord(letter):04X}" for letter in lacking]
    return [f"boxes: this machine has no font for {few(codes, 6)}; install one and draw again"] if codes else []


def blank(width: float = COLUMN, height: float = HEIGHT) -> Figure:
    """Return an empty figure; its size is in inches, unless the figure's keys choose another one."""
    of_page = chosen()
    figure = Figure(figsize=(of_page.width or width, of_page.height or height))
    FigureCanvasAgg(figure)
    return figure


def panels(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure of `count` panels that share their axes, and the panels row by row."""
    if count == 1:
        figure = blank()
        return figure, [figure.add_subplot()]
    columns = 2 if count in (2, 4) else min(max(3, int(np.ceil(np.sqrt(count)))), most_columns())
    return grid(range(count), columns)


def most_columns() -> int:
    """Return the largest number of columns of panels that the width of the figure has room for."""
    return min(6, max(2, int((chosen().width or PAGE) / 1.15)))


def most_in_grid() -> int:
    """Return the largest number of columns in a grid of panels, in which each column is a value of a variable."""
    return int(((chosen().width or PAGE) - MARGIN) / 0.9)


def maps(count: int, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure of `count` maps, two in a row; `height` is that of one map in inches."""
    if count == 1:
        figure = blank(COLUMN, height)
        return figure, [figure.add_subplot()]
    figure, plots = grid(range(count), 2)
    figure.set_figheight(chosen().height or -(-count // 2) * height + 0.3)
    return figure, plots


def grid(places: Sequence[int], columns: int) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels that share their axes, at these places of a grid, counted row by row; and the panels."""
    rows = 1 + max(places) // columns
    figure = blank(COLUMN if columns <= 2 else PAGE, 1.0 + rows * (1.3 if columns <= 2 else 1.5))
    every: list[Axes] = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel().tolist()
    for index, plot in enumerate(every):
        if index not in places:
            plot.remove()
            continue
        if index + columns not in places:
            plot.xaxis.set_tick_params(labelbottom=True)
        if index % columns == 0 or index - 1 not in places:
            plot.yaxis.set_tick_params(labelleft=True)
    return figure, [every[index] for index in places]


def outer_labels(plots: Sequence[Axes], xlabel: str, ylabel: str) -> None:
    """Label the outer panels of each row and column, once each."""
    first: dict[int, Axes] = {}
    last: dict[int, Axes] = {}
    for plot in plots:
        _, spec = _panel(plot)
        last[spec.colspan.start] = plot
        first.setdefault(spec.rowspan.start, plot)
    several = len(plots) > 1
    for plot in first.values():
        plot.set_ylabel(wrapped(ylabel, _room(plot)[1], 8, 2) if several else shortened(ylabel, 48))
    for plot in last.values():
        plot.set_xlabel(wrapped(xlabel, _room(plot)[0], 8, 2) if several else shortened(xlabel, 60))


def _room(plot: Axes, beside: float = 0) -> tuple[float, float]:
    """Return the width of a panel, and its height with its title and ticks, in inches. `beside`: width of a colour bar."""
    figure, spec = _panel(plot)
    grid = spec.get_gridspec()
    return (figure.get_figwidth() - MARGIN - beside) / grid.ncols - 0.1, figure.get_figheight() / grid.nrows - 0.1


def _panel(plot: Axes) -> tuple[Figure, SubplotSpec]:
    """Return the figure of a panel, and its place in the grid of panels."""
    figure, spec = plot.get_figure(root=True), plot.get_subplotspec()
    if figure is None or spec is None:
        raise TypeError("these axes are not a panel of a figure")
    return figure, spec


def title(plot: Axes, text: str) -> None:
    """Write the title of one of several panels, in lines that are no wider than the panel."""
    grid = _panel(plot)[1].get_gridspec()
    if grid.ncols * grid.nrows > 1:
        if chosen().titles == "letters":
            figure, _ = _panel(plot)
            text = f"({_letter(figure.axes.index(plot))}) {text}".rstrip()
        plot.set_title(_unbroken(text, _room(plot)[0]), fontsize=7)


def strips(plots: Sequence[Axes], above: Sequence[str], beside: Sequence[str]) -> None:
    """Write above each column of panels, and beside each row, what its panels share. The texts are given for each panel."""
    places = list(enumerate(_panel(plot)[1] for plot in plots))
    tops = {spec.colspan.start: k for k, spec in sorted(places, key=lambda of: -of[1].rowspan.start)}
    ends = {spec.rowspan.start: k for k, spec in sorted(places, key=lambda of: of[1].colspan.start)}
    for k, plot in enumerate(plots):
        title(plot, above[k] if k in tops.values() else "")
    for k in ends.values():
        text = _unbroken(beside[k], _room(plots[k])[1])
        at: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "center", "rotation": 270}
        plots[k].annotate(text, (1, 0.5), (3, 0), fontsize=7, gid=STRIP, **at)


def _unbroken(text: str, width: float) -> str:
    """Return a title in lines of this many inches. No line ends beside a =, if that can be."""
    return wrapped(text.replace(" = ", "\xa0=\xa0"), width, 7, 8).replace("\xa0", " ")


def _letter(index: int) -> str:
    """Return a, b, …, z, aa, ab, … for 0, 1, …"""
    return (_letter(index // 26 - 1) if index >= 26 else "") + "abcdefghijklmnopqrstuvwxyz"[index % 26]


def settle(figure: Figure, drawing: Drawing) -> None:
    """Place title, legend and small print around the plots; then compute the layout once for all formats."""
    width, table = figure.get_figwidth(), drawing.figure
    above: list[Legend | Text] = []
    below: list[Legend | Text] = []
    if table.title:
        above.append(figure.text(0.02, 1, wrapped(table.title, width * 0.96, 8.5), va="top", fontsize=8.5))
    for legend in figure.legends:
        if table.legend != "right":
            (above if table.legend == "above" else below).append(legend)
    small = (drawing.note if table.small_print else "", table.footnote)
    if words := "\n".join(wrapped(text, width * 0.97, 6, 8) for text in small if text):
        below.append(figure.text(0.99, 0, words, va="bottom", ha="right", fontsize=6, color=FAINT))
    _limit(figure, drawing)
    _in_engineering_units(figure)
    room = {item: item.get_window_extent().height / figure.dpi + GAP for item in [*above, *below]}
    around = sum(room.values()) + 2 * GAP
    beside = max((legend.get_window_extent().height / figure.dpi for legend in figure.legends if legend not in room), default=0)
    if chosen().height is None:
        plain = figure.get_figheight() + _titles(figure) + sum(room[item] for item in above) + GAP
        figure.set_figheight(max(plain, beside + around))
    _lay_out(figure, above, below, room)
    if any(plot.get_aspect() != "auto" for plot in figure.axes):
        _fit(figure, lambda: _lay_out(figure, above, below, room), around, beside)


def _fit(figure: Figure, lay_out: Callable[[], None], around: float, beside: float) -> None:
    """Fit texts and height to panels whose shape is fixed: they may be narrower than their part of the width."""
    fixed = [plot for plot in figure.axes if plot.get_aspect() != "auto"]
    strips = {text: plot for plot in fixed for text in plot.texts if text.get_gid() == STRIP}
    for plot in fixed:
        width = plot.get_position().width * figure.get_figwidth()
        plot.title.set_text(_unbroken(plot.get_title().replace("\n", " "), width))
    for strip, plot in strips.items():
        text, height = strip.get_text().replace("\n", " "), plot.get_position().height * figure.get_figheight()
        upright = inches(text, 7) > 2 * height  # more than two lines that are turned take too much of the width
        strip.set(text=_unbroken(text, UPRIGHT if upright else height), rotation=0 if upright else 270)
    if chosen().height is not None:
        return
    if strips:  # they kept the rows apart
        lay_out()
    needed = Bbox.union([box for plot in fixed if (box := plot.get_tightbbox()) is not None]).height / figure.dpi
    widest = fixed[0].get_position().width
    for spare in (1.0, 1.1, 1.2, 1.4):  # a figure that is too low has narrower panels
        figure.set_figheight(max(needed * spare, beside) + around)
        lay_out()
        if fixed[0].get_position().width > 0.98 * widest:
            break


def _lay_out(
    figure: Figure, above: Sequence[Legend | Text], below: Sequence[Legend | Text], room: Mapping[Legend | Text, float]
) -> None:
    """Place items, which need this room in inches, above and below the plots, and the plots between them."""
    height = figure.get_figheight()
    top, bottom = 1 - GAP / 2 / height, GAP / 2 / height
    for item in above:
        _hang(figure, item, top)
        top -= room[item] / height
    for item in reversed(below):
        _hang(figure, item, bottom, "lower center")
        bottom += room[item] / height
    # An engine that belongs to the figure would compute the layout again, and draw twice, for each format.
    rect = (0, bottom, 1, top - bottom)
    fixed = any(plot.get_aspect() != "auto" for plot in figure.axes)
    ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03, hspace=0.02, wspace=0.02, rect=rect, compress=fixed).execute(figure)


def _titles(figure: Figure) -> float:
    """Return the height in inches of the second and later lines of the panels' titles."""
    lines: dict[int, int] = {}
    for plot in figure.axes:
        if spec := plot.get_subplotspec():
            row = spec.rowspan.start
            lines[row] = max(lines.get(row, 0), plot.title.get_text().count("\n"))
    return 0.11 * sum(lines.values())


def _limit(figure: Figure, drawing: Drawing) -> None:
    """Apply the limits that the figure declares to all panels."""
    plots = [plot for plot in figure.axes if plot.get_subplotspec() is not None and plot.get_label() != "<colorbar>"]
    for plot in plots:
        if drawing.figure.xlim:
            plot.set_xlim(*drawing.figure.xlim)
        if drawing.figure.ylim:
            plot.set_ylim(*drawing.figure.ylim)


def _hang(
    figure: Figure, item: Legend | Text, y: float, edge: Literal["upper center", "lower center"] = "upper center"
) -> None:
    """Move the upper or the lower edge of a legend or a text to a height of the figure."""
    if isinstance(item, Legend):
        item.set_loc(edge)
        item.set_bbox_to_anchor((0.5, y), figure.transFigure)
    else:
        item.set_y(y)


def _in_engineering_units(figure: Figure) -> None:
    """Write the ticks of very small and very large values with the prefixes of their unit: 250 µs instead of 0.00025 s."""
    for axis in (axis for plot in figure.axes for axis in (plot.xaxis, plot.yaxis)):
        text = axis.label.get_text()
        match = re.fullmatch(r"(.*)\s\[(\w+)\]", text, re.DOTALL)
        largest = float(np.abs(axis.get_view_interval()).max())
        plain = type(axis.get_major_formatter()) in (ScalarFormatter, EngFormatter)  # panels may share theirs
        is_far = largest < 0.01 or (largest >= 1e4 and match is not None and match[2] != "s")  # nobody says kiloseconds
        if match and match[2] in BASE and plain and is_far:
            axis.set_major_formatter(EngFormatter(match[2], sep="\N{NO-BREAK SPACE}"))
            axis.label.set_text(match[1])


def label(name: str, unit: str = "", *, given: str = "") -> str:
    """Return a label with its unit in brackets: the given text, or the name with blanks for underscores."""
    text = given or name.replace("_", " ")
    return f"{text} [{unit}]" if unit else text


def axis_label(axis: Axis) -> str:
    return label(axis.name, axis.unit, given=axis.label)


def point(axes: Sequence[Axis], cell: Mapping[str, Value]) -> str:
    """Return the title of a panel: its values of some variables."""
    words = []
    for axis in axes:
        value = dict(zip(axis.values, names(axis.values, 60), strict=True))[cell[axis.name]]
        words.append(f"{axis.label or axis.name.replace('_', ' ')} = {value}{f' {axis.unit}' if axis.unit else ''}")
    return ", ".join(words)


def value_label(drawing: Drawing) -> str:
    """Return the label of the values in a figure of one column."""
    column = next(iter(drawing.tables))
    if drawing.figure.ylabel:
        return drawing.figure.ylabel
    if drawing.figure.kind == "timeseries":
        return label(column, drawing.units.get(column, ""))
    if drawing.figure.measure == "time_to":
        threshold = number(drawing.figure.threshold or 0.0)
        return label(f"{drawing.time} until {column} ≥ {threshold}", drawing.units.get(drawing.time, ""))
    return label(of_run(drawing.figure.measure, column), drawing.units.get(column, ""))


def time_label(drawing: Drawing) -> str:
    return drawing.figure.xlabel or label(drawing.time, drawing.units.get(drawing.time, ""))


def number(value: float, digits: int = 6) -> str:
    """Return a number with at most this many significant digits."""
    return f"{value:.{digits}g}".replace("e+0", "e").replace("e+", "e").replace("e-0", "e-").replace("-", "−")


def names(values: Sequence[Value], limit: int = 28) -> list[str]:
    """Return the values of an axis as ticks or entries in a legend: short, but as long as it takes to tell them apart."""
    texts: list[str] = []
    for longer in range(12):
        texts = [named(value, limit + 8 * longer, 6 + longer) for value in values]
        if len(set(texts)) == len(set(values)):
            break
    return texts


def named(value: Value, limit: int = 28, digits: int = 6) -> str:
    """Return a value of an axis in short. A whole number has all of its digits."""
    if isinstance(value, str):
        return shortened(value, limit)
    return number(value, digits if value % 1 or float(f"{value:.6g}") == value else 17)


def shortened(text: str, limit: int) -> str:
    """Return the text as one line of at most `limit` characters; the middle is left out."""
    line = visible(re.sub("[ \t\r\n]+", " ", text).strip(" "))
    half = (limit - 1) // 2
    return line if len(line) <= limit else f"{line[:half]}…{line[-half:]}"


def inches(text: str, size: float) -> float:
    """Return the width in inches of a line of text in letters of `size` points."""
    wide, _, _ = text_to_path.get_text_width_height_descent(text, FontProperties(size=size), ismath=False)
    return float(wide) / 72 * 1.02


def wrapped(text: str, width: float, size: float, most: int = 4) -> str:
    """Return the text in at most `most` lines of `width` inches, in letters of `size` points; long words are broken."""
    lines = [""]
    for word in re.findall(r"[^ ]+ *", shortened(text, 400)):
        for part in _parts(word, width, size):
            if lines[-1] and inches((lines[-1] + part).rstrip(" "), size) > width:
                lines.append("")
            lines[-1] += part
    if len(lines) > most:
        lines[most - 1 :] = [f"{lines[most - 1][:-2].rstrip()} …"]
    return "\n".join(line.rstrip() for line in lines)


def _parts(word: str, width: float, size: float) -> list[str]:
    """Return a word; one that is too wide for a line, in parts: at its no-break spaces, else in letters."""
    if inches(word.rstrip(" "), size) <= width:
        return [word]
    parts = re.findall("[^\xa0]+\xa0*", word)
    return [part for some in parts for part in _parts(some, width, size)] if len(parts) > 1 else list(word)


def colours(axis: Axis) -> list[ColorType]:
    """Return a colour for each value: along a scale for numbers, which have an order; clearly different ones for names."""
    count, known = len(axis.values), named_colours()
    if count > MOST:
        raise UsageError(
            f"the figure has {count} series, one for each value of {axis.name}, but at most {MOST} can be drawn; "
            "choose some with where, give some a panel with facet, or draw a summary or a heatmap"
        )
    if count <= len(known) and (not axis.numeric or chosen().colours):
        return list(known[:count])
    if count == 1:
        return [known[0]]
    if count > FEW and axis.numeric:
        norm = _norm(axis)
        return list(sequential()([norm(value) for value in axis.values if not isinstance(value, str)]))
    return list(sequential()([k / (count - 1) for k in range(count)]))


def named_colours() -> tuple[ColorType, ...]:
    """Return the colours of categories."""
    return chosen().colours or NAMED


def looks(axis: Axis) -> list[Look]:
    """Return the look of a line for each value; if each has an entry in the legend, no two have the same colour and style."""
    count = len(axis.values)
    if count == 1:
        return [{"color": named_colours()[0]}]
    if count > (FEW if axis.numeric else STYLED):
        return [{"color": colour} for colour in colours(axis)]
    several = list(named_colours()) if count > FEW else colours(axis)
    styles = [(k + k // FEW) % FEW for k in range(count)]
    return [
        {"color": several[k % len(several)], "linestyle": DASHES[style], "marker": MARKERS[style]}
        for k, style in enumerate(styles)
    ]


def sequential() -> LinearSegmentedColormap:
    """Return viridis without its yellow end, which is too light on white."""
    return LinearSegmentedColormap.from_list("sierra", mpl.colormaps["viridis"](np.linspace(0, 0.85, 128)))


def legend(
    figure: Figure,
    plots: Sequence[Axes],
    axis: Axis,
    entries: Sequence[str],
    handles: Sequence[Artist],
    more: Sequence[tuple[Artist, str]] = (),
) -> None:
    """Identify the series: by a legend above the data if there are few, else by a colour bar. `more`: further entries."""
    shown, title = list(more), ""
    if len(entries) > _entries(axis, handles) or not _has_room(figure, entries):
        colour_bar(figure, plots, axis, entries)
    elif len(entries) > 1:
        shown = [*zip(handles, entries, strict=True), *more]
        title = shortened(axis_label(axis), 60)
    if shown:
        place_legend(figure, [handle for handle, _ in shown], [name for _, name in shown], title)


def lines(looks: Sequence[Look]) -> list[Line2D]:
    """Return the handles of a legend of lines."""
    return [Line2D([], [], **look) for look in looks]


def _entries(axis: Axis, handles: Sequence[Artist]) -> int:
    """Return the largest number of entries of a legend. Lines and marks of many names differ in colour and style."""
    if axis.numeric:
        return FEW
    return STYLED if all(isinstance(handle, Line2D) for handle in handles) else NAMES


def _columns(figure: Figure, entries: Sequence[str]) -> int:
    """Return the number of columns of a legend that the width of the figure has room for."""
    return max(1, min(len(entries), int(figure.get_figwidth() * 0.98 / _widest(entries))))


def _widest(entries: Sequence[str]) -> float:
    """Return the width of the widest entry of a legend, with its handle, in inches."""
    return max(inches(entry, 7) for entry in entries) + 0.38


def _has_room(figure: Figure, entries: Sequence[str]) -> bool:
    """Return whether a legend leaves at least half of a given height to the plots."""
    rows = -(-len(entries) // _columns(figure, entries))
    return len(entries) <= FEW or rows * ENTRY <= (chosen().height or np.inf) / 2


def place_legend(figure: Figure, handles: Sequence[Artist], entries: Sequence[str], title: str = "") -> None:
    """Add a legend in as few rows as possible, with its title before the first entry if there is room."""
    room = figure.get_figwidth() * 0.98
    columns = _columns(figure, entries)
    if title and chosen().legend != "right" and inches(title, 7) + 0.1 + _widest(entries) * len(entries) < room:
        handles, entries, title = [Line2D([], [], linestyle="none"), *handles], [title, *entries], ""
        columns = len(entries)
    rows = -(-len(entries) // columns)
    beside = chosen().legend == "right"
    location: Literal["outside right upper", "upper center"] = "outside right upper" if beside else "upper center"
    legend = figure.legend(handles, entries, loc=location, ncols=1 if beside else -(-len(entries) // rows), title=title or None)
    legend.set_in_layout(beside)


def colour_bar(figure: Figure, plots: Sequence[Axes], axis: Axis, entries: Sequence[str]) -> None:
    """Show the values of an axis as a scale of colours."""
    if axis.numeric:
        source = ScalarMappable(_norm(axis), sequential())
        values = numbers(axis)
    else:
        source = ScalarMappable(BoundaryNorm(np.arange(len(entries) + 1) - 0.5, len(entries)), ListedColormap(colours(axis)))
        values = list(map(float, range(len(entries))))
    bar = figure.colorbar(source, ax=list(plots), pad=0.02, aspect=28, fraction=0.05, use_gridspec=False)
    bar.outline.set_linewidth(0.4)
    shown = thinned(len(values), 10 if axis.numeric else 24)
    bar.ax.yaxis.set_major_locator(FixedLocator([values[k] for k in shown]))
    bar.ax.yaxis.set_major_formatter(_table({values[k]: entries[k] for k in shown}))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    bar.ax.tick_params(labelsize=6 if axis.numeric or len(values) <= 12 else 5, length=0 if not axis.numeric else 2)
    some = "" if axis.numeric or len(shown) == len(values) else f" ({len(shown)} of {len(values)} named)"
    bar.set_label(shortened(axis_label(axis), 48) + some)


def value_bar(
    figure: Figure, plots: Sequence[Axes], colours: ScalarMappable, text: str, extend: Literal["neither", "max"] = "neither"
) -> None:
    """Show numbers as a scale of colours, which is logarithmic if these colours are; an arrow ends it if it may `extend`."""
    bar = figure.colorbar(colours, ax=list(plots), pad=0.02, aspect=24, fraction=0.06, use_gridspec=False, extend=extend)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=6, length=2)
    if isinstance(colours.norm, LogNorm):
        log_ticks(bar.ax.yaxis, *colours.get_clim())
    bar.set_label(shortened(text, 40))


def thinned(count: int, most: int) -> list[int]:
    """Return at most about `most` of `count` indices, at equal distances."""
    return list(range(0, count, -(-count // most)))


def geometric(values: Sequence[Value]) -> bool:
    """Return whether numbers grow by a constant factor, as those of a Log scale do."""
    if len(values) < 3 or any(isinstance(v, str) or v <= 0 for v in values):
        return False
    exact = np.array(values, dtype=float)
    ratios = exact[1:] / exact[:-1]
    return bool(ratios[0] > 1 and np.allclose(ratios, ratios[0], rtol=1e-9))


def scale_values(plot: Axes, axis: Axis, *, log: bool | None, margin: float = 0.04) -> None:
    """Set up the x axis of an independent variable: numbers at their positions, names side by side."""
    if not axis.numeric:
        side_by_side(plot, axis)
        return
    check_x(axis, log=log)
    values, grows = numbers(axis), is_log(axis, log)
    if grows:
        plot.set_xscale("log", base=2)
    low, high = min(values), max(values)
    if low == high:
        plot.set_xlim(low - 1, low + 1)
    elif plot.get_xscale() == "log":
        plot.set_xlim(low * (low / high) ** margin, high * (high / low) ** margin)
    else:
        plot.set_xlim(low - (high - low) * margin, high + (high - low) * margin)
    if grows or len(values) <= 6:
        ticks = _apart(plot, values)
        plot.xaxis.set_major_locator(FixedLocator(ticks))
        plot.xaxis.set_major_formatter(_table(dict(zip(ticks, names(ticks), strict=True))))
        plot.xaxis.set_minor_locator(NullLocator())


def is_log(axis: Axis, log: bool | None) -> bool:
    """Return whether the x axis of a variable is logarithmic; if the figure does not say it, one of 1, 2, 4, … is."""
    return geometric(axis.values) if log is None else log


def _apart(plot: Axes, values: Sequence[float]) -> list[float]:
    """Return the values whose names have room as ticks: all, or every second one, every third one, …"""
    words, width = names(values), _room(plot)[0]
    to_panel = plot.transScale + plot.transLimits
    places = [float(to_panel.transform((value, 0))[0]) * width for value in values]
    for every in range(-(-len(values) // 11), len(values)):
        shown = range(0, len(values), every)
        ends = [(places[k] - wide, places[k] + wide) for k in shown for wide in [inches(words[k], 7) / 2 + 0.02]]
        if all(left[1] <= right[0] for left, right in pairwise(ends)):
            return [values[k] for k in shown]
    return list(values[:1])


def check_x(axis: Axis, *, log: bool | None) -> None:
    """Raise UsageError if a logarithmic x axis cannot show the values of an independent variable."""
    if log and axis.numeric and (lowest := min(numbers(axis))) <= 0:
        raise UsageError(f"log_x needs values above 0, but {axis.name} has {number(lowest)}")


def side_by_side(plot: Axes, axis: Axis, beside: float = 0) -> None:
    """Give each value one place, at 0, 1, 2, …, with its name below it: turned or smaller, if there is little room.

    `beside` is the width in inches of a colour bar.
    """
    words, width = names(axis.values, 22), _room(plot, beside)[0]
    plot.set_xlim(-0.6, len(words) - 0.4)
    shown, size = readable(len(words), width)
    spacing, widest = width / len(words), max(inches(words[k], size) for k in shown)
    turned = widest + 0.06 > spacing * (shown[1] if len(shown) > 1 else 1)
    angle = (90 if spacing < 0.2 or plot.title.get_text() else 35) if turned else 0
    plot.set_xticks(shown, [words[k] for k in shown], rotation=angle, fontsize=size)
    if angle == 35:
        for label in plot.get_xticklabels():
            label.set(ha="right", rotation_mode="anchor")
    plot.grid(visible=False, axis="x")
    figure, at = _panel(plot)
    if angle and at.num1 == 0:
        figure.set_figheight(figure.get_figheight() + widest * np.sin(np.radians(angle)) * 0.9)


def is_crowded(plot: Axes, words: Sequence[str]) -> bool:
    """Return whether some words are wider than their places side by side in a panel."""
    return max(inches(word, 7) for word in words) + 0.06 > _room(plot)[0] / len(words)


def readable(count: int, room: float) -> tuple[list[int], float]:
    """Return which of `count` lines of text side by side are readable in this many inches, and their size in points."""
    every = 1 + int(count * SMALLEST * 1.1 / 72 / room)
    return list(range(0, count, every)), min(7.0, room * every / count * 72 / 1.1)


def unnamed(plot: Axes, axis: Axis, beside: float = 0) -> list[str]:
    """Return a note if not all names of a variable have room below a panel; `beside`: see `side_by_side`."""
    return left_out("x", len(axis.values), _room(plot, beside)[0])


def left_out(axis: str, count: int, room: float) -> list[str]:
    """Return a note if not all of `count` names have room on an axis of this many inches."""
    shown, _ = readable(count, room)
    return [f"{axis} axis: {len(shown)} of {count} names, at equal distances"] if len(shown) < count else []


def scale_y(plot: Axes, drawing: Drawing, lowest: float, highest: float) -> None:
    """Make the y axis logarithmic if the figure declares it. Raises UsageError if no value is above 0."""
    check_y(drawing, highest)
    if drawing.figure.log_y:
        plot.set_yscale("log", nonpositive="clip")
        log_ticks(plot.yaxis, lowest, highest)


def check_y(drawing: Drawing, highest: float) -> None:
    """Raise UsageError if a logarithmic y axis cannot show any value."""
    if drawing.figure.log_y and not highest > 0:
        raise UsageError("log_y needs values above 0, but there are none")


def log_ticks(of: XAxis | YAxis, lowest: float, highest: float) -> None:
    """Set the ticks of a logarithmic axis: powers of 10, with 2 and 5 in between if there are few; else ordinary ones."""
    wide = highest / lowest if lowest > 0 else np.inf
    powers = LogLocator(subs=(1, 2, 5) if wide < 100 else (1,), numticks=8)
    of.set_major_locator(powers if wide >= 10 else AutoLocator())
    of.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))
    of.set_minor_locator(NullLocator())


def scale_time(plot: Axes, drawing: Drawing, earliest: float) -> None:
    """Make the time axis logarithmic if the figure declares it."""
    if drawing.figure.log_x:
        plot.set_xscale("log", nonpositive="mask" if earliest > 0 else "clip")
        plot.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))
        plot.xaxis.set_minor_locator(NullLocator())


def drawable(values: npt.ArrayLike, drawing: Drawing) -> Floats:
    """Return the values as floats; NaN if a value is missing, or if the scale cannot show it."""
    floats = np.asarray(values, dtype=float)
    bad = ~np.isfinite(floats) | (drawing.figure.log_y & (floats <= 0))
    return np.where(bad, np.nan, floats)


def interval(
    plot: Axes, x: npt.ArrayLike, low: Floats, high: Floats, *, color: ColorType, linewidth: float, cap: float = 2
) -> list[Artist]:
    """Draw intervals from `low` to `high`, which need not contain the center. Return the artists."""
    reach = [np.zeros(len(low)), high - low]
    bars = plot.errorbar(x, low, reach, fmt="none", ecolor=color, elinewidth=linewidth, capsize=cap, capthick=linewidth)
    return [*bars[1], *bars[2]]


def span(values: Floats) -> tuple[float, float]:
    """Return the smallest and the largest finite value; NaN if there is none."""
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


def column(table: pa.Table, name: str) -> Floats:
    """Return a column of a pyarrow table as numpy floats; NULL becomes NaN."""
    values: Floats = numpy_of(table.column(name)).astype(float, copy=False)
    return values


def numbers(axis: Axis) -> list[float]:
    return [float(value) for value in axis.values]


@cache
def _defaults() -> dict[RcKeyType, object]:
    """Return the settings of all figures."""
    skipped = {"backend", "backend_fallback", "interactive", "toolbar", "timezone", "webagg.port"}
    ours = mpl.rc_params_from_file(SETTINGS, use_default_template=False)
    return {name: value for name, value in {**mpl.rcParamsDefault, **ours}.items() if name not in skipped}


def _norm(axis: Axis) -> Normalize:
    return (LogNorm if geometric(axis.values) else Normalize)(min(numbers(axis)), max(numbers(axis)))


def _table(names: dict[float, str]) -> FuncFormatter:
    return FuncFormatter(lambda value, _: names.get(value) or names[min(names, key=lambda known: abs(known - value))])


def _power(value: float) -> str:
    exponent = np.log10(value) if value > 0 else 0.0
    if value <= 0 or -2.5 <= exponent < 3 or abs(exponent - round(exponent)) > 1e-9:
        return number(value)
    return "10" + str(round(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
