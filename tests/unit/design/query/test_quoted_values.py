"""Values in quotes reach the inputs, the store, conditions and the repetition of a batch as they were written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.projects import make, quick, run, sql

CONFIG = """\
template = "input.json"
command = "python3 sim.py {input} {law}"
seed = "/seed"
runs = 1
[variables]
law = "/law"
[queries.laws]
criteria = 'law="random walk",none'
"""
SIMULATOR = """\
import json, sys
with open(sys.argv[1]) as file:
    law = json.load(file)["law"]
with open("out.csv", "w") as file:
    print("same,length", sys.argv[2] == law, sep="\\n", end="," + str(len(law)) + "\\n", file=file)
"""
TEXTS = ("exponential(0.2s)", 'a "b", c', "{seed} and {project}", "龍 $1$", "1.10", " <x> ", "1")
QUERY = r'law="exponential(0.2s)","a \"b\", c","{seed} and {project}","龍 $1$","1.10"," <x> ","1"'


def project(folder: Path) -> Path:
    make(folder, CONFIG, simulator=SIMULATOR)
    (folder / "input.json").write_text('{"law": "", "seed": 0}')
    return folder


@pytest.mark.integration
def test_values_reach_inputs_the_store_and_a_repetition_of_the_batch(tmp_path: Path) -> None:
    folder = project(tmp_path / "project")
    done, _ = run(folder, QUERY)
    rows = sql(folder, "SELECT law, same, length FROM out JOIN batch_runs USING (run) ORDER BY ordinal")
    assert [(row["law"], row["same"], row["length"]) for row in rows] == [(text, True, len(text)) for text in TEXTS]
    assert sql(folder, "SELECT query FROM batches") == [{"query": QUERY}]
    again, _ = run(folder, str(done["batch"]))
    assert (again["batch"], again["executed"]) == (done["batch"], 0)
    assert quick(folder, "why", str(done["batch"])).stdout.endswith(": reused\n")


def selected(folder: Path, query: str, condition: str) -> int:
    done = quick(folder, "run", query, "--only", condition, "-n", "--json")
    assert done.returncode == 0, done.stderr
    return int(json.loads(done.stdout)["selected"])


def test_conditions_have_values_in_quotes(tmp_path: Path) -> None:
    folder = project(tmp_path / "project")
    assert selected(folder, QUERY, r'law="exponential(0.2s)" , "a \"b\", c"') == 2
    assert selected(folder, QUERY, 'law != "{seed} and {project}" and law != "龍 $1$"') == len(TEXTS) - 2
    assert selected(folder, QUERY, 'law=1,"1.10"') == 2
    done = quick(folder, "run", QUERY, "--only", "law=none")
    assert done.stderr.count("\n") == 1
    assert 'law is never none; law is "exponential(0.2s)", "a' in done.stderr


def test_a_label_may_be_in_quotes(tmp_path: Path) -> None:
    groups = (
        '[controllers.rw]\nlabel = "random walk"\nchanges = [{ set = "/law", value = "x" }]\n[controllers.b]\nchanges = []\n'
    )
    folder = project(tmp_path / "project")
    (folder / "sierra.toml").write_text(CONFIG.replace(" {law}", "") + groups)
    assert selected(folder, "controller=rw,b", 'controller="random walk"') == 1


def test_named_queries_and_their_batches_have_values_in_quotes(tmp_path: Path) -> None:
    folder = project(tmp_path / "project")
    first = json.loads(quick(folder, "run", "laws", "-n", "--json").stdout)
    other = json.loads(quick(folder, "run", 'law="random walk","none"', "-n", "--json").stdout)
    assert first["batch"] == other["batch"]
    assert first["query"] == 'law="random walk",none'


def test_the_message_shows_what_to_type_in_a_shell(tmp_path: Path) -> None:
    done = quick(project(tmp_path / "project"), "run", "law=exponential(0.2s)")
    assert done.returncode == 2
    assert done.stderr.endswith("use 'law=\"exponential(0.2s)\"'\n")
