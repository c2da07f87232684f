"""Poses of robots: points at their places, with a line in the direction of their heading if there is one."""

from __future__ import annotations

from collections.abc import Sequence

from sierra.errors import UsageError
from sierra.extensions.videos.sql_tracks import Rows, Source, Stacked
from sierra.extensions.videos.table import Video
from sierra.store.samples import ChosenRun
from sierra.store.sql_names import identifier


class Poses:
    """The poses of the robots of each run: a row for each robot and time."""

    def __init__(self, source: Source, video: Video, runs: Sequence[ChosenRun]) -> None:
        source.check(video.columns, numeric=True)
        self.columns = video.columns
        if video.robot:
            source.check((video.robot,), numeric=False)
        expressions = {f"c{place}": f"{identifier(name)}::DOUBLE" for place, name in enumerate(video.columns)}
        self.rows = [Rows(source, run, expressions) for run in runs]
        if video.robot:
            for rows in self.rows:
                _check_once(source, rows, video.robot)
        self.tracks = [Stacked(rows) for rows in self.rows]


def _check_once(source: Source, rows: Rows, robot: str) -> None:
    """Raise UsageError if a robot has two poses at one time."""
    table = source.sql(
        f'SELECT "# t" AS t, {identifier(robot)}::VARCHAR AS robot, count(*) AS rows FROM {rows.relation} '
        'WHERE isfinite("# t") GROUP BY ALL HAVING count(*) > 1 ORDER BY ALL LIMIT 1'
    )
    for row in table.to_pylist():
        place = int((rows.times * source.per_second.get(rows.run.experiment, 1.0) < row["t"]).sum())
        where = f"output {source.output.name!r}, {rows.at(place)}"
        raise UsageError(f"{where}: robot {row['robot']!r} has {row['rows']} poses; make one by sql")
