"""Poses of robots: points at their places, with a line in the direction of their heading if there is one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from sierra.errors import UsageError
from sierra.extensions.videos.sql_tracks import Rows, Stacked, TrackSource
from sierra.extensions.videos.table import Video
from sierra.store.batch_data import ChosenRun
from sierra.store.sql_names import identifier, quote
from sierra.util.text import natural

if TYPE_CHECKING:
    from sierra.extensions.videos.tracks import State


class Poses:
    """The poses of the robots of each run: a row for each robot and time."""

    def __init__(self, source: TrackSource, video: Video, runs: Sequence[ChosenRun]) -> None:
        source.check(video.columns, numeric=True)
        self.columns = video.columns
        if video.robot:
            source.check((video.robot,), numeric=False)
        self.robots = _robots(source, video.robot, runs) if video.robot else []
        """The names of robots in their natural order, if a column has them."""
        expressions = {f"c{index}": f"{identifier(name)}::DOUBLE" for index, name in enumerate(video.columns)}
        if self.robots:
            members = ", ".join(map(quote, self.robots))
            expressions["robot"] = f"enum_code({identifier(video.robot)}::VARCHAR::ENUM({members}))::DOUBLE"
        self.rows = [Rows(source, run, expressions) for run in runs]
        if video.robot:
            for rows in self.rows:
                _check_once(source, rows, video.robot)
        self.tracks = [_Poses(rows) if self.robots else Stacked(rows) for rows in self.rows]


class _Poses(Stacked):
    """The poses of a run, and the number of each robot, by the place of its name."""

    def states(self) -> Iterator[State]:
        for (columns,) in super().states():
            yield columns[:, :-1], columns[:, -1]


def _robots(source: TrackSource, robot: str, runs: Sequence[ChosenRun]) -> list[str]:
    found: set[str] = set()
    for run in runs:
        names = f"SELECT DISTINCT {identifier(robot)}::VARCHAR AS robot FROM {source.relation(run)}"
        found.update(name for name in source.sql(names).column("robot").to_pylist() if name is not None)
    return sorted(found, key=natural)


def _check_once(source: TrackSource, rows: Rows, robot: str) -> None:
    """Raise UsageError if a robot has two poses at one time."""
    table = source.sql(
        f'SELECT "# t" AS t, {identifier(robot)}::VARCHAR AS robot, count(*) AS rows FROM {rows.relation} '
        'WHERE isfinite("# t") GROUP BY ALL HAVING count(*) > 1 ORDER BY ALL LIMIT 1'
    )
    for row in table.to_pylist():
        place = int((rows.times * source.per_second.get(rows.run.experiment, 1.0) < row["t"]).sum())
        where = f"output {source.output.name!r}, {rows.at(place)}"
        raise UsageError(f"{where}: robot {row['robot']!r} has {row['rows']} poses; make one by sql")
