"""Figures, tables, comparisons and videos with `query` show the last batch of that query, and no other batch."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import projects

CONFIG = (
    projects.CONFIG
    + """
[queries.small]
criteria = "population_size=1,2"
runs = 2
[queries.noisy]
criteria = "noise=0.1,0.2"
runs = 3
[figures.of_small]
query = "small"
kind = "summary"
column = "coverage"
[figures.of_text]
query = "noise=0.1,0.2"
kind = "summary"
column = "coverage"
[figures.of_noisy]
query = ["noisy"]
kind = "summary"
column = "coverage"
[figures.both]
query = ["a=small", "b=twice"]
kind = "summary"
column = "coverage"
[figures.of_any]
kind = "box"
column = "coverage"
[figures.needs_noise]
kind = "summary"
column = "coverage"
x = "noise"
[queries.twice]
criteria = "population_size=1,2"
runs = 3
[paper_tables.numbers]
query = "noisy"
column = "coverage"
[comparisons.sizes]
query = "small"
by = "population_size"
column = "coverage"
"""
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = projects.make(tmp_path_factory.mktemp("bound") / "project", CONFIG)
    for query in ("small", "noisy"):
        assert projects.quick(made, "run", query, "--no-figures").returncode == 0
    return made


def batch(folder: Path, query: str, runs: int = 4) -> str:
    found = projects.quick(folder, "sql", f"SELECT batch FROM batches WHERE query = '{query}' AND runs = {runs}").stdout
    return found.split()[-1]


def drawn(folder: Path, *words: str) -> tuple[set[str], str]:
    """Return the figures and tables that are drawn, each with the beginning of its batch, and the messages."""
    done = projects.quick(folder, "figures", *words, "--json")
    assert done.returncode == 0, done.stderr
    files = map(Path, json.loads(done.stdout))
    return {f"{file.parent.name[:4]}/{file.stem}" for file in files}, done.stderr


@pytest.mark.integration
def test_a_batch_has_the_figures_of_its_query_and_those_of_any_that_fit(folder: Path) -> None:
    small, noisy = batch(folder, "population_size=1,2"), batch(folder, "noise=0.1,0.2", 6)
    names, notes = drawn(folder, small)
    assert names == {f"{small[:4]}/of_small", f"{small[:4]}/of_any"}
    assert notes == "", "a figure of another query is left out without a word"
    names, notes = drawn(folder)
    assert names == {f"{noisy[:4]}/{name}" for name in ("of_noisy", "of_any", "needs_noise", "numbers")}
    assert notes == ""


@pytest.mark.integration
def test_named_ones_show_the_last_batches_of_their_queries(folder: Path) -> None:
    small, noisy = batch(folder, "population_size=1,2"), batch(folder, "noise=0.1,0.2", 6)
    assert drawn(folder, "of_small", "numbers")[0] == {f"{small[:4]}/of_small", f"{noisy[:4]}/numbers"}
    assert drawn(folder, small, "of_noisy", "of_any")[0] == {f"{small[:4]}/of_noisy", f"{small[:4]}/of_any"}
    refused = projects.quick(folder, "figures", "of_text")
    assert refused.returncode == 2
    assert "the query 'noise=0.1,0.2' has not been run; run: sierra run noise=0.1,0.2" in refused.stderr
    refused = projects.quick(folder, "figures", "both")
    assert "the query 'twice' has not been run; run: sierra run twice" in refused.stderr
    compared = projects.quick(folder, "compare", "sizes", "--json", "--no-figure")
    assert small in compared.stdout
    assert noisy not in compared.stdout


@pytest.mark.integration
def test_several_queries_are_drawn_together_and_checked(tmp_path: Path) -> None:
    made = projects.make(tmp_path / "p", CONFIG)
    for query in ("small", "twice"):
        assert projects.quick(made, "run", query).returncode == 0
    names, _ = drawn(made, "both")
    small, twice = batch(made, "population_size=1,2"), batch(made, "population_size=1,2", 6)
    assert names == {f"{small[:10]}-{twice[:10]}"[:4] + "/both_a_b"}
    checked = projects.quick(made, "figures", small, "--check")
    assert checked.returncode == 0, checked.stdout
    assert "both_a_b: follows from the store" in checked.stdout


@pytest.mark.integration
def test_the_last_batch_counts_whatever_the_code_was(tmp_path: Path) -> None:
    made = projects.make(tmp_path / "p", CONFIG)
    assert projects.quick(made, "run", "small", "--no-figures").returncode == 0
    first = batch(made, "population_size=1,2")
    simulator = made / "sim.py"
    simulator.write_text(simulator.read_text() + "\n# changed\n")
    assert {name[:4] for name in drawn(made, "of_small")[0]} == {first[:4]}, "the code of no other batch"
    assert projects.quick(made, "run", "small", "--no-figures").returncode == 0
    second = projects.quick(made, "ls", "--json")
    last = json.loads(second.stdout)[-1]["batch"]
    assert last != first
    assert {name[:4] for name in drawn(made, "of_small")[0]} == {last[:4]}
    assert drawn(made, first)[0] == {f"{first[:4]}/of_any"}, "of_small shows the last batch only"


@pytest.mark.integration
def test_an_invalid_query_is_named_and_the_others_are_drawn(tmp_path: Path) -> None:
    made = projects.make(tmp_path / "p", CONFIG.replace('query = ["noisy"]', 'query = "smal"'))
    done = projects.quick(made, "run", "small")
    assert done.returncode == 0
    assert "figure of_noisy: query: 'smal' is not a query in sierra.toml; did you mean 'small'?" in done.stderr
    assert "of_small" in done.stdout


def test_keys_that_exclude_each_other_are_refused(tmp_path: Path) -> None:
    made = projects.make(tmp_path / "p", projects.CONFIG + '[comparisons.c]\nquery = "a"\ngroups = ["a", "b"]\n')
    refused = projects.quick(made, "compare", "c")
    assert refused.returncode == 2
    assert '"query" is one query, and needs "by"' in refused.stderr


@pytest.mark.integration
def test_a_named_query_has_a_target(tmp_path: Path) -> None:
    targets = '[queries.q]\ncriteria = "population_size=1"\nruns = 1\ntarget = "fast"\n[targets.slow]\n[targets.fast]\n'
    made = projects.make(tmp_path / "p", projects.CONFIG + targets)
    done = projects.quick(made, "run", "q", "--no-figures")
    assert done.returncode == 0, done.stderr
    assert "fast" in projects.quick(made, "sql", "SELECT target FROM sessions").stdout
    assert projects.quick(made, "run", "q", "--target", "slow", "--no-figures").returncode == 0
    assert "slow" in projects.quick(made, "sql", "SELECT target FROM sessions").stdout
