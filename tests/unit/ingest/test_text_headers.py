"""The keys for text tables whose names are not in their first line are found, and named where such a table is not read."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sierra.ingest.text_headers import keys_of
from tests.projects import make, quick
from tests.readings import read_file

TABLES: list[tuple[bytes, dict[str, Any] | None]] = [
    (b"t,v\n1,2\n3,4\n", {}),
    (b"# t,v\n1,2\n3,4\n", {}),
    (b"# made\n# t,v\n1,2\n", {"skip": 1}),
    (b'#{"t_start": 1.5, "env_id": "A"}\nr,l,t\n1,5,0\n2,5,1\n', {"comment": "#"}),
    (b"s,kW,kW\nTime,HRR,Q\n0,1,1\n1,2,1\n", {"skip": 1}),
    (b'# x\n@    title "E"\n@ s0 legend "P"\n0 0\n1 1\n', {"comment": ["#", "@"], "delimiter": "blanks", "header": False}),
    (b"setting,value\nlength,3\nt,v\n0,1\n1,2\n", {"skip": 2}),
    (b"# t v\n0 1\n2 3\n", {"delimiter": "blanks"}),
    (b"# x\r\nt\tv\r\n0\t1\r\n", {"comment": "#"}),
    (b"Report of x\n\nt;v\n0;1\n", {"skip": 2}),
    (b"\nt,v\n0,1\n", {"skip": 1}),
    (b"# p,q\n\n0,5\n1,6\n", {"skip": 2, "header": False}),
    (b"t,v\ns,m/s\n0,1\n1,2\n", {"units_row": True}),
    (b"# x\nt v\n[s] [m]\n0 1\n1 2\n", {"comment": "#", "units_row": True, "delimiter": "blanks"}),
    (b"Zeit;E\n0,5;1\n1,0;2,25\n", {"decimal": ","}),
    (b"# x\nZeit E\n0,5 1\n1,0 2\n", {"comment": "#", "decimal": ",", "delimiter": "blanks"}),
    (b"Zeit;E\n0;1,234\n1;2,345\n", {}),  # commas of thousands leave doubt
    (b"t,v\n0,1\n1,2\nt,v\n2,3\n", {"comment": "t,v", "header": False, "columns": ["t", "v"]}),
    (b"t v\n0 1\nt v\n2 3\n", {"comment": "t v", "header": False, "columns": ["t", "v"], "delimiter": "blanks"}),
    (b"t,v\n0,1\n1,2\nt,v\n0,1\n", None),  # a run may have appended to its file
    (b"t,v\nt,vw\n0,1\nt,v\n1,2\n", None),  # the names are the beginning of another line
    (b"a,b\n-1,2\nt,v\n0,1\n1,2\n", {"skip": 2}),  # a small table above, as wide as the other one
    (b"a,b\n1,2\n3,4\nt,v\n0,1\n1,2\n", None),  # which of them is it?
    (b"# made\ncolour,n\n#ff0000,3\nred,4\n", None),  # is the marked line a row?
    (b"first robot,second robot\ne-puck 1,e-puck 2\ne-puck 3,e-puck 4\n", None),  # no names between blanks
    (b"battery,rssi\n-,-\n99,-60\n97,-61\n", None),  # values are missing, these are no units
    (b"left,right\nspeed,dist\n1,2\n", None),  # two lines of names
    (b"time [s],x\n1,2\ntime [s],x\n2,3\n", None),  # `columns` cannot have this name
    (
        b"# flock: N=10\n#  t[s]  order\n0.0 0.5\n0.5 0.6\n# contacts: 16\n",
        {"delimiter": "blanks", "comment": "#", "header": False, "columns": ["t", "order"], "units": {"t": "s"}},
    ),
    (
        b"# made\n# time,alive\n# [s],[%]\n0,100\n1,50\n",
        {"comment": "#", "header": False, "columns": ["time", "alive"], "units": {"time": "s", "alive": "%"}},
    ),
    (b"name,v\na,n/a\nb,1\n", None),  # rows with texts are no headers
    (b"name,2001,2002\na,1,2\n", None),
    (b"t,1,2\n0,2,3\n", None),
    (b"t,v\nn/a,NA\n0,1\n", None),
    (b"t,v\n0,1\nt,v\n0,1\n", None),
    (b" id | v\n----+-----\n  1 | 2.0\n  2 | -3.0\n", {"comment": "---"}),
    (b"| id | v  |\n|:---|---:|\n| 1  | -2 |\n", {"comment": "|:---"}),
    (b"+----+---+\n| id | v |\n+----+---+\n|  1 | 2 |\n+----+---+\n", {"comment": "+---"}),
    (b"t    v\n==== ====\n0    1\n2    3\n", {"delimiter": "blanks", "comment": "==="}),
    (b"id|v\n---|---\n1|2\n---|3\n", None),  # the last line is a row
    (b"a b c\n", None),
    (b"", None),
    (b"t,v\n1,2\n3\n", None),
]


@pytest.mark.parametrize(("content", "keys"), TABLES)
def test_keys_are_found(tmp_path: Path, content: bytes, keys: dict[str, Any] | None) -> None:
    found = keys_of(content)
    assert found == keys
    if found is not None:
        reading, rows = read_file(tmp_path, "t.csv", content, format="csv", **dict(found))
        assert not reading.faults
        assert len(rows) == len([line for line in content.splitlines() if line.lstrip(b"| ")[:1].isdigit()])


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=6)
@given(
    st.lists(st.sampled_from(["# x", "@ y", "a,b", "title", "", "1,2", "s,kW", "# p,q"]), max_size=4),
    st.sampled_from(["t,v", "# t,v", ""]),
)
def test_table_is_read_by_the_keys_that_are_found(tmp_path: Path, above: list[str], head: str) -> None:
    content = "\n".join([*above, *([head] if head else []), "0,5", "1,6.5", "2,7", ""]).encode()
    if (keys := keys_of(content)) is None:
        return
    reading, rows = read_file(tmp_path, "t.csv", content, format="csv", **dict(keys))
    assert not reading.faults
    assert [list(row.values())[-1] for row in rows][-3:] == [5, 6.5, 7]


@pytest.mark.parametrize(
    ("content", "keys", "fault"),
    [
        (TABLES[3][0], {}, '(set comment = "#" in [outputs.t])'),
        (TABLES[4][0], {}, "the column 'kW' occurs twice (set skip = 1 in [outputs.t])"),
        (TABLES[5][0], {"comment": "#", "delimiter": "blanks"}, '(set comment = ["#", "@"], header = false in [outputs.t])'),
        (b"t,v\ns,m\n1,2\n", {"comment": "#", "header_lines": 3}, "(set units_row = true in [outputs.t])"),
        (b"t,v\n1,2\n3\n", {}, "too few fields (1, not 2): '3'"),
        (b"1,2\n3,4\n", {}, "(if the file has no header, set header = false in [outputs.…])"),
    ],
)
def test_failure_names_the_keys_that_read_the_file(tmp_path: Path, content: bytes, keys: dict[str, Any], fault: str) -> None:
    reading, _ = read_file(tmp_path, "t.csv", content, format="csv", **keys)
    assert reading.faults["e0"].endswith(fault)


SIMULATOR = """\
import sys
n = int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])
rows = "".join(f"{i},{n * i},5\\n" for i in range(4))
open("monitor.csv", "w").write('#{"t_start": 1.5}\\nt,r,l\\n' + rows)
open("fire.csv", "w").write("s,kW,kW\\nt,HRR,Q\\n" + rows)
open("energy.xvg", "w").write("# made\\n@ title E\\n" + rows.replace(",", " "))
"""


@pytest.mark.integration
def test_outputs_writes_the_keys_of_tables_that_could_not_be_read(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    assert quick(folder, "run", "population_size=1", "--no-figures").returncode == 1
    done = quick(folder, "outputs", "--write")
    assert done.returncode == 0, done.stderr
    written = tomllib.loads((folder / "sierra.toml").read_text())["outputs"]
    assert written == {
        "monitor": {"file": "monitor.csv", "comment": "#"},
        "fire": {"file": "fire.csv", "skip": 1},
        "energy": {"file": "energy.xvg", "format": "csv", "comment": ["#", "@"], "delimiter": "blanks", "header": False},
    }
    assert quick(folder, "run", "population_size=1", "--no-figures").returncode == 0
    for table, column in (("monitor", "r"), ("fire", "HRR"), ("energy", "column1")):
        assert quick(folder, "sql", f"SELECT count({column}) AS n FROM {table}", "--format", "csv").stdout.split() == ["n", "8"]


@pytest.mark.integration
def test_init_writes_the_keys_of_tables_that_could_not_be_read(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    (folder / "sierra.toml").unlink()
    done = quick(folder, "init", "--yes", "--command", "python3 sim.py {input}")
    assert done.returncode == 0, done.stderr
    written = tomllib.loads((folder / "sierra.toml").read_text())["outputs"]
    assert written["monitor"] == {"file": "monitor.csv", "comment": "#"}
    assert written["fire"] == {"file": "fire.csv", "skip": 1}
