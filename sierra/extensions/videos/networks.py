"""Networks as tracks: the edges and nodes of each run over time.

A row is an edge from a source to a target, perhaps with a weight; a row without a target is a node only. The nodes of a film
are those of all its runs and times, so that a node keeps its place. Their positions are columns of the rows of which a node is
the source, or a layout of the edges of all times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from sierra.errors import UsageError
from sierra.extensions.videos.sql_tracks import Columns, Rows, TrackSource
from sierra.extensions.videos.table import Video
from sierra.store.batch_data import ChosenRun
from sierra.store.sql_names import identifier, node_name, quote
from sierra.util.hashing import sha256
from sierra.util.text import counted, natural

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from sierra.extensions.videos.tracks import Floats, State


NODES, EDGES, ARROWS = 500, 10_000, 1000
"""The largest number of nodes, and of edges and of arrows at one time: more cannot be read."""


class Networks:
    """The networks of some runs, whose nodes have common numbers."""

    def __init__(self, source: TrackSource, video: Video, runs: Sequence[ChosenRun]) -> None:
        import numpy as np

        source.check(video.columns, numeric=False)
        source.check((*video.columns[2:], *video.place, *filter(None, (video.node_value,))), numeric=True)
        self.video, self.source = video, source
        ends = [node_name(name) for name in video.columns[:2]]
        self.nodes = self._nodes(ends, runs)
        members = ", ".join(map(quote, self.nodes))
        numbers = [f"enum_code(({end})::ENUM({members}))::DOUBLE" for end in ends]
        numeric = {"weight": video.columns[2:], "x": video.place[:1], "y": video.place[1:], "value": (video.node_value,)}
        values = {key: f"{identifier(names[0])}::DOUBLE" for key, names in numeric.items() if names and names[0]}
        columns = {"source": numbers[0], "target": numbers[1], **values}
        self.rows = [Rows(source, run, columns) for run in runs]
        self.tracks = [_Network(rows, self) for rows in self.rows]
        self.counts = self._counts(ends)
        names = "\n".join(f"{len(name)} {name}" for name in self.nodes)
        self.names = np.frombuffer(bytes.fromhex(sha256(names.encode())), np.uint8)
        """The hash of the nodes' names, which are a part of each state."""

    def _nodes(self, ends: Sequence[str], runs: Sequence[ChosenRun]) -> list[str]:
        """Return the names of all nodes in their natural order. Raises UsageError if there are none, or too many."""
        names: set[str] = set()
        for run in runs:
            relation = self.source.relation(run)
            each = " UNION ALL ".join(f"SELECT {end} AS node FROM {relation}" for end in ends)
            table = self.source.sql(f"SELECT DISTINCT node FROM ({each}) WHERE node IS NOT NULL LIMIT {NODES + 1}")
            names.update(table.column("node").to_pylist())
            if len(names) > NODES:
                raise UsageError(f"a network of more than {NODES} nodes cannot be read; choose some by sql")
        if not names:
            raise UsageError(f"output {self.source.output.name!r} has no node in {' or '.join(self.video.columns[:2])}")
        return sorted(names, key=natural)

    def _counts(self, ends: Sequence[str]) -> dict[str, int]:
        """Return the number of rows that are not drawn as edges, by the reason."""
        source, target = ends
        weight = f"{identifier(self.video.columns[2])}::DOUBLE" if self.video.columns[2:] else "1.0"
        total: dict[str, int] = {}
        for rows in self.rows:
            table = self.source.sql(
                f"SELECT count(*) FILTER (s = t) AS loops, count(*) FILTER (s IS NULL) AS lost, "
                f"count(*) FILTER (s <> t AND NOT coalesce(isfinite(w), false)) AS weightless "
                f"FROM (SELECT {source} AS s, {target} AS t, {weight} AS w FROM {rows.relation})"
            )
            for name, count in table.to_pylist()[0].items():
                total[name] = total.get(name, 0) + count
        return total

    def notes(self) -> list[str]:
        """Return notes on rows that are not drawn."""
        loops, lost, weightless = (self.counts[name] for name in ("loops", "lost", "weightless"))
        return [
            *([f"{counted(loops, 'edge')} from a node to itself left out"] if loops else []),
            *([f"{counted(weightless, 'edge')} without a finite weight left out"] if weightless else []),
            *([f"{counted(lost, 'row')} without a source left out"] if lost else []),
        ]

    def places(self) -> dict[str, tuple[float, float]]:
        """Return the places of all nodes in a layout of all edges. Raises NotInstalled."""
        from sierra.deliverables.figures.node_layout import layout

        return layout(self.nodes, self.edges(), self.video.layout)

    def edges(self) -> list[tuple[str, str]]:
        """Return the edges of all runs and times, each once, in the order of the nodes."""
        import numpy as np

        pairs: set[tuple[int, int]] = set()
        for track in self.tracks:
            for _, edges, _ in track.states():
                pairs.update(zip(*np.sort(edges[:, :2].astype(int), axis=1).T.tolist(), strict=True))
        return [(self.nodes[one], self.nodes[other]) for one, other in sorted(pairs)]


class _Network:
    """The network of one run. A state: nodes (x, y, value, number), edges (source, target, weight), the hash of the names."""

    def __init__(self, rows: Rows, network: Networks) -> None:
        self._rows, self._network = rows, network
        self.times = rows.times

    def states(self) -> Iterator[State]:
        for place, columns in enumerate(self._rows.each()):
            edges = self._edges(columns, place)
            yield self._nodes(columns, edges, place), edges, self._network.names

    def _edges(self, columns: Columns, frame: int) -> Floats:
        """Return the edges with their mean weights, in the order of the nodes. Raises UsageError if there are too many."""
        import numpy as np

        source, target = (columns[name].astype(np.float64) for name in ("source", "target"))
        weight = columns["weight"].astype(np.float64) if "weight" in columns else np.ones(len(source))
        good = np.isfinite(source) & np.isfinite(target) & (source != target) & np.isfinite(weight)
        ends = np.column_stack([source[good], target[good]]).astype(np.int64)
        if not self._network.video.directed:
            ends.sort(axis=1)
        most = ARROWS if self._network.video.directed else EDGES
        pairs, inverse, counts = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
        if len(pairs) > most:
            raise UsageError(f"{self._where(frame)}: {len(pairs)} edges cannot be read; at most {most} are possible")
        means = np.bincount(inverse.ravel(), weight[good], len(pairs)) / np.maximum(counts, 1)
        return np.column_stack([pairs.astype(np.float64).reshape(-1, 2), means])

    def _nodes(self, columns: Columns, edges: Floats, frame: int) -> Floats:
        """Return a row for each node of the film: x, y and value, the means over the rows of which it is the source."""
        import numpy as np

        source = columns["source"].astype(np.float64)
        count = len(self._network.nodes)
        means = [
            _means(source, columns[name], count) if name in columns else np.full(count, np.nan) for name in ("x", "y", "value")
        ]
        nodes = np.column_stack([*means, np.arange(count)])
        ends = edges[:, :2].astype(np.int64).ravel()
        if self._network.video.place and len(lost := ends[~np.isfinite(nodes[ends, :2]).all(axis=1)]):
            name = self._network.nodes[int(lost[0])]
            raise UsageError(f"{self._where(frame)}: node {name!r} has an edge but no position; it needs a row as a source")
        return nodes

    def _where(self, place: int) -> str:
        return f"output {self._rows.source.output.name!r}, {self._rows.at(place)}"


def _means(group: Floats, values: npt.NDArray[np.generic], count: int) -> Floats:
    """Return the mean of the finite values of each group, whose number is below `count`; NaN if there are none."""
    import numpy as np

    numbers = values.astype(np.float64)
    good = np.isfinite(group) & np.isfinite(numbers)
    groups = group[good].astype(np.int64)
    size = np.bincount(groups, minlength=count)
    found: Floats = np.where(size, np.bincount(groups, numbers[good], count) / np.maximum(size, 1), np.nan)
    return found
