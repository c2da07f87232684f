"""Records of the files that observed runs use."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sierra.ingest.observations import observed, written
from sierra.model import Result
from tests import projects

SIMULATOR = """\
import os, sys
here = os.path.dirname(os.path.abspath(sys.argv[0]))
data = open(os.path.join(here, "data", "map.txt")).read()
os.path.exists(os.path.join(here, "plugin.so"))
os.listdir(os.path.join(here, "data"))
open(os.path.join(here, "data.log"), "a").write("x")
print("tick,value", *(f"{tick},{len(data)}" for tick in range(3)), sep="\\n", file=open("swarm.csv", "w"))
"""


@pytest.fixture
def root(tmp_path: Path, require: Callable[..., str]) -> Path:
    """A project whose runs are started by a script, and read and write files of the project."""
    require("strace")
    config = projects.CONFIG.replace("python3 sim.py", "sh {project}/run.sh").replace("runs = 2", 'runs = 2\nobserve = "all"')
    root = projects.make(tmp_path / "project", config, simulator=SIMULATOR)
    (root / "run.sh").write_text('python3 "$(dirname "$0")/sim.py" "$1"\n')
    (root / "data").mkdir()
    (root / "data" / "map.txt").write_text("wall\n")
    (root / ".gitignore").write_text("data.log\n")
    return root


def run(root: Path, *words: str) -> str:
    done = projects.quick(root, "run", "population_size=1,2", "--no-figures", *words)
    assert done.returncode == 0, done.stderr
    return done.stderr


def sql(root: Path, statement: str) -> list[dict[str, Any]]:
    done = projects.quick(root, "sql", "--format", "json", statement)
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


@pytest.mark.integration
def test_files_that_runs_use_and_write_are_recorded_once_for_all_runs(root: Path) -> None:
    assert "runs wrote files into the project: {project}/data.log (" in run(root)
    rows = sql(root, "SELECT path, use, count(*) AS n FROM files_written GROUP BY ALL")
    assert rows == [{"path": "{project}/data.log", "use": "written", "n": 4}]
    observations = sql(root, "SELECT * FROM observations JOIN executions USING (execution)")
    assert [one["reason"] for one in observations] == [None] * 4
    assert len({one["files"] for one in observations}) == 1
    own = sql(root, "SELECT path, use, size FROM files_read WHERE path LIKE '{project}/%' AND use <> 'found' ORDER BY path")
    assert own == [
        {"path": "{project}/data", "use": "listed", "size": None},
        {"path": "{project}/data/map.txt", "use": "read", "size": 5},
        {"path": "{project}/plugin.so", "use": "missed", "size": None},
        {"path": "{project}/run.sh", "use": "read", "size": (root / "run.sh").stat().st_size},
        {"path": "{project}/sim.py", "use": "read", "size": len(SIMULATOR)},
    ]
    executed = [row["path"].rpartition("/")[2] for row in sql(root, "SELECT path FROM files_read WHERE use = 'executed'")]
    assert any(re.fullmatch(r"python3(\.\d+)?", name) for name in executed), "the script's program is named too"
    assert not sql(root, "SELECT path FROM files_read WHERE path LIKE '/proc/%' OR path LIKE '%/.sierra/%'")
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
@pytest.mark.parametrize("where", ["a checkout", "a work folder"])
def test_names_of_files_do_not_depend_on_where_runs_execute(root: Path, tmp_path: Path, where: str) -> None:
    projects.commit(root)
    run(root)
    there = tmp_path / "there" / "project"
    shutil.copytree(root, there, ignore=shutil.ignore_patterns(".sierra", "data.log"))
    setting = '[source]\ndirty = "ignore"\n' if where == "a checkout" else f'[store]\nwork_folder = "{tmp_path}/work"\n'
    with (there / "sierra.toml").open("a") as file:
        file.write(setting)
    (there / "sim.py").write_text(SIMULATOR + ("raise SystemExit(1)\n" if where == "a checkout" else ""))
    (tmp_path / "work").mkdir()
    run(there)
    files = "SELECT DISTINCT o.files, path, use, sha256 FROM observations o JOIN files_read USING (files) ORDER BY ALL"
    assert sql(there, files) == sql(root, files)


@pytest.mark.integration
def test_a_batch_without_a_complete_observation_says_so(root: Path) -> None:
    (root / "sim.py").write_text(SIMULATOR + 'import subprocess\nsubprocess.run(["/proc/self/root/bin/true"], check=True)\n')
    said = run(root)
    assert "no run was observed completely" in said
    assert "it executed a file through /proc" in said


@pytest.mark.integration
@pytest.mark.parametrize(("setting", "count"), [("first", 2), ("none", 0), ("all", 4)])
def test_the_setting_decides_which_runs_are_observed(root: Path, setting: str, count: int) -> None:
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace('observe = "all"', f'observe = "{setting}"\nobserve_budget = 0'))
    run(root)
    assert sql(root, "SELECT count(*) AS n FROM observations") == [{"n": count}]


@pytest.mark.integration
def test_observation_changes_neither_ids_nor_outputs(root: Path, tmp_path: Path) -> None:
    run(root)
    plain = projects.make(tmp_path / "plain", (root / "sierra.toml").read_text().replace("all", "none"), simulator=SIMULATOR)
    for name in ("run.sh", ".gitignore"):
        (plain / name).write_text((root / name).read_text())
    (plain / "data").mkdir()
    (plain / "data" / "map.txt").write_text("wall\n")
    (root / "data.log").unlink()
    run(plain)
    same = "SELECT run, result FROM executions ORDER BY run"
    assert [row["result"] for row in sql(root, same)] == [row["result"] for row in sql(plain, same)]


@pytest.mark.nightly
def test_show_counts_the_files_of_an_execution(root: Path) -> None:
    run(root, "--runs", "1")
    [execution, _] = sql(root, "SELECT execution FROM executions")
    shown = json.loads(projects.quick(root, "show", execution["execution"], "--json").stdout)["observation"]
    assert (shown["method"], shown["reason"], shown["written"]) == ("strace", None, 1)
    assert shown["read"] > 3
    assert re.search(r"Python 3\.\d+.*; .*dirname.*; 2 scripts, 1 other file$", shown["used"])
    assert shown["used"] in projects.quick(root, "show", execution["execution"]).stdout


@pytest.mark.nightly
def test_doctor_says_how_files_can_be_observed(root: Path) -> None:
    assert "observation of files: all files that runs use, by strace" in projects.quick(root, "doctor").stdout
    with (root / "sierra.toml").open("a") as file:
        file.write("[runners.slurm]\n")
    said = "observation on clusters: slurm: checked on the node when a run is observed"
    assert said in projects.quick(root, "doctor").stdout


@pytest.mark.nightly
def test_rm_removes_what_was_observed(root: Path) -> None:
    run(root)
    [batch] = json.loads(projects.quick(root, "ls", "--json").stdout)
    assert projects.quick(root, "rm", batch["batch"], "--yes").returncode == 0
    for table in ("observations", "files_read", "files_written"):
        assert sql(root, f"SELECT count(*) AS n FROM {table}") == [{"n": 0}]


def test_names_that_are_not_utf_8_are_escaped(tmp_path: Path) -> None:
    files = [["/a\udcff", "read", "0" * 64, 1], ["/b\n", "missed", None, None]]
    record = {
        "method": "strace",
        "reason": None,
        "disturbed": None,
        "notes": [],
        "distributions": [],
        "files": files,
        "listings": {},
        "written": [["/\udcfe", "written"], ["/\udcfd", "removed"]],
    }
    (tmp_path / "observed.json").write_text(json.dumps(record))
    result = Result("r", "e", str(tmp_path), 0, 0, 0, None, None, 0, 0, 0, "h", 0, (), observed=True)
    found = observed(result)
    assert found is not None
    assert [row.path for row in found.read] == ["/a\\xff", "/b\n"]
    assert [row.path for row in found.written] == ["/\\xfe", "/\\xfd"]
    assert written(result) == ("/\\xfe",)


@pytest.mark.integration
def test_a_run_that_observation_would_change_is_executed_unobserved(root: Path, tmp_path: Path) -> None:
    privileged = tmp_path / "privileged"
    shutil.copy(shutil.which("true") or "", privileged)
    privileged.chmod(0o4755)
    with (root / "run.sh").open("a") as file:
        file.write(f"{privileged}\n")
    run(root)
    assert sql(root, "SELECT count(*) AS n FROM executions WHERE status = 'ok'") == [{"n": 4}]
    rows = sql(root, "SELECT DISTINCT method, reason, o.files FROM observations o ANTI JOIN files_read USING (files)")
    assert [(row["method"], "setuid" in row["reason"]) for row in rows] == [("none", True)]
    execution = sql(root, "SELECT execution FROM observations LIMIT 1")[0]["execution"]
    assert "setuid" in projects.quick(root, "show", execution).stdout
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
def test_a_run_whose_tracer_is_killed_is_executed_unobserved(root: Path) -> None:
    (root / "sim.py").write_text(
        "import os, re\n"
        "tracer = int(re.search(r'TracerPid:\\s*(\\d+)', open('/proc/self/status').read())[1])\n"
        f"if tracer:\n    os.kill(tracer, 9)\n{SIMULATOR}"
    )
    run(root)
    assert sql(root, "SELECT count(*) AS n FROM executions WHERE status = 'ok'") == [{"n": 4}]
    assert sql(root, "SELECT count(*) AS n FROM swarm") == [{"n": 12}]
    assert {row["method"] for row in sql(root, "SELECT method FROM observations")} == {"none"}


@pytest.mark.nightly
def test_limits_apply_to_observed_runs(root: Path) -> None:
    (root / "sim.py").write_text("import time\ntime.sleep(60)\n")
    config = root / "sierra.toml"
    config.write_text(config.read_text() + "[limits]\nwall = 1\ngrace = 1\n")
    assert projects.quick(root, "run", "population_size=1", "--runs", "1", "--no-figures").returncode == 1
    assert sql(root, "SELECT status FROM executions") == [{"status": "timeout"}]
