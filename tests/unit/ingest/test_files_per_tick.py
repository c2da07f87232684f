"""Files whose names have a number become one table with the number as a column."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sierra.config.output_tables import Output
from tests import projects
from tests.projects import quick

SIMULATOR = """\
import os, sys
os.mkdir("floor")
for tick in (0, 2, 10, 9):
    with open(f"floor/floor-{tick}.csv", "w") as file:
        print("x,v", file=file)
        for x in range(2):
            print(x, tick + x / 2, sep=",", file=file)
"""
ODD_SEED = """\
if int(open(sys.argv[1]).read().split('<random seed="')[1].split('"')[0]) % 2:
"""
CONFIG = projects.CONFIG + '[outputs.floor]\nfile = "floor/floor-{tick}.csv"\n'


def made(folder: Path, more: str = "", config: str = CONFIG) -> Path:
    return projects.make(folder, config, simulator=SIMULATOR + more)


def rows(root: Path, statement: str) -> list[str]:
    ended = quick(root, "sql", statement)
    assert ended.returncode == 0, ended.stderr
    return [" ".join(line.split()) for line in ended.stdout.splitlines()[1:]]


def reason(root: Path) -> str:
    [line] = rows(root, "SELECT DISTINCT reason FROM executions")
    return line


@pytest.mark.integration
def test_numbers_in_names_become_a_column_in_their_natural_order(tmp_path: Path) -> None:
    root = made(tmp_path)
    ended = quick(root, "run", "population_size=1", "--no-figures")
    assert ended.returncode == 0, ended.stderr
    assert rows(root, 'SELECT tick, x, v FROM floor WHERE number = 0 ORDER BY "row"') == [
        f"{tick} {x} {tick + x / 2:g}" for tick in (0, 2, 9, 10) for x in (0, 1)
    ]
    assert len(list((root / ".sierra").rglob("output.*.parquet"))) == 1
    assert quick(root, "fsck").returncode == 0


@pytest.mark.integration
def test_time_axis_may_be_the_number_of_the_files(tmp_path: Path) -> None:
    root = projects.make(tmp_path, CONFIG + 'time = "tick"\n', simulator=SIMULATOR.replace("range(2)", "range(1)"))
    assert quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    ended = quick(root, "stats", "floor", "v", "--times", "own", "--json")
    assert ended.returncode == 0, ended.stderr
    assert {row["t"] for row in json.loads(ended.stdout)} == {0, 2, 9, 10}


@pytest.mark.integration
@pytest.mark.parametrize(
    ("more", "config", "said"),
    [
        ("os.rename('floor', 'roof')\n", CONFIG, "did not write 'floor/floor-{tick}.csv' (output 'floor')"),
        ("open('floor/floor-02.csv', 'w').write('x,v\\n')\n", CONFIG, "is tick 2, as floor/floor-"),
        ("", CONFIG.replace("{tick}", "{X}"), "has a column 'x', but that is a number in its name"),
        ("open('floor/floor-9.csv', 'a').write('1')\n", CONFIG, "floor/floor-9.csv: line 4: "),
    ],
    ids=["no file", "one number twice", "a column of that name", "a file that is cut short"],
)
def test_files_that_do_not_fit_fail_the_run_in_one_line(tmp_path: Path, more: str, config: str, said: str) -> None:
    root = made(tmp_path, more, config)
    assert quick(root, "run", "population_size=1", "--no-figures").returncode == 1
    assert said in reason(root)


@pytest.mark.integration
def test_missing_number_in_some_runs_differs_from_their_siblings(tmp_path: Path) -> None:
    root = made(tmp_path, ODD_SEED + "    os.remove('floor/floor-9.csv')\n")
    assert quick(root, "run", "population_size=1", "--no-figures", "--runs", "6").returncode == 1
    found = rows(root, "SELECT DISTINCT reason FROM executions WHERE status = 'mismatch'")
    assert ["table 'floor' has 6 rows" in line or "table 'floor' has 8 rows" in line for line in found] == [True]


@pytest.mark.parametrize(
    ("file", "path", "numbers"),
    [
        ("floor-{tick}.csv", "floor-007.csv", (7,)),
        ("r{robot}/t.{tick}.csv", "r3/t.12.csv", (3, 12)),
        ("./floor-{tick}.csv", "floor-7.csv", (7,)),
        ("floor-{tick}.csv", "floor-x.csv", None),
        ("floor-{tick}.csv", "floor--1.csv", None),
        ("floor-{tick}.csv", "floor-1Xcsv", None),
        ("floor-{tick}.csv", "a/floor-1.csv", None),
    ],
)
def test_names_match_whole_numbers_only(file: str, path: str, numbers: tuple[int, ...] | None) -> None:
    output = Output(file=file)
    assert output.ticks_of(path) == numbers
    assert output.matches(path) == (numbers is not None)


@pytest.mark.parametrize("keys", [{"file": "*-{tick}.csv"}, {"file": "{tick}-{TICK}.csv"}])
def test_pattern_that_is_not_clear_is_an_error(keys: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"exclude each other|occurs twice"):
        Output(**keys)
