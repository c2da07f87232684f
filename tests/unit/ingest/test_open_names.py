"""Files that have another name in each run get a pattern: in failures, in `sierra init` and in `sierra outputs --write`."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

import sierra
from sierra.ingest import open_names
from tests.projects import quick

CLOCK = """
import datetime, json, sys
given = json.load(open(sys.argv[1]))
for kind in KINDS:
    open(datetime.datetime.now().strftime(kind + "_%Y-%m-%d_%H-%M-%S-%f.csv"), "w").write(f"t,v\\n0,{given['n']}\\n")
"""
CONFIG = 'template = "t.json"\ncommand = "python3 sim.py {input}"\nseed = "/seed"\nruns = 2\n[variables]\nn = "/n"\n'


def project(folder: Path, *kinds: str, config: str | None = CONFIG) -> Path:
    (folder / "sim.py").write_text(CLOCK.replace("KINDS", repr(kinds)))
    (folder / "t.json").write_text(json.dumps({"n": 1, "seed": 1}))
    if config is not None:
        (folder / "sierra.toml").write_text(config)
    return folder


@pytest.mark.parametrize(
    ("runs", "found"),
    [
        ([["log_2026-11-27_10-11-12.csv"], ["log_2026-11-27_10-11-13.csv"]], {"log_*.csv"}),
        ([["log_10-11-12.csv", "x.csv"], ["log_10-11-13.csv", "x.csv"]], {"log_*.csv"}),
        ([["a_1764239472.csv", "b_1764239472.csv"], ["a_1764239473.csv", "b_1764239473.csv"]], {"a_*.csv", "b_*.csv"}),
        (
            [["robot1_20261127.csv", "robot2_20261127.csv"], ["robot1_20261128.csv", "robot2_20261128.csv"]],
            {"robot1_*.csv", "robot2_*.csv"},
        ),
        ([["20261127T101112/log.csv"], ["20261127T101113/log.csv"]], {"*/log.csv"}),
        ([["out_a8f3.csv"], ["out_b0c9.csv"]], {"out_*.csv"}),
        ([["x[1]_10-11-12.csv"], ["x[1]_10-11-13.csv"]], {"x[[]1]_*.csv"}),
        ([["a.csv"], ["b.csv"]], set()),
        ([["f1.csv", "f2.csv"], ["f1.csv", "f2.csv"]], set()),
        ([["f1.csv", "f2.csv"], ["f1.csv"]], set()),
        ([["log_10-11-12.csv"]], set()),
    ],
)
def test_names_that_differ_between_runs_become_patterns(runs: list[list[str]], found: set[str]) -> None:
    assert set(open_names.patterns(runs).values()) == found


@pytest.mark.parametrize(
    ("path", "pattern"),
    [
        ("log_2026-11-27_10-11-12.csv", "log_*.csv"),
        ("20261127/log_3.csv", "*/log_3.csv"),
        ("seed20261.csv", None),
        ("log_3.csv", None),
        ("n2048.csv", None),
    ],
)
def test_one_run_alone_shows_dates(path: str, pattern: str | None) -> None:
    assert open_names.with_date(path) == pattern


@pytest.mark.integration
def test_runs_that_fail_because_the_clock_is_in_names_say_which_declaration_helps(tmp_path: Path) -> None:
    root = project(tmp_path, "log", "pose")
    done = quick(root, "run", "n=1,2", "--no-figures")
    declared = '[outputs.log] file = "log_*.csv" and [outputs.pose] file = "pose_*.csv" make tables of them'
    assert (done.returncode, done.stdout.count(declared)) == (1, 4), done.stdout
    with (root / "sierra.toml").open("a") as file:
        print('[outputs.log]\nfile = "log_*.csv"\n[outputs.pose]\nfile = "pose_*.csv"', file=file)
    done = quick(root, "run", "n=1,2", "--no-figures")
    assert (done.returncode, "4 evaluated again" in done.stdout) == (0, True), done.stdout
    assert sierra.open(root).sql("SELECT n, v FROM log ORDER BY ALL").to_pylist() == [{"n": n, "v": n} for n in (1, 1, 2, 2)]


@pytest.mark.integration
def test_a_run_without_the_file_of_a_former_clock_says_which_pattern_helps(tmp_path: Path) -> None:
    root = project(tmp_path, "log", config=CONFIG + '[outputs.log]\nfile = "log_2026-01-02_03-04-05-000000.csv"\n')
    done = quick(root, "run", "n=1", "--no-figures")
    assert done.returncode == 1
    assert '[outputs.log] file = "log_*.csv" makes one table of them' in done.stdout


@pytest.mark.integration
def test_init_finds_patterns_from_its_two_runs(tmp_path: Path) -> None:
    root = project(tmp_path, "log", "pose", config=None)
    assert quick(root, "init", "-y", "--command", "python3 sim.py {input}").returncode == 0
    declared = tomllib.loads((root / "sierra.toml").read_text())["outputs"]
    assert declared == {"log": {"file": "log_*.csv"}, "pose": {"file": "pose_*.csv"}}
    assert quick(root, "run", "population_size=1,2", "--runs", "2", "--no-figures").returncode == 0


@pytest.mark.integration
def test_outputs_write_declares_the_pattern_of_dated_files(tmp_path: Path) -> None:
    root = project(tmp_path, "log")
    assert quick(root, "run", "n=1,2", "--runs", "1", "--no-figures").returncode == 0
    assert quick(root, "outputs", "--write").returncode == 0
    assert tomllib.loads((root / "sierra.toml").read_text())["outputs"] == {"log": {"file": "log_*.csv"}}
    assert quick(root, "run", "n=1,2", "--runs", "2", "--no-figures").returncode == 0
