"""Times that are no numbers are a time axis in seconds since midnight of the day of a run's first row."""

from __future__ import annotations

import sys
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import duckdb
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sierra.store.clock_times import TimeKind, kind_of, seconds
from tests.projects import CONFIG, make, quick

CONNECTION = duckdb.connect(config={"threads": 1})


def read(texts: list[str | None], kind: str = "VARCHAR") -> tuple[TimeKind | None, list[float | None]]:
    """Return the form of times, and their seconds in a single run."""
    connection = CONNECTION
    connection.execute(f"CREATE OR REPLACE TABLE x AS SELECT 1 AS run, unnest($t::VARCHAR[])::{kind} AS t", {"t": texts})
    found = kind_of(lambda text: connection.execute(text).fetchall(), "x", "t", kind)
    if found is None:
        return None, []
    return found, [row[0] for row in connection.execute(f"SELECT {seconds('t', found, 'run')} FROM x").fetchall()]


@pytest.mark.parametrize(
    ("texts", "kind", "expected"),
    [
        (["00:00:10", " 00:01:00.25", None], TimeKind.CLOCK, [10, 60.25, None]),
        (["23:59:59", "1:00:00:00", "12:01:00:00,5"], TimeKind.CLOCK, [86_399, 86_400, 12 * 86_400 + 3600.5]),
        (["2024-05-01T10:00:00+02:00", "2024-05-02T00:00:00.5+02:00"], TimeKind.MOMENT, [36_000, 86_400.5]),
        (["2024-05-01 10:00", "2024-05-01 10:01"], TimeKind.MOMENT, [36_000, 36_060]),
        (["2024-03-31T01:59:59+01:00", "2024-03-31T03:00:00+02:00"], TimeKind.MOMENT, [7_199, 7_200]),
        (["2024-05-01T23:00:00-0530", "2024-05-02T04:31:00Z"], TimeKind.MOMENT, [82_800, 82_860]),
        (["2024-05-01", "2024-05-03"], TimeKind.MOMENT, [0, 172_800]),
        (["2024-05-01T00:00:00.123456789Z", "2024-05-01T00:00:01.000000001Z"], TimeKind.MOMENT, [0.123456789, 1.000000001]),
        (["1969-12-31T23:00:00", "1970-01-01T01:00:00"], TimeKind.MOMENT, [82_800, 90_000]),
        (["00:00:10", "2024-05-01T10:00:00"], None, []),
        (["2024-05-01T10:00:00+02:00", "2024-05-01T10:00:01"], None, []),  # in which zone is the second?
        (["2024-05-01T10:61:00"], None, []),
        (["125:00:00", "126:30:00"], TimeKind.CLOCK, [450_000, 455_400]),
        (["00:00:10:24", "00:00:11:00"], None, []),  # of films: the last number counts frames
        (["00:75:00"], None, []),
        (["-00:00:10", "00:00:00"], None, []),
        (["99999999999999999999:00:00:00"], None, []),
        (["10:00", "11:00"], None, []),
        (["2024-13-01T10:00:00"], None, []),
        ([None], None, []),
    ],
)
def test_texts_are_read_as_seconds(texts: list[str | None], kind: TimeKind | None, expected: list[float]) -> None:
    assert read(texts) == (kind, [None if one is None else pytest.approx(one, abs=1e-9) for one in expected])


@pytest.mark.parametrize("kind", ["TIMESTAMP", "TIMESTAMP_NS", "TIMESTAMP_MS", "DATE"])
def test_times_of_parquet_are_read_as_seconds(kind: str) -> None:
    texts: list[str | None] = ["2024-05-01 10:00:00.250", None, "2024-05-02 00:00:00"]
    assert read(texts, kind)[1] == ([0, None, 86_400] if kind == "DATE" else [36_000.25, None, 86_400])


def test_times_of_parquet_depend_on_no_zone_of_this_machine_and_may_be_far_away() -> None:
    CONNECTION.execute("SET TimeZone = 'America/New_York'")
    try:
        texts: list[str | None] = ["2024-11-03 05:30:00+00", "2024-11-03 06:30:00+00", "infinity"]
        assert read(texts, "TIMESTAMP WITH TIME ZONE")[1] == [19_800, 23_400, None]
    finally:
        CONNECTION.execute("RESET TimeZone")
    assert read(["9999-12-30", "9999-12-31"], "DATE")[1] == [0, 86_400]
    assert read(["2500-01-01 00:00:01", "2500-01-02 00:00:00.5"], "TIMESTAMP")[1] == [1, 86_400.5]
    assert read(["2024-05-01 00:00:00.123456789"], "TIMESTAMP_NS")[1] == [0.123456789]


@pytest.mark.integration
@settings(deadline=None, max_examples=10)
@given(
    st.datetimes(datetime(1900, 1, 2), datetime(2200, 1, 1)),  # noqa: DTZ001 - hypothesis adds the zone
    st.lists(st.integers(0, 10**12), max_size=3),
    st.sampled_from([0, 120, -330]),
)
def test_moments_are_those_of_python(first: datetime, steps: list[int], zone: int) -> None:
    local = first.replace(tzinfo=timezone(timedelta(minutes=zone)))
    moments = [local + timedelta(microseconds=step) for step in (0, *steps)]
    midnight = local.replace(hour=0, minute=0, second=0, microsecond=0)
    expected = [(moment - midnight) / timedelta(seconds=1) for moment in moments]
    assert read([moment.isoformat() for moment in moments])[1] == pytest.approx(expected, abs=2e-6)
    later = [moment.astimezone(UTC).isoformat() for moment in moments[1:]]
    assert read([local.isoformat(), *later])[1] == pytest.approx(expected, abs=2e-6)


SIMULATOR = """\
import sys
n = int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])
seed = int(open(sys.argv[1]).read().split('<random seed="')[1].split('"')[0])
import pyarrow as pa, pyarrow.parquet as pq, datetime
first = datetime.datetime(2024, 5, 1 + seed % 3, 23, 59, 58)
times = [first + datetime.timedelta(seconds=second) for second in range(4)]
open("iso.csv", "w").write("stamp,v\\n" + "".join(f"{at.isoformat()},{n * i}\\n" for i, at in enumerate(times)))
open("clock.csv", "w").write("time,v\\n" + "".join(f"00:00:{10 * i:02d},{n * i}\\n" for i in range(4)))
open("night.csv", "w").write("time,v\\n23:59:58,1\\n23:59:59,2\\n00:00:00,3\\n")
open("words.csv", "w").write("when,v\\n" + "".join(f"step {i},{n * i}\\n" for i in range(4)))
pq.write_table(pa.table({"at": times, "v": range(4)}), "moments.parquet")
"""
OUTPUTS = """
[outputs.iso]
file = "iso.csv"
time = "stamp"
[outputs.words]
file = "words.csv"
time = "when"
[outputs.moments]
file = "moments.parquet"
time = "at"
"""


@pytest.mark.integration
def test_statistics_and_figures_have_seconds_and_say_so(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", CONFIG.replace("python3", sys.executable) + OUTPUTS, simulator=SIMULATOR)
    done = quick(folder, "run", "population_size=1,2")
    assert "Conversion" not in done.stderr
    assert "output 'words': its time 'when' has values such as 'step 0', which are neither numbers nor times" in done.stderr
    for table, time, times in (
        ("iso", "stamp", ["86398.0", "86399.0", "86400.0", "86401.0"]),
        ("clock", "time", ["0.0", "10.0", "20.0", "30.0"]),
        ("moments", "at", ["86398.0", "86399.0", "86400.0", "86401.0"]),
    ):
        said = quick(folder, "stats", table, "v", "--times", "own", "--statistic", "mean", "--format", "csv")
        assert f"the time '{time}' of output '{table}' is read as seconds since midnight" in said.stderr
        lines = [line.split(",") for line in said.stdout.splitlines()]
        assert [line[lines[0].index("t")] for line in lines[1:5]] == times
    [drawing] = folder.glob("figures/*/iso_v_timeseries.svg")
    assert "stamp [s]" in drawing.read_text() or "stamp (s)" in drawing.read_text()
    said = quick(folder, "stats", "night", "v").stderr
    assert "whose time goes back" in said
    assert "if its clock passes midnight, let the run write the day, too: 1:00:00:05, or a date" in said
    assert quick(folder, "stats", "words", "v").stderr.startswith("sierra: output 'words': its time 'when' has values")
