"""Runs with different seeds and the same data are reported: they are not independent samples."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.projects import CONFIG, SIMULATOR, make, quick

SAYS = "all runs of each experiment have the same data in all tables, although their seeds differ"
FIXED = SIMULATOR.replace("noise * (seed % 100)", "noise")
WITH_SEED = FIXED.replace('"tick,coverage"', '"tick,coverage,seed"').replace("+ noise,", "+ noise, seed,")
WITH_CLOCK = FIXED.replace("import sys", "import sys, time").replace('"tick,coverage"', '"tick,coverage,wall"')
WITH_CLOCK = WITH_CLOCK.replace("+ noise,", "+ noise, time.time_ns(),")
VOLATILE = '[outputs.swarm]\nfile = "swarm.csv"\nvolatile = ["wall"]\n'
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
        (FIXED, '[outputs.swarm]\nfile = "swarm.csv"\nrates = ["coverage"]\n', False),
        (SIMULATOR.replace("noise * (seed % 100)", "(noise * (seed % 100) if count == 2 else 0)"), "", False),
    ],
    ids=[
        "the same files",
        "other values",
        "a column of seeds",
        "a clock",
        "a volatile clock",
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
@pytest.mark.parametrize(("value", "equal"), [("7", True), ("seed", False)])
def test_tables_whose_files_have_more_than_rows_are_compared_by_their_rows(value: str, equal: bool, tmp_path: Path) -> None:
    config = 'command = "{python} {project}/sim.py {population_size} {seed}"\n[variables]\npopulation_size = {}\n'
    root = make(tmp_path / "p", config, simulator=TABLE.replace("VALUE", value))
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
