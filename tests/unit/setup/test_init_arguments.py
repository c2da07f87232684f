"""`sierra init` for programs without a template: the arguments of a given command become variables, seed and output."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.projects import quick
from tests.unit.setup.test_init import answering

MODEL = """\
import argparse, os
parser = argparse.ArgumentParser()
parser.add_argument("--robots", type=int, required=True)
parser.add_argument("--max-speed", type=float, required=True)
parser.add_argument("--seed", type=int, required=True)
parser.add_argument("--out", required=True)
given = parser.parse_args()
with open(os.path.join(given.out, "swarm.csv"), "w") as file:
    print("tick,covered", 0, given.robots * given.max_speed + given.seed % 7, sep="\\n0,", file=file)
"""
GIVEN = "python3 model.py --robots 4 --max-speed=0.5 --seed 1 --out results/"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "model.py").write_text(MODEL)
    (tmp_path / "results").mkdir()
    return tmp_path


def settings(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "sierra.toml").read_text())


@pytest.mark.integration
def test_arguments_become_a_variable_the_seed_and_the_output_and_what_is_written_runs(folder: Path) -> None:
    done = quick(folder, "init", "--json", "--command", GIVEN)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["template"], said["next"], said["notes"]) == (None, "sierra run population_size.Log8 -n", [])
    assert (said["tried"]["status"], said["tried"]["values"]) == ("ok", {"population_size": 4})
    assert settings(folder) == {
        "command": "python3 model.py {arguments} --max-speed=0.5 --seed {seed} --out {output}",
        "runs": 10,
        "variables": {"population_size": {"argument": "--robots {value}"}},
    }
    assert '# max_speed = { argument = "--max-speed={value}" }' in (folder / "sierra.toml").read_text()
    ran = quick(folder, "run", "population_size=1,2", "--runs", "2", "--no-figures", "--json")
    assert json.loads(ran.stdout)["failed"] == 0
    found = json.loads(
        quick(folder, "sql", "--json", "SELECT count(DISTINCT covered) AS n FROM swarm WHERE covered > 0").stdout
    )
    assert found == [{"n": 4}]  # the variable and the seed have an effect
    assert not list((folder / "results").iterdir())


@pytest.mark.parametrize(
    ("given", "command", "variables"),
    [
        ("./sim robots=4 rng=7 log=a.txt", "./sim {arguments} rng={seed} log=a.txt", {"population_size": "robots={value}"}),
        ("./sim -n 4 --quiet in.csv", "./sim {arguments} --quiet in.csv", {"population_size": "-n {value}"}),
        ("./sim --threads 4 --mode fast", "./sim --threads 4 --mode fast", {}),
        ("./sim --noise -0.5 --RngRun=3", "./sim {arguments} --RngRun={seed}", {"noise": "--noise {value}"}),
        ("./sim run --seed 1 --robots 8", "./sim run --seed {seed}", {"population_size": "--robots {value}"}),
        ("./sim -carla-rpc-port=2000 --seed 1", "./sim -carla-rpc-port={port} --seed {seed}", {}),
        (
            "./sim --port 9 --remote-port 8813 --zmqPort=5555 --url tcp://localhost:8813 --report yes",
            "./sim --port 9 --remote-port {port} --zmqPort={port2} --url tcp://localhost:{port} --report yes",
            {},
        ),
        ("./sim --server sim.py --port 2000", "./sim --server sim.py --port {port}", {}),
        ("./sim --host lic.example.org --port 2000", "./sim --host lic.example.org --port 2000", {}),
        ("python3 -W 1 sim.py --out=/tmp/a/x.csv -v 2", "python3 -W 1 sim.py --out={output}/x.csv", {"v": "-v {value}"}),
    ],
)
def test_each_spelling_of_an_argument_is_recognised(
    tmp_path: Path, given: str, command: str, variables: dict[str, str]
) -> None:
    (tmp_path / "sim.py").write_text("")
    assert quick(tmp_path, "init", "-y", "--no-try", "--command", given).returncode == 0
    assert settings(tmp_path)["command"] == command
    assert settings(tmp_path)["variables"] == {name: {"argument": words} for name, words in variables.items()}


def test_placeholders_in_the_command_are_variables(folder: Path) -> None:
    done = quick(folder, "init", "-y", "--command", "python3 model.py --robots {population_size} --seed {seed} --out {output}")
    assert done.returncode == 1, "the program needs --max-speed too"
    assert "--out {output}' with population_size=1 failed: exit status 2; " in done.stderr
    assert "next: sierra run population_size=1,2 -n" in done.stdout
    assert settings(folder)["variables"] == {"population_size": {}}


@pytest.mark.nightly
def test_options_choose_other_arguments(folder: Path) -> None:
    words = ("--command", GIVEN, "--variable", "speed=--max-speed", "--variable", "team=robots", "--seed", "-")
    done = quick(folder, "init", "-y", *words)
    assert done.returncode == 0
    assert 'seed = { argument = "--seed {value}" }' in done.stderr
    found = settings(folder)
    assert found["command"] == "python3 model.py {arguments} --seed 1 --out {output}"
    assert {name: table["argument"] for name, table in found["variables"].items()} == {
        "speed": "--max-speed={value}",
        "team": "--robots {value}",
    }


def test_wrong_options_are_errors_in_one_line(folder: Path) -> None:
    for words, said in (
        (["--variable", "x=--robot"], "no argument '--robot' with a value; it has --robots, --max-speed, --seed, --out"),
        (["--variable", "robots"], "give a variable as NAME=ARGUMENT"),
        (["--variable", "run=--robots"], "run"),
        (["--variable", "x=--seed"], "--seed gets the seed"),
        (["--seed", "--sede"], "no argument '--sede'"),
    ):
        done = quick(folder, "init", "-y", "--command", GIVEN, *words)
        assert said in done.stderr
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert not (folder / "sierra.toml").exists()


@pytest.mark.integration
def test_a_program_that_fails_with_its_arguments_leaves_a_file_to_correct(folder: Path) -> None:
    done = quick(folder, "init", "-y", "--command", "python3 model.py --robots many --seed 1")
    assert done.returncode == 1
    assert "invalid int value" in done.stderr
    assert settings(folder)["command"] == "python3 model.py --robots many --seed {seed}"


def test_a_file_that_could_be_a_template_is_named_if_it_is_not_used(folder: Path) -> None:
    (folder / "world.xml").write_text("<world/>")
    done = quick(folder, "init", "-y", "--no-try", "--command", GIVEN)
    assert "note: the command has no {input}, so that runs do not depend on world.xml\n" in done.stderr
    assert "template" not in settings(folder)


def test_a_folder_with_a_program_alone_asks_for_a_template_or_arguments(folder: Path) -> None:
    done = quick(folder, "init", "-y")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "give the template with --template FILE, or the arguments of a program that reads none" in done.stderr


@pytest.mark.nightly
def test_arguments_are_asked_for_on_a_terminal(folder: Path) -> None:
    code, said = answering(folder, "", GIVEN, "", "speed=--max-speed", "", "")
    assert code == 0, said
    assert "the file from which the inputs of all runs are generated (- if the program reads only arguments)" in said
    assert "argument that gets each run's seed" in said
    assert list(settings(folder)["variables"]) == ["population_size", "speed"]
