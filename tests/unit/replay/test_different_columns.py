"""A replay names every column that differs, a line each, and tells what a clock measures from simulated numbers."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pyarrow as pa
import pytest

from sierra.cli.render_columns import column_lines
from sierra.replay.compare_values import of_tables
from tests import projects, stores
from tests.projects import quick

CLOCKS = """
import time, random
with open("swarm.csv", "w") as file:
    print("tick,coverage,wall_s,stamp,other", file=file)
    for tick in range(5):
        print(tick, NUMBER, time.perf_counter_ns(), time.time(), "same", sep=",", file=file)
"""


def project(folder: Path, number: str, config: str = "") -> Path:
    return projects.make(folder, projects.CONFIG + config, simulator=projects.SIMULATOR + CLOCKS.replace("NUMBER", number))


@pytest.mark.nightly
def test_clocks_are_named_and_the_proposed_line_makes_the_replay_equal(tmp_path: Path) -> None:
    root = project(tmp_path, "count * tick")
    batch = stores.ask(root, "population_size=1,2")
    ended = quick(root, "replay", batch)
    lines = [line.strip() for line in ended.stdout.splitlines()]
    assert ended.returncode == 1
    assert any(line.startswith("column 'wall_s' (a clock) differs in 20 of 20 rows of 4 runs; largest") for line in lines)
    assert any(line.startswith("column 'stamp' (a clock) differs in 20 of 20 rows of 4 runs; largest") for line in lines)
    assert "all 3 other columns are the same" in lines
    wanted = 'set file = "swarm.csv", volatile = ["wall_s", "stamp"] in [outputs.swarm]'
    assert f"to leave out what clocks measure, {wanted}" in lines
    with (root / "sierra.toml").open("a") as file:
        print('[outputs.swarm]\nfile = "swarm.csv"\nvolatile = ["wall_s", "stamp"]', file=file)
    again = quick(root, "replay", batch)
    assert again.returncode == 0, again.stdout
    assert "column " not in again.stdout


@pytest.mark.nightly
def test_numbers_that_differ_beside_clocks_are_said_and_declared_columns_stay_volatile(tmp_path: Path) -> None:
    config = '[outputs.swarm]\nfile = "swarm.csv"\nvolatile = ["stamp"]\n'
    root = project(tmp_path, "random.random()", config)
    ended = quick(root, "replay", stores.ask(root, "population_size=1"))
    lines = [line.strip() for line in ended.stdout.splitlines()]
    assert any(line.startswith("column 'coverage' differs in 10 of 10 rows of 2 runs; largest difference 0.") for line in lines)
    assert 'set volatile = ["stamp", "wall_s"] in [outputs.swarm]; 1 other column would still differ' in ended.stdout


def lines_of(old: dict[str, list[object]], new: dict[str, list[object]]) -> list[str]:
    return list(column_lines([of_tables(pa.table(old), pa.table(new))]))


def test_every_column_has_a_line_however_many_differ() -> None:
    old, new = ({f"c{n}": [0.0, 0.5 * n * now] for n in range(9)} for now in (False, True))
    lines = lines_of(old, new)
    assert [line.split("'")[1] for line in lines[:-1]] == [f"c{n}" for n in range(1, 9)]
    assert lines[0] == "column 'c1' differs in 1 of 2 rows of 1 run; largest difference 0.5"
    assert lines[-1] == "the other column is the same"


def test_texts_and_flags_have_no_distance() -> None:
    assert lines_of({"a": ["x", "y"], "b": [True, False]}, {"a": ["x", "z"], "b": [True, True]}) == [
        "column 'a' differs in 1 of 2 rows of 1 run",
        "column 'b' differs in 1 of 2 rows of 1 run",
        "no other column was compared",
    ]


def test_missing_or_new_columns_are_not_called_the_same() -> None:
    lines = lines_of({"a": [1], "b": [1]}, {"a": [2], "c": [1]})
    assert lines == ["column 'a' differs in 1 of 1 row of 1 run; largest difference 1 (relative 1)"]


@pytest.mark.parametrize(
    ("name", "was", "now", "clock"),
    [
        ("cpuSeconds", 1.0, 2.0, True),
        ("RTF", 1.0, 0.9, True),
        ("x", 1.7e9, 1.7e9 + 60, True),
        ("x", 1_700_000_000_000, 1_700_000_060_000, True),
        ("x", 1.7e9, 1.6e9, False),
        ("x", "2026-01-01T00:00:00", "2026-01-02T00:00:00", True),
        ("x", datetime(2026, 1, 1), datetime(2026, 1, 2), True),  # noqa: DTZ001
        ("duration", 1.0, 2.0, True),
        ("clock", 1.0, 2.0, False),
        ("speed", 1.0, 2.0, False),
        ("walls", 1.0, 2.0, False),
    ],
)
def test_a_clock_is_known_by_its_name_or_its_values(name: str, was: object, now: object, clock: bool) -> None:
    [line, *_] = lines_of({name: [was]}, {name: [now]})
    assert ("a clock)" in line) is clock


def test_a_duration_beside_numbers_that_differ_is_not_called_a_clock() -> None:
    lines = lines_of({"duration": [1.0], "energy": [1.0]}, {"duration": [2.0], "energy": [1.5]})
    assert not any("clock" in line for line in lines)
