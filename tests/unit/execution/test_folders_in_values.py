"""`{project}` and `{output}` in values of changes: filled in when a run is executed, and in no id."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.projects import quick, run, sql

SIMULATOR = """\
import pathlib, re, sys

paths = re.findall(r"(?:map|log)[^/]*(/[^\\"'<>\\n]+)", pathlib.Path(sys.argv[1]).read_text())
with open(paths[1], "w") as file:
    print("tick,height", file=file)
    print(0, pathlib.Path(paths[0]).read_text().strip(), sep=",", file=file)
"""
FORMATS = {
    "xml": '<a map="none" log="none" count="1" seed="0"/>\n',
    "json": '{"map": "none", "log": "none", "count": 1, "seed": 0}\n',
    "yaml": "map: none\nlog: none\ncount: 1\nseed: 0\n",
    "toml": 'map = "none"\nlog = "none"\ncount = 1\nseed = 0\n',
    "ini": "[a]\nmap = none\nlog = none\ncount = 1\nseed = 0\n",
    "txt": "map {{project}}/maps/{{map}}.txt\nlog {{output}}/out.csv\n{{count}} {{seed}}\n",
}
CONFIG = """\
template = "in.FORMAT"
command = "python3 sim.py {input}"
runs = 1
seed = "BEFOREseed"
changes = [{ set = "BEFORElog", value = "{output}/out.csv" }]
[variables]
population_size = "BEFOREcount"
map = { changes = [{ set = "BEFOREmap", value = "{project}/maps/{map}.txt" }] }
"""


def make(folder: Path, kind: str = "json") -> Path:
    (folder / "maps").mkdir(parents=True)
    (folder / "maps" / "one.txt").write_text("7\n")
    (folder / "sim.py").write_text(SIMULATOR)
    (folder / f"in.{kind}").write_text(FORMATS[kind])
    config = CONFIG.replace("FORMAT", kind).replace("BEFORE", {"xml": "/a/@", "ini": "/a/"}.get(kind, "/"))
    if kind == "txt":
        config = config.replace('changes = [{ set = "/log", value = "{output}/out.csv" }]\n', "")
        config = config.replace("{project}/maps/{map}.txt", "{map}")
    (folder / "sierra.toml").write_text(config)
    return folder


@pytest.mark.integration
@pytest.mark.parametrize("kind", FORMATS)
def test_paths_are_filled_in_and_not_in_ids(tmp_path: Path, kind: str) -> None:
    root = make(tmp_path / "p", kind)
    summary, noted = run(root, "population_size=1,2", "map=one")
    assert noted == ""
    assert [row["height"] for row in sql(root, "SELECT height FROM out")] == [7, 7]
    other = make(tmp_path / "elsewhere" / "q", kind)
    assert run(other, "population_size=1,2", "map=one")[0]["batch"] == summary["batch"]
    shutil.rmtree(root / "maps")
    done = quick(root, "replay", summary["batch"])
    assert "2 identical" in done.stdout, done.stderr


@pytest.mark.nightly
def test_a_variable_of_that_name_keeps_its_meaning(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    config = (root / "sierra.toml").read_text().replace("map = {", "output = {").replace("{project}/maps/{map}.txt", "{output}")
    (root / "sierra.toml").write_text(config.replace('changes = [{ set = "/log", value = "{output}/out.csv" }]\n', "", 1))
    done = quick(root, "run", "output=one", "--dry-run")
    assert done.returncode == 0, done.stderr
    (root / "sim.py").write_text("import sys, shutil\nshutil.copy(sys.argv[1], 'seen.txt')\n")
    run(root, "output=one")
    [row] = sql(root, "SELECT run FROM runs")
    assert '"map": "one"' in quick(root, "files", str(row["run"]), "seen.txt").stdout


def test_an_absolute_path_into_the_project_is_refused_with_what_to_write(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    (root / "in.json").write_text(FORMATS["json"].replace("none", f"{root}/maps/one.txt", 1))
    told = f"{root}/maps/one.txt is a path of this machine, and ids must not depend on it; write value = "
    for words in (("population_size=1",), ("population_size=1", "--set", f"/map={root}/maps/one.txt")):
        done = quick(root, "run", *words, "--dry-run")
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert told + '"{project}/maps/one.txt" in a change' in done.stderr
        (root / "in.json").write_text(FORMATS["json"])


def test_a_template_with_the_mark_of_a_folder_is_refused(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    (root / "in.json").write_text(FORMATS["json"].replace("none", "sierraFolder7d1c0e4bProject", 1))
    done = quick(root, "run", "population_size=1", "--dry-run")
    assert done.returncode == 2
    assert "contains sierraFolder7d1c0e4b, which marks folders in inputs" in done.stderr


@pytest.mark.integration
def test_a_project_in_a_folder_with_an_unusual_name_is_refused_before_a_run_reads_the_path(tmp_path: Path) -> None:
    root = make(tmp_path / "a & b", "xml")
    done = quick(root, "run", "population_size=1", "map=one")
    assert done.returncode == 2
    assert "move the project to a folder with a plain name" in done.stderr


@pytest.mark.nightly
def test_a_blank_in_the_path_of_the_project_is_harmless(tmp_path: Path) -> None:
    root = make(tmp_path / "my project", "yaml")
    run(root, "population_size=1", "map=one")
    assert [row["height"] for row in sql(root, "SELECT height FROM out")] == [7]
