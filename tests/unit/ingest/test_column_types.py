"""Values of every type of Parquet and Arrow are recorded exactly, in one unit, or their run fails."""

from __future__ import annotations

import datetime
import io
import itertools
import json
import sys
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.ingest.model import Written
from sierra.ingest.read import read
from sierra.model import OutputFile
from sierra.store.connections import connect
from sierra.store.union_files import relation
from sierra.worker.outputs import describe
from tests import projects, samples
from tests.readings import read_file, shape_of

SPAN, INSTANT = datetime.timedelta(seconds=2), datetime.datetime(2020, 2, 20, 17, 16, 35, tzinfo=datetime.UTC)
MOMENT, CLOCK = INSTANT.replace(tzinfo=None), datetime.time(1, 2, 3)
FINE = 1577836800000000001

Table = Mapping[str, tuple[pa.Array, str, str]]
"""Arrays of one value by their types, each with the type and the text that SQL shows."""
DURATIONS: Table = {
    **{f"duration {unit}": (pa.array([SPAN], pa.duration(unit)), "BIGINT", "2000000000") for unit in ("s", "ms", "us", "ns")},
    "dictionary of durations": (pa.array([SPAN], pa.duration("ms")).dictionary_encode(), "BIGINT", "2000000000"),
}
TIMES: Table = {
    **{f"timestamp {u}": (pa.array([MOMENT], pa.timestamp(u)), "TIMESTAMP", str(MOMENT)) for u in ("s", "ms", "us")},
    "timestamp ns": (pa.array([FINE], pa.timestamp("ns")), "TIMESTAMP_NS", "2020-01-01 00:00:00.000000001"),
    **{
        f"timestamp {unit} {zone}": (pa.array([INSTANT], pa.timestamp(unit, zone)), "TIMESTAMP WITH TIME ZONE", f"{MOMENT}+00")
        for unit in ("s", "ms", "us")
        for zone in ("UTC", "Europe/Berlin")
    },
    "timestamp ns UTC": (pa.array([FINE], pa.timestamp("ns", "UTC")), "TIMESTAMPTZ_NS", "2020-01-01 00:00:00.000000001+00"),
    "date32": (pa.array([MOMENT.date()], pa.date32()), "DATE", "2020-02-20"),
    "date64": (pa.array([MOMENT.date()], pa.date64()), "DATE", "2020-02-20"),
    "timestamp of the year 3000": (
        pa.array([MOMENT.replace(year=3000)], pa.timestamp("us")),
        "TIMESTAMP",
        "3000-02-20 17:16:35",
    ),
}
CLOCKS: Table = {
    **{f"time {unit}": (pa.array([CLOCK], pa.time32(unit)), "TIME", "01:02:03") for unit in ("s", "ms")},
    "time us": (pa.array([CLOCK], pa.time64("us")), "TIME", "01:02:03"),
    "time ns": (pa.array([1_000_000_001], pa.time64("ns")), "TIME_NS", "00:00:01.000000001"),
}
NUMBERS: Table = {
    **{
        str(kind): (pa.array([2], kind), name, "2")
        for kind, name in (
            (pa.int8(), "TINYINT"),
            (pa.int16(), "SMALLINT"),
            (pa.int32(), "INTEGER"),
            (pa.int64(), "BIGINT"),
            (pa.uint8(), "UTINYINT"),
            (pa.uint16(), "USMALLINT"),
            (pa.uint32(), "UINTEGER"),
        )
    },
    "uint64": (pa.array([2**64 - 1], pa.uint64()), "UBIGINT", str(2**64 - 1)),
    "dictionary of numbers": (pa.array([2]).dictionary_encode(), "BIGINT", "2"),
    "float16": (pa.array([2.5], pa.float16()), "FLOAT", "2.5"),
    "float32": (pa.array([2.5], pa.float32()), "FLOAT", "2.5"),
    "float64": (pa.array([0.1]), "DOUBLE", "0.1"),
    "decimal of scale 1": (pa.array([Decimal("2.5")], pa.decimal128(5, 1)), "DECIMAL(5,1)", "2.5"),
    "decimal of scale 3": (pa.array([Decimal("2.5")], pa.decimal128(7, 3)), "DECIMAL(7,3)", "2.500"),
    "decimal256": (pa.array([Decimal("2.5")], pa.decimal256(20, 3)), "DECIMAL(20,3)", "2.500"),
}
OTHERS: Table = {
    **{str(kind): (pa.array(["ab"], kind), "VARCHAR", "ab") for kind in (pa.string(), pa.large_string(), pa.string_view())},
    "dictionary of texts": (pa.array(["ab"]).dictionary_encode(), "VARCHAR", "ab"),
    **{
        str(kind): (pa.array([b"ab"], kind), "BLOB", "ab")
        for kind in (pa.binary(), pa.large_binary(), pa.binary(2), pa.binary_view())
    },
    "bool": (pa.array([True]), "BOOLEAN", "true"),
    **{
        str(kind): (pa.array([[1, 2]], kind), "BIGINT[]", "[1, 2]")
        for kind in (pa.list_(pa.int64()), pa.large_list(pa.int64()), pa.list_(pa.int64(), 2), pa.list_view(pa.int64()))
    },
    "list of timestamps": (pa.array([[MOMENT]], pa.list_(pa.timestamp("ms"))), "TIMESTAMP[]", f"['{MOMENT}']"),
    "struct": (pa.array([{"a": 1}]), "STRUCT(a BIGINT)", "{'a': 1}"),
}
ALL: Table = {**DURATIONS, **TIMES, **CLOCKS, **NUMBERS, **OTHERS}


def parquet(array: pa.Array) -> bytes:
    file = io.BytesIO()
    pq.write_table(pa.table({"v": array}), file)
    return file.getvalue()


def together(folder: Path, *arrays: pa.Array) -> tuple[list[str], str, list[Any]]:
    """Record each array as the file of one run; return the kinds of their values, and the type and the texts in SQL."""
    files = []
    for place, array in enumerate(arrays):
        path = folder / f"{place}.parquet"
        path.write_bytes(parquet(array))
        seen = OutputFile(**describe(str(path), "t.parquet"))
        facts = (seen.head, seen.lines, seen.ended, seen.bytes, seen.quotes, seen.blank, seen.alike)
        files.append(Written(str(path), f"r{place}", f"e{place}", "t.parquet", *facts))
    target = folder / "target" / "table.parquet"
    target.parent.mkdir()
    reading = read(samples.database(2), files, shape_of(folder / "t.parquet", {}), target)
    assert not reading.faults
    connection = connect()
    connection.execute("SET TimeZone = 'Asia/Tokyo'")
    found = relation(lambda text: connection.execute(text).fetchall(), sorted(map(str, target.parent.iterdir())))
    connection.execute("SET TimeZone = 'UTC'")
    rows = connection.execute(f"SELECT typeof(v), v::VARCHAR FROM {found.sql} ORDER BY run").fetchall()
    return [kinds["v"] for kinds in reading.columns.values()], rows[0][0], [row[1] for row in rows]


@pytest.mark.nightly
def test_each_type_is_recorded_exactly(tmp_path: Path) -> None:
    for place, (name, (array, kind, text)) in enumerate(ALL.items()):
        folder = tmp_path / str(place)
        folder.mkdir()
        _, shown, texts = together(folder, array)
        assert (name, shown, texts) == (name, kind, [text])


def test_durations_of_all_units_are_nanoseconds(tmp_path: Path) -> None:
    kinds, shown, texts = together(tmp_path, *(array for array, _, _ in DURATIONS.values()))
    assert (set(kinds), shown, set(texts)) == ({"duration"}, "BIGINT", {"2000000000"})


@pytest.mark.nightly
def test_types_of_two_runs_give_equal_values_or_differ_in_kind(tmp_path: Path) -> None:
    families = [{kind: (name, one) for name, one in family.items() for kind in one[1:2]} for family in (TIMES, NUMBERS, OTHERS)]
    alike = [pair for family in (DURATIONS, TIMES, CLOCKS) for pair in itertools.pairwise(family.items())]
    unlike = [pair for family in families for pair in itertools.combinations(family.values(), 2)]
    pairs = [*alike, *unlike]
    for place, ((first, (one, *_, text)), (second, (other, *_, expected))) in enumerate(pairs):
        folder = tmp_path / str(place)
        folder.mkdir()
        kinds, shown, texts = together(folder, one, other)
        if kinds[0] == kinds[1] and shown == "DOUBLE":
            text, expected = (str(float(value)) for value in (text, expected))
        if kinds[0] == kinds[1] and shown.startswith("DECIMAL"):
            text, expected = (str(Decimal(value)) for value in (text, expected))
        if kinds[0] == kinds[1] or shown == "VARCHAR":
            assert (first, second, texts) == (first, second, [text, expected])
        else:  # the dates beside times are their midnights
            assert shown.startswith("TIMESTAMP") or shown == ""
            assert [value[:19].ljust(19) for value in texts] == [
                (value[:19] if len(value) > 10 else f"{value} 00:00:00") for value in (text, expected)
            ]


@pytest.mark.parametrize(
    ("array", "fault"),
    [
        (pa.array([10**10], pa.duration("s")), "has a duration of more than 292 years, which nanoseconds cannot hold"),
        (pa.array([[SPAN]]), "has durations within lists or structures: write them as numbers, or as a column of durations"),
        (
            pa.array([{"a": SPAN}]),
            "has durations within lists or structures: write them as numbers, or as a column of durations",
        ),
    ],
    ids=["large", "list", "struct"],
)
def test_durations_that_cannot_be_nanoseconds_are_faults(tmp_path: Path, array: pa.Array, fault: str) -> None:
    reading, rows = read_file(tmp_path, "t.parquet", parquet(array))
    assert (list(reading.faults.values()), rows) == ([f"t.parquet: the column 'v' {fault}"], [])


def test_a_column_without_values_has_no_kind(tmp_path: Path) -> None:
    assert together(tmp_path, pa.nulls(1), DURATIONS["duration ms"][0])[0] == ["empty", "duration"]


WRITES = """\
import sys, pyarrow as pa, pyarrow.parquet as pq
n = int(open(sys.argv[1]).read().split('count="')[1].split('"')[0])
d = pa.array([1500 * 1000 ** (n - 1)] * 2, {1: pa.duration("ms"), 2: pa.duration("us"), 3: pa.int64()}[n])
stamps = [1577836800000000001] * 2
pq.write_table(pa.table({"t": [0, 1], "d": d, "stamp": pa.array(stamps, pa.timestamp("ns"))}), "out.parquet")
"""


@pytest.mark.nightly
def test_the_unit_of_durations_is_shown_everywhere(tmp_path: Path) -> None:
    config = projects.CONFIG.replace("python3", sys.executable)
    project = sierra.open(projects.make(tmp_path / "p", config, simulator=WRITES))
    batch = project.run("population_size=1,2", figures=False).batch
    assert project.sql("SELECT DISTINCT d FROM out").column(0).to_pylist() == [1_500_000_000]
    described = projects.quick(project.root, "sql", "DESCRIBE out")
    assert described.stderr == "note: durations of out are in ns: 'd'\n"
    assert "d BIGINT in ns" in " ".join(projects.quick(project.root, "outputs").stdout.split())
    table = projects.quick(project.root, "stats", "out", "d", "--format", "latex", "--statistic", "mean").stdout
    assert "d {[}ns]" in table
    drawn, _ = project.deliverables.draw(batch, formats=["svg"])
    assert any("d [ns]" in file.read_text() for file in drawn if file.suffix == ".svg")
    ended = projects.quick(project.root, "run", "population_size=1,3", "--no-figures")
    note = "column 'd' of output 'out' has durations in 2, numbers in 2 runs; SQL shows all of them as numbers, of which only"
    assert f"note: {note} the durations are in ns" in ended.stderr


@pytest.mark.integration
def test_nanoseconds_and_intervals_are_printed_plainly(tmp_path: Path) -> None:
    config = projects.CONFIG.replace("python3", sys.executable)
    project = sierra.open(projects.make(tmp_path / "p", config, simulator=WRITES))
    project.run("population_size=1", figures=False)
    ask = "SELECT DISTINCT stamp, [stamp] AS l, INTERVAL 14 MONTH + INTERVAL '1.5 s' AS i FROM out"
    moment, interval = "2020-01-01 00:00:00.000000001", "1 year 2 months 00:00:01.5"
    assert project.sql(ask).to_pylist() == [{"stamp": moment, "l": [moment], "i": interval}]
    assert moment in project.sql(ask)._repr_html_()
    printed = {
        form: projects.quick(project.root, "sql", ask, "--format", form) for form in ("table", "csv", "json", "markdown")
    }
    for one in printed.values():
        assert one.returncode == 0
        assert one.stdout.count(moment) == 2
        assert interval in one.stdout
    assert json.loads(printed["json"].stdout)[0]["stamp"] == moment
    assert projects.quick(project.root, "sql", ask, "--format", "parquet", "-o", "made.parquet").returncode == 0
    assert pq.read_table(project.root / "made.parquet").column("stamp").cast(pa.int64()).to_pylist() == [FINE]
    assert pq.read_table(project.root / "made.parquet").column("i").to_pylist() == [interval]
