"""The time axis of outputs that declare none is chosen by the name of a column or by its values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests import projects
from tests.projects import quick

TIMESTEP = projects.SIMULATOR.replace("tick,coverage", "timestep,coverage").replace("print(tick, ", "print(tick * 10, ")
LENGTHS = projects.SIMULATOR.replace("range(5)", "range(20 + seed % 50)").replace("tick,coverage", "timestep,coverage")
TAKEN = "'timestep' is used as the time of output 'swarm', because it increases equally in all runs"

TIME = 'time = "COLUMN" in [outputs.swarm]'


def times(root: Path, *words: str) -> tuple[set[Any], str]:
    """Return the times at which there are statistics of coverage, and the messages."""
    ended = quick(root, "stats", "swarm", "coverage", "--times", "own", "--json", *words)
    assert ended.returncode == 0, ended.stderr
    return {row["t"] for row in json.loads(ended.stdout)}, ended.stderr


def asked(root: Path, simulator: str, config: str = "", runs: int = 3) -> Path:
    projects.make(root, projects.CONFIG + config, simulator=simulator)
    assert quick(root, "run", "population_size=1,2", "--runs", str(runs), "--no-figures").returncode == 0
    return root


@pytest.mark.integration
def test_column_that_increases_alike_in_all_runs_is_the_time_and_is_reported(tmp_path: Path) -> None:
    found, told = times(asked(tmp_path, TIMESTEP))
    assert found == {0, 10, 20, 30, 40}
    assert TAKEN in told
    ended = quick(tmp_path, "figures")
    assert ended.returncode == 0
    assert f'{TAKEN} (to name another, set time = "COLUMN" in [outputs.swarm])' in ended.stderr
    assert ended.stderr.count("is used as the time") == 1


@pytest.mark.nightly
def test_declared_or_conventionally_named_time_column_is_used_without_a_report(tmp_path: Path) -> None:
    root = asked(tmp_path / "called", projects.SIMULATOR)
    assert times(root)[0] == {0, 1, 2, 3, 4}
    assert "is used as" not in times(root)[1]
    declared = asked(tmp_path / "declared", TIMESTEP, '[outputs.swarm]\nfile = "swarm.csv"\ntime = "timestep"\n')
    assert times(declared)[0] == {0, 10, 20, 30, 40}
    assert "is used as" not in times(declared)[1]


@pytest.mark.nightly
def test_time_column_is_found_in_runs_of_different_lengths(tmp_path: Path) -> None:
    ragged = '[outputs.swarm]\nfile = "swarm.csv"\nmismatch = "ragged"\n'
    found, told = times(asked(tmp_path, TIMESTEP.replace("range(5)", "range(3 + seed % 3)"), ragged))
    assert {0, 10, 20} <= found
    assert TAKEN in told


@pytest.mark.nightly
@pytest.mark.parametrize(
    "written",
    [
        "tick * count",  # differs between experiments
        "tick + seed % 7",  # differs between runs
        "min(tick, 3)",  # stops increasing
        "-tick",
        "'nan' if tick == 4 else tick",
        "'' if tick == 4 else tick",
    ],
)
def test_columns_that_do_not_increase_alike_in_all_runs_are_not_the_time(written: str, tmp_path: Path) -> None:
    simulator = TIMESTEP.replace("print(tick * 10, ", f"print({written}, ")
    found, told = times(asked(tmp_path, simulator))
    assert found == {0, 1, 2, 3, 4}
    assert "is used as" not in told
    assert (
        "output 'swarm' has no time column: row numbers are used instead, because no column increases equally in all runs"
        in told
    )


@pytest.mark.integration
def test_last_row_of_a_declared_table_without_a_time_is_noted_once(tmp_path: Path) -> None:
    simulator = projects.SIMULATOR.replace("tick,coverage", "robot,coverage,energy").replace(
        "print(tick, count", 'print(f"r{tick}", seed % 7, count'
    )
    root = asked(tmp_path, simulator, '[outputs.swarm]\nfile = "swarm.csv"\n')
    last = "output 'swarm' has no time column: row numbers are used instead"
    assert f"and final is the last of a run's 5 rows (if a column is the time, set {TIME}" in quick(root, "figures").stderr
    assert quick(root, "figures").stderr.count(last) == 1
    assert quick(root, "stats", "swarm", "energy").stderr.count(last) == 1
    for words in (("--where", "robot = 'r3'"), ("--measure", "mean")):
        assert last not in quick(root, "stats", "swarm", "energy", *words).stderr, "one row of a run, or all of them count"


@pytest.mark.integration
def test_no_column_is_chosen_as_the_time_for_a_single_run(tmp_path: Path) -> None:
    projects.make(tmp_path, simulator=TIMESTEP)
    assert quick(tmp_path, "run", "population_size=1", "--runs", "1", "--no-figures").returncode == 0
    assert "is used as" not in times(tmp_path)[1]


@pytest.mark.integration
def test_column_that_differs_by_rounding_only_between_runs_is_the_time(tmp_path: Path) -> None:
    simulator = TIMESTEP.replace("print(tick * 10, ", "print(sum([0.1] * tick) if seed % 2 else tick * 0.1, ")
    simulator = simulator.replace("range(5)", "range(12)")
    found, told = times(asked(tmp_path, simulator, runs=6))
    assert TAKEN in told
    assert len(found) == 12


@pytest.mark.integration
def test_series_whose_times_differ_by_rounding_is_no_table_of_events(tmp_path: Path) -> None:
    rounded = "(sum([0.1] * tick) if seed % 2 else tick * 0.1)"
    simulator = LENGTHS.replace("print(tick, ", f"print({rounded}, ")
    projects.make(tmp_path, simulator=simulator)
    done = quick(tmp_path, "run", "population_size=1,2", "--runs", "6", "--no-figures")
    assert done.returncode == 1
    assert "other runs of its experiment have" in done.stdout
