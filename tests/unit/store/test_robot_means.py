"""Means of the robots of a run, against values that were computed by hand."""

from __future__ import annotations

import duckdb
import pytest

from sierra.store import robot_means

Row = tuple[int, float, float | None]


def mean(rows: list[Row], template: str) -> list[tuple[float, float | None]]:
    """Return the times and values of one run, from rows of robot, time and value."""
    connection = duckdb.connect()
    connection.execute('CREATE TABLE data ("# experiment" INT, run TEXT, "# number" INT, robot INT, t DOUBLE, value DOUBLE)')
    connection.executemany("INSERT INTO data VALUES (0, 'r', 0, ?, ?, ?)", rows)
    text = template.format(rows=robot_means.rows("data", "robot", "value", "t", simulated=False))
    return connection.execute(f"SELECT t, value FROM ({text}) ORDER BY t").fetchall()


@pytest.mark.parametrize("template", [robot_means.SAME_TIMES, robot_means.OTHER_TIMES])
def test_robots_with_the_same_times_give_their_mean_without_the_base_station(template: str) -> None:
    rows: list[Row] = [(1, 0, 1), (2, 0, 3), (0, 0, 100), (1, 1, 5), (2, 1, 9), (0, 1, 100)]
    assert mean(rows, template) == [(0, 2), (1, 7)]
    assert mean([(0, 0, 4), (0, 1, 5)], template) == [(0, 4), (1, 5)]
    assert mean([(1, 0, 1), (2, 0, None), (1, 1, 1), (2, 1, float("nan"))], template) == [(0, None), (1, None)]


def test_robots_with_other_times_have_their_last_value_from_their_first_to_their_last_time() -> None:
    # robot 1 at 0, 2, 4; robot 2 at 1, 2.5
    rows: list[Row] = [(1, 0, 10), (1, 2, 20), (1, 4, 30), (2, 1, 1), (2, 2.5, 3)]
    assert mean(rows, robot_means.OTHER_TIMES) == [(0, 10), (1, 5.5), (2, 10.5), (2.5, 11.5), (4, 30)]


@pytest.mark.parametrize(
    ("runs", "partial"),
    [
        ({"a": {1: (0, 10), 2: (0.5, 9.9)}}, 0),
        ({"a": {1: (0, 10), 2: (0, 5)}, "b": {1: (0, 10), 2: (2, 10)}, "c": {1: (0, 10), 2: (0, 10)}}, 2),
        ({"a": {1: (0, 10), 2: (0, 10)}, "b": {1: (0, 10)}}, 1),
        ({"a": {1: (3, 3)}}, 0),
    ],
)
def test_runs_without_a_robot_for_some_time_are_counted(runs: dict[str, dict[int, tuple[float, float]]], partial: int) -> None:
    """`runs` has the first and the last time of each robot."""
    connection = duckdb.connect()
    connection.execute('CREATE TABLE data ("# experiment" INT, run TEXT, "# number" INT, robot INT, t DOUBLE, value DOUBLE)')
    rows = [(run, robot, t) for run, robots in runs.items() for robot, times in robots.items() for t in times]
    connection.executemany("INSERT INTO data VALUES (0, ?, 0, ?, ?, 1)", rows)
    query = robot_means.PARTIAL.format(rows=robot_means.rows("data", "robot", "value", "t", simulated=False))
    assert connection.execute(query).fetchall() == [(partial,)]
    said = robot_means.note("odom", same_times=False, partial=partial)
    assert (f"; in {partial} run" in said) == (partial > 0)


@pytest.mark.parametrize(
    ("rows", "facts"),
    [
        ([(1, 0, 1), (2, 0, 1), (1, 1, 1), (2, 1, 1)], (False, True)),
        ([(1, 0, 1), (2, 0, 1), (1, 1, 1)], (False, False)),
        ([(1, 0, 1), (1, 0, 2), (2, 0, 1)], (True, True)),
    ],
)
def test_shared_times_and_doubled_rows_are_found(rows: list[Row], facts: tuple[bool, bool]) -> None:
    connection = duckdb.connect()
    connection.execute('CREATE TABLE data ("# experiment" INT, run TEXT, "# number" INT, robot INT, t DOUBLE, value DOUBLE)')
    connection.executemany("INSERT INTO data VALUES (0, 'r', 0, ?, ?, ?)", rows)
    assert connection.execute(
        robot_means.TIMES.format(rows=robot_means.rows("data", "robot", "value", "t", simulated=False))
    ).fetchall() == [facts]
