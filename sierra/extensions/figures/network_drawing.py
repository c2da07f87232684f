"""Figures of networks: nodes at positions from the data or of a computed layout, and edges as wide as their weight.

A computed layout is that of the edges of all panels together, so that a node has the same place in each panel.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize, to_hex
from matplotlib.figure import Figure

from sierra.deliverables.figures import facets, style
from sierra.deliverables.figures.node_layout import NAMED, Places, layout
from sierra.errors import UsageError
from sierra.util.arrow_columns import numpy_of
from sierra.util.text import counted, few, verb

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing
    from sierra.extensions.figures.network import NetworkOptions

NODES = 500
EDGES = 10_000
"""The largest number of nodes, and of edges in all panels together."""
ARROWS = 1000
"""The largest number of edges with arrows in all panels together."""
BEHIND = {"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.4}
"""The box behind a name, which keeps it readable on edges."""


def notes(drawing: Drawing, options: NetworkOptions) -> list[str]:
    """Return notes on the chosen time, and on rows that are no edges. Raises UsageError if there is no time to choose."""
    if options.at is not None and drawing.time == "row":
        raise UsageError('"at" chooses edges by their time, but this output has no time column; name it by time')
    (counts,) = drawing.rows["counts"].to_pylist()
    shown = set(drawing.rows["nodes"].column("experiment").to_pylist())
    empty = len(drawing.cells.keys() - shown)
    return [
        *_times(drawing, options),
        *([f"positions: means of {' and '.join(options.place)}"] if options.place else []),
        *(["hollow: no edge"] if _lonely(drawing) else []),
        *_looks(drawing, options),
        *([f"{counted(counts['loops'], 'edge')} from a node to itself left out"] if counts["loops"] else []),
        *([f"{counted(counts['weightless'], 'edge')} without a finite weight left out"] if counts["weightless"] else []),
        *([f"{counted(counts['lost'], 'row')} without a source left out"] if counts["lost"] else []),
        *([f"{empty} of {counted(len(drawing.cells), 'experiment')} without such rows"] if empty else []),
    ]


def network(drawing: Drawing, options: NetworkOptions) -> Figure:
    """Draw a network for each experiment."""
    edges, nodes = drawing.rows["edges"], drawing.rows["nodes"]
    _check_size(edges, nodes, ARROWS if options.directed else EDGES)
    links, known = _by_experiment(edges), _by_experiment(nodes)
    figure, plots = _panels(drawing, list(known))
    computed = {} if options.place else _layout(edges, nodes, options.layout)
    most = float(np.abs(style.column(edges, "weight")).max(initial=0.0)) or 1.0
    looks = _Looks(drawing)
    for plot, (ordinal, mine) in zip(plots, known.items(), strict=True):
        places = _given(mine) if options.place else {name: computed[name] for name in mine.column("node").to_pylist()}
        own = links[ordinal].to_pylist() if ordinal in links else []
        colours = [looks.edge(ordinal, edge["source"], edge["target"]) for edge in own]
        ends = [(places[e["source"]], places[e["target"]], abs(e["weight"]) / most) for e in own]
        _edges(plot, ends, colours, options)
        _nodes(plot, places, {name for edge in own for name in (edge["source"], edge["target"])}, ordinal, looks)
        if not options.place:
            plot.set_axis_off()
        plot.set_aspect("equal")
        plot.margins(0.12)
    if options.place:
        names = [style.label(name, drawing.units.get(name, "")) for name in options.place]
        style.outer_labels(plots, names[0], names[1])
    if looks.colours is not None:
        column = options.edge_color
        style.value_bar(figure, plots, looks.colours, style.label(column, drawing.units.get(column, "")))
    return figure


class _Looks:
    """The looks of nodes and edges that the data have."""

    def __init__(self, drawing: Drawing) -> None:
        """Raises UsageError for a size below 0, which no area shows."""
        self._sizes, self._labels = (_values(drawing, look, "node") for look in ("size", "label"))
        if (least := min(self._sizes.values(), default=0.0)) < 0:
            raise UsageError(f"node_size: the area of a mark cannot be below 0, but a node has {least:g}")
        self._most = max(self._sizes.values(), default=0.0) or 1.0
        self._numbers = _values(drawing, "colour", "source", "target")
        numbers = self._numbers.values()
        self.colours = ScalarMappable(Normalize(min(numbers), max(numbers)), "viridis") if numbers else None
        """The colours of edges; None if all have the same."""

    def edge(self, ordinal: int, source: str, target: str) -> str:
        """Return the colour of an edge; that of edges without a value is grey."""
        value = self._numbers.get((ordinal, source, target))
        return style.FAINT if value is None or self.colours is None else to_hex(tuple(self.colours.to_rgba(value)))

    def size(self, ordinal: int, node: str, usual: float) -> float:
        """Return the diameter of the mark of a node in points; that of nodes without a value is the smallest."""
        if not self._sizes:
            return usual
        return max(1.0, 2.5 * usual * math.sqrt(self._sizes.get((ordinal, node), 0.0) / self._most))

    def label(self, ordinal: int, node: str) -> str:
        return str(self._labels.get((ordinal, node), node))


def _values(drawing: Drawing, look: str, *keys: str) -> dict[tuple[Any, ...], Any]:
    """Return the values of a look by experiment and node or edge; empty if the figure does not have it."""
    rows = drawing.rows[look].to_pylist() if look in drawing.rows else []
    return {(row["experiment"], *(row[key] for key in keys)): row["value"] for row in rows}


def _looks(drawing: Drawing, options: NetworkOptions) -> list[str]:
    """Return notes on what areas, texts and colours mean, and on what has no value."""
    nodes, edges = drawing.rows["nodes"].num_rows, drawing.rows["edges"].num_rows
    said = []
    if name := options.node_size:
        sizes = _values(drawing, "size", "node")
        said.append(f"area: mean {style.label(name, drawing.units.get(name, ''))}, at most {max(sizes.values(), default=0):g}")
        said += [f"{lost} without a value are dots"] if (lost := nodes - len(sizes)) else []
    if options.node_label:
        several = sum(row["labels"] > 1 for row in drawing.rows["label"].to_pylist())
        said += [f"{counted(several, 'node')} with several texts; the first is shown"] if several else []
    if options.edge_color:
        looks = _Looks(drawing)
        ends = ((row["experiment"], row["source"], row["target"]) for row in drawing.rows["edges"].to_pylist())
        lost = sum(looks.edge(*end) == style.FAINT for end in ends)
        said += [f"grey: {lost} of {counted(edges, 'edge')} without a value"] if lost else []
    return said


def _times(drawing: Drawing, options: NetworkOptions) -> list[str]:
    match options.at:
        case None:
            return []
        case "last":
            return [f"at each run's last {drawing.time}"]
        case time:
            return [f"at {drawing.time} {time:g}"]


def _panels(drawing: Drawing, ordinals: list[int]) -> tuple[Figure, list[Axes]]:
    """Return a panel for each of these experiments, with its values as title."""
    figure, plots = facets.experiments(drawing, ordinals)
    return figure, [plots[ordinal] for ordinal in ordinals]


def _by_experiment(table: pa.Table) -> dict[int, pa.Table]:
    ordinals = numpy_of(table.column("experiment"))
    return {int(ordinal): table.filter(ordinals == ordinal) for ordinal in np.unique(ordinals)}


def _check_size(edges: pa.Table, nodes: pa.Table, most: int) -> None:
    count = max(table.num_rows for table in _by_experiment(nodes).values())
    if count > NODES:
        raise UsageError(f"a network of {count} nodes cannot be read; at most {NODES} are possible; use where")
    if edges.num_rows > most:
        raise UsageError(f"{edges.num_rows} edges cannot be read; at most {most} are possible; use where, run or at")


def _given(nodes: pa.Table) -> Places:
    """Return the positions from the data. Raises UsageError if a node has none."""
    x, y = style.column(nodes, "x"), style.column(nodes, "y")
    names = nodes.column("node").to_pylist()
    if lost := [name for name, known in zip(names, np.isfinite(x) & np.isfinite(y), strict=True) if not known]:
        raise UsageError(
            f"{len(lost)} of {counted(len(names), 'node')} {verb(len(lost), 'has', 'have')} no position: {few(lost, 3)}; "
            "a node needs a row of which it is the source"
        )
    return dict(zip(names, zip(x.tolist(), y.tolist(), strict=True), strict=True))


def _layout(edges: pa.Table, nodes: pa.Table, name: str) -> Places:
    """Return computed positions of the nodes of all panels."""
    return layout(nodes.column("node").to_pylist(), [(edge["source"], edge["target"]) for edge in edges.to_pylist()], name)


def _edges(
    plot: Axes,
    edges: list[tuple[tuple[float, float], tuple[float, float], float]],
    colours: list[str],
    options: NetworkOptions,
) -> None:
    """Draw lines or arrows; the widest has the weight 1."""
    widths = [0.2 + 1.1 * weight for *_, weight in edges]
    if not options.directed:
        plot.add_collection(LineCollection([ends for *ends, _ in edges], linewidths=widths, colors=colours, zorder=1))
        return
    for (start, end, _), width, colour in zip(edges, widths, colours, strict=True):
        arrow = {"arrowstyle": "-|>,head_length=0.25,head_width=0.12", "linewidth": width, "color": colour}
        shape = {"shrinkA": 3, "shrinkB": 3, "connectionstyle": "arc3,rad=0.12"}
        plot.annotate("", end, start, arrowprops={**arrow, **shape}, zorder=1)


def _nodes(plot: Axes, places: Places, joined: set[str], ordinal: int, looks: _Looks) -> None:
    colour, usual = style.named_colours()[0], 4.0 if len(places) <= 100 else 2.0
    for name, (x, y) in places.items():
        face, size = colour if name in joined else "white", looks.size(ordinal, name, usual)
        plot.plot(x, y, "o", color=colour, markerfacecolor=face, markersize=size, markeredgewidth=0.7)
        if len(places) <= NAMED:
            text = style.shortened(looks.label(ordinal, name), 12)
            above = (0, size / 2 + 1)
            plot.annotate(text, (x, y), above, textcoords="offset points", ha="center", va="bottom", fontsize=5, bbox=BEHIND)


def _lonely(drawing: Drawing) -> bool:
    """Return whether a node has no edge in its panel."""
    edges = drawing.rows["edges"].to_pylist()
    joined = {(edge["experiment"], edge[end]) for edge in edges for end in ("source", "target")}
    nodes = drawing.rows["nodes"]
    return not joined.issuperset(zip(nodes.column("experiment").to_pylist(), nodes.column("node").to_pylist(), strict=True))
