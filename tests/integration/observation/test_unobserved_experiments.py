"""Each experiment is observed before its runs are reused; one that could not be executes again if anything outside changed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from sierra.execution.observation import choose_runs
from tests import projects

SIMULATOR = """\
import os, sys
maps = os.environ["MAPS"]
count = open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0]
listed = len(os.listdir(maps + "/listed"))
value = int(open(f"{maps}/{count}").read()) + 0 * listed
print("tick,value", *(f"{tick},{value}" for tick in range(3)), sep="\\n", file=open("swarm.csv", "w"))
"""
"""Each experiment reads a map of its own."""
QUERY = "population_size=1,2,3"
VALUES = (
    "SELECT x.population_size AS map, any_value(s.value) AS value FROM swarm s JOIN effective USING (execution) "
    "JOIN experiments x ON x.batch = effective.batch AND x.ordinal = effective.ordinal GROUP BY 1 ORDER BY 1"
)


@pytest.fixture
def maps(tmp_path: Path, require: Callable[..., str]) -> Path:
    """A folder outside the project with the maps."""
    require("strace")
    folder = tmp_path / "maps"
    (folder / "listed").mkdir(parents=True)
    for number in (1, 2, 3):
        (folder / str(number)).write_text("10")
    return folder


@pytest.fixture
def root(maps: Path, tmp_path: Path) -> Path:
    config = projects.CONFIG + f'[environment]\nset = {{ MAPS = "{maps}" }}\n'
    return projects.make(tmp_path / "project", config, simulator=SIMULATOR)


@pytest.fixture
def dear(monkeypatch: pytest.MonkeyPatch) -> None:
    """Observations cost too much: only the first run of a session is observed."""
    monkeypatch.setattr(choose_runs, "ALWAYS", 0)
    monkeypatch.setattr(choose_runs, "PART", 0.0)


def run(root: Path, *words: str) -> tuple[int, int, str]:
    """Execute the runs one after the other; return how many were executed and reused, and the notes."""
    summary, said = projects.run(root, QUERY, "--jobs", "1", *words)
    return summary["executed"], summary["reused"], said


def test_a_changed_file_executes_only_the_experiment_again_that_used_it(root: Path, maps: Path) -> None:
    assert run(root)[:2] == (6, 0)
    (maps / "2").write_text("99")
    predicted = projects.quick(root, "run", QUERY, "--dry-run", "--explain").stdout
    assert "2 runs: executed with other programs or files" in predicted
    executed, reused, said = run(root)
    assert (executed, reused) == (2, 4)
    assert f"4 runs reused, because the executions did not use what has changed: {maps}/2" in said
    assert projects.sql(root, VALUES) == [{"map": 1, "value": 10}, {"map": 2, "value": 99}, {"map": 3, "value": 10}]
    assert run(root)[:2] == (0, 6)
    assert run(root, "--runs", "3")[:2] == (3, 6)
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.nightly
def test_the_file_of_a_seed_executes_its_run_in_each_experiment_again(
    root: Path, maps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All experiments use the same seeds. Of the second runs, only that of the last experiment is observed."""
    (root / "sim.py").write_text(SIMULATOR.replace("swarm count", "random seed"))
    config = root / "sierra.toml"
    config.write_text(f"observe_budget = 1e9\n{config.read_text()}")
    runs = sierra.open(root).plan(QUERY).batch.runs
    for one in runs:
        (maps / str(one.seed)).write_text("10")
    monkeypatch.setattr(choose_runs, "is_sampled", lambda batch, run: run == runs[-1].id)
    assert run(root)[:2] == (6, 0)
    (maps / str(runs[-1].seed)).write_text("99")
    assert run(root)[:2] == (3, 3)


@pytest.mark.usefixtures("dear")
def test_an_experiment_that_was_not_observed_executes_again_if_any_file_outside_has_changed(root: Path, maps: Path) -> None:
    assert run(root)[:2] == (6, 0)
    assert run(root)[:2] == (0, 6)
    (maps / "1").write_text("99")
    predicted = projects.quick(root, "run", QUERY, "--dry-run", "--explain").stdout
    assert "4 runs: not observed" in predicted
    assert "2 runs: executed with other programs or files" in predicted
    assert f"{maps}/1" in predicted
    executed, reused, said = run(root)
    assert (executed, reused) == (6, 0)
    assert "4 runs execute again because their experiments were not observed" in said
    [batch] = projects.sql(root, "SELECT batch FROM batches")
    explained = projects.quick(root, "why", batch["batch"]).stdout
    assert f"not observed before, and nobody knows whether it used what has changed: {maps}/1" in explained


@pytest.mark.parametrize(("few", "executed"), [(False, 0), (True, 4)], ids=["all observed", "one observed"])
def test_a_change_that_is_harmless_to_the_observed_runs_executes_the_others_again(
    root: Path, few: bool, executed: int, request: pytest.FixtureRequest
) -> None:
    """A package is installed that no observed run imports, for a Python that the command does not name."""
    if few:
        request.getfixturevalue("dear")
    venv = root.parent / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("python3 sim.py", "sh run.sh"))
    (root / "run.sh").write_text(f"exec {venv}/bin/python3 {root}/sim.py $1\n")
    assert run(root)[:2] == (6, 0)
    [packages] = venv.glob("lib/python3*/site-packages")
    (packages / "unused_package.py").touch()
    *counts, said = run(root)
    assert counts == [executed, 6 - executed]
    assert "files that they used have changed" not in said
    assert (f"not observed: nobody knows whether they used what has changed: {packages}" in said) is few
    assert run(root)[:2] == (0, 6)


@pytest.mark.usefixtures("dear")
def test_why_says_that_an_execution_does_not_count_because_it_was_not_observed(root: Path, maps: Path) -> None:
    run(root)
    (maps / "1").write_text("99")
    run(root, "--only", "population_size<=1")
    [one] = projects.sql(root, "SELECT run FROM batch_runs WHERE ordinal = 1 AND number = 0")
    said = projects.quick(root, "why", one["run"]).stdout
    assert "not observed, and files that other runs of its session used have changed" in said


@pytest.mark.usefixtures("dear")
def test_a_change_in_the_project_that_no_observed_run_used_executes_nothing(root: Path) -> None:
    (root / ".gitignore").write_text(".sierra\nlog.txt\n")
    projects.commit(root)
    run(root)
    (root / "log.txt").write_text("a build has ended")
    assert run(root)[:2] == (0, 6)


def test_a_lack_of_the_tracer_is_said_by_the_run_that_needs_it_and_not_again(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracer = tmp_path / "bin" / "strace"
    tracer.parent.mkdir()
    tracer.write_text("#!/bin/sh\necho 'strace -- version 4.0'\n")
    tracer.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tracer.parent}:{os.environ['PATH']}")
    said = run(root)[2]
    assert said.count("runs are observed only in part, because") == 1
    assert "5.3 or newer is needed" in said
    assert "observed only in part" not in run(root)[2]


@pytest.mark.usefixtures("dear")
def test_files_that_exchange_their_contents_execute_the_runs_that_were_not_observed_again(root: Path, maps: Path) -> None:
    """Only the first run is observed; it reads the file of its seed, which stays as it is."""
    (root / "sim.py").write_text(
        "import sys\nseed = int(open(sys.argv[1]).read().split('<random seed=\"')[1].split('\"')[0])\n"
        "value = open(sys.argv[2 + seed % 3]).read()\n"
        "print('tick,value', f'0,{value}', sep='\\n', file=open('swarm.csv', 'w'))\n"
    )
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("{input}", f"{{input}} {maps}/1 {maps}/2 {maps}/3"))
    for number in (1, 2, 3):
        (maps / str(number)).write_text(str(number))
    query = ("run", "population_size=1", "--runs", "6", "--no-figures", "--json")

    def executed() -> int:
        return int(json.loads(projects.quick(root, *query).stdout)["executed"])

    assert executed() == 6
    seen = {str(one["value"]) for one in projects.sql(root, "SELECT DISTINCT value FROM swarm")}
    [first] = projects.sql(root, "SELECT path FROM files_read WHERE path LIKE '%/maps/%' AND use = 'read'")
    one, other = sorted(path for path in maps.iterdir() if path.is_file() and str(path) != first["path"])
    contents = one.read_text(), other.read_text()
    assert seen & set(contents)
    for path, content in zip((other, one), contents, strict=True):
        path.write_text(content)
    assert executed() == 5
