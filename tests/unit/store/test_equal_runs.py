"""Runs with different seeds and the same data are reported: they are not independent samples."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.projects import CONFIG, SIMULATOR, make, quick, sql

SAYS = "all runs of each experiment have the same data in all tables, although their seeds differ"
FIXED = SIMULATOR.replace("noise * (seed % 100)", "noise")
WITH_SEED = FIXED.replace('"tick,coverage"', '"tick,coverage,seed"').replace("+ noise,", "+ noise, seed,")
WITH_CLOCK = FIXED.replace("import sys", "import sys, time").replace('"tick,coverage"', '"tick,coverage,wall"')
WITH_CLOCK = WITH_CLOCK.replace("+ noise,", "+ noise, time.time_ns(),")
VOLATILE = '[outputs.swarm]\nfile = "swarm.csv"\nvolatile = ["wall"]\n'
NAMED = FIXED.replace("import sys", "import os, sys").replace('"swarm.csv"', 'f"log_2026-11-27_{seed}_{os.getpid()}.csv"')
NAMED += "    if count < 3: open(file.name.replace('log', 'more'), 'w').write('tick\\n1\\n')\n"
PATTERN = '[outputs.swarm]\nfile = "log_*.csv"\n[outputs.more]\nfile = "more_*.csv"\n'
TABLE = """\
import sys, pyarrow as pa, pyarrow.parquet as pq
count, seed = (int(text) for text in sys.argv[1:])
pq.write_table(pa.table({"v": [count, VALUE]}).replace_schema_metadata({"seed": str(seed)}), "swarm.parquet")
"""


def said(root: Path, *words: str) -> str:
    """Return what `sierra run` says for two experiments with three runs each."""
    done = quick(root, "run", "population_size=1,2", "--no-figures", *(words or ("--runs", "3")))
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.parametrize(
    ("simulator", "config", "equal"),
    [
        (FIXED, "", True),
        (SIMULATOR, "", False),
        (WITH_SEED, "", True),
        (WITH_CLOCK, "", False),
        (WITH_CLOCK, VOLATILE, True),
        (NAMED, PATTERN, True),
        (FIXED, '[outputs.swarm]\nfile = "swarm.csv"\nrates = ["coverage"]\n', False),
        (SIMULATOR.replace("noise * (seed % 100)", "(noise * (seed % 100) if count == 2 else 0)"), "", False),
    ],
    ids=[
        "the same files",
        "other values",
        "a column of seeds",
        "a clock",
        "a volatile clock",
        "a clock in the names of files",
        "a rate",
        "one experiment differs",
    ],
)
@pytest.mark.integration
@pytest.mark.each_case
def test_seeds_without_effect_are_reported(simulator: str, config: str, equal: bool, tmp_path: Path) -> None:
    root = make(tmp_path / "p", CONFIG + config, simulator=simulator)
    assert (SAYS in said(root)) == equal
    assert (SAYS in quick(root, "stats", "swarm", "coverage").stderr) == equal


@pytest.mark.integration
@pytest.mark.parametrize(("value", "name", "equal"), [("7", "swarm.", True), ("seed", "swarm.", False), ("7", "swarm_*", True)])
def test_tables_whose_files_have_more_than_rows_are_compared_by_their_rows(
    value: str, name: str, equal: bool, tmp_path: Path
) -> None:
    config = 'command = "{python} {project}/sim.py {population_size} {seed}"\n[variables]\npopulation_size = {}\n'
    simulator = TABLE.replace("VALUE", value)
    if "*" in name:
        config += f'[outputs.swarm]\nfile = "{name}.parquet"\n'
        simulator = simulator.replace('"swarm.parquet"', 'f"swarm_{seed}.parquet"')
    root = make(tmp_path / "p", config, simulator=simulator)
    assert (SAYS in said(root)) == equal


@pytest.mark.integration
def test_captions_and_reports_say_that_seeds_had_no_effect(tmp_path: Path) -> None:
    root = make(tmp_path / "p", simulator=FIXED)
    assert quick(root, "run", "population_size=1,2", "--runs", "3").returncode == 0
    for caption in root.glob("figures/*/*.txt"):
        assert SAYS in caption.read_text().replace("All runs", "all runs")
    assert quick(root, "report").returncode == 0
    [page] = root.rglob("*report*/**/*.html") if not list(root.glob("*.html")) else root.glob("*.html")
    assert SAYS in re.sub(r"\s+", " ", page.read_text()).replace("All runs", "all runs")


@pytest.mark.integration
def test_one_run_and_runs_without_seed_are_not_reported(tmp_path: Path) -> None:
    root = make(tmp_path / "p", simulator=FIXED)
    assert SAYS not in said(root, "--runs", "1")
    unseeded = make(tmp_path / "q", CONFIG.replace('seed = "//random/@seed"\n', ""), simulator=FIXED)
    assert SAYS not in said(unseeded)


LIMITED = """\
import random, sys
count, seed = (int(text) for text in sys.argv[1:])
chance = random.Random(seed if seed <= LARGEST else 19780503)
with open("swarm.csv", "w") as file:
    print("tick,coverage", *(f"{tick},VALUE" for tick in range(TICKS)), sep="\\n", file=file)
"""
BARE = 'command = "{python} {project}/sim.py {population_size} {seed}"\n[variables]\npopulation_size = {}\n'


def limited(folder: Path, value: str, ticks: int = 3, largest: int = 900_000_000, config: str = "") -> Path:
    """Make a project with a program that takes a default seed beyond the largest one."""
    simulator = LIMITED.replace("LARGEST", str(largest)).replace("VALUE", value).replace("TICKS", str(ticks))
    return make(folder, BARE + config, simulator=simulator)


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    ("value", "ticks", "equal"),
    [
        ("{count + chance.gauss(0, 1):.6f}", 3, True),
        ("{chance.gauss(0, 1):.6f}", 1, True),
        ("{chance.randrange(1000)}", 20, True),
        ("{chance.randrange(4)}", 3, False),
        ("{chance.randrange(30) / 30:.6f}", 1, False),
        ("{chance.random() if seed <= LARGEST else 0:.6f}", 3, False),
        ("{0.123456 * tick:.6f}", 3, False),
    ],
    ids=["series", "one number", "many counts", "few counts", "a rate", "zero as soon as it fails", "the same in all runs"],
)
def test_some_runs_with_the_same_data_are_counted(value: str, ticks: int, equal: bool, tmp_path: Path) -> None:
    root = limited(tmp_path / "p", value.replace("LARGEST", "900_000_000"), ticks)
    text = "5 of 10 runs of population_size=1 have the same data although their seeds differ"
    assert (text in said(root, "--runs", "10")) == equal
    if equal and ticks == 3:
        stated = quick(root, "stats", "swarm", "coverage").stderr
        assert text in stated
        assert "set max = 900000000 in [seed]" in stated


@pytest.mark.integration
def test_a_largest_seed_makes_the_runs_differ(tmp_path: Path) -> None:
    root = limited(tmp_path / "p", "{chance.gauss(0, 1):.6f}", config="[seed]\nmax = 900_000_000\n")
    assert "the same data" not in said(root, "--runs", "10")
    drawn = sql(root, "SELECT run, seed FROM batch_runs ORDER BY ALL")
    assert len({row["seed"] for row in drawn}) == 10
    assert max(row["seed"] for row in drawn) <= 900_000_000
    again = quick(root, "run", "population_size=1,2", "--runs", "10", "--no-figures")
    assert "20 runs: 0 executed, 20 reused" in again.stdout
    assert quick(root, "replay", drawn[0]["run"]).returncode == 0


@pytest.mark.integration
def test_more_runs_than_seeds_are_refused(tmp_path: Path) -> None:
    root = limited(tmp_path / "p", "{chance.random():.6f}", config="[seed]\nmax = 65\n")
    done = quick(root, "run", "population_size=1", "--runs", "66", "--dry-run")
    assert done.returncode == 2
    assert "[seed] max allows 65 different seeds, and this query requests 66 runs per experiment" in done.stderr
    assert quick(root, "run", "population_size=1", "--runs", "65", "--dry-run").returncode == 0
    tried = quick(root, "try", "population_size=1", "--seed", "66")
    assert (tried.returncode, tried.stderr) == (2, "sierra: seed 66 is above 65, the largest seed ([seed] max)\n")
    several = quick(root, "run", "population_size=1", "montecarlo.C9", "--runs", "2", "--dry-run")
    assert several.returncode == 2
    assert "montecarlo allows at most 4 experiments with [seed] max = 65" in several.stderr


@pytest.mark.nightly
def test_a_try_says_that_another_seed_gave_the_same_tables(tmp_path: Path) -> None:
    root = make(tmp_path / "p", simulator=FIXED)
    same = "this run has the same tables as the one with seed 1, which was tried before"
    assert same not in quick(root, "try", "--seed", "1").stderr
    assert same not in quick(root, "try", "--seed", "1").stderr
    assert same in quick(root, "try", "--seed", "2").stderr
    assert same not in quick(root, "try", "population_size=3", "--seed", "3").stderr
    unseeded = make(tmp_path / "q", CONFIG.replace('seed = "//random/@seed"\n', ""), simulator=FIXED)
    for seed in ("1", "2"):
        assert "same tables" not in quick(unseeded, "try", "--seed", seed).stderr
