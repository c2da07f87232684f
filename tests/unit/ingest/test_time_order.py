"""A run fails whose time goes back within a file, and within the rows of a robot, unless the project allows it."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as pq
import pytest

from sierra.ingest.model import Form, Shape
from tests.projects import CONFIG, SIMULATOR, make, quick, sql
from tests.tiers import of_extension
from tests.unit.ingest.test_row_counts import make as files_of
from tests.unit.ingest.test_row_counts import read_files

RESTARTED = [0.0, 1.0, 2.0, 3.0, 0.5, 1.5]
BACK = "time goes back from 3 to 0.5 in row 5"
ALLOWED = '(to take rows in the order of their times, set time_order = "any" in [outputs.out])'


def csv(path: Path, times: Sequence[float]) -> Form:
    path.write_text("t,v\n" + "".join(f"{t},{place}\n" for place, t in enumerate(times)))
    return Form()


def jsonl(path: Path, times: Sequence[float]) -> Form:
    path.write_text("".join(json.dumps({"t": t, "v": place}) + "\n" for place, t in enumerate(times)))
    return Form()


def as_json(path: Path, times: Sequence[float]) -> Form:
    path.write_text(json.dumps({"rows": [{"t": t, "v": place} for place, t in enumerate(times)]}))
    return Form(rows="rows")


def xml(path: Path, times: Sequence[float]) -> Form:
    rows = "".join(f'<row t="{t}" v="{place}"/>' for place, t in enumerate(times))
    path.write_text(f"<rows>{rows}</rows>")
    return Form(rows="//row")


def table(times: Sequence[float]) -> pa.Table:
    return pa.table({"t": list(times), "v": list(range(len(times)))})


def parquet(path: Path, times: Sequence[float]) -> Form:
    pq.write_table(table(times), path)
    return Form()


def arrow(path: Path, times: Sequence[float]) -> Form:
    feather.write_feather(table(times), str(path))
    return Form()


def sqlite(path: Path, times: Sequence[float]) -> Form:
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE log (t REAL, v INTEGER)")
        database.executemany("INSERT INTO log VALUES (?, ?)", [(t, place) for place, t in enumerate(times)])
    return Form(rows="log")


FORMATS: dict[str, Callable[[Path, Sequence[float]], Form]] = {
    "csv": csv,
    "jsonl": jsonl,
    "json": as_json,
    "xml": xml,
    "parquet": parquet,
    "arrow": arrow,
    "sqlite": sqlite,
}


def faults(folder: Path, kind: str, times: Sequence[float], **shape: Any) -> list[str]:
    """Return the faults of a file with these times, beside a file whose times ascend."""
    paths = files_of(folder, [b"", b""], [f"0/out.{kind}", f"1/out.{kind}"])
    FORMATS[kind](paths[1], [float(place) for place in range(6)])
    form = FORMATS[kind](paths[0], times)
    given = Shape(kind, form=form, name="out", declared=True, **shape)
    reading, _ = read_files(folder, paths, shape=given)
    assert "e1" not in reading.faults
    return list(reading.faults.values())


@pytest.mark.parametrize("kind", ["csv", "jsonl", "json", "xml", "parquet", *of_extension("formats", "arrow", "sqlite")])
def test_run_fails_if_its_time_goes_back_in_any_format(kind: str, tmp_path: Path) -> None:
    assert faults(tmp_path, kind, RESTARTED) == [f"out.{kind}: {BACK} {ALLOWED}"]


@pytest.mark.parametrize("times", [[0, 0, 1, 1, 2, 2], [0, 1, 2, 3, 4, 5], [5, float("nan"), 6, float("inf"), 7, 8]])
def test_equal_and_missing_times_are_no_step_back(times: list[float], tmp_path: Path) -> None:
    assert not faults(tmp_path, "csv", times)


def test_step_back_after_a_missing_time_is_found_with_its_row(tmp_path: Path) -> None:
    [fault] = faults(tmp_path, "csv", [float("nan"), 1, 2, float("nan"), 1.5, 3])
    assert "time goes back from 2 to 1.5 in row 5" in fault


def test_declared_time_is_checked_instead_of_the_first_column(tmp_path: Path) -> None:
    assert not faults(tmp_path, "csv", RESTARTED, time="v")
    assert faults(tmp_path, "csv", RESTARTED, time="t")


def test_any_order_of_times_can_be_allowed(tmp_path: Path) -> None:
    assert not faults(tmp_path, "csv", RESTARTED, any_order=True)


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        ([(0, 1), (1, 1), (0, 2), (1, 2)], ""),
        ([(0.0, 1), (0.1, 2), (1.0, 1), (0.9, 2)], ""),
        ([(0, 1), (1, 1), (0, 2), (-1, 2)], "time goes back from 1 to 0 in row 3"),
        ([(0, 1), (2, 2), (1, 3), (3, 4)], "time goes back from 2 to 1 in row 3"),
        ([(0, 1), (1, 1), (2, 1), (0, 2), (1, 2), (0, 3)], ""),
        ([(0, 0), (1, 10), (2, 20), (0, 0), (1, 10), (2, 20)], "time goes back from 2 to 0 in row 4"),
    ],
    ids=["one after the other", "by turns", "one goes back", "a counter", "one with a single row", "a clock that loops"],
)
def test_each_robot_in_a_file_has_a_time_of_its_own(rows: list[tuple[float, int]], fault: str, tmp_path: Path) -> None:
    paths = files_of(tmp_path, [("t,robot\n" + "".join(f"{t},{robot}\n" for t, robot in rows)).encode()])
    reading, _ = read_files(tmp_path, paths, shape=Shape("csv", name="out"))
    [found] = reading.faults.values() or [""]
    assert fault in found
    assert bool(found) == bool(fault)


RESUMES = SIMULATOR.replace("for tick in range(5)", "for tick in (0, 1, 2, 3, 0.5, 1.5)")


@pytest.mark.nightly
def test_runs_that_go_back_fail_until_the_project_allows_it_and_captions_then_say_so(tmp_path: Path) -> None:
    root = make(tmp_path / "p", simulator=RESUMES)
    done = quick(root, "run", "population_size=1,2", "--no-figures")
    assert done.returncode == 1
    assert f"swarm.csv: {BACK}" in done.stdout
    assert 'set file = "swarm.csv", time_order = "any" in [outputs.swarm]' in done.stdout
    with (root / "sierra.toml").open("a") as file:
        file.write('[outputs.swarm]\nfile = "swarm.csv"\ntime_order = "any"\n')
    done = quick(root, "run", "population_size=1,2")
    assert done.returncode == 0, done.stderr
    assert "4 reused" in done.stdout + done.stderr  # evaluated again from their recorded files
    [caption] = [path.read_text() for path in root.glob("figures/*/swarm_coverage_summary.txt")]
    note = "the time of output 'swarm' goes back in 4 runs: rows are taken in the order of their times"
    assert note in caption.replace("The time", "the time")
    told = quick(root, "stats", "swarm", "coverage", "-s", "mean", "--json")
    assert note in told.stderr
    [first, *_] = json.loads(told.stdout)
    [run] = sql(root, "SELECT avg(coverage) AS v FROM swarm WHERE tick = 3 AND population_size = 1")
    assert first["mean"] == pytest.approx(run["v"])


@pytest.mark.integration
def test_statistics_refuse_files_of_a_run_that_overlap_in_time(tmp_path: Path) -> None:
    """A restart that continues in a second file is as wrong as one in the same file."""
    two = SIMULATOR.replace('with open("swarm.csv", "w") as file:', "for part, start in ((1, 0), (2, START)):")
    two = two.replace('    print("tick', '    file = open(f"log_{part}.csv", "w")\n    print("tick').replace(
        "range(5)", "range(4)"
    )
    two = two.replace("print(tick, count", "print(start + tick, count")
    config = CONFIG + '[outputs.log]\nfile = "log_*.csv"\ntime = "tick"\n'
    after = make(tmp_path / "after", config, simulator=two.replace("START", "4"))
    within = make(tmp_path / "within", config, simulator=two.replace("START", "1.5"))
    for root, code in ((after, 0), (within, 2)):
        assert quick(root, "run", "population_size=1", "--no-figures").returncode == 0
        told = quick(root, "stats", "log", "coverage")
        assert told.returncode == code, told.stderr
        assert ("2 runs whose time goes back" in told.stderr) == (code == 2)


@pytest.mark.integration
def test_statistics_refuse_a_time_that_is_declared_later_and_goes_back(tmp_path: Path) -> None:
    root = make(tmp_path / "p", simulator=RESUMES.replace("tick,coverage", "hour,coverage"))
    assert quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    with (root / "sierra.toml").open("a") as file:
        file.write('[outputs.swarm]\nfile = "swarm.csv"\ntime = "hour"\n')
    told = quick(root, "stats", "swarm", "coverage")
    assert told.returncode == 2
    assert "2 runs whose time goes back, as after a restart from a checkpoint" in told.stderr
