"""`sierra run --inputs` writes what a batch would execute: the same inputs and commands, and nothing is executed."""

from __future__ import annotations

import csv
import json
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.projects import CONFIG, make, quick, run, sql

QUERY = ("population_size=1,8", "noise=0,0.5")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    return make(tmp_path / "project", CONFIG + "[environment]\nset = { MAPS = '{project}/maps', OUT = '{output}' }\n")


def written(project: Path, *words: str) -> list[dict[str, str]]:
    """Write inputs beside the project; return the rows of the manifest."""
    done = quick(project, "inputs", *(words or QUERY), "--to", "../inputs")
    assert done.returncode == 0, done.stderr
    with (project.parent / "inputs" / "manifest.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def command(project: Path, row: dict[str, str]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((project.parent / "inputs" / row["folder"] / "command.json").read_text())
    return found


@pytest.mark.integration
def test_runs_and_inputs_are_those_that_a_batch_records(project: Path) -> None:
    rows = written(project)
    assert not (project / ".sierra").exists()
    run(project, *QUERY)
    recorded = sql(project, "SELECT run, seed, population_size, noise FROM runs ORDER BY run")
    mine = [
        {
            "run": row["run"],
            "seed": int(row["seed"]),
            "population_size": int(row["population_size"]),
            "noise": float(row["noise"]),
        }
        for row in sorted(rows, key=lambda row: row["run"])
    ]
    assert mine == recorded
    for row in rows:
        done = quick(project, "files", row["run"], "input.xml", "--to", f"../files/{row['run']}")
        assert done.returncode == 0
        [file] = (project.parent / "files" / row["run"]).rglob("input.xml")
        assert (project.parent / "inputs" / row["folder"] / "input.xml").read_bytes() == file.read_bytes()


KILLED = """
import os, signal, sys
from pathlib import Path
import sierra
from sierra.execution import write_inputs
write_inputs._write_all = lambda *of: os.kill(os.getpid(), signal.SIGKILL)
project = sierra.open(".")
project.plans.write_inputs(project.plan("population_size=1", runs=1), Path("../first"))
"""


@pytest.mark.integration
def test_the_next_inputs_remove_what_a_killed_command_has_left(project: Path) -> None:
    before = {path.name for path in project.parent.iterdir()}
    ended = subprocess.run([sys.executable, "-c", KILLED], cwd=project, check=False)
    assert ended.returncode == -signal.SIGKILL
    assert len(list(project.parent.iterdir())) == len(before) + 1
    assert written(project, "population_size=1")
    assert {path.name for path in project.parent.iterdir()} == {*before, "inputs"}


def test_a_command_works_in_the_output_folder_of_its_run(project: Path) -> None:
    row = next(row for row in written(project) if row["population_size"] == "8")
    found = command(project, row)
    assert found["argv"] == ["python3", str(project / "sim.py"), "../input.xml"]
    assert found["line"] == f"python3 {project / 'sim.py'} ../input.xml"
    place = project.parent / "inputs" / row["folder"]
    subprocess.run(found["argv"], cwd=place / found["folder"], check=True)
    assert (place / "output" / "swarm.csv").read_text().count("\n") == 6


def test_marks_of_folders_in_inputs_are_filled_in(project: Path) -> None:
    config = project / "sierra.toml"
    change = 'changes = [{ set = "//arena/@size", value = "{output}/a {project}/b" }]\n'
    config.write_text(change + config.read_text())
    [row, *_] = written(project, "population_size=1")
    arena = (project.parent / "inputs" / row["folder"] / "input.xml").read_text()
    assert f'<arena size="./a {project}/b">' in arena


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("{input}", "{input} {port}"),
        ("runs = 2", 'runs = 2\nbefore = "true"'),
        ("runs = 2", 'runs = 2\nchanges = [{ set = "//arena/@size", value = "{port}" }]'),
    ],
)
def test_a_command_that_needs_more_than_a_shell_has_no_script(before: str, after: str, project: Path) -> None:
    config = project / "sierra.toml"
    config.write_text(config.read_text().replace(before, after))
    [row, *_] = written(project, "population_size=1")
    folder = project.parent / "inputs" / row["folder"]
    assert sorted(path.name for path in folder.iterdir()) == ["command.json", "input.xml", "output"]


def test_the_script_of_a_run_has_its_id_and_its_quoted_command(project: Path) -> None:
    [row, *_] = written(project)
    first, line = (project.parent / "inputs" / row["folder"] / "command.sh").read_text().splitlines()
    found = command(project, row)
    assert first == f"# run {row['run']}"
    variables = [f"{name}={value}" for name, value in found["environment"].items()]
    assert shlex.split(line) == ["exec", "env", *variables, *found["argv"]]


def test_a_program_whose_name_looks_like_a_variable_is_called_by_a_shell(project: Path) -> None:
    config = project / "sierra.toml"
    config.write_text(config.read_text().replace("python3 sim.py {input}", "./a=b {input}"))
    program = project / "a=b"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    [row, *_] = written(project)
    line = (project.parent / "inputs" / row["folder"] / "command.sh").read_text().splitlines()[1]
    assert shlex.split(line)[-6:] == ["sh", "-c", 'exec "$@"', "sh", str(program), "../input.xml"]


def test_the_folder_says_which_texts_of_this_machine_commands_name(project: Path) -> None:
    written(project)
    request = json.loads((project.parent / "inputs" / "batch.json").read_text())
    assert (request["project"], request["python"]) == (str(project), sys.executable)


def test_variables_of_the_environment_are_the_declared_ones(project: Path) -> None:
    [row, *_] = written(project)
    environment = command(project, row)["environment"]
    assert environment["MAPS"] == f"{project}/maps"
    assert (environment["SIERRA_RUN_ID"], environment["SIERRA_SEED"]) == (row["run"], row["seed"])
    assert environment["PYTHONHASHSEED"] == "0"
    assert environment.keys().isdisjoint({"HOME", "TMPDIR", "PATH", "SIERRA_SESSION", "SIERRA_EXECUTION"})


def test_placeholders_of_the_run_are_relative_to_its_output_folder(project: Path) -> None:
    config = project / "sierra.toml"
    line = "python3 sim.py {input} --out={output}/poses.csv --beside {run}/output2 {run} {output}"
    config.write_text(config.read_text().replace("python3 sim.py {input}", line))
    [row, *_] = written(project)
    assert command(project, row)["argv"][3:] == ["--out=./poses.csv", "--beside", "../output2", "..", "."]


def test_the_request_beside_the_manifest_is_one_that_run_takes(project: Path) -> None:
    written(project, *QUERY, "--runs", "3", "--set", "//arena/@size=20")
    done = quick(project, "run", "../inputs/batch.json", "--dry-run", "--json")
    assert done.returncode == 0
    request = json.loads((project.parent / "inputs" / "batch.json").read_text())
    assert (json.loads(done.stdout)["batch"], json.loads(done.stdout)["runs"]) == (request["batch"], 12)


def test_only_a_part_is_written(project: Path) -> None:
    rows = written(project, *QUERY, "--only", "population_size=8 and noise=0.5")
    assert {row["folder"] for row in rows} == {"runs/3/0", "runs/3/1"}
    assert sorted(path.name for path in (project.parent / "inputs" / "runs").iterdir()) == ["3"]


@pytest.mark.parametrize("name", ["notes", ".hidden"])
def test_a_folder_that_is_not_empty_is_refused(project: Path, name: str) -> None:
    folder = project.parent / "inputs"
    folder.mkdir()
    (folder / name).write_text("precious")
    done = quick(project, "inputs", *QUERY, "--to", "../inputs")
    assert (done.returncode, done.stderr) == (2, "sierra: ../inputs is not empty; use a new folder\n")
    assert [path.name for path in folder.iterdir()] == [name]


def test_an_empty_folder_is_filled(project: Path) -> None:
    (project.parent / "inputs").mkdir()
    assert len(written(project)) == 8


def test_an_error_leaves_no_folder(project: Path) -> None:
    before = sorted(path.name for path in project.parent.iterdir())
    done = quick(project, "inputs", *QUERY, "--only", "noise=7", "--to", "../inputs")
    assert done.returncode == 2
    assert quick(project, "inputs", *QUERY, "--to", "../no/inputs").returncode == 2
    assert sorted(path.name for path in project.parent.iterdir()) == before


def test_inputs_in_the_project_are_reported_because_they_count_as_code(project: Path) -> None:
    done = quick(project, "inputs", *QUERY, "--to", "inputs")
    assert done.returncode == 0
    assert "is in the project: its files count as code, and make all runs new, unless git ignores them" in done.stderr


@pytest.mark.nightly
def test_files_beside_the_inputs_and_values_of_the_command_are_written(tmp_path: Path) -> None:
    config = 'files = ["maps"]\n' + CONFIG.replace("{input}", "{input} {population_size}")
    project = make(tmp_path / "project", config, simulator="import sys\nprint(open('../maps/a').read(), sys.argv[2])\n")
    (project / "maps").mkdir()
    (project / "maps" / "a").write_text("a map of")
    row = written(project)[-1]
    found = command(project, row)
    assert found["argv"][2:] == ["../input.xml", "8"]
    place = project.parent / "inputs" / row["folder"]
    assert (
        subprocess.run(found["argv"], cwd=place / "output", check=True, capture_output=True, text=True).stdout == "a map of 8\n"
    )
    assert quick(project, "try", "population_size=8").stdout.startswith("a map of 8\n--\nresult  ok\n")
