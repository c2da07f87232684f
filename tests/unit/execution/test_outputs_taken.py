"""After the first runs SIERRA says how it read the outputs; `sierra outputs` shows it again, and declares the tables."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from tests import projects
from tests.projects import quick, sql

FILES = """
import os
open("map.xml", "w").write("<a/>")
open("log.bin", "wb").write(b"x")
os.mkdir("floor")
for number in range(3):
    open(f"floor/f-{number}.csv", "w").write("a,b\\n1,2\\n")
"""
QUERY = ("run", "population_size=1,2", "--no-figures")
TABLE = "table swarm from swarm.csv: 5 rows; tick BIGINT, coverage DOUBLE; time axis: tick"


def project(folder: Path, more: str = "", config: str = projects.CONFIG) -> Path:
    return projects.commit(projects.make(folder, config, simulator=projects.SIMULATOR + more))


@pytest.mark.integration
def test_first_runs_say_what_was_read_and_what_was_not_and_later_ones_do_not(tmp_path: Path) -> None:
    project(tmp_path, FILES)
    first = quick(tmp_path, *QUERY)
    assert TABLE in first.stdout.splitlines()
    assert "not a table: log.bin: no reader takes .bin files" in first.stdout
    assert '[outputs.map] file = "map.xml", format = "xml", rows = "//ELEMENT"' in first.stdout
    again = quick(tmp_path, *QUERY, "--runs", "3")
    assert "2 executed" in again.stdout
    assert "table swarm" not in again.stdout
    assert json.loads(quick(tmp_path, *QUERY, "--runs", "4", "--json").stdout)["outputs"] is None


@pytest.mark.nightly
def test_new_shape_of_a_table_is_said_again(tmp_path: Path) -> None:
    project(tmp_path)
    assert TABLE in quick(tmp_path, *QUERY).stdout
    (tmp_path / "sim.py").write_text(projects.SIMULATOR.replace('"tick,coverage"', '"tick,area"'))
    projects.commit(tmp_path, "second")
    assert "swarm.csv: 5 rows; tick BIGINT, area DOUBLE" in quick(tmp_path, *QUERY).stdout


@pytest.mark.integration
def test_outputs_shows_the_tables_of_a_batch_or_query_from_the_store(tmp_path: Path) -> None:
    project(tmp_path, FILES)
    assert quick(tmp_path, *QUERY).returncode == 0
    found = json.loads(quick(tmp_path, "outputs", "--json").stdout)
    [table] = found["tables"]
    assert (table["name"], table["file"], table["least"], table["most"], table["time"]) == ("swarm", "swarm.csv", 5, 5, "tick")
    assert [(column["name"], column["type"]) for column in table["columns"]] == [("tick", "BIGINT"), ("coverage", "DOUBLE")]
    assert [(one["path"], one["files"]) for one in found["unread"]] == [("floor/f-0.csv", 12), ("log.bin", 4), ("map.xml", 4)]
    assert 'file = "floor/f-{tick}.csv"' in found["unread"][0]["why"]
    for words in ((found["batch"][:8],), ("population_size=1,2",)):
        assert json.loads(quick(tmp_path, "outputs", *words, "--json").stdout) == found
    ended = quick(tmp_path, "outputs", "population_size=4")
    assert (ended.returncode, ended.stdout) == (2, "")
    assert "has not been run" in ended.stderr


@pytest.mark.integration
def test_columns_have_the_names_by_which_sql_takes_them(tmp_path: Path) -> None:
    more = 'open("two.csv", "w").write("population_size,v,V,run\\n0,1,2,3\\n")'
    declared = '[outputs.two]\nfile = "two.csv"\ntime = "population_size"\nunits = { V = "m" }\n'
    project(tmp_path, more, f"{projects.CONFIG}\n{declared}")
    assert quick(tmp_path, *QUERY).returncode == 0
    [two] = [table for table in json.loads(quick(tmp_path, "outputs", "--json").stdout)["tables"] if table["name"] == "two"]
    names = [column["name"] for column in two["columns"]]
    assert [column["unit"] for column in two["columns"]] == [None, None, "m", None]
    assert two["time"] == names[0]
    assert [list(row.values()) for row in sql(tmp_path, f"SELECT DISTINCT {', '.join(names)} FROM two")] == [[0, 1, 2, 3]]


@pytest.mark.nightly
def test_declared_keys_of_a_file_that_is_no_table_make_one(tmp_path: Path) -> None:
    project(tmp_path, FILES)
    assert quick(tmp_path, *QUERY).returncode == 0
    found = json.loads(quick(tmp_path, "outputs", "--json").stdout)
    [keys] = [one["why"].partition("declare ")[2] for one in found["unread"] if one["path"].startswith("floor/")]
    with (tmp_path / "sierra.toml").open("a") as file:
        print("\n".join(keys.partition(" ")[::2]), file=file)
    assert quick(tmp_path, *QUERY).returncode == 0
    assert sql(tmp_path, "SELECT count(*) AS rows, max(tick) AS tick FROM f") == [{"rows": 12, "tick": 2}]


AROUND = """# what a person wrote
runs = 2   # few
[outputs.other]   # a file
file = 'note.txt'
format = "file"
required=false

[figures.one]
kind = "summary"
table = "swarm"
column = [ "coverage" ]   # the last lines
"""


@pytest.mark.integration
def test_write_adds_the_tables_changes_nothing_else_and_nothing_executes_again(tmp_path: Path) -> None:
    head, variables = projects.CONFIG.replace("runs = 2\n", "").split("[variables]")
    before = head + AROUND + "[variables]" + variables
    project(tmp_path, config=before)
    batch = json.loads(quick(tmp_path, *QUERY, "--json").stdout)["batch"]
    rows = sql(tmp_path, "SELECT * FROM swarm ORDER BY run, tick")
    executions = sql(tmp_path, "SELECT execution FROM executions ORDER BY 1")
    written = quick(tmp_path, "outputs", "--write")
    assert written.returncode == 0, written.stderr
    assert "[outputs.swarm]" in written.stdout
    after = (tmp_path / "sierra.toml").read_text()
    rest = iter(after.splitlines())
    assert all(line in rest for line in before.splitlines())
    assert tomllib.loads(after)["outputs"]["swarm"] == {"file": "swarm.csv"}
    again = json.loads(quick(tmp_path, *QUERY, "--json").stdout)
    assert (again["batch"], again["executed"], again["reused"]) == (batch, 0, 4)
    assert sql(tmp_path, "SELECT * FROM swarm ORDER BY run, tick") == rows
    assert sql(tmp_path, "SELECT execution FROM executions ORDER BY 1") == executions
    assert "nothing was changed" in quick(tmp_path, "outputs", "--write").stdout
    assert (tmp_path / "sierra.toml").read_text() == after


@pytest.mark.nightly
def test_table_that_only_some_runs_wrote_is_declared_as_not_required(tmp_path: Path) -> None:
    config = projects.CONFIG + '[outputs.rare]\nfile = "rare.csv"\nrequired = false\n'
    project(tmp_path, 'if count == 2:\n    open("two.csv", "w").write("a\\n1\\n")\n', config)
    assert quick(tmp_path, *QUERY).returncode == 0
    assert quick(tmp_path, "outputs", "--write").returncode == 0
    assert tomllib.loads((tmp_path / "sierra.toml").read_text())["outputs"]["two"] == {"file": "two.csv", "required": False}
    again = json.loads(quick(tmp_path, *QUERY, "--json").stdout)
    assert (again["executed"], again["failed"]) == (0, 0)


@pytest.mark.integration
@pytest.mark.parametrize(("end", "said"), [("", "2 runs, which all failed"), ("raise SystemExit(3)", "2 runs with results")])
def test_tables_that_no_run_has_are_not_called_too_many(tmp_path: Path, end: str, said: str) -> None:
    simulator = f"open('out.csv', 'w').write('a,b\\n1,2\\n1,2,3\\n')\n{end}\n"
    projects.make(tmp_path, projects.CONFIG + '[success]\naccept = ["exit 3"]\n', simulator=simulator)
    assert quick(tmp_path, "run", "population_size=1", "--no-figures").returncode == (0 if end else 1)
    printed = quick(tmp_path, "outputs").stdout
    assert f": 0 tables from {said}\nnot a table: out.csv: it could not be read (see the reason of its run)" in printed


SUBFOLDERS = """
import os
for name in ("floor", "end"):
    os.mkdir(name)
for number in range(3):
    open(f"floor/f-{number}.csv", "w").write(f"a,b\\n1,{count}\\n")
open(f"end/robot-{seed}.csv", "w").write("z\\n1\\n")
if count == 2:
    open("end/rare.tsv", "w").write("z\\ty\\n1\\t2\\n")
open("log.bin", "wb").write(b"x")
"""


@pytest.mark.nightly
def test_write_declares_tables_in_subfolders_and_one_table_of_many_files(tmp_path: Path) -> None:
    project(tmp_path, SUBFOLDERS)
    assert quick(tmp_path, *QUERY).returncode == 0
    written = quick(tmp_path, "outputs", "--write")
    assert written.returncode == 0, written.stderr
    assert "the next sierra run reads the files of new tables again; it executes nothing again for that\n" in written.stdout
    assert "not a table: log.bin: no reader takes .bin files\n" in written.stdout
    assert "end/" not in written.stdout
    assert tomllib.loads((tmp_path / "sierra.toml").read_text())["outputs"] == {
        "swarm": {"file": "swarm.csv"},
        "rare": {"file": "end/rare.tsv", "required": False},
        "robot": {"file": "end/robot-*.csv"},
        "f": {"file": "floor/f-{tick}.csv"},
    }
    again = json.loads(quick(tmp_path, *QUERY, "--json").stdout)
    assert (again["executed"], again["reevaluated"], again["failed"]) == (0, 4, 0)
    assert sql(tmp_path, "SELECT count(*) AS n, sum(tick) AS ticks FROM f") == [{"n": 12, "ticks": 12}]
    assert sql(tmp_path, "SELECT count(*) AS n FROM robot") == [{"n": 4}]
    said = quick(tmp_path, "outputs", "--write").stdout
    assert "all tables are declared; nothing was changed\nnot a table: log.bin" in said


@pytest.mark.integration
@pytest.mark.parametrize(
    ("names", "file"),
    [
        ((1, 2), "x/a-{tick}-b-7.csv"),
        ((10, 9), "x/a-{tick}-b-7.csv"),
    ],
)
def test_the_proposed_pattern_has_a_place_for_each_number_that_differs(
    tmp_path: Path, names: tuple[int, int], file: str
) -> None:
    more = f"import os\nos.mkdir('x')\nfor n in {names}: open(f'x/a-{{n}}-b-7.csv', 'w').write('a\\n1\\n')\n"
    project(tmp_path, more)
    assert f'file = "{file}"' in quick(tmp_path, "try").stdout


@pytest.mark.nightly
def test_numbers_that_differ_only_between_the_first_and_the_last_name_are_found_too(tmp_path: Path) -> None:
    more = "import os\nos.mkdir('x')\nfor a, b in ((1, 5), (2, 3), (9, 5)): open(f'x/{a}-{b}.csv', 'w').write('a\\n1\\n')\n"
    project(tmp_path, more)
    assert quick(tmp_path, *QUERY).returncode == 0
    assert 'file = "x/{tick1}-{tick2}.csv"' in quick(tmp_path, "outputs").stdout


@pytest.mark.integration
@pytest.mark.parametrize(
    "written", ["outputs = {}\n", "outputs = { other = { file = 'a', format = 'file', required = false } }\n"]
)
def test_inline_table_is_refused_with_the_lines_to_write(tmp_path: Path, written: str) -> None:
    project(tmp_path, config=written + projects.CONFIG)
    assert quick(tmp_path, *QUERY).returncode == 0
    before = (tmp_path / "sierra.toml").read_bytes()
    ended = quick(tmp_path, "outputs", "--write")
    assert (ended.returncode, len(ended.stderr.splitlines())) == (2, 1)
    assert '[outputs.swarm] file = "swarm.csv"' in ended.stderr
    assert (tmp_path / "sierra.toml").read_bytes() == before


@pytest.mark.nightly
def test_settings_in_pyproject_get_the_tables_too(tmp_path: Path) -> None:
    project(tmp_path)
    (tmp_path / "sierra.toml").unlink()
    config = projects.CONFIG.replace("[variables]", "[tool.sierra.variables]")
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "a"\nversion = "1"\n\n[tool.sierra]\n' + config)
    assert quick(tmp_path, *QUERY).returncode == 0
    assert quick(tmp_path, "outputs", "--write").returncode == 0
    tool = tomllib.loads((tmp_path / "pyproject.toml").read_text())["tool"]["sierra"]
    assert tool["outputs"] == {"swarm": {"file": "swarm.csv"}}
    assert json.loads(quick(tmp_path, *QUERY, "--json").stdout)["executed"] == 0


@pytest.mark.nightly
def test_a_declaration_that_was_removed_is_not_written_without_its_keys(tmp_path: Path) -> None:
    more = "import json\njson.dump([{'a': 1}], open('r.json', 'w'))\nos = __import__('os'); os.remove('swarm.csv')\n"
    config = projects.CONFIG + '[outputs.r]\nfile = "r.json"\nformat = "json"\n'
    project(tmp_path, more, config)
    assert quick(tmp_path, *QUERY).returncode == 0
    (tmp_path / "sierra.toml").write_text(projects.CONFIG)
    said = quick(tmp_path, "outputs", "--write").stdout
    assert "sierra.toml: nothing was changed\n" in said
    assert 'not declared any more: [outputs.r] file = "r.json" had other keys too\n' in said
    assert (tmp_path / "sierra.toml").read_text() == projects.CONFIG
