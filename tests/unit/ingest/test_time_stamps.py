"""Time stamps of CSV are times, as those of Parquet are; no digit and no zone gets lost, and old texts stay texts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import duckdb
import pytest

from sierra.ingest import csv
from tests.projects import make, quick, run, sql
from tests.readings import read_file

NOON = 1_796_040_000 * 10**9
"""2026-11-30 12:00 UTC in nanoseconds."""


def recorded(folder: Path, cells: Sequence[str]) -> tuple[str, str, list[int | str | None]]:
    """Return the kind and the type of a column with these cells, and its values; times in nanoseconds."""
    content = "n,t\n" + "".join(f'{place},"{cell}"\n' if cell else f"{place},\n" for place, cell in enumerate(cells))
    reading, _ = read_file(folder, "out.csv", content.encode())
    [kinds] = reading.columns.values()
    [target] = (folder / "target").iterdir()
    table = f"'{target}'"
    [(kind,)] = duckdb.sql(f"SELECT DISTINCT typeof(t) FROM {table}").fetchall()
    value = "epoch_ns(t)" if "TIME" in kind else "t"
    return kinds["t"], kind, [row[0] for row in duckdb.sql(f"SELECT {value} FROM {table} ORDER BY n").fetchall()]


@pytest.mark.parametrize(
    ("cells", "kind", "values"),
    [
        (["2026-11-30T12:00:00.123Z"], "TIMESTAMP WITH TIME ZONE", [NOON + 123 * 10**6]),
        (["2026-11-30 12:00:00+01:00"], "TIMESTAMP WITH TIME ZONE", [NOON - 3600 * 10**9]),
        (["2026-11-30T12:00Z", "2026-11-30 13:30:00+0130", "2026-11-30 11:00-01"], "TIMESTAMP WITH TIME ZONE", [NOON] * 3),
        (["2026-11-30 12:00:00", "", " 2026-11-30T12:00:00.000001 "], "TIMESTAMP", [NOON, None, NOON + 1000]),
        (["2026-11-30 12:00:00,123"], "TIMESTAMP", [NOON + 123 * 10**6]),
        (["2026-11-30T12:00:00", "2026-11-30T12:00:00.000000001"], "TIMESTAMP_NS", [NOON, NOON + 1]),
        (["2026-11-30T12:00:00.123456789-00:30"], "TIMESTAMPTZ_NS", [NOON + 1800 * 10**9 + 123_456_789]),
    ],
)
def test_time_stamps_are_times_with_all_their_digits(
    tmp_path: Path, cells: list[str], kind: str, values: list[int | None]
) -> None:
    kinds = {"TIMESTAMP_NS": "TIMESTAMP", "TIMESTAMPTZ_NS": "TIMESTAMP WITH TIME ZONE"}
    assert recorded(tmp_path, cells) == (kinds.get(kind, kind), kind, values)


@pytest.mark.parametrize(
    "cells",
    [
        ["2026-11-30T12:00:00Z", "2026-11-30T12:00:00"],
        ["2026-02-28 12:00", "2026-02-30 12:00"],
        ["2026-11-30 12:00:00", "n/a"],
        ["2026-11-30 12:00:00", "5"],
        ["2026-11-30 12:00:00", "nan"],
        ["2026-11-30"],
        ["12:00:00"],
        ["2026-11-30 24:00:00"],
        ["2016-12-31T23:59:60Z"],
        ["2026-11-30T12:00:00.0000000001"],
        ["3000-01-01 00:00", "2026-11-30T12:00:00.000000001"],
        ["0000-01-01 00:00:00"],
        ["2026-11-30T12:00:00+25:00"],
        ["2026-11-30T12:00:00 Europe/Berlin"],
    ],
)
def test_other_texts_stay_texts_as_they_are(tmp_path: Path, cells: list[str]) -> None:
    assert recorded(tmp_path, cells) == ("text", "VARCHAR", cells)


@pytest.mark.integration
def test_a_time_far_below_the_first_rows_decides_too(tmp_path: Path) -> None:
    rows = 60_000
    cells = ["2026-11-30T12:00:00Z"] * rows
    assert recorded(tmp_path, [*cells, "2026-11-30T12:00:00.000000001Z"])[1] == "TIMESTAMPTZ_NS"
    assert recorded(tmp_path, [*cells, "2026-11-30T12:00:00"])[1] == "VARCHAR"
    assert recorded(tmp_path, [*cells, "2026-02-30T12:00:00Z"])[1] == "VARCHAR"


SIMULATOR = """\
import json, sys
with open(sys.argv[1]) as file:
    given = json.load(file)
with open("out.csv", "w") as file:
    print("stamp,name,v", file=file)
    for second in range(3):
        print(f"2026-11-30T12:00:0{second}.5+02:00", given["name"], given["n"] * second + given["seed"] % 7, sep=",", file=file)
"""
CONFIG = """\
template = "input.json"
command = "python3 sim.py {input}"
seed = "/seed"
runs = 2
[variables]
n = "/n"
[outputs.out]
file = "out.csv"
time = "stamp"
"""


def project(folder: Path) -> Path:
    make(folder, CONFIG, simulator=SIMULATOR)
    (folder / "input.json").write_text('{"n": 1, "seed": 0, "name": "a"}')
    return folder


def type_of(folder: Path) -> str:
    [row] = sql(folder, "SELECT DISTINCT typeof(stamp) AS kind FROM out")
    return str(row["kind"])


@pytest.mark.integration
def test_times_are_a_time_axis_and_replays_are_identical(tmp_path: Path) -> None:
    folder = project(tmp_path / "project")
    done, _ = run(folder, "n=1,2")
    assert type_of(folder) == "TIMESTAMP WITH TIME ZONE"
    assert len(sql(folder, "SELECT * FROM out WHERE stamp > TIMESTAMP '2026-11-30 10:00:01'")) == 8
    for format in ("table", "markdown", "csv"):
        printed = quick(folder, "sql", "--format", format, "SELECT min(stamp) AS stamp FROM out").stdout
        assert "+00:00" in printed.splitlines()[-1], "times with a zone are printed with it"
    stats = quick(folder, "stats", "out", "v", "--times", "own", "--statistic", "mean", "--json")
    rows = json.loads(stats.stdout)
    assert {36_000.5, 36_001.5, 36_002.5} in [{row[name] for row in rows} for name in rows[0]]
    assert quick(folder, "replay", str(done["batch"])).returncode == 0


@pytest.mark.integration
def test_texts_that_an_earlier_version_recorded_stay_texts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = project(tmp_path / "project")
    with monkeypatch.context() as patch:
        patch.setattr(csv.Csv, "times", False)  # as an earlier version recorded them
        done, _ = run(folder, "n=1")
    more, _ = run(folder, "n=1", "--runs", "6")
    other, _ = run(folder, "n=2")
    assert [one["failed"] for one in (done, more, other)] == [0, 0, 0]
    assert type_of(folder) == "VARCHAR"
    assert sql(folder, "SELECT DISTINCT stamp FROM out ORDER BY ALL LIMIT 1") == [{"stamp": "2026-11-30T12:00:00.5+02:00"}]
    assert quick(folder, "replay", str(done["batch"])).returncode == 0


@pytest.mark.integration
def test_programs_may_leave_out_zeros_in_some_runs(tmp_path: Path) -> None:
    folder = project(tmp_path / "project")
    text = SIMULATOR.replace(".5+02:00", "{'.123456789' if given['seed'] % 2 else ''}")
    (folder / "sim.py").write_text(text)
    done, _ = run(folder, "n=1", "--runs", "6")
    assert (done["failed"], done["executed"]) == (0, 6)
    assert type_of(folder) == "TIMESTAMP_NS"


@pytest.mark.integration
def test_texts_among_times_of_other_runs_make_a_column_of_texts(tmp_path: Path) -> None:
    folder = project(tmp_path / "project")
    (folder / "sim.py").write_text(SIMULATOR.replace('{second}.5+02:00"', '{second}"if second or given["number"] else "n/a"'))
    (folder / "input.json").write_text('{"n": 1, "seed": 0, "name": "a", "number": 0}')
    config = CONFIG + '[[run_changes]]\nset = "/number"\nvalue = "{run}"\n'
    (folder / "sierra.toml").write_text(config)
    done, _ = run(folder, "n=1", "--runs", "4")
    assert (done["failed"], done["executed"]) == (0, 4)
    assert type_of(folder) == "VARCHAR"
    assert sql(folder, "SELECT count(*) AS n FROM out WHERE stamp = 'n/a'") == [{"n": 1}]


@pytest.mark.integration
def test_texts_after_recorded_times_fail_no_run(tmp_path: Path) -> None:
    folder = project(tmp_path / "project")
    late = '{second}"if second or given["number"] < 3 else "n/a"'
    (folder / "sim.py").write_text(SIMULATOR.replace('{second}.5+02:00"', late))
    (folder / "input.json").write_text('{"n": 1, "seed": 0, "name": "a", "number": 0}')
    (folder / "sierra.toml").write_text(CONFIG + '[[run_changes]]\nset = "/number"\nvalue = "{run}"\n')
    for runs in ("3", "4"):
        done, _ = run(folder, "n=1", "--runs", runs)
        assert done["failed"] == 0
    assert type_of(folder) == "VARCHAR"
    assert sql(folder, "SELECT count(*) AS n FROM out WHERE stamp = 'n/a'") == [{"n": 1}]
