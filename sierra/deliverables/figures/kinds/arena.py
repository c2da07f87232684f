"""Kinds that show rows in space: paths of robots, how often they were where, and the cells of a matrix."""

from __future__ import annotations

from functools import partial
from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field, NonNegativeInt

from sierra.config.field_types import Finite, Positive, Table
from sierra.deliverables.figures.base import RUN, DrawnBy, DrawnKind, Request
from sierra.errors import UsageError
from sierra.stats.needs import Needs
from sierra.store.rounded_times import at_time
from sierra.store.sql_names import identifier

MOST = 100_000
"""The largest number of points that are drawn; of more, every k-th of each path."""
Times = float | tuple[float, ...]
SPACE = frozenset({"facet", "xlim", "ylim", "labels"})


class TrajectoriesOptions(Table):
    """Figures of kind `trajectories`."""

    robot: str = Field("", description="column that tells the robots apart; default: one robot for each run")
    run: Annotated[NonNegativeInt, RUN] = 0


class Trajectories(DrawnKind[TrajectoriesOptions]):
    """The paths over two columns, x and y, of one run of each experiment: circles at the starts, squares at the ends."""

    Options: ClassVar[type[Table]] = TrajectoriesOptions
    uses: ClassVar[frozenset[str]] = SPACE | {"palette"}

    def needs(self, request: Request) -> Needs:
        x, y = (f"{identifier(name)}::DOUBLE" for name in _two(request))
        robot = f"{identifier(self.options.robot)}::VARCHAR" if self.options.robot else "''"
        statement = f"""\
WITH points AS (
  SELECT "# experiment" AS experiment, {robot} AS robot, "# t" AS t, "# place" AS place, {x} AS x, {y} AS y
  FROM data WHERE "# number" = {self.options.run}
), numbered AS (
  SELECT *, row_number() OVER (PARTITION BY experiment, robot ORDER BY t, place) - 1 AS step,
    count(*) OVER (PARTITION BY experiment, robot) AS steps, 1 + (count(*) OVER () - 1) // {MOST} AS every
  FROM points
)
SELECT experiment, robot, t, x, y, every FROM numbered WHERE step % every = 0 OR step = steps - 1
ORDER BY experiment, robot, t, place"""
        others = (self.options.robot,) if self.options.robot else ()
        shows = "paths, ○ start, □ end"
        return Needs(rows={"paths": statement}, columns=2, others=others, shows=shows, run=self.options.run)

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import arena

        return DrawnBy(arena.trajectories, (partial(arena.notes_on_paths, run=self.options.run),))


class DensityOptions(Table):
    """Figures of kind `density`."""

    bins: int = Field(40, ge=2, le=500, description="number of cells along the longer side; cells are squares")


class Density(DrawnKind[DensityOptions]):
    """The part of all rows of an experiment in each cell of two columns, x and y."""

    Options: ClassVar[type[Table]] = DensityOptions
    uses: ClassVar[frozenset[str]] = SPACE | {"log_y"}

    def needs(self, request: Request) -> Needs:
        x, y = (f"{identifier(name)}::DOUBLE" for name in _two(request))
        ends = [_ends("x", request.figure.xlim), _ends("y", request.figure.ylim)]
        statement = f"""\
WITH points AS (SELECT "# experiment" AS experiment, {x} AS x, {y} AS y FROM data),
finite AS (SELECT * FROM points WHERE isfinite(x) AND isfinite(y)),
ends AS (SELECT {", ".join(ends)} FROM finite),
sized AS (SELECT *, coalesce(nullif(greatest(x1 - x0, y1 - y0), 0), 1.0) / {self.options.bins} AS cell FROM ends)
SELECT experiment, least(floor((x - x0) / cell), ceil((x1 - x0) / cell) - 1)::INTEGER AS i,
  least(floor((y - y0) / cell), ceil((y1 - y0) / cell) - 1)::INTEGER AS j, count(*) AS count,
  any_value(x0) AS x0, any_value(y0) AS y0, any_value(x1) AS x1, any_value(y1) AS y1, any_value(cell) AS cell
FROM finite, sized WHERE x BETWEEN x0 AND x1 AND y BETWEEN y0 AND y1 GROUP BY ALL ORDER BY ALL"""
        counts = f"SELECT count(*) AS rows, count(*) FILTER (isfinite({x}) AND isfinite({y})) AS finite FROM data"
        return Needs(rows={"cells": statement, "counts": counts}, columns=2, shows="part of all rows in each cell")

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import arena

        return DrawnBy(arena.density, (arena.notes_on_cells,))


class MatrixOptions(Table):
    """Figures of kind `matrix`. Without `run`, the mean of all runs is shown."""

    at: Annotated[
        tuple[Finite, ...], BeforeValidator(lambda v: v if isinstance(v, tuple) else (v,), json_schema_input_type=Times)
    ] = Field((), description="time of the matrix, or times with a column of panels each; default: the mean over all times")
    run: Annotated[NonNegativeInt | None, RUN] = None
    aspect: Positive = Field(1.0, description="height of a cell as a multiple of its width")
    axes: Literal["rows", "xy"] = Field(
        "rows",
        description="`rows`: the first two columns are the number of the row, from the top, and of the column; `xy`: they are "
        "x, to the right, and y, upwards",
    )


class Matrix(DrawnKind[MatrixOptions]):
    """A matrix that runs write as rows of three columns (row, column, value), as colours."""

    Options: ClassVar[type[Table]] = MatrixOptions
    uses: ClassVar[frozenset[str]] = frozenset({"facet", "log_y", "labels"})

    def needs(self, request: Request) -> Needs:
        if len(request.columns) != 3:
            raise UsageError("a matrix needs three columns: of the number of the row, of the column, and of the value")
        row, column, value = (f"{identifier(name)}::DOUBLE" for name in request.columns)
        row, column = (column, row) if self.options.axes == "xy" else (row, column)
        chosen = ["true"]
        if self.options.run is not None:
            chosen.append(f'"# number" = {self.options.run}')
        if self.options.at:
            chosen.append(f"({' OR '.join(map(at_time, self.options.at))})")
        several = len(self.options.at) > 1
        t = ', "# t" AS t' if several else ""
        statement = f"""\
WITH cells AS (
  SELECT "# experiment" AS experiment{t}, run, {row} AS i, {column} AS j, list_avg(list_sort(list({value}))) AS value
  FROM data WHERE isfinite({value}) AND {" AND ".join(chosen)} GROUP BY ALL
)
SELECT experiment{", t" if several else ""}, i, j, list_avg(list_sort(list(value))) AS value, count(*) AS n
FROM cells GROUP BY ALL ORDER BY ALL"""
        bad = f"SELECT count(*) AS rows, count(*) FILTER (isfinite({value})) AS finite FROM data WHERE {' AND '.join(chosen)}"
        what = "mean of the runs, " if self.options.run is None else ""
        when = f"at {', '.join(f'{time:g}' for time in self.options.at)}" if self.options.at else "mean of the rows"
        return Needs(rows={"cells": statement, "counts": bad}, columns=3, shows=f"{what}{when}", run=self.options.run)

    def drawn_by(self) -> DrawnBy:
        from sierra.deliverables.figures import arena

        notes = partial(arena.notes_on_matrix, times=self.options.at)
        drawn = partial(arena.matrix, aspect=self.options.aspect, upwards=self.options.axes == "xy")
        return DrawnBy(drawn, (notes,))


def _ends(name: str, limits: tuple[float, float] | None) -> str:
    """Return the SQL of the two ends of an axis: the given limits, or those of the data."""
    low, high = limits or (None, None)
    first = f"min({name})" if low is None else f"any_value({low!r}::DOUBLE)"
    last = f"max({name})" if high is None else f"any_value({high!r}::DOUBLE)"
    return f"{first} AS {name}0, {last} AS {name}1"


def _two(request: Request) -> tuple[str, str]:
    if len(request.columns) != 2:
        raise UsageError(f"a {request.figure.kind} figure needs two columns, x and y, not {len(request.columns)}")
    x, y = request.columns
    return x, y
