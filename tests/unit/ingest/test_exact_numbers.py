"""Whole numbers that DOUBLE cannot hold keep their digits beside missing values, and beside fractions."""

from __future__ import annotations

import io
from decimal import Decimal
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.config.output_tables import Tolerance
from sierra.replay.compare_values import Rules, Verdict, of_tables
from tests import projects
from tests.readings import read_file, read_files

FIRST, LAST = 1582218195625938945, 1582218195625938999
LARGEST = "98765432109876543210987654321098765432"


@pytest.mark.parametrize("nan", ["nan", "NaN", "-nan", ""])
@pytest.mark.parametrize("great", [FIRST, -FIRST, LARGEST])
def test_nan_is_missing_beside_whole_numbers_that_double_cannot_hold(tmp_path: Path, nan: str, great: int | str) -> None:
    reading, rows = read_file(tmp_path, "t.csv", f"v,w\n{great},1\n{nan},2\n7,3\n".encode())
    assert [row["v"] for row in rows] == [int(great), None, 7]
    assert reading.shape.nans == (("v",) if nan else ())
    assert set(rows[0]) == {"v", "w"}


@pytest.mark.parametrize("other", ["0.5", "inf", "-Infinity", "1e300"])
def test_fractions_beside_them_have_the_texts_of_all_numbers_beside_them(tmp_path: Path, other: str) -> None:
    _, rows = read_file(tmp_path, "t.csv", f"v\n{FIRST}\n{other}\n\nnan\n".encode())
    assert [row["# text of v"] for row in rows] == [str(FIRST), other, None, "nan"]
    assert [repr(row["v"]) for row in rows] == [repr(float(FIRST)), repr(float(other)), "None", "nan"]


def test_numbers_of_more_digits_than_any_whole_type_has_keep_their_texts(tmp_path: Path) -> None:
    great = str(2**128 - 1)
    _, rows = read_file(tmp_path, "t.csv", f"v\n{great}\n1\n".encode())
    assert [row["# text of v"] for row in rows] == [great, "1"]


@pytest.mark.parametrize("great", [f"{2**53 + 1}.0", f"-{2**53 + 1}.", f"+00{FIRST}.000", f"{LARGEST}.0", f"{10**39 + 1}.0"])
def test_whole_numbers_with_a_decimal_point_keep_their_texts(tmp_path: Path, great: str) -> None:
    _, rows = read_file(tmp_path, "t.csv", f"v\n{great}\n7\n".encode())
    assert [(row["v"], row["# text of v"]) for row in rows] == [(float(great), great), (7.0, "7")]


@pytest.mark.parametrize("great", [2**53 + 1, -FIRST, int(LARGEST)])
def test_json_documents_keep_the_digits_of_whole_numbers_with_a_decimal_point(tmp_path: Path, great: int) -> None:
    content = f'[{{"v": {great}.0, "w": {2**53}.0}}, {{"v": 0.5, "w": 7.0}}]'.encode()
    _, rows = read_file(tmp_path, "t.json", content, format="json")
    assert [(row["v"], row["# text of v"]) for row in rows] == [(float(great), str(great)), (0.5, "0.5")]
    assert [repr(row["w"]) for row in rows] == [repr(2.0**53), "7.0"]


@pytest.mark.parametrize("name", ["t.jsonl", "t.json"])
def test_large_numbers_of_json_that_double_holds_have_no_texts(tmp_path: Path, name: str) -> None:
    lines = ('{"v": 1.582218195625939e+18}', '{"v": 0.5}')
    content = "\n".join(lines) if name == "t.jsonl" else f"[{','.join(lines)}]"
    _, rows = read_file(tmp_path, name, content.encode(), format=name[2:])
    assert rows == [{"v": 1.582218195625939e18}, {"v": 0.5}]


@pytest.mark.parametrize(
    "number", [f"{2**53}.0", f"{2**53 + 2}.00", f"0000000{2**53}.0", f"{2**100}.0", "-0000000000000000000.0", "1e20"]
)
def test_whole_numbers_that_double_holds_have_no_texts(tmp_path: Path, number: str) -> None:
    _, rows = read_file(tmp_path, "t.csv", f"v\n{number}\n7\n".encode())
    assert [repr(list(row.values())) for row in rows] == [repr([float(number)]), "[7.0]"]


def test_smaller_whole_numbers_and_nan_are_as_before(tmp_path: Path) -> None:
    _, rows = read_file(tmp_path, "t.csv", f"v,w\n{2**53},100000000000000000000\nnan,0.5\n".encode())
    assert [[repr(value) for value in row.values()] for row in rows] == [[repr(2.0**53), "1e+20"], ["nan", "0.5"]]


@pytest.mark.parametrize(
    ("first", "second", "kinds"),
    [
        ((2**53 + 1, None), ("0.50", (10, 2)), ["decimal128(10, 2)", "int64"]),
        ((2**53 + 1, None), ("0", (38, 0)), ["decimal128(38, 0)"]),
        (("9007199254740993", (20, 0)), ("1", (38, 0)), ["decimal128(20, 0)", "decimal128(38, 0)"]),
        (("9007199254740993.25", (20, 2)), ("0.5", (20, 1)), ["decimal128(20, 1)", "decimal128(20, 2)"]),
        (("9007199254740993.25", (20, 2)), (0.5, None), ["decimal128(20, 2)", "double"]),
        (("2.5", (20, 2)), ("0.5", (20, 1)), ["double"]),
        ((7, None), ("0.50", (10, 2)), ["double"]),
    ],
)
def test_decimals_of_several_types_keep_their_digits_in_parquet(
    tmp_path: Path, first: tuple[Any, Any], second: tuple[Any, Any], kinds: list[str]
) -> None:
    values = [value if digits is None else Decimal(value) for value, digits in (first, second)]
    types = [None if digits is None else pa.decimal128(*digits) for _, digits in (first, second)]
    contents = []
    for value, kind in zip(values, types, strict=True):
        pq.write_table(pa.table({"v": pa.array([value], kind)}), file := io.BytesIO())
        contents.append(file.getvalue())
    _, rows = read_files(tmp_path, [tmp_path / "r0/t.parquet", tmp_path / "r1/t.parquet"], contents)
    assert sorted(row["v"] for row in rows) == sorted(values)
    written = [pq.read_schema(file).field("v").type for file in (tmp_path / "target").iterdir()]
    assert sorted(map(str, written)) == kinds


FILES = f"""\
import json, sys
n = int(open(sys.argv[1]).read().split('count="')[1].split('"')[0])
values = [{FIRST}, {LAST}, [float("nan"), 0.5, None][n - 1]]
texts = ["" if value is None else str(value) for value in values]
open("c.csv", "w").write("t,v\\n" + "".join(f"{{t}},{{v}}\\n" for t, v in enumerate(texts)))
open("l.jsonl", "w").write("".join(json.dumps(dict(t=t, v=v)) + "\\n" for t, v in enumerate(values)))
open("j.json", "w").write(json.dumps([dict(t=t, v=v) for t, v in enumerate(values)]))
open("x.xml", "w").write("<r>" + "".join(f'<e t="{{t}}" v="{{v}}"/>' for t, v in enumerate(texts)) + "</r>")
open("p.csv", "w").write("% made by hand\\n" + open("c.csv").read())
"""
OUTPUTS = """\
[outputs.j]
file = "j.json"
format = "json"
[outputs.x]
file = "x.xml"
format = "xml"
rows = "//e"
[outputs.p]
file = "p.csv"
comment = "%"
"""
EACH = "SELECT population_size AS n, t, v, v_text FROM {} ORDER BY ALL"


@pytest.mark.nightly
def test_every_text_format_keeps_them_also_when_rules_change(tmp_path: Path) -> None:
    config = projects.CONFIG + OUTPUTS
    project = sierra.open(projects.make(tmp_path / "p", config, simulator=FILES))
    summary = project.run("population_size=1,2,3", figures=False)
    assert (summary.runs, summary.failed) == (6, 0)
    tables = {name: project.sql(EACH.format(name)).to_pylist() for name in "cljxp"}
    kept = {1: [str(FIRST), str(LAST), None], 2: [str(FIRST), str(LAST), "0.5"], 3: [str(FIRST), str(LAST), None]}
    assert [row["v_text"] for row in tables["c"]] == [text for texts in kept.values() for text in texts for _ in range(2)]
    assert all(rows == tables["c"] for rows in tables.values())
    assert project.maintenance.fsck().findings == ()
    (project.root / "sierra.toml").write_text(config.replace('file = "j.json"', 'file = "j.json"\nmin_rows = 1'))
    again = sierra.open(project.root)
    assert again.run("population_size=1,2,3", figures=False).executed == 0
    assert {name: again.sql(EACH.format(name)).to_pylist() for name in "cljxp"} == tables
    assert again.maintenance.fsck().findings == ()


@pytest.mark.integration
def test_runs_with_nothing_but_nan_and_small_numbers_leave_the_column_whole(tmp_path: Path) -> None:
    three = f'[{FIRST}, {LAST}, [float("nan"), 0.5, None][n - 1]]'
    writes = FILES.replace(three, f"[[{FIRST}, 2], [float('nan'), 3], [4, 5]][n - 1]")
    assert writes != FILES
    project = sierra.open(projects.make(tmp_path / "p", projects.CONFIG + OUTPUTS, simulator=writes))
    assert project.run("population_size=1,2,3", figures=False).failed == 0
    assert project.sql("DESCRIBE SELECT v FROM c").to_pylist()[0]["column_type"] == "BIGINT"
    assert set(project.sql("SELECT v FROM c").column(0).to_pylist()) == {FIRST, None, 2, 3, 4, 5}
    told = projects.quick(project.root, "sql", "SELECT max(v) FROM c").stderr
    assert told == "note: column 'v' of c has very large whole numbers, and nan in some runs; nan is NULL\n"


@pytest.mark.integration
@pytest.mark.parametrize("other", ["inf", "-inf", "1e20"])
def test_the_first_whole_number_that_double_cannot_hold_keeps_its_digits(tmp_path: Path, other: str) -> None:
    great = 2**53 + 1
    three = f'[{FIRST}, {LAST}, [float("nan"), 0.5, None][n - 1]]'
    writes = FILES.replace(three, f"[[{great}, float('{other}'), 7][n - 1]]")
    assert writes != FILES
    project = sierra.open(projects.make(tmp_path / "p", projects.CONFIG + OUTPUTS, simulator=writes))
    assert project.run("population_size=1,2,3", figures=False).failed == 0
    for name in "cljxp":
        rows = project.sql(EACH.format(name)).to_pylist()[::2]
        assert [row["v"] for row in rows] == [float(great), float(other), 7.0]
        assert [row["v_text"] for row in rows] == [str(great), None, None]
    assert project.maintenance.fsck().findings == ()


@pytest.mark.integration
def test_sql_has_the_texts_of_whole_numbers_with_a_decimal_point(tmp_path: Path) -> None:
    three = f'[{FIRST}, {LAST}, [float("nan"), 0.5, None][n - 1]]'
    writes = FILES.replace(three, f"[0.5, '{2**53 + 1}.0' if n == 3 else 2.0]")
    assert writes != FILES
    project = sierra.open(projects.make(tmp_path / "p", projects.CONFIG + OUTPUTS, simulator=writes))
    assert project.run("population_size=1,2,3,4,5", figures=False).failed == 0
    for name in "cxp":
        rows = project.sql(f"SELECT v, v_text FROM {name} WHERE t = 1 ORDER BY v DESC LIMIT 3").to_pylist()
        assert [tuple(row.values()) for row in rows] == [(2.0**53, f"{2**53 + 1}.0")] * 2 + [(2.0, None)]
    told = projects.quick(project.root, "sql", "SELECT max(v) FROM c").stderr
    assert "the exact digits are in 'v_text'" in told
    assert project.maintenance.fsck().findings == ()


def test_a_replay_compares_the_texts_unless_the_numbers_may_differ() -> None:
    recorded, found = (
        pa.table({"v": [float(number), 0.5], "# text of v": [str(number), "0.5"]}) for number in (FIRST, FIRST + 1)
    )
    assert of_tables(recorded, found).verdict is Verdict.DIFFERENT
    assert of_tables(recorded, recorded).verdict is Verdict.EQUAL
    assert of_tables(recorded, found, Rules(volatile=("v",))).verdict is Verdict.EQUAL
    assert of_tables(recorded, found, Rules(tolerance={"v": Tolerance(abs=1e3)})).verdict is Verdict.EQUAL
