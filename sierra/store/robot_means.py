"""The mean of the robots of a run: statistics over runs have one value per run and time, and robots are no repetitions.

In a table that all robots of a run write, the value of the run at a time t is the mean of the values of its robots at t. The
base station (robot 0) of real robots does not count if other robots write the table too. If one of the values is missing or not
finite, so is the mean: the robots that are left would be another swarm.

Simulated robots write such a table if each has a file of its own, and the column `robot` says whose it is: `robot_{robot}.csv`.

Robots may write at different times. Then the times of a run are those of all its robots, and each robot has, from its first to
its last time, the value of its last row. Before and after that, the mean is the one of the other robots. A note counts the runs
in which a robot is missing for more than a tenth of the time, or in all of it. A robot that wrote two rows at one time has no
single value; such a table stays as it is, and statistics refuse it.
"""

from __future__ import annotations

from sierra.util.text import counted

COLUMNS = ("robot", "place")
"""The columns that may have the place of the robot that wrote a row; `place` is for files with an own column `robot`."""
IS_PLACE = "SELECT coalesce(bool_and(starts_with(file, {column}::VARCHAR || '/')), false) FROM {data}"
"""True if a column has the folder of each file: other columns may have the same name."""
SIMULATED = COLUMNS[0]
"""The column that says which of several simulated robots wrote a row."""
HAS_OWN_FILE = """
SELECT coalesce(bool_and(robots = files AND pairs = files), false) AND coalesce(max(files), 0) > 1 FROM (
    SELECT count(DISTINCT {column}) AS robots, count(DISTINCT file) AS files, count(DISTINCT (file, {column})) AS pairs
    FROM {data} GROUP BY execution
)
"""
"""True if each robot of a run wrote a file of its own, and some runs have several."""

ROWS = """
SELECT "# experiment" AS experiment, run, "# number" AS number, {column} AS robot, {t} AS t, {value}::DOUBLE AS value
FROM {data}
"""
WITHOUT_BASE = "{rows} WHERE {column} > 0 OR NOT EXISTS (SELECT 1 FROM {data} WHERE {column} > 0)"
"""The rows of all robots that count."""

TIMES = """
SELECT coalesce(max(doubled), false) AS doubled, coalesce(bool_and(robots = all_robots), true) AS same FROM (
    SELECT robots, all_robots, rows > robots AS doubled FROM (
        SELECT experiment, run, t, count(*) AS rows, count(DISTINCT robot) AS robots FROM ({rows}) WHERE isfinite(t)
        GROUP BY ALL
    ) JOIN (SELECT experiment, run, count(DISTINCT robot) AS all_robots FROM ({rows}) GROUP BY ALL) USING (experiment, run)
)
"""
"""Two facts: whether a robot has two rows at one time, and whether all robots of each run have the same times."""

PARTIAL = """
SELECT count(*) FROM (
    SELECT count(*) < max(count(*)) OVER (PARTITION BY experiment) AS lacks,
           min(last) - max(first) AS together, max(last) - min(first) AS whole
    FROM (SELECT experiment, run, robot, min(t) AS first, max(t) AS last FROM ({rows}) WHERE isfinite(t) GROUP BY ALL)
    GROUP BY experiment, run
) WHERE lacks OR together < 0.9 * whole
"""
"""The number of runs that have fewer robots than other runs of their experiment, or a robot without values for a tenth of the
time or more."""

MEAN = "CASE WHEN bool_and(coalesce(isfinite(value), false)) THEN list_sum(list(value ORDER BY robot)) / count(*) END AS value"
"""Added in the order of the robots, so that the order of rows has no effect on the last digits."""

PLACE = "NULL::VARCHAR AS file, NULL::BIGINT AS place"
"""Means are not rows of a file."""
SAME_TIMES = f"SELECT experiment, run, number, t, {MEAN}, {PLACE} FROM ({{rows}}) GROUP BY experiment, run, number, t"

OTHER_TIMES = f"""
WITH rows AS (SELECT * FROM ({{rows}}) WHERE isfinite(t)),
robots AS (SELECT experiment, run, number, robot, min(t) AS first, max(t) AS last FROM rows GROUP BY ALL),
times AS (SELECT DISTINCT experiment, run, number, t FROM rows),
points AS (
    SELECT experiment, run, number, robot, t FROM times JOIN robots USING (experiment, run, number)
    WHERE t BETWEEN first AND last
)
SELECT p.experiment, p.run, p.number, p.t, {MEAN}, {PLACE} FROM (
    SELECT p.*, r.value FROM points p ASOF JOIN rows r
    ON p.experiment = r.experiment AND p.run = r.run AND p.robot = r.robot AND p.t >= r.t
) p GROUP BY p.experiment, p.run, p.number, p.t
UNION ALL SELECT experiment, run, number, t, value, {PLACE} FROM ({{rows}}) WHERE NOT coalesce(isfinite(t), false)
"""


def rows(data: str, column: str, value: str, t: str, *, simulated: bool) -> str:
    """Return the query for the rows that count. `data` is a relation; `column`, `value` and `t` are SQL expressions.

    `simulated`: no robot is the base station.
    """
    every = ROWS.format(column=column, data=data, value=value, t=t)
    return every if simulated else WITHOUT_BASE.format(rows=every, column=column, data=data)


def note(table: str, *, same_times: bool, partial: int) -> str:
    """Return a note for readers of the statistics of a table. `partial` is the number of runs that `PARTIAL` counts."""
    how = "" if same_times else "; their times differ, so the last value of each robot is carried forward"
    lack = f"; in {counted(partial, 'run')}, robots lack more than a tenth of the time, where the mean is that of the others"
    return (
        f"output {table!r}: the value of a run is the mean of its robots at each time{how}{lack if partial else ''} "
        "(a derived table can have another)"
    )
