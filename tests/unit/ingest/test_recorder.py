"""Outputs of runs are recorded exactly, or faults are reported; tested mostly through the public interface."""

from __future__ import annotations

import io
import json
import math
import textwrap
from collections.abc import Callable, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import sierra
from sierra.api import Project
from sierra.errors import QueryError
from sierra.execution.summary import Summary
from sierra.ingest.model import Reading, Shape, Written
from sierra.ingest.read import read
from sierra.ingest.recorder import Recorder
from sierra.store import equal_runs
from sierra.store.batch_data import BatchData
from sierra.worker.outputs import describe
from tests import projects, samples
from tests.tiers import at_night

TOML = """
template = "t.xml"
command = "{python} -I -S sim.py {input}"
seed = "//e/@seed"
runs = 4
[variables]
n = "//e/@n"
k = "//e/@k"
"""
SIM = """
import os, pathlib, re, sys, time
text = pathlib.Path(sys.argv[1]).read_text()
seed, n, k = (int(re.search(rf' {name}="(\\d+)"', text)[1]) for name in ("seed", "n", "k"))
def write(content, name="out.csv"):
    pathlib.Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())
good = "tick,v\\n0,0.5\\n1,1.5\\n2,2.5\\n"
"""

Make = Callable[..., Project]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Make a project whose simulator is these lines of Python, which can use `seed`, `n`, `k`, `good` and `write`."""

    def make(lines: str, toml: str = "") -> Project:
        return written(tmp_path, lines, toml)

    return make


def written(folder: Path, lines: str, toml: str = "") -> Project:
    (folder / "sierra.toml").write_text(TOML + toml)
    (folder / "t.xml").write_text('<e seed="0" n="0" k="0"/>')
    (folder / "sim.py").write_text(SIM + textwrap.dedent(lines))
    return sierra.open(folder)


def run(project: Project, query: str = "n=1", **options: Any) -> Summary:
    return project.run(query, figures=False, **options)


def column(project: Project, name: str = "v", table: str = "out") -> list[Any]:
    rows: list[Any] = project.sql(f'SELECT "{name}" FROM {table} ORDER BY number').column(0).to_pylist()
    return rows


def reasons(project: Project) -> list[str]:
    """Return the distinct reasons for which runs failed."""
    rows: list[Any] = (
        project.sql("SELECT DISTINCT reason FROM executions WHERE status <> 'ok' ORDER BY 1").column(0).to_pylist()
    )
    return rows


def failed(project: Project) -> list[int]:
    """Return the numbers of the failed runs."""
    rows = project.sql("SELECT DISTINCT number FROM batch_runs JOIN executions USING (run) WHERE status <> 'ok' ORDER BY 1")
    numbers: list[int] = rows.column(0).to_pylist()
    return numbers


# ---------------------------------------------------------------- valid outputs


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_delimiters_and_line_ends_are_detected(tmp_path: Path, delimiter: str, end: str) -> None:
    content = f'a{delimiter}b{end}1{delimiter}"x{delimiter}""y""{end}z"{end}'
    _, rows = table(tmp_path, [content.encode()] * 3)
    assert rows == [(1, f'x{delimiter}"y"{end}z')] * 3


def test_quoted_delimiters_in_a_header_are_ignored_in_detection(tmp_path: Path) -> None:
    _, rows = table(tmp_path, [b'"a;b;c",d\n1,2\n'], names=True)
    assert rows == [("a;b;c", "d"), (1, 2)]


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("\ufeffa\n1\n", [1]),
        ("a, b\n 1 , 2\n", [1]),
        ("a\n1e3\n-2.5E-1\n", [1000.0, -0.25]),
        ("a\ninf\n-inf\n", [math.inf, -math.inf]),
        ("a,b\n,1\n2,1\n", [None, 2]),
        ("a\n1\n\n3\n", [1, None, 3]),
        ("a\ntrue\nFalse\n", [True, False]),
        ("a\ntrue\n1\n", ["true", "1"]),
        ("a\n1\nx y\n", ["1", "x y"]),
        ("a\n-0\n", [-0.0]),
        ("a\n9223372036854775807\n", [2**63 - 1]),
        ("a\n9223372036854775808\n1\n", [Decimal(2**63), Decimal(1)]),
        ("a\n", []),
        ("a\r1\r2\r", [1, 2]),
        ("a,,\n1,2,3\n", [1]),
        ("a\n12_34\n", ["12_34"]),
        ("a\n0.5\n12_34\n", ["0.5", "12_34"]),
        ("a\n1e400\n", ["1e400"]),
        ("a\n1e-400\n", [0.0]),
        ("a\n-nan\n1\n", [math.nan, 1.0]),
        ("a\n0x10\n", ["0x10"]),
        ("a\n2020-01-01\n", ["2020-01-01"]),
    ],
)
def test_columns_get_the_narrowest_type_that_keeps_their_values(tmp_path: Path, text: str, values: list[Any]) -> None:
    reading, rows = table(tmp_path, [text.encode()])
    assert not reading.faults
    assert [repr(row[0]) for row in rows] == [repr(value) for value in values]


@pytest.mark.integration
def test_fractions_in_one_run_among_whole_numbers_are_not_rounded(make: Make) -> None:
    project = make("write('v\\n1\\n' if seed % 5 else 'v\\n1.5\\n')\nwrite(f'{seed}', 'seed.txt')")
    run(project, runs=20)
    seeds = project.sql("SELECT seed, v FROM out JOIN runs USING (run)").to_pylist()
    assert len(seeds) == 20
    assert {row["v"] for row in seeds} == {1.0, 1.5}
    assert all(row["v"] == (1.0 if row["seed"] % 5 else 1.5) for row in seeds)


def test_number_in_one_run_stays_a_number_among_flags_of_other_runs(tmp_path: Path) -> None:
    files = [b"a\ntrue\n", *[b"a\nfalse\n"] * 3, b"a\n1\n", *[b"a\ntrue\n"] * 4]
    reading, _ = table(tmp_path, files)
    assert {key[0]: kinds["a"] for key, kinds in reading.columns.items()} == {
        f"e{number}": "number" if number == 4 else "flag" for number in range(9)
    }
    assert {path.name for path in tmp_path.glob("target*")} == {"target.parquet", "target~1001.parquet"}


def test_large_whole_numbers_stay_exact_among_files_with_empty_columns(tmp_path: Path) -> None:
    empty = b"a,b\n,1\n"
    _, rows = table(tmp_path, [empty, empty, empty, b"a,b\n1152921504606846977,1\n", empty, empty, empty])
    assert {row[0] for row in rows} == {None, 2**60 + 1}


def test_line_of_three_megabytes_is_read(tmp_path: Path) -> None:
    reading, rows = table(tmp_path, [b"a\n" + b"x" * 3_000_000 + b"\n", b"a\ny\n"])
    assert not reading.faults
    assert sorted(len(row[0]) for row in rows) == [1, 3_000_000]


@pytest.mark.integration
def test_column_names_that_are_difficult_in_sql_are_kept_or_made_unique(make: Make) -> None:
    header = 'run,Run,"a ""b""",größe,select,N,,filename,experiment,place'
    project = make(f"write({header!r} + chr(10) + ','.join(map(str, range(10))) + chr(10))")
    summary = run(project, runs=1)
    assert not summary.failed
    [row] = project.sql("SELECT * FROM out").to_pylist()
    known = ("run_lower", "Run_upper_1", 'a "b"', "größe", "select", "N_", "column6", "filename_", "experiment", "place")
    assert [row[name] for name in known] == list(range(10))
    assert row["n"] == 1
    with BatchData(project.store, summary.batch) as frame:
        for place, name in enumerate(known):
            frame.samples("out", name.replace("N_", "N"))
            assert frame.sql("SELECT experiment, t, value FROM samples").to_pylist() == [
                {"experiment": 0, "t": 0.0, "value": float(place)}
            ]


@pytest.mark.integration
def test_undeclared_outputs_get_valid_sql_table_names(make: Make) -> None:
    names = ["a-b", "1st", "Runs", "select", "x y", "ü"]
    project = make(f"for name in {names!r}: write(good, name + '.csv')")
    assert not run(project).failed
    assert set(project.store.outputs()) == {"a_b", "_1st", "Runs_", "select", "x_y", "ü"}
    for name in project.store.outputs():
        assert project.sql(f'SELECT count(*) FROM "{name}"').column(0).to_pylist() == [12]


@pytest.mark.integration
def test_outputs_are_recorded_as_they_are_declared(make: Make) -> None:
    first, other = seeds(2)
    toml = """
[outputs.poses]
file = "p/*.csv"
[outputs.more]
file = "more.csv"
required = false
[outputs.ragged]
file = "ragged.csv"
mismatch = "ragged"
"""
    lines = f"""
    os.mkdir("p")
    for i in range(3): write(f"x\\n{{i}}\\n", f"p/{{i}}.csv")
    if seed == {first}: write(good, "more.csv")
    write(good if seed != {other} else good + "3,3.5\\n", "ragged.csv")
    write(bytes(range(256)), "a.bin")
    write("hello", "notes.txt")
    """
    project = make(lines, toml)
    assert not run(project, runs=2).failed
    rows = project.sql("SELECT number, file, x FROM poses ORDER BY number, x").to_pylist()
    assert rows == [{"number": n, "file": f"p/{i}.csv", "x": i} for n in range(2) for i in range(3)]
    assert project.sql("SELECT DISTINCT number FROM more").to_pylist() == [{"number": 0}]
    assert project.sql("SELECT number, count(*) AS n FROM ragged GROUP BY 1 ORDER BY 1").to_pylist() == [
        {"number": 0, "n": 3},
        {"number": 1, "n": 4},
    ]
    files = project.sql("SELECT DISTINCT path, sha256 FROM artifacts WHERE kind = 'file'").to_pylist()
    contents = {row["path"]: project.store.object(row["sha256"]) for row in files}
    assert contents == {"a.bin": bytes(range(256)), "notes.txt": b"hello"}


@pytest.mark.integration
def test_rows_of_large_csv_files_keep_their_order_across_runs(make: Make) -> None:
    project = make("write('i\\n' + ''.join(f'{i * 7919 % 100003}\\n' for i in range(100003)))")
    summary = run(project, runs=3, jobs=2)
    with BatchData(project.store, summary.batch) as frame:
        frame.samples("out", "i")
        for number in range(3):
            found = frame.sql("SELECT value FROM samples WHERE number = $n ORDER BY t", n=number).column(0).to_pylist()
            assert found == [i * 7919 % 100003 for i in range(100003)]


@pytest.mark.integration
def test_rows_of_large_json_files_keep_their_order(tmp_path: Path) -> None:
    lines = b"".join(b'{"i":%d,"s":"%s"}\n' % (i, b"x" * 900) for i in range(40_000))
    _, rows = table(tmp_path, [lines, b'{"i":1,"s":"a"}\n'], "jsonl", columns="i", only="e0")
    assert [row[0] for row in rows] == list(range(40_000))


# ---------------------------------------------------------------- round trips


FLOATS = st.floats() | st.sampled_from([5e-324, -0.0, 1e308, 2.2250738585072014e-308, 0.1])
INTS = st.integers(-(2**63), 2**63 - 1)
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\r\0"), min_size=1)
COLUMNS = st.one_of(st.lists(each, min_size=1, max_size=6) for each in (FLOATS, INTS, st.integers(-(10**37), 10**37), TEXTS))


@pytest.mark.integration
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=COLUMNS)
def test_csv_values_are_read_back_exactly(tmp_path: Path, values: list[Any]) -> None:
    quoted = [f'"{v}"'.replace('"', '""')[1:-1] if isinstance(v, str) else repr(v) for v in values]
    reading, rows = table(tmp_path, [("k,a\n" + "".join(f"k,{text}\n" for text in quoted)).encode()])
    assert not reading.faults
    found = [row[1] for row in rows]
    if all(isinstance(value, str) for value in values) and not all(isinstance(value, str) for value in found):
        found = [None if value is None else values[place] for place, value in enumerate(found)]  # texts that look like numbers
    assert [repr(v) if isinstance(v, float) else v for v in found] == [repr(v) if isinstance(v, float) else v for v in values]


@pytest.mark.integration
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=COLUMNS)
def test_json_values_are_read_back_exactly(tmp_path: Path, values: list[Any]) -> None:
    content = "".join(json.dumps({"a": value}) + "\n" for value in values)
    reading, rows = table(tmp_path, [content.encode()], "jsonl")
    assert not reading.faults
    assert [repr(row[0]) if isinstance(row[0], float) else row[0] for row in rows] == [
        repr(value) if isinstance(value, float) else value for value in values
    ]


# ---------------------------------------------------------------- faults


FAULTS = {
    "too few fields": ("write(good.replace('1,1.5', '1'))", "line 3: too few fields (1, not 2): '1'"),
    "cut short in a line": ("write(good[:-5])", "line 4: the last line is truncated"),
    "a last line without its end": ("write(good[:-2])", "line 4: the last line is truncated"),
    "fewer rows": ("write(good[:-6])", "has 2 rows, but 3 of the 3 other runs of its experiment have 3"),
    "more rows": ("write(good + '3,3.5\\n')", "has 4 rows, but 3 of the 3 other runs of its experiment have 3"),
    "a missing column": (
        "write('tick\\n0\\n1\\n2\\n')",
        "table 'out' lacks the column 'v' (other runs have tick, v) (to allow this, set ",
    ),
    "a further column": ("write(good.replace('\\n', ',w\\n', 1).replace('5\\n', '5,1\\n'))", "has the additional column 'w'"),
    "another order": ("write('v,tick\\n0,0\\n0,1\\n0,2\\n')", "has its columns in another order"),
    "text among numbers": ("write(good.replace('1.5', 'oops'))", "line 3: text in the numeric column 'v': 'oops'"),
    "the header again": ("write(good.replace('1,1.5', 'tick,v'))", "line 3: the header is repeated: 'tick,v'"),
    "a doubled header": ("write(good.replace('v', 'v,v', 1))", "line 1: the column 'v' occurs twice"),
    "too many fields": ("write(good.replace('1.5', '1.5,9'))", "line 3: too many fields (3, not 2)"),
    "no bytes": ("write('')", "is empty and has no header"),
    "a header only": ("write('tick,v\\n')", "has 0 rows, but 3 of the 3 other runs of its experiment have 3"),
    "no UTF-8": ("write(good.encode().replace(b'1.5', b'\\xff'))", "line 3: is not UTF-8"),
    "an open quote": ("write(good.replace('2.5', '\"2.5'))", "line 4: quotes are not closed"),
    "mixed line ends": ("write(good.replace('\\n', '\\r\\n', 2))", "some lines end in CR LF, and some in LF"),
    "no table": ("pass", "table 'out' is missing, but 3 of the 3 other runs of its experiment have it"),
    "one table more": (
        "write(good); write(good, 'more.csv')",
        "there is a table 'more', but 3 of the 3 other runs of its experiment have none",
    ),
}


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> tuple[Project, Summary]:
    """A batch with an experiment for each of FAULTS: n is its position, and run number 2 has the fault."""
    cases = "".join(
        f"{'elif' if place else 'if'} n == {place} and seed == {seeds(4)[2]}:\n    {lines}\n"
        for place, (lines, _) in enumerate(FAULTS.values())
    )
    project = written(tmp_path_factory.mktemp("faulty"), f"{cases}else:\n    write(good)")
    return project, run(project, f"n={','.join(map(str, range(len(FAULTS))))}")


@pytest.mark.integration
def test_one_faulty_run_of_each_experiment_fails(faulty: tuple[Project, Summary]) -> None:
    _, summary = faulty
    assert (summary.failed, summary.missing) == (len(FAULTS), 0)


@pytest.mark.parametrize("fault", FAULTS)
def test_one_faulty_run_is_detected_and_its_fault_is_reported(faulty: tuple[Project, Summary], fault: str) -> None:
    project, _ = faulty
    place = list(FAULTS).index(fault)
    [failure] = project.sql(
        "SELECT number, status, reason FROM executions JOIN batch_runs USING (run) WHERE status <> 'ok' AND ordinal = $place",
        place=place,
    ).to_pylist()
    assert (failure["status"], failure["number"]) == ("mismatch", 2)
    assert FAULTS[fault][1] in failure["reason"]
    assert project.sql(f"SELECT count(DISTINCT number), count(*) FROM out WHERE n = {place}").to_pylist() == [
        {"count(DISTINCT number)": 3, "count_star()": 9}
    ]


def seeds(count: int) -> list[int]:
    from sierra.design.seeds import seed

    return [seed(0, number) for number in range(count)]


@pytest.mark.integration
@pytest.mark.parametrize("bad", [(0,), (0, 1), pytest.param((3,), marks=pytest.mark.nightly)])
@pytest.mark.parametrize("fault", ["text among numbers", "a missing column", "fewer rows", "a last line without its end"])
def test_only_the_faulty_runs_fail_at_any_position(make: Make, bad: tuple[int, ...], fault: str) -> None:
    chosen = [seeds(4)[number] for number in bad]
    project = make(f"if seed in {chosen}:\n    {FAULTS[fault][0]}\nelse:\n    write(good)")
    assert run(project).failed == len(bad)
    assert failed(project) == list(bad)


@pytest.mark.integration
@pytest.mark.parametrize("fault", ["text among numbers", *at_night(["a missing column", "a last line without its end"])])
def test_faulty_run_that_was_recorded_first_is_detected_by_later_runs(make: Make, fault: str) -> None:
    lines = f"if seed == {seeds(1)[0]}:\n    {FAULTS[fault][0]}\nelse:\n    write(good)"
    project = make(lines)
    assert not run(project, runs=1).failed
    summary = run(project, runs=5)
    assert summary.failed == 1
    assert failed(project) == [0]
    assert project.sql("SELECT count(*) AS n FROM out").to_pylist() == [{"n": 12}]


def test_faults_in_a_later_flush_are_detected(tmp_path: Path) -> None:
    good = b"a,b\n1,0.5\n"
    first, _ = table(tmp_path, [good] * 5)
    for bad in (b"a,b\n1,0.", b"a,b\n1\n"):
        reading, rows = table(tmp_path, [bad], shape=first.shape)
        assert len(reading.faults) == 1, bad
        assert rows == []
    reading, rows = table(tmp_path, [b"a,b\n1.5,2\n"], shape=first.shape)
    assert not reading.faults
    assert rows == [(1.5, 2)]


@pytest.mark.integration
def test_several_faults_in_one_batch_are_reported_separately_with_exit_code_1(make: Make) -> None:
    bad = seeds(10)
    project = make(
        f"""
        if seed == {bad[1]}: write(good[:-5])
        elif seed == {bad[4]}: write(good.replace('0.5', 'x'))
        elif seed == {bad[7]}: write('tick\\n0\\n')
        else: write(good)
        """
    )
    done = projects.quick(project.root, "run", "n=1", "--runs", "10", "--no-figures", "--json")
    assert done.returncode == 1, done.stderr
    failures = json.loads(done.stdout)["failures"]
    assert {failure["status"] for failure in failures} == {"mismatch"}
    assert any("out.csv: line 4" in failure["reason"] for failure in failures)
    assert failed(project) == [1, 4, 7]
    assert len(reasons(project)) == 3
    assert project.sql("SELECT count(*) AS n FROM out").to_pylist() == [{"n": 21}]


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (b'{"a":1,"b":', "line 1: is truncated or not JSON"),
        (b"[1]\n", "line 1: is not an object"),
        (b'{"a":1,"b":"x"}\n{"a":1,"a":2,"b":"x"}\n', "line 2: the key 'a' occurs twice"),
    ],
)
def test_faulty_json_lines_are_detected(tmp_path: Path, bad: bytes, said: str) -> None:
    good = b'{"a":1,"b":"x"}\n'
    reading, rows = table(tmp_path, [good, bad, good, good], "jsonl")
    assert list(reading.faults) == ["e1"]
    assert said in reading.faults["e1"]
    assert rows == [(1, "x")] * 3


def test_json_fractions_in_one_run_of_many_are_not_rounded(tmp_path: Path) -> None:
    _, rows = table(tmp_path, [b'{"a":1}\n'] * 40 + [b'{"a":1.5}\n'] + [b'{"a":1}\n'] * 9, "jsonl")
    assert sorted(row[0] for row in rows) == [1.0] * 49 + [1.5]


@pytest.mark.parametrize("bad", [b"", b"PAR1 not really", b"cut"])
def test_faulty_parquet_files_are_detected(tmp_path: Path, bad: bytes) -> None:
    good = parquet(tmp_path, {"a": [1, 2], "b": ["x", "y"]})
    reading, rows = table(tmp_path, [good, good[: len(good) // 2] if bad == b"cut" else bad, good], "parquet")
    assert list(reading.faults) == ["e1"]
    assert rows == [(1, "x"), (2, "y")] * 2


def test_first_line_with_text_among_json_numbers_is_noted(tmp_path: Path) -> None:
    good, bad = b'{"a":1,"b":"x"}\n', b'{"a":1,"b":"x"}\n{"a":"q","b":"x"}\n'
    reading, _ = table(tmp_path, [good, bad, good, good], "jsonl")
    assert reading.hints == {("e1", "out.jsonl"): {"a": "out.jsonl: line 2: text in the numeric column 'a': 'q'"}}


def test_decimals_with_more_than_38_digits_are_a_fault(tmp_path: Path) -> None:
    wide, good = (pa.array([Decimal("1.5")], pa.decimal256(60, 20)), pa.array([Decimal("1.5")], pa.decimal128(38, 20)))
    reading, rows = table(tmp_path, [parquet(tmp_path, {"v": column}) for column in (good, wide, good)], "parquet")
    assert list(reading.faults) == ["e1"]
    assert reading.faults["e1"].endswith("the column 'v' has decimals of more than 38 digits, which is the maximum of a table")
    assert len(rows) == 2


def test_parquet_files_of_different_types_are_joined_as_text_with_their_kinds_noted(tmp_path: Path) -> None:
    files = [{"a": [1]}, {"a": [1.5]}, {"a": ["x"]}, {"a": [2]}]
    reading, rows = table(tmp_path, [parquet(tmp_path, file) for file in files], "parquet")
    assert [kinds["a"] for kinds in reading.columns.values()] == ["number", "number", "number", "text"]
    assert rows == [("1.0",), ("1.5",), ("x",), ("2.0",)]


def test_parquet_values_are_read_back_exactly(tmp_path: Path) -> None:
    values = {"i": [2**63 - 1], "u": pa.array([2**64 - 1], pa.uint64()), "f": [5e-324], "t": ["ü\n\"'"], "l": [[1, 2]]}
    _, rows = table(tmp_path, [parquet(tmp_path, values)] * 2, "parquet")
    assert rows == [(2**63 - 1, 2**64 - 1, 5e-324, "ü\n\"'", [1, 2])] * 2


@pytest.mark.nightly
def test_batches_with_different_column_types_are_queried_together(make: Make) -> None:
    project = make("write({1: 'v\\n1\\n', 2: 'v\\n0.1\\n', 3: 'v\\nx\\n', 4: 'v,w\\n,1\\n,1\\n'}[n])")
    for n, kind in ((1, "BIGINT"), (2, "DOUBLE"), (4, "DOUBLE"), (3, "DOUBLE")):
        assert not run(project, f"n={n}", runs=2).failed
        assert project.sql("DESCRIBE SELECT v FROM out").to_pylist()[0]["column_type"] == kind
    found = project.sql("SELECT n, v, v_text FROM out GROUP BY ALL ORDER BY n").to_pylist()
    assert [tuple(row.values()) for row in found] == [(1, 1.0, None), (2, 0.1, None), (3, None, "x"), (4, None, None)]


# ---------------------------------------------------------------- helpers


def parquet(folder: Path, columns: dict[str, Any]) -> bytes:
    pq.write_table(pa.table(columns), folder / "made.parquet")
    return (folder / "made.parquet").read_bytes()


def table(
    folder: Path,
    contents: Sequence[bytes],
    kind: Any = "csv",
    *,
    shape: Shape | None = None,
    columns: str = "* EXCLUDE (run, execution)",
    only: str = "%",
    names: bool = False,
) -> tuple[Reading, list[tuple[Any, ...]]]:
    """Read files as recording does; return the reading and the rows by run."""
    target = folder / "target.parquet"
    files = []
    for number, content in enumerate(contents):
        path = folder / f"{number}.{kind}"
        path.write_bytes(content)
        seen = describe(str(path), f"out.{kind}")
        facts = (seen["path"], seen["head"], seen["lines"], seen["ended"], seen["bytes"])
        files.append(Written(str(path), f"r{number}", f"e{number}", *facts))
    for old in folder.glob("target*.parquet"):
        old.unlink()
    connection = samples.database(2)
    reading = read(connection, files, shape or Shape(kind), target)
    if not any(folder.glob("target*.parquet")):
        return reading, []
    source = f"read_parquet('{folder}/target*.parquet', file_row_number = true, union_by_name = true)"
    found = connection.execute(
        f"SELECT {columns} FROM {source} WHERE execution LIKE $only ORDER BY run, file_row_number".replace(
            "* EXCLUDE (run", "* EXCLUDE (file_row_number, run"
        ),
        {"only": only},
    )
    rows = found.fetchall()
    head = [tuple(name for name, *_ in found.description or ())] if names else []
    return reading, [*head, *rows]


COLUMNS_BY_N = """
names = ["tick", "v", *(f"x{robot}" for robot in range(n))]
write("".join(",".join(row) + "\\n" for row in [names, *([str(t)] * len(names) for t in range(3))]))
"""


def as_parquet(names: Sequence[str]) -> bytes:
    file = io.BytesIO()
    pq.write_table(pa.table({name: [0, 1, 2] for name in names}), file)
    return file.getvalue()


BY_N = {
    "csv": COLUMNS_BY_N,
    "jsonl": """
import json
names = ["tick", "v", *(f"x{robot}" for robot in range(n))]
write("".join(json.dumps({name: t for name in names}) + "\\n" for t in range(3)), "out.jsonl")
""",
    "parquet": """
write(FILES[len(range(n))], "out.parquet")
""".replace("FILES", repr({n: as_parquet(["tick", "v", *(f"x{robot}" for robot in range(n))]) for n in (1, 2, 3)})),
}
"""A simulator whose columns depend on `n`, in each format."""


@pytest.mark.integration
@pytest.mark.parametrize("kind", BY_N)
def test_columns_may_differ_between_experiments(make: Make, noted: Callable[[], list[str]], kind: str) -> None:
    project = make(BY_N[kind])
    summary = run(project, "n=1,2,3", runs=2)
    assert (summary.failed, summary.missing, noted()) == (0, 0, [])
    rows = project.sql(
        "SELECT n, count(*) AS rows, count(x0) AS x0, count(x2) AS x2 FROM out GROUP BY ALL ORDER BY n"
    ).to_pylist()
    assert rows == [{"n": n, "rows": 6, "x0": 6, "x2": 6 * (n == 3)} for n in (1, 2, 3)]


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["csv", *at_night(set(BY_N) - {"csv"})])
def test_runs_with_other_columns_than_their_siblings_fail(make: Make, kind: str) -> None:
    project = make(BY_N[kind].replace("range(n)", f"range(1 + (seed == {seeds(2)[1]}))"))
    assert run(project, "n=1,2").failed == 2
    assert failed(project) == [1]
    [reason] = reasons(project)
    assert "has the additional column 'x1' (other runs have " in reason
    assert f'(to allow this, set file = "out.{kind}", mismatch = "ragged" in [outputs.out])' in reason


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["csv", *at_night(set(BY_N) - {"csv"})])
def test_columns_may_differ_between_sibling_runs_with_mismatch_ragged(make: Make, kind: str) -> None:
    toml = f'[outputs.out]\nfile = "out.{kind}"\nmismatch = "ragged"\n'
    project = make(BY_N[kind].replace("range(n)", f"range(1 + (seed == {seeds(2)[1]}))"), toml)
    assert run(project).failed == 0
    assert project.sql("SELECT count(x0) AS x0, count(x1) AS x1 FROM out").to_pylist() == [{"x0": 12, "x1": 3}]


@pytest.mark.nightly
def test_run_with_odd_columns_fails_even_if_recorded_first(make: Make) -> None:
    project = make(f"write(good if seed != {seeds(1)[0]} else 'tick,v,w\\n0,1,2\\n1,1,2\\n2,1,2\\n')")
    assert run(project, runs=1).failed == 0
    run(project, runs=3)
    assert failed(project) == [0]


@pytest.mark.integration
@pytest.mark.parametrize(("other", "apart"), [("bad", False), ("true", True), *at_night([("bad", True), ("true", False)])])
def test_column_of_another_kind_in_one_experiment_is_noted_without_failing_runs(
    make: Make, noted: Callable[[], list[str]], monkeypatch: pytest.MonkeyPatch, other: str, apart: bool
) -> None:
    project = make(f"write('tick,v\\n0,%s\\n' % ({other!r} if n == 3 else 0.5))")
    run(project, "n=3", runs=1)
    monkeypatch.setattr(Recorder, "due", lambda self: apart and bool(self._pending))
    summary = run(project, "n=1,2,3", runs=3, jobs=1)
    assert (summary.failed, summary.missing) == (0, 0)
    kind = "text in 3" if other == "bad" else "flags in 3"
    [told] = [note for note in noted() if "column 'v'" in note]
    assert "column 'v' of output 'out' has " in told
    assert kind in told
    assert "numbers in 6" in told
    assert column(project, "n").count(3) == 3


TEXTS_LIKE_NUMBERS = "write('t,sha\\n0,%s\\n' % ({} if seed in {} else '3ab'))"


@pytest.mark.integration
@pytest.mark.parametrize(
    ("text", "apart"),
    [("1e5", True), ("007", False), ("true", True), *at_night([("1e5", False), ("007", True), ("true", False)])],
)
def test_texts_that_look_like_numbers_stay_the_same_in_any_recording_order(
    make: Make, monkeypatch: pytest.MonkeyPatch, text: str, apart: bool
) -> None:
    project = make(TEXTS_LIKE_NUMBERS.format(repr(text), seeds(2)))
    monkeypatch.setattr(Recorder, "due", lambda self: apart and bool(self._pending))
    again = run(project, runs=8, jobs=1).failed
    assert 0 <= again <= 2 * apart
    assert all("run the query again to read it like them" in reason for reason in reasons(project))
    assert column(project, "sha") == [*[text] * (2 - again), *["3ab"] * 6]
    assert run(project, runs=8, jobs=1).failed == 0
    assert column(project, "sha") == [text, text, *["3ab"] * 6]


@pytest.mark.nightly
def test_texts_first_read_as_numbers_are_restored_in_every_batch_after_reexecution(make: Make) -> None:
    project = make(TEXTS_LIKE_NUMBERS.format("'1e5'", seeds(2)))
    assert run(project, runs=2).failed == 0
    assert run(project, runs=8).failed == 2
    for runs in (2, 8, 2, 8):
        assert run(project, runs=runs).failed == 0
        assert column(project, "sha")[:2] == ["1e5"] * 2


@pytest.mark.integration
@pytest.mark.parametrize("bad", [0, 3, *at_night([1])])
def test_text_among_numbers_is_detected_wherever_recordings_are_split(
    make: Make, monkeypatch: pytest.MonkeyPatch, bad: int
) -> None:
    project = make(f"write(good.replace('1.5', 'oops' if seed == {seeds(4)[bad]} else '1.5'))")
    monkeypatch.setattr(Recorder, "due", lambda self: bool(self._pending))
    assert run(project, jobs=1).failed == 1
    assert failed(project) == [bad]
    if bad == 3:
        assert project.sql("SELECT avg(v) AS v FROM out").to_pylist() == [{"v": 1.5}]


LOOKS_NUMERIC = "column 'v' of output 'out' is text in 2 runs, so it has no figure: most of its values look like numbers; "
ONE_COLUMN = "column {!r} of output 'out' is text in 2 runs, so it has no figure: "


TEXTS: list[tuple[str, str | None]] = [
    ("t;v\n0;1,5\n1;2,5\n", ONE_COLUMN.format("v") + "its numbers have a decimal comma ([outputs.out] "),
    (
        "t,v\n0,1.5\n1,2.5\n2,NA\n",
        LOOKS_NUMERIC + "leave cells without a number empty instead of writing 'NA' (2 such cells)",
    ),
    (
        "t,v\n0,1e5 m\n1,2e5 m\n",
        LOOKS_NUMERIC + """write '1e5 m' without 'm' ([outputs.out] units = { "v" = "m" } declares the unit), """
        "or convert it, for example: [tables.out",
    ),
    (
        "t,v\n0,50%\n1,7.5%\n",
        LOOKS_NUMERIC + """write '50%' without '%' ([outputs.out] units = { "v" = "%" } declares the unit), """
        "or convert it, for example: [tables.out",
    ),
    ("t;v\n0;1'234.5\n1;2'000\n", LOOKS_NUMERIC + """write "1'234.5" without separators between digits"""),
    ("t;v\n0;1_234.5\n1;2_000\n", LOOKS_NUMERIC + "write '1_234.5' without separators between digits"),
    (
        "t,v\n0,1.5\n1,n/a\n2,NA\n3,NA\n4,-\n",
        LOOKS_NUMERIC + "leave cells without a number empty instead of writing '-' (8 such cells)",
    ),
    ("t,v\n0,ab\n1,NA\n2,NA\n", None),
    ("t,my speed\n0,-\n1,2\n2,3\n", LOOKS_NUMERIC.replace("'v'", "'my speed'") + "leave cells without a number"),
    ("t v\n0 1.5\n", ONE_COLUMN.format("t v") + 'are these several columns? (set delimiter = " " in [outputs.out])'),
    (
        "# t v\n0 1.5\n",
        ONE_COLUMN.format("# t v") + 'are these several columns? (set delimiter = "blanks" in [outputs.out])',
    ),
    (
        "# a\nt\n0\n1\n2\n",
        ONE_COLUMN.format("a") + "the first line is a comment; begin with the column names, without '#' ([outputs.out] file",
    ),
    (
        "t,v\n0,true\n1,1\n2,1\n",
        LOOKS_NUMERIC + "it has 'true' beside numbers; write the same words everywhere, or only 0 and 1",
    ),
    (
        "t,v\n0,1.5ms\n1,800us\n",
        LOOKS_NUMERIC + "some have the unit 'ms' or 'us'; write all in the same unit, or convert them to 's', for example: "
        """[tables.out""",
    ),
    ("t,v\n0,1.5ms\n1,8m\n2,7m\n", LOOKS_NUMERIC + "some have the unit 'm' or 'ms'; write all in the same unit, without"),
    (
        "t,v\n0,1.5\n1,8m\n2,7m\n",
        LOOKS_NUMERIC + "some have the unit 'm' and some have none; write all in the same unit, without its name",
    ),
    ("t,v\n0,tensor(3.5)\n1,tensor(4.5)\n", LOOKS_NUMERIC + "write the number alone instead of 'tensor(3.5)'"),
    ("t,v\n0,np.float64(3.5)\n1,[4.5]\n", LOOKS_NUMERIC + "write the number alone instead of '[4.5]'"),
    ("t;v\n0;1,5\n1;tensor(4.5)\n2;x\n", LOOKS_NUMERIC + "it has '1,5' and 'tensor(4.5)' and 'x'; write all of them as"),
    (
        "t,v\n0,1.5\n1,n/a\n2,NA\n3,4\n4,5\n",
        LOOKS_NUMERIC
        + 'leave cells without a number empty instead of writing \'NA\' (4 such cells), or set na = ["NA", "n/a"] in',
    ),
    (
        "v\n(m)\n0\n1\n",
        LOOKS_NUMERIC.partition("most")[0] + "units are below its names ([outputs.out] file",
    ),
    ("t;v\n0;1,5\n1;2.5\n2;3\n", LOOKS_NUMERIC + "it has '1,5' and '2.5'; write all of them as plain numbers"),
    ("t;v\n0;1,234\n1;2.5\n2;3\n", LOOKS_NUMERIC + "it has '1,234' and '2.5'; write all of them as plain numbers"),
    ("t,v\n0,1_0\n1,2\n2,3\n", LOOKS_NUMERIC + "write '1_0' as a plain number, or leave the cell empty (2 such cells)"),
    ("t,v\n0,1.#INFO\n1,2\n2,3\n", LOOKS_NUMERIC + "write '1.#INFO' as a plain number, or leave the cell empty"),
    (
        "t,v\n0, 3B\n1, 2MiB\n",
        LOOKS_NUMERIC + "some have the unit 'B' or 'MiB'; write all in the same unit, or convert them to 'B', for example: "
        """[tables.out""",
    ),
    ("t,v\n0,ab\n", None),
    ("t,v\n0,3ab\n1,4cd\n2,77f\n", None),
    ("t,v\n0,2020-01-01\n", None),
    ("t,v\n0,12:30:05\n", None),
    ("word\nthe\nword\n", None),
]
"""Tables, and the beginning of the note on each."""
HALF = (len(TEXTS) + 1) // 2


@pytest.mark.integration
def test_probably_unintended_text_columns_are_noted_once_with_a_suggestion(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The runs of two batches write all `TEXTS`, as out0.csv, out1.csv and so on."""
    notes = []
    for first in (0, HALF):  # a run has at most 20 tables that are not declared
        content = [content for content, _ in TEXTS[first : first + HALF]]
        lines = f"for place, content in enumerate({content!r}, {first}):\n    write(content, f'out{{place}}.csv')"
        with pytest.MonkeyPatch.context() as patch:
            noted = all_notes(patch)
            assert not run(written(tmp_path_factory.mktemp("texts"), lines), runs=2).failed
            notes += noted()
    found = {}
    for place, (_, said) in enumerate(TEXTS):
        of_place = [note for note in notes if f"output 'out{place}'" in note]
        names = ((f"output 'out{place}'", "output 'out'"), (f"[outputs.out{place}]", "[outputs.out]"))
        found[place] = [note.replace(*names[0]).replace(*names[1])[: len(said or "")] for note in of_place]
    assert found == {place: [said] * (said is not None) for place, (_, said) in enumerate(TEXTS)}
    proposals = [json.loads(note.partition(" sql = ")[2]) for note in notes if "[tables." in note]
    converted: list[tuple[list[str], list[float]]] = [
        (["1.5ms", "+8e2 us"], [0.0015, 0.0008]),
        (["1e5 m"], [100_000]),
        (["50%", " 37.5 % "], [50, 37.5]),
        ([" 3B", "2MiB "], [3, 2_097_152]),
    ]
    for sql, (cells, values) in zip(proposals, converted, strict=True):
        name = sql.rpartition(" ")[2]
        table = f"(SELECT 1 AS run, 0 AS t, unnest({cells}) AS v)"
        assert [row[2] for row in duckdb.sql(sql.replace(f"FROM {name}", f"FROM {table}")).fetchall()] == pytest.approx(values)


@pytest.mark.integration
def test_cells_with_units_are_converted_exactly_by_the_proposal(make: Make, noted: Callable[[], list[str]]) -> None:
    project = make("write('t,size,took\\n0, 3GiB,1.5ms \\n1,7 MiB , 800us\\n2,5B,2ns\\n')")
    assert not run(project, runs=1).failed
    proposed = [json.loads(note.split("sql = ")[1]) for note in noted() if "convert them to" in note]
    found = [[tuple(row.values())[1:] for row in project.sql(f"{sql} ORDER BY run, t").to_pylist()] for sql in proposed]
    sizes, times = [(0, 3 * 2**30), (1, 7 * 2**20), (2, 5)], [(0, 0.0015), (1, 0.0008), (2, 2e-9)]
    assert found[0] == sizes * (len(found[0]) // 3)
    assert [row[1] for row in found[1]] == pytest.approx([took for _, took in times] * (len(found[1]) // 3), rel=1e-12)


@pytest.mark.integration
def test_comments_and_wrong_delimiters_are_noted_with_what_is_right(make: Make, noted: Callable[[], list[str]]) -> None:
    lines = "write('# a, b\\nt,v\\n0,1\\n1,2\\n', 'commented.csv')\nwrite('t,v\\n0,1\\n1,2\\n')\n"
    lines += "write('setting,value\\nlength,3\\nt,v\\n0,1\\n1,2\\n', 'preamble.csv')"
    project = make(lines, '[outputs.out]\nfile = "out.csv"\ndelimiter = ";"\n')
    assert not run(project, runs=2).failed
    comment = "is text in 2 runs, so it has no figure: the first line is a comment; begin with "
    delimiter = ONE_COLUMN.format("t,v") + 'are these several columns? (set delimiter = "," in [outputs.out])'
    preamble = 'its names are not in its first line ([outputs.preamble] file = "preamble.csv", skip = 2 reads it)'
    assert sum(note.endswith(preamble) for note in noted()) == 2
    assert [comment in note for note in noted() if note != delimiter and preamble not in note] == [True, True]
    assert delimiter in noted()


APPENDED = "did the run append to the file? write the header once, before all rows"
FAULTS_OF_ALL_RUNS = (
    ("tick,v\n0,0.5\n1,1.5\ntick,v\n0,0.5\n", f"line 4: the header is repeated: 'tick,v' ({APPENDED})"),
    ("name,kind\na,b\nname,kind\nc,d\n", f"line 3: the header is repeated: 'name,kind' ({APPENDED})"),
    ("\ufeffv,w\r\n1,2\r\n\ufeffv,w\r\n3,4\r\n", f"line 3: the header is repeated: 'v,w' ({APPENDED})"),
    ("v\n1\n2\nv\n3\n", f"line 4: the header is repeated: 'v' ({APPENDED})"),
    ("tick,v\n0,0.5\n tick, v \n0,0.5\n", f"line 3: the header is repeated: 'tick,v' ({APPENDED})"),
    ('tick,v\n0,0.5\n"tick","v"\n0,0.5\n', f"line 3: the header is repeated: 'tick,v' ({APPENDED})"),
    ("# made by sim\nt,v\n0,1\n", "line 1: is a comment, but the column names must be here: '# made by sim'"),
    ("t,v\n# warm-up\n0,1\n", "line 2: too few fields (1, not 2): '# warm-up' (if such lines are comments, set comment"),
    ("# t,v\n0,1\n1\n", "line 3: too few fields (1, not 2): '1'"),
    ("# made by sim\n# version 3\nt,v\n0,1\n", "line 1: is a comment, but the column names must be here: '# made by"),
    ("tic", "line 1: the last line is truncated (it does not end with a line feed)"),
)
"""Contents of a file, and how the reason for the failure begins."""


@pytest.mark.integration
def test_faults_that_all_runs_have_fail_each_of_them(make: Make) -> None:
    project = make(f"write({[content for content, _ in FAULTS_OF_ALL_RUNS]!r}[n])")
    count = len(FAULTS_OF_ALL_RUNS)
    assert run(project, f"n={','.join(map(str, range(count)))}", runs=2).failed == 2 * count
    rows = project.sql("SELECT DISTINCT n, reason FROM executions JOIN points USING (run) ORDER BY n").to_pylist()
    assert [row["n"] for row in rows] == list(range(count))
    for row, (content, said) in zip(rows, FAULTS_OF_ALL_RUNS, strict=True):
        assert row["reason"].startswith(f"out.csv: {said}"), content


@pytest.mark.nightly
def test_repeated_header_is_found_where_lines_end_in_cr(make: Make) -> None:
    project = make("write('tick,v\\r0,0.5\\rtick,v\\r1,0.5\\r')")
    assert run(project, runs=3).failed == 3
    assert reasons(project) == [f"out.csv: line 3: the header is repeated: 'tick,v' ({APPENDED})"]


@pytest.mark.nightly
def test_empty_column_in_one_experiment_fits_any_type_in_others(make: Make) -> None:
    project = make("write('tick,v,x%d\\n0,%s,1\\n' % (n, '' if n == 3 else 0.5))")
    for n in (3, 1, 2):
        run(project, f"n={n}")
    assert run(project, "n=1,2,3").failed == 0
    assert project.sql("SELECT n, avg(v) AS v FROM out GROUP BY 1 ORDER BY 1").to_pylist() == [
        {"n": 1, "v": 0.5},
        {"n": 2, "v": 0.5},
        {"n": 3, "v": None},
    ]


@pytest.mark.nightly
def test_ragged_columns_accumulate_over_several_sessions(make: Make) -> None:
    project = make(COLUMNS_BY_N, '[outputs.out]\nfile = "out.csv"\nmismatch = "ragged"\n')
    for n in (3, 1, 2):
        assert project.run(f"n={n}", figures=False).failed == 0
    rows = project.sql("SELECT n, count(x0) AS x0, count(x1) AS x1, count(x2) AS x2 FROM out GROUP BY ALL ORDER BY n")
    assert [tuple(row.values()) for row in rows.to_pylist()] == [(1, 12, 0, 0), (2, 12, 12, 0), (3, 12, 12, 12)]


def test_unnamed_columns_are_all_kept(tmp_path: Path) -> None:
    _, rows = table(tmp_path, [b"a,,\n1,2,3\n"], names=True)
    assert rows == [("a", "column1", "column2"), (1, 2, 3)]


@pytest.mark.parametrize("odd", [b"12_34", b"1e400"])
def test_invalid_number_among_numbers_of_many_runs_is_noted_and_kept_as_text(tmp_path: Path, odd: bytes) -> None:
    files = [b"a,b\n0.5,x_y\n"] * 20 + [b"a,b\n" + odd + b",x_y\n"] + [b"a,b\n1.5,x_y\n"] * 20
    reading, rows = table(tmp_path, files)
    assert reading.hints == {("e20", "out.csv"): {"a": f"out.csv: line 2: text in the numeric column 'a': {odd.decode()!r}"}}
    assert sorted(row[0] for row in rows) == sorted([*["0.5"] * 20, odd.decode(), *["1.5"] * 20])


@pytest.mark.parametrize("content", [b"\x1f\x8b\x08\0a\n1\n", "a,b\n1,2\n".encode("utf-16"), b"gr\xf6\xdfe\n1\n", b"\0\0\n"])
def test_header_that_is_not_utf_8_is_detected(tmp_path: Path, content: bytes) -> None:
    reading, _ = table(tmp_path, [content])
    assert "line 1: is not UTF-8 text" in reading.faults["e0"]


@pytest.mark.parametrize("content", [b"\na,b\n1,2\n", b",,\n1,2,3\n", b'"a,b\n1,2\n'])
def test_header_without_names_is_detected(tmp_path: Path, content: bytes) -> None:
    reading, rows = table(tmp_path, [content])
    assert reading.faults["e0"].startswith("out.csv: line 1: ")
    assert rows == []


def test_delimiter_is_detected_for_each_set_of_columns(tmp_path: Path) -> None:
    reading, rows = table(tmp_path, [b"a\n1\n", b"a;b\n1;2\n", b"a;b;c\n1;2;3\n"], columns="a")
    assert not reading.faults
    assert rows == [(1,)] * 3


@pytest.mark.integration
def test_two_thousand_columns_are_read(tmp_path: Path) -> None:
    content = (",".join(f"c{place}" for place in range(2000)) + "\n" + ",".join(["0.5"] * 2000) + "\n").encode()
    reading, rows = table(tmp_path, [content] * 2)
    assert not reading.faults
    assert rows == [(0.5,) * 2000] * 2


def test_faults_contain_no_path_of_the_machine(tmp_path: Path) -> None:
    reading, _ = table(tmp_path, [b"PAR1"], "parquet")
    assert str(tmp_path) not in reading.faults["e0"]


# ---------------------------------------------------------------- allowed, but probably unintended


@pytest.fixture
def noted(monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """Return a function that returns the final notes of the recorders of a session."""
    return all_notes(monkeypatch)


def all_notes(patch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """Return a function for the notes of all recorders; that on equal runs is left out, as these programs use no seed."""
    recorders: list[Recorder] = []
    made = Recorder.__init__

    def make(self: Recorder, *arguments: Any, **options: Any) -> None:
        made(self, *arguments, **options)
        recorders.append(self)

    patch.setattr(Recorder, "__init__", make)
    return lambda: [note for recorder in recorders for note in recorder.notes() if note != equal_runs.NOTE]


@pytest.mark.integration
def test_tables_that_are_kept_as_files_are_noted(make: Make, noted: Callable[[], list[str]]) -> None:
    toml = '[outputs.declared]\nfile = "d/*.csv"\n'
    lines = "for folder in ('d', 'logs'): os.mkdir(folder); write(good, folder + '/1.csv'); write(good, folder + '/2.csv')"
    run(make(lines + "\nwrite(good, 'x-y.csv'); write(good, 'x_y.csv'); write(good, 'x_y.tsv'); write('', 'a.txt')", toml))
    assert [note for note in noted() if "seeds" not in note] == [
        "'x_y.csv' makes the table 'x_y_2', because the table 'x_y' is that of 'x-y'",
        "'logs/1.csv' and 1 other are kept as files: undeclared and in a subfolder "
        '([outputs.NAME] file = "logs/*.csv" makes a table of them)',
        "'x_y.tsv' is kept as a file: undeclared, and another file already makes the table of that name "
        '([outputs.NAME] file = "x_y.tsv" makes it a table)',
    ]


@pytest.mark.nightly
def test_too_many_undeclared_tables_are_kept_as_files_and_noted(make: Make, noted: Callable[[], list[str]]) -> None:
    run(make("for i in range(21): write(good, f'{i:02}.csv')"))
    assert noted() == [
        "'00.csv' and 20 others are kept as files: undeclared, and more than 20 in a run "
        '([outputs.NAME] file = "*.csv" makes a table of them)'
    ]


@pytest.mark.integration
@pytest.mark.parametrize(("value", "said"), [("n", False), ("float(n)", False), ("7", True)])
def test_column_hidden_by_a_variable_is_noted_if_its_values_differ(
    make: Make, noted: Callable[[], list[str]], value: str, said: bool
) -> None:
    project = make(f"write(f'tick,N\\n0,{{{value}}}\\n')")
    run(project, "n=1,2")
    told = "column 'N' of output 'out' is named 'N_' in SQL, because 'n' is the independent variable, which has other values"
    assert noted() == [told] * said
    assert len(column(project, "N_")) == 8


@pytest.mark.integration
def test_columns_that_only_one_run_has_are_noted(make: Make, noted: Callable[[], list[str]]) -> None:
    project = make("write(good if n != 2 else 'tick,w\\n0,1\\n1,1\\n2,1\\n')")
    assert run(project, "n=1,2,3", runs=1).failed == 0
    assert noted() == [
        "output 'out': one run has columns that no other run has; no other run of the experiment can confirm them"
    ]


@pytest.mark.parametrize("query", ["n=9007199254740993,0.5", "n=0.5,-9007199254740993", "n=0:9007199254740993:3"])
def test_whole_numbers_beyond_float_precision_are_not_mixed_with_decimals(make: Make, query: str) -> None:
    with pytest.raises(QueryError, match=r"9007199254740993 is beyond 2\*\*53"):
        run(make("write(good)"), query)


@pytest.mark.integration
def test_links_pipes_and_odd_names_among_outputs_are_harmless(make: Make) -> None:
    project = make("write(good); os.symlink('out.csv', 'link.csv'); os.mkfifo('pipe.csv'); write(good, 'new\\nline.csv')")
    summary = run(project)
    assert summary.failed == 0
    assert project.store.outputs() == ["new_line", "out"]
    assert "'link.csv' and 1 other are not recorded: only files are recorded, and links are not followed" in summary.notes


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["csv", "jsonl", "parquet"])
def test_rows_of_a_large_file_keep_their_order_with_several_threads(tmp_path: Path, kind: str) -> None:
    path, count = tmp_path / f"big.{kind}", 250_000
    pads = [f"{number * 7919 % 1_000_003:06}" * 8 for number in range(count)]
    match kind:
        case "csv":
            path.write_text("tick,pad\n" + "".join(f"{number},x{pad}\n" for number, pad in enumerate(pads)))
        case "jsonl":
            path.write_text("".join(f'{{"tick": {number}, "pad": "x{pad}"}}\n' for number, pad in enumerate(pads)))
        case _:
            pq.write_table(pa.table({"tick": range(count), "pad": pads}), path, row_group_size=2000)
    data = path.read_bytes()
    file = Written(str(path), "run", "execution", path.name, "tick,pad", data.count(b"\n"), True, len(data))
    connection = duckdb.connect(config={"threads": 4})
    reading = read(connection, [file], Shape(kind), tmp_path / "table.parquet")
    assert (dict(reading.faults), list(reading.rows.values())) == ({}, [count])
    assert pq.read_table(tmp_path / "table.parquet", columns=["tick"])["tick"].to_pylist() == list(range(count))


EVENTS = "write('tick,v\\n' + '0,1\\n' * (seed % 7))"


@pytest.mark.integration
@pytest.mark.parametrize(
    ("lines", "toml", "told"),
    [
        (EVENTS, "", 'if these are events, set file = "out.csv", mismatch = "ragged" in [outputs.out]'),
        (EVENTS, '[outputs.out]\nfile = "out.csv"\n', 'if these are events, set mismatch = "ragged" in [outputs.out]'),
        (EVENTS, '[outputs.out]\nfile = "out.csv"\nmismatch = "ragged"\n', None),
        ("write(good if seed % 2 else good + '3,3.5\\n')", "", None),
        ("write(good)", "", None),
    ],
)
def test_ragged_is_proposed_for_tables_of_events(
    make: Make, noted: Callable[[], list[str]], lines: str, toml: str, told: str | None
) -> None:
    assert len({seed % 7 for seed in seeds(6)}) > 3
    run(make(lines, toml), runs=6)
    assert [note for note in noted() if "events" in note] == [
        note for note in noted() if told is not None and note.startswith("output 'out' has ") and note.endswith(told)
    ]
    assert any("events" in note for note in noted()) == (told is not None)


@pytest.mark.integration
def test_file_whose_format_must_be_named_is_kept_with_a_note(make: Make, noted: Callable[[], list[str]]) -> None:
    project = make("write('[{\"v\": 1}]', 'out.json')", '[outputs.out]\nfile = "out.json"\n')
    assert not run(project, runs=2).failed
    assert noted() == [
        "'out.json' is kept as a file: declared without a format "
        '([outputs.out] format = "json" makes a table, and format = "file" keeps the file)'
    ]
    (project.root / "sierra.toml").write_text(TOML + '[outputs.out]\nfile = "out.json"\nformat = "json"\n')
    again = run(sierra.open(project.root), runs=2)
    assert (again.executed, again.failed) == (0, 0)
    assert column(sierra.open(project.root)) == [1, 1]
