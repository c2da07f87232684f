"""The tables that XML documents, printed lines and files of robots make are found, and only if there is no doubt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sierra.config import line_patterns
from sierra.ingest import open_names, printed_lines, xml_lists
from tests.projects import make, quick, sql
from tests.readings import read_file

XML: list[tuple[str, str | None]] = [
    ('<summary><step time="0" n="1"/><step time="1" n="2"/></summary>', "//step"),
    ('<trips><trip id="a"><emissions CO="1"/></trip><trip id="b"/></trips>', "//trip"),
    ('<f><timestep time="0"><vehicle id="a"/><vehicle id="b"/></timestep><timestep time="1"/></f>', "//vehicle"),
    ("<r><a><x>1</x></a><a><x>2</x></a><b><a/></b></r>", "/r/a"),
    ('<r><i n="1"><p/><p/><q/><q/></i><i n="2"/></r>', None),  # two lists in each row
    ('<r><s><i n="1"/><i n="2"/></s><u><j n="1"/><j n="2"/></u></r>', None),  # two lists: see below
    ("<a><b/><b/></a>", None),  # nothing in them
    ('<a><b x="1"/></a>', None),  # nothing is repeated
    ("<a>" * 100_000, None),
    ("<a", None),
    ('<!DOCTYPE a [<!ENTITY e "e">]><a><b x="1"/><b x="2"/></a>', None),
]


@pytest.mark.parametrize(("content", "rows"), XML)
def test_repeated_elements_are_rows(tmp_path: Path, content: str, rows: str | None) -> None:
    keys = xml_lists.keys_of(content.encode())
    assert keys == (None if rows is None else {"rows": rows})
    if rows is not None:
        reading, read = read_file(tmp_path, "t.xml", content.encode(), format="xml", rows=rows)
        assert not reading.faults
        assert len(read) == 2


LISTS = (
    '<r><s><i n="1"/><i n="2"/></s><step t="0"><j n="1"/><j n="2"/></step><step t="1"/><step t="2"><k m="1"/></step>'
    '<u><p/><q n="1"/><q n="2"/></u></r>'
)


@pytest.mark.integration
def test_each_list_of_a_document_becomes_a_table_and_elements_without_rows_are_noted(tmp_path: Path) -> None:
    root = make(tmp_path, simulator=f"open('out.xml', 'w').write({LISTS!r})\n")
    assert quick(root, "run", "noise=1", "--runs", "1").returncode == 0
    unread = quick(root, "outputs").stdout
    for rows in ("i", "j", "q"):
        assert f'//{rows}; declare [outputs.{rows}] file = "out.xml", format = "xml", rows = "//{rows}"' in unread
    written = quick(root, "outputs", "--write").stdout
    assert written.startswith(f"{root}/sierra.toml: added [outputs.i], [outputs.j], [outputs.q]\n")
    noted = quick(root, "run", "noise=1", "--runs", "1").stderr
    assert "note: output 'j' has no row for 2 elements without \"//j\" within; another output of this file" in noted
    assert noted.count("has no row for") == 1
    assert sql(root, 'SELECT n, "step.t" AS t FROM j ORDER BY n') == [{"n": 1, "t": 0}, {"n": 2, "t": 0}]
    assert sql(root, "SELECT (SELECT count(*) FROM i) AS i, (SELECT count(*) FROM q) AS q") == [{"i": 2, "q": 2}]


AT = {"at": 1.5, "at_2": 2, "step": 1, "step_2": 9}
PRINTED: list[tuple[str, dict[str, Any]]] = [
    (
        "Begin ...\nstep 0: score=3.5\nstep 1: score=-1e-3\n",
        {"lines": [{"step": 0, "score": 3.5}, {"step": 1, "score": -0.001}]},
    ),
    ("RESULT coverage=1.5 collisions=5\n", {"result": [{"coverage": 1.5, "collisions": 5}]}),
    ("t=  0.0 e=  nan\nt= 10.0 e= -2.5\n", {"lines": [{"t": 0.0, "e": float("nan")}, {"t": 10.0, "e": -2.5}]}),
    (
        "Robot 3 is home after 12.5s\nRobot 4 is home after 2.5s\n",
        {"lines": [{"Robot": 3, "after": 12.5}, {"Robot": 4, "after": 2.5}]},
    ),
    ("[12:00:01] energy 3.5\n[12:00:02] energy 3.6\n", {"lines": [{"energy": 3.5}, {"energy": 3.6}]}),
    ("at=[1.5, 2] step 1/9\nat=[3.5, 4] step 2/9\n", {"lines": [AT, {"at": 3.5, "at_2": 4, "step": 2, "step_2": 9}]}),
    ("max-speed=1 min-speed=2\n", {"max": [{"max_speed": 1, "min_speed": 2}]}),
    ("cost=950.6\ncost=1,020.8\n", {}),  # is the comma that of thousands?
    ("Größe=1\nGröße=2\n", {}),  # no name that a group can have
    ("time,x\n0,1.5\n1,2.5\n", {"stdout": [{"time": 0, "x": 1.5}, {"time": 1, "x": 2.5}]}),
    ('{"a": 1}\n{"a": 2}\n', {"stdout": [{"a": 1}, {"a": 2}]}),
    ("version: 1.2\nListening on port 8080\ndone\n", {}),
    ("a=1\nb=1\nc=1\nd=1\ne=1\n", {}),  # tables of too many forms
    ("1 2 3\n4 5 6\n", {}),
    ("\x1b[31mscore=1\x1b[0m\nscore=2\n", {}),
    ("", {}),
]


@pytest.mark.parametrize(("content", "tables"), PRINTED)
def test_named_numbers_in_lines_are_columns(tmp_path: Path, content: str, tables: dict[str, Any]) -> None:
    found = printed_lines.keys_of(content.encode())
    read = {}
    for name, keys in found.items():
        if "lines" in keys:
            line_patterns.check(str(keys["lines"]))
        reading, read[name] = read_file(
            tmp_path, "stdout", content.encode(), **{key: keys[key] for key in keys if key != "file"}
        )
        assert not reading.faults
    assert repr(read) == repr(tables)


@pytest.mark.parametrize(
    ("paths", "pattern", "name"),
    [
        (["robot_0.csv", "robot_1.csv"], "robot_{robot}.csv", "robot"),
        (["Agent1.csv", "Agent2.csv"], "Agent{robot}.csv", "Agent"),
        (["logs/uav-01-pose.csv", "logs/uav-02-pose.csv"], "logs/uav-{robot}-pose.csv", "logs_uav"),
        (["robot_1.csv"], None, ""),
        (["floor-1.csv", "floor-2.csv"], None, ""),
        (["plant1.csv", "plant2.csv"], None, ""),
        (["a*robot1.csv", "a*robot2.csv"], None, ""),
        (["run1_robot1.csv", "run2_robot2.csv"], None, ""),
    ],
)
def test_files_of_robots_have_one_pattern(paths: list[str], pattern: str | None, name: str) -> None:
    found = open_names.of_robots(dict.fromkeys(paths, ("t", "x")))
    assert found == (dict.fromkeys(paths, pattern) if pattern else {})
    assert pattern is None or open_names.name_of(pattern) == name


def test_files_of_robots_with_other_columns_or_a_column_of_robots_stay_tables_of_their_own() -> None:
    assert open_names.of_robots({"robot_0.csv": ("t", "x"), "robot_1.csv": ("t", "y")}) == {}
    assert open_names.of_robots({"robot_0.csv": ("t", "Robot"), "robot_1.csv": ("t", "Robot")}) == {}


ROBOTS = """\
import sys
for robot in range(int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])):
    with open(f"robot_{robot}.csv", "w") as file:
        file.write("t;x\\n" + "".join(f"{t};{t * robot},5\\n" for t in range(3)))
"""


@pytest.mark.integration
def test_declared_outputs_join_the_files_of_robots_and_read_decimal_commas(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=ROBOTS)
    assert quick(folder, "run", "population_size=1,2", "--runs", "1", "--no-figures").returncode == 0
    written = quick(folder, "outputs", "--write")
    assert written.stdout == (
        f"{folder}/sierra.toml: added [outputs.robot]\n"
        "the next sierra run reads the files of new tables again; it executes nothing again for that\n"
    )
    assert 'file = "robot_{robot}.csv"\ndecimal = ","\n' in (folder / "sierra.toml").read_text()
    again = quick(folder, "run", "population_size=1,2", "--runs", "1", "--no-figures")
    assert "2 runs: 0 executed, 2 reused" in again.stdout
    sums = quick(folder, "sql", "SELECT robot, sum(x) AS x FROM robot GROUP BY robot ORDER BY robot", "--format", "csv").stdout
    assert sums == "robot,x\n0,3.0\n1,4.5\n"
