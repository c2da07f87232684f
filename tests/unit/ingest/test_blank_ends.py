"""Blank lines at the end of a CSV with one column are no rows; other blank lines in it are rows without a value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sierra.ingest import csv
from tests.projects import make, quick
from tests.readings import read_file, read_files

SIMULATOR = """\
import sys
n = int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])
open("out.csv", "w").write(f"v\\n{n}\\n\\n{n + 1}\\n\\n")
"""


@pytest.mark.parametrize(
    ("content", "keys", "values"),
    [
        (b"v\n1\n2\n\n", {}, [1, 2]),
        (b"v\n1\n2\n\n\n\n", {}, [1, 2]),
        (b"v\r\n1\r\n2\r\n\r\n", {}, [1, 2]),
        (b"v\n1\n\n2\n\n", {}, [1, None, 2]),
        (b"v\n1\n2\n", {}, [1, 2]),
        (b"v\n\n", {}, []),
        (b'v\n"a\n\nb"\n""\n\n', {}, ["a\n\nb", None]),
        (b"1\n2\n\n", {"header": False, "columns": ("v",)}, [1, 2]),
        (b"# c\nv\n1\nNA\n\n", {"comment": "#", "na": ("NA",)}, [1, None]),
        (b"v\n1,5\n\n", {"decimal": ",", "delimiter": ";"}, [1.5]),
    ],
)
def test_blank_lines_at_the_end_are_no_rows(tmp_path: Path, content: bytes, keys: dict[str, Any], values: list[Any]) -> None:
    reading, rows = read_file(tmp_path, "t.csv", content, **keys)
    assert not reading.faults
    assert [row["v"] for row in rows] == values
    assert list(reading.counted.values()) == [len(values)]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_many_blank_lines_within_a_file_are_read_at_once(tmp_path: Path, end: str) -> None:
    _, rows = read_file(tmp_path, "t.csv", ("v" + end * 30_000 + "1" + end).encode())  # in squared time, this takes a minute
    assert len(rows) == 30_000


def test_files_with_and_without_a_blank_end_are_read_alike(tmp_path: Path) -> None:
    reading, rows = read_files(tmp_path, [tmp_path / "0" / "t.csv", tmp_path / "1" / "t.csv"], [b"v\n1\n2\n\n", b"v\n1\n2\n"])
    assert [row["v"] for row in rows] == [1, 2, 1, 2]
    assert set(reading.rows.values()) == {2}


def test_fault_before_a_blank_end_is_reported_with_the_name_of_the_file(tmp_path: Path) -> None:
    reading, _ = read_file(tmp_path, "t.csv", b"v\n1\n2,3\n\n")
    assert reading.faults == {"e0": "t.csv: line 3: too many fields (2, not 1): '2,3'"}


@pytest.mark.integration
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=12)
@given(st.lists(st.sampled_from(["1", "", '""', "x"]), max_size=5), st.booleans())
def test_last_row_has_a_value_or_quotes(tmp_path: Path, cells: list[str], ended: bool) -> None:
    reading, rows = read_file(tmp_path, "t.csv", ("v\n" + "\n".join(cells) + "\n" * ended).encode())
    while cells and not cells[-1]:
        cells.pop()
    assert not reading.faults
    assert len(rows) == len(cells)


@pytest.mark.integration
def test_final_value_is_the_last_one_and_recorded_tables_are_continued_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    assert quick(folder, "run", "population_size=4", "--no-figures").returncode == 0
    final = ("stats", "out", "v", "--statistic", "mean", "--format", "csv")
    assert quick(folder, *final).stdout.splitlines()[1].split(",")[6] == "5.0"
    assert quick(folder, "run", "population_size=4", "--no-figures", "--runs", "3").returncode == 0
    with monkeypatch.context() as patch:
        patch.setattr(csv.Csv, "_is_single_column", lambda *_: False)  # as an earlier version recorded them
        assert quick(folder, "run", "population_size=6", "--no-figures").returncode == 0
    assert quick(folder, "run", "population_size=6", "--no-figures", "--runs", "5").returncode == 0
    counts = "SELECT DISTINCT population_size AS p, count(*) AS n FROM out GROUP BY run, p ORDER BY ALL"
    assert quick(folder, "sql", counts, "--format", "csv").stdout.split() == ["p,n", "4,3", "6,4"]
