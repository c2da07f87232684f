"""Text tables are read as programs write them; what is not understood is an error with its line."""

from __future__ import annotations

import dataclasses
import gzip
import tomllib
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sierra.config import project_file
from sierra.errors import ConfigError
from sierra.ingest import csv
from sierra.store.table_layout import TableLayout
from tests import projects
from tests.readings import read_file

TWO = [{"t": 1, "v": 0.5}, {"t": 2, "v": 1.5}]
PADDED = [{"id": "r0", "v": 1}, {"id": "a b", "v": None}]
GOOD: list[tuple[str, bytes, dict[str, Any], list[dict[str, Any]]]] = [
    ("comments", b"# made by x\n\nt,v\n1,0.5\n  # between\n2,1.5\n# end", {"comment": "#"}, TWO),
    ("comments in quotes are text", b'# x\nt,v\n1,"a\n# b"\n', {"comment": "#"}, [{"t": 1, "v": "a\n# b"}]),
    ("quotes in comments have no meaning", b'# 5" wide\nt,v\n1,0.5\n# "\n2,1.5\n', {"comment": "#"}, TWO),
    ("a comment of several characters", b"// x\nt,v\n1,0.5\n2,1.5\n", {"comment": "//"}, TWO),
    ("lines that are skipped", b"Report\n,,,,\nt,v\n1,0.5\n2,1.5\n", {"skip": 2}, TWO),
    ("a row of units", b"t,v\ns,m/s\n1,0.5\n2,1.5\n", {"units_row": True}, TWO),
    ("several header lines", b"pose,pose,t\nx,y,\n1,2,3\n", {"header_lines": 2}, [{"pose.x": 1, "pose.y": 2, "t": 3}]),
    ("decimal commas", b"t;v\n1;0,5\n2;1,5\n", {"decimal": ","}, TWO),
    ("decimal commas without header", b"1;0,5\n2;1,5\n", {"decimal": ",", "header": False, "columns": ("t", "v")}, TWO),
    ("decimal commas in quotes", b't,v\n1,"0,5"\n2,"1,5"\n', {"decimal": ","}, TWO),
    ("texts for missing values", b"t,v\n1,NA\n-,1.5\n", {"na": ("NA", "-")}, [{"t": 1, "v": None}, {"t": None, "v": 1.5}]),
    ("semicolons", b"t;v\n1;0.5\n2;1.5\n", {}, TWO),
    ("tabs", b"t\tv\n1\t0.5\n2\t1.5\n", {"comment": "#"}, TWO),
    ("blanks between bars", b"# c\n id  | v \n r0  | 1 \n a b | \n", {"comment": "#"}, PADDED),
    ("blanks and other values between bars", b"id|v\n r0 |1\na b | - \n", {"na": ("-",)}, PADDED),
    ("blanks in quotes between bars", b'id|v\n"r0 " |1\n"a b"|   \n', {}, PADDED),
    ("blanks between other delimiters", b"id;v\n r0 ;1\n", {}, [{"id": " r0 ", "v": 1}]),
    ("a rule", b" id  | v\n-----+----\n r0  |  1\n a b |\n", {"comment": "---"}, PADDED),
    ("blanks in names", b"# c\nmy time,v\n1,2\n", {"comment": "#"}, [{"my time": 1, "v": 2}]),
    ("columns of blanks", b"\n   t     v\n   1   0.5\n\n   2   1.5\n", {"delimiter": "blanks"}, TWO),
    ("fixed width", "ŧ  v   \n1  0.5 \n2  1.5\n".encode(), {"widths": (3, 4)}, [{"ŧ": 1, "v": 0.5}, {"ŧ": 2, "v": 1.5}]),
    ("fixed width without blanks", b"10.5\n21.5\n", {"widths": (1, 3), "header": False, "columns": ("t", "v")}, TWO),
    ("line ends of Windows", b"# x\r\nt;v\r\n1;0,5\r\n2;1,5\r\n", {"decimal": ",", "comment": "#"}, TWO),
    ("a byte order mark", b"\xef\xbb\xbf# x\nt,v\n1,0.5\n2,1.5\n", {"comment": "#"}, TWO),
    ("everything together", b"Log\n%u\nt;v\n%u\ns;m\n%u\n1;0,5\nNaN;-\n", {"skip": 1, "comment": "%", "units_row": True,
     "decimal": ",", "na": ("-", "NaN")}, [{"t": 1, "v": 0.5}, {"t": None, "v": None}]),
]  # fmt: skip


@pytest.mark.parametrize(("content", "keys", "rows"), [case[1:] for case in GOOD], ids=[case[0] for case in GOOD])
def test_file_is_read_as_it_is_declared(tmp_path: Path, content: bytes, keys: dict[str, Any], rows: list[Any]) -> None:
    for name, stored in (
        ("t.csv", content),
        ("t.csv.gz", gzip.compress(content)),
        ("t.csv.zst", pa.compress(content, "zstd", asbytes=True)),
    ):
        reading, found = read_file(tmp_path, name, stored, format="csv", **keys)
        assert not reading.faults
        assert found == rows
        assert list(reading.counted.values()) == [len(rows)]


@pytest.mark.integration
def test_texts_between_bars_stay_as_an_earlier_version_recorded_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texts, dump = {}, TableLayout.dump
    for begun in ("later", "earlier"):
        folder = projects.make(tmp_path / begun, simulator="open('t.csv', 'w').write(' id  | v\\n r0  | 1\\n')\n")
        with monkeypatch.context() as patch:
            if begun == "earlier":
                patch.setattr(csv, "PADDED", "")
                patch.setattr(TableLayout, "dump", lambda layout: dump(dataclasses.replace(layout, trimmed=False)))
            projects.run(folder, "population_size=1")
        projects.run(folder, "population_size=1,2")
        texts[begun] = projects.values(folder, "SELECT id FROM t")
    assert texts == {"later": {"r0"}, "earlier": {" r0  "}}


@pytest.mark.integration
def test_texts_between_bars_are_trimmed_whatever_runs_before_them_wrote(tmp_path: Path) -> None:
    read = "import sys\nsize = open(sys.argv[1]).read().partition('count=\"')[2][0]\n"
    program = read + "open('t.csv', 'w').write('id,v\\nr0,1\\n' if size == '1' else ' id  | v\\n r0  | 1\\n')\n"
    texts = []
    for order in ((1, 2), (2, 1)):
        folder = projects.make(tmp_path / str(order[0]), simulator=program)
        for size in order:
            projects.run(folder, f"population_size={size}")
        texts.append(projects.values(folder, "SELECT id FROM t"))
    assert texts == [{"r0"}, {"r0"}]


BAD: list[tuple[str, bytes, dict[str, Any], str]] = [
    ("text after a comment", b"# x\n# y\nt,v\n1,2\n3,4 # z\n5\n", {"comment": "#"}, "line 6: too few fields (1, not 2)"),
    ("line cut short", b"# x\nt,v\n1,2\n1", {"comment": "#"}, "line 4: too few fields (1, not 2)"),
    ("line with too many fields", b"a\nt,v\n1,2\n1,2,3\n", {"skip": 1}, "line 4: too many fields (3, not 2)"),
    ("numbers instead of units", b"t,v\n1,2\n3,4\n", {"units_row": True}, "line 2: the number '2' instead of a unit"),
    ("too few units", b"t,v\ns\n3,4\n", {"units_row": True}, "line 2: 1 units, but 2 columns"),
    ("no units", b"t,v\n", {"units_row": True}, "ends before the line with units"),
    ("too few header lines", b"t,v\n", {"header_lines": 2}, "has 1 of 2 header lines"),
    ("header lines of different lengths", b"a,b\nc\n1,2\n", {"header_lines": 2}, "line 2: 1 column names, but the first"),
    ("nothing but comments", b"# x\n", {"comment": "#"}, "is empty and has no header"),
    ("names in a comment", b"# t,v\n1,a\n2,b\n", {"comment": "#"}, "line 2: the number '1' among the column names"),
    ("decimal point", b"t;v\n1;0,5\n2;1.234\n", {"decimal": ","}, "line 3: '1.234' has a decimal point"),
    ("too short for fixed width", b"t  v  \n1\n", {"widths": (3, 3)}, "line 2: too few characters (1; widths has 6)"),
    ("too long for fixed width", b"t  v  \n1  2   3\n", {"widths": (3, 3)}, "line 2: too many characters (8; widths has 6)"),
    ("tab in fixed width", b"t  v  \n1\t2  \n", {"widths": (3, 3)}, "line 2: has a tab"),
    ("quotes among blanks", b't v\n"1 2" 3\n', {"delimiter": "blanks"}, "line 2: has a quote"),
    ("blanks with too few fields", b"t v\n\n1 2\n3\n", {"delimiter": "blanks"}, "line 4: too few fields (1, not 2)"),
    ("open quote", b'# x\nt,v\n1,"2\n', {"comment": "#"}, "line 3: "),
    ("a column twice after joining", b"a,a\nb,b\n1,2\n", {"header_lines": 2}, "line 1: the column 'a.b' occurs twice"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "keys", "fault"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_fault_is_reported_with_its_line_in_the_original_file(
    tmp_path: Path, content: bytes, keys: dict[str, Any], fault: str
) -> None:
    reading, rows = read_file(tmp_path, "t.csv", content, **keys)
    assert rows == []
    assert reading.faults["e0"].startswith(f"t.csv: {fault}")
    assert "\n" not in reading.faults["e0"]


@pytest.mark.parametrize("name", ["t.csv.gz", "t.csv.zst"])
def test_compressed_file_that_is_cut_short_or_damaged_fails(tmp_path: Path, name: str) -> None:
    content = b"t,v\n" + b"".join(b"%d,%d\n" % (n, n * n * 7919) for n in range(5000))
    whole = gzip.compress(content) if name.endswith("gz") else pa.compress(content, "zstd", asbytes=True)
    for damaged in (whole[:-1], whole[: len(whole) // 2], whole + b"x", b"", content, whole[:900] + b"\0\0" + whole[902:]):
        reading, rows = read_file(tmp_path, name, damaged, format="csv")
        assert rows == []
        assert reading.faults["e0"].startswith(f"{name}: ")


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=15)
@given(
    st.lists(st.sampled_from(["1;2", "# 3", "", " # 4", "5;6", '7;"8', '9";1', '"# x"', "# \"'", ";"]), max_size=8),
    st.booleans(),
)
def test_rows_are_counted_as_they_are_read_or_the_file_is_refused(tmp_path: Path, lines: list[str], ended: bool) -> None:
    content = ("a;b\n" + "\n".join(lines) + "\n" * ended).encode()
    reading, rows = read_file(tmp_path, "t.csv", content, comment="#")
    without = [line for line in lines if not line.lstrip().startswith("#") and line]
    if not reading.faults and '"' not in "".join(without):
        assert len(rows) == len(without)
    assert bool(reading.faults) != (("e0", "t.csv") in reading.rows)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ('skip = 2\nformat = "jsonl"', "skip needs format = \"csv\", but the format is 'jsonl'"),
        ("header = false\nunits_row = true", "units_row needs header = true"),
        ('widths = [2]\ndelimiter = ";"', "widths and delimiter exclude each other"),
        ('decimal = ","\ndelimiter = ","', 'decimal = "," needs another delimiter'),
        ('delimiter = "ab"', "delimiter"),
    ],
)
def test_keys_that_do_not_fit_are_errors(tmp_path: Path, lines: str, message: str) -> None:
    text = projects.CONFIG + f'[outputs.t]\nfile = "t.csv"\n{lines}\n'
    with pytest.raises(ConfigError) as error:
        project_file.parse(tomllib.loads(text), "sierra.toml")
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("head", "names"),
    [
        ("# t,v", ["t", "v"]),
        ("#t,v", ["t", "v"]),
        ("%t,v", ["t", "v"]),
        ('"# t",v', ["t", "v"]),
        ("## t,v", ["t", "v"]),
        ("#,v", ["#", "v"]),
        ("# of cars,v", ["# of cars", "v"]),
        ("# v,v", ["# v", "v"]),
        ("t,# v", ["t", "# v"]),
    ],
)
def test_mark_of_a_comment_is_no_part_of_the_first_name(tmp_path: Path, head: str, names: list[str]) -> None:
    for keys in ({}, {"na": ("NA",)}, {"skip": 1}):
        content = "a line\n" * int(keys.get("skip", 0)) + f"{head}\n1,2\n"
        reading, rows = read_file(tmp_path, "t.csv", content.encode(), **keys)
        assert not reading.faults
        assert rows == [dict(zip(names, (1, 2), strict=True))]


def test_mark_of_a_comment_between_blanks_is_no_column(tmp_path: Path) -> None:
    _, rows = read_file(tmp_path, "t.csv", b"# t v\n1 0.5\n2 1.5\n", delimiter="blanks")
    assert rows == TWO
    _, rows = read_file(tmp_path, "t.csv", b"# t v\n1 0.5 7\n", delimiter="blanks")
    assert rows == [{"#": 1, "t": 0.5, "v": 7}]


@pytest.mark.parametrize("keys", [{"comment": ("#", "@")}, {"comment": ("@", "#")}, {"comment": ("# ", "@", "#")}])
def test_lines_with_one_of_several_beginnings_are_comments(tmp_path: Path, keys: dict[str, Any]) -> None:
    content = b'# made by hand\n@    title "Energies"\n  @ s0 legend "Potential"\n1 0.5\n@ between\n2 1.5\n#"\n'
    reading, rows = read_file(
        tmp_path, "energy.xvg", content, format="csv", delimiter="blanks", header=False, columns=("t", "v"), **keys
    )
    assert rows == TWO
    assert list(reading.counted.values()) == [2]


@pytest.mark.parametrize("comment", [[], [""], ["#", ""], 3])
def test_list_of_comments_has_texts(tmp_path: Path, comment: Any) -> None:
    with pytest.raises(ConfigError, match="comment"):
        project_file.parse({**tomllib.loads(projects.CONFIG), "outputs": {"t": {"file": "t.csv", "comment": comment}}}, "x")
