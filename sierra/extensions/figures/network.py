"""The kind for networks: nodes and edges from rows with a source and a target."""

from __future__ import annotations

from functools import partial
from typing import Annotated, ClassVar, Literal

from pydantic import Field, NonNegativeInt, model_validator

from sierra.config.deliverable_tables import Layout
from sierra.config.field_types import Finite, Table
from sierra.deliverables.figures.base import RUN, DrawnBy, DrawnKind, Request
from sierra.errors import UsageError
from sierra.stats.needs import Needs
from sierra.store.rounded_times import at_time
from sierra.store.sql_names import identifier, node_name


class NetworkOptions(Table):
    """Figures of kind `network`. Without `run`, the mean of all runs is shown, in which a missing edge counts as 0."""

    at: Finite | Literal["last"] | None = Field(
        None, description="time of the edges, or `last`: the last time of each run; default: the edges of all times"
    )
    run: Annotated[NonNegativeInt | None, RUN] = None
    directed: bool = Field(False, description="draw arrows, and do not merge the two directions of an edge")
    place: tuple[str, ...] = Field(
        (), description="columns of the x and y position of the source of a row; default: a computed layout"
    )
    layout: Layout = "spring"
    node_size: str = Field(
        "", description="column whose mean over the rows of which a node is the source is the area of its mark"
    )
    node_label: str = Field(
        "", description="column with the text at a node, in rows of which it is the source; default: its name"
    )
    edge_color: str = Field("", description="column whose mean over the rows of an edge is its colour")

    @model_validator(mode="after")
    def _fitting(self) -> NetworkOptions:
        if len(self.place) not in (0, 2):
            raise ValueError('"place" should name the two columns of x and y')
        return self


class Network(DrawnKind[NetworkOptions]):
    """A network for each experiment, from two or three columns: source, target, weight; a row without a target is a node."""

    Options: ClassVar[type[Table]] = NetworkOptions
    libraries: ClassVar[tuple[str, ...]] = ("networkx",)
    uses: ClassVar[frozenset[str]] = frozenset()

    def needs(self, request: Request) -> Needs:
        if len(request.columns) not in (2, 3):
            raise UsageError(f"a network needs two or three columns, source, target and weight, not {len(request.columns)}")
        source, target, *_ = map(node_name, request.columns)
        weight = f"{identifier(request.columns[2])}::DOUBLE" if len(request.columns) == 3 else "1.0"
        x, y = (f"{identifier(name)}::DOUBLE" for name in self.options.place) if self.options.place else ("NULL", "NULL")
        looks = {"size": self.options.node_size, "colour": self.options.edge_color, "label": self.options.node_label}
        kinds = {"size": "DOUBLE", "colour": "DOUBLE", "label": "VARCHAR"}
        more = "".join(f", {identifier(name)}::{kinds[look]} AS {look}" for look, name in looks.items() if name)
        rows = f"""\
WITH rows AS (
  SELECT "# experiment" AS experiment, run, {source} AS source, {target} AS target, {weight} AS weight, {x} AS x, {y} AS y{more}
  FROM {self._chosen()}
)"""
        tables = {"edges": rows + self._edges(), "nodes": rows + NODES, "counts": rows + COUNTS}
        ends = "source, target" if self.options.directed else "least(source, target), greatest(source, target)"
        tables |= {look: rows + LOOKS[look].format(ends=ends) for look, name in looks.items() if name}
        return Needs(
            rows=tables,
            columns=None,
            others=tuple(filter(None, [self.options.node_label])),
            numbers=(*self.options.place, *filter(None, (self.options.node_size, self.options.edge_color))),
            numeric=False,
            shows=self._shows(weighted=len(request.columns) == 3),
            run=self.options.run,
        )

    def drawn_by(self) -> DrawnBy:
        from sierra.extensions.figures.network_drawing import network, notes

        return DrawnBy(partial(network, options=self.options), (partial(notes, options=self.options),))

    def _chosen(self) -> str:
        """Return the relation of the rows that the options choose."""
        of_run = "true" if self.options.run is None else f'"# number" = {self.options.run}'
        match self.options.at:
            case None:
                return f"data WHERE {of_run}"
            case "last":
                last = 'max("# t") OVER (PARTITION BY "# experiment", run) AS "# last"'
                return f'(SELECT *, {last} FROM data) WHERE "# t" = "# last" AND {of_run}'
            case time:
                return f"data WHERE {at_time(time)} AND {of_run}"

    def _edges(self) -> str:
        """Return the statement of the edges, with the mean weight over the runs that wrote any row."""
        ends = "source, target" if self.options.directed else "least(source, target) AS one, greatest(source, target) AS other"
        runs = 'SELECT "# experiment" AS experiment, count(DISTINCT run) AS runs FROM data'
        if self.options.run is not None:
            runs += f' WHERE "# number" = {self.options.run}'
        return f"""\
, edges(experiment, run, source, target, weight) AS (
  SELECT experiment, run, {ends}, list_avg(list_sort(list(weight))) FROM rows
  WHERE source <> target AND isfinite(weight) GROUP BY ALL
)
SELECT experiment, source, target, list_sum(list_sort(list(weight))) / any_value(runs) AS weight
FROM edges JOIN ({runs} GROUP BY ALL) USING (experiment) GROUP BY ALL ORDER BY ALL"""

    def _shows(self, *, weighted: bool) -> str:
        of_runs = "mean weight over the runs" if weighted else "part of the runs with the edge"
        width = of_runs if self.options.run is None else "weight" if weighted else ""
        return f"width: {width}" if width else ""


NODES = """
SELECT experiment, node, list_avg(list_sort(list(x) FILTER (isfinite(x)))) AS x,
  list_avg(list_sort(list(y) FILTER (isfinite(y)))) AS y
FROM (SELECT experiment, source AS node, x, y FROM rows UNION ALL SELECT experiment, target, NULL, NULL FROM rows)
WHERE node IS NOT NULL GROUP BY ALL ORDER BY experiment, node"""
"""The nodes: all sources and targets. The position of a node is the mean over the rows of which it is the source."""
LOOKS = {
    "size": """
SELECT experiment, source AS node, list_avg(list_sort(list(size))) AS value
FROM rows WHERE source IS NOT NULL AND isfinite(size) GROUP BY ALL ORDER BY ALL""",
    "label": """
SELECT experiment, source AS node, min(label) AS value, count(DISTINCT label) AS labels
FROM rows WHERE source IS NOT NULL AND label IS NOT NULL GROUP BY ALL ORDER BY ALL""",
    "colour": """, joined(experiment, source, target, colour) AS (
  SELECT experiment, {ends}, colour FROM rows WHERE source <> target AND isfinite(weight) AND isfinite(colour)
)
SELECT experiment, source, target, list_avg(list_sort(list(colour))) AS value FROM joined GROUP BY ALL ORDER BY ALL""",
}
"""The looks of nodes and edges: means over the rows of all chosen runs; a node has one label."""
COUNTS = """
SELECT count(*) FILTER (source = target) AS loops, count(*) FILTER (source IS NULL) AS lost,
  count(*) FILTER (source <> target AND NOT coalesce(isfinite(weight), false)) AS weightless
FROM rows"""
