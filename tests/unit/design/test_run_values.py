"""Values of variables in the command and the environment of runs, without a template."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.projects import TEMPLATE, quick, run, sql

SIMULATOR = """\
import json, os, sys

with open("told.json", "w") as file:
    json.dump([sys.argv[1:], os.environ.get("SPEED"), os.environ.get("SEED")], file)
with open("out.csv", "w") as file:
    print("tick,value", file=file)
    print(0, len(sys.argv), sep=",", file=file)
"""
CONFIG = """\
command = "python3 sim.py --robots={population_size} {arguments} --last"
runs = 1
seed = { argument = "--seed {value}", environment = "SEED" }
[variables]
population_size = {}
max_speed = { argument = "--speed {value}", environment = "SPEED" }
kind = { argument = ["--kind", "a {value}"] }
"""


def make(folder: Path, config: str = CONFIG) -> Path:
    folder.mkdir()
    (folder / "sim.py").write_text(SIMULATOR)
    (folder / "sierra.toml").write_text(config)
    return folder


def told(folder: Path) -> list[list[object]]:
    """Return what the programs of all runs were told, in the order of the batch."""
    runs = [str(row["run"]) for row in sql(folder, "SELECT run FROM batch_runs ORDER BY ordinal, number")]
    found = []
    for one in runs:
        done = quick(folder, "files", one, "told.json")
        assert done.returncode == 0, done.stderr
        found.append(json.loads(done.stdout))
    return found


def refused(folder: Path, *words: str) -> str:
    done = quick(folder, "run", *words, "--dry-run")
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert done.stderr.count("\n") == 1
    return done.stderr


@pytest.mark.integration
def test_a_project_without_a_template_gives_values_to_command_and_environment(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    summary, noted = run(root, "population_size=1,2", "max_speed=0.5")
    seed = str(sql(root, "SELECT DISTINCT seed FROM runs")[0]["seed"])
    assert noted == ""
    assert told(root) == [[[f"--robots={count}", "--speed", "0.5", "--seed", seed, "--last"], "0.5", seed] for count in (1, 2)]
    assert run(root, "population_size=1,2", "max_speed=0.5")[0]["executed"] == 0
    assert quick(root, "fsck").returncode == 0
    assert summary["batch"]


@pytest.mark.integration
def test_a_value_is_one_word_unless_the_argument_has_several(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    run(root, "population_size=1", "kind=x-y.z")
    words = told(root)[0][0]
    assert isinstance(words, list)
    assert words[1:3] == ["--kind", "a x-y.z"]


@pytest.mark.nightly
def test_arguments_follow_the_command_if_it_has_no_place_for_them(tmp_path: Path) -> None:
    root = make(tmp_path / "p", CONFIG.replace(" {arguments}", ""))
    run(root, "population_size=1", "max_speed=3")
    words = told(root)[0][0]
    assert isinstance(words, list)
    assert words[:4] == ["--robots=1", "--last", "--speed", "3"]


@pytest.mark.integration
def test_values_are_part_of_the_identity_of_runs(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    run(root, "population_size=1,2", "max_speed=1")
    first = {str(row["run"]) for row in sql(root, "SELECT run FROM runs")}
    assert run(root, "population_size=1,2,3", "max_speed=1")[0]["executed"] == 1
    (root / "sierra.toml").write_text(CONFIG.replace('environment = "SPEED"', 'environment = "PACE"'))
    assert run(root, "population_size=1,2", "max_speed=1")[0]["executed"] == 2
    assert len(first) == 2


@pytest.mark.integration
def test_a_replay_executes_the_recorded_values(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    summary, _ = run(root, "population_size=1,2", "max_speed=0.5")
    (root / "sierra.toml").write_text(
        'command = "python3 sim.py {other}"\nruns = 1\nseed = { argument = "-s {value}" }\n[variables]\nother = {}\n'
    )
    done = quick(root, "replay", summary["batch"])
    assert done.returncode == 0, done.stderr
    assert "2 identical" in done.stdout


@pytest.mark.nightly
def test_show_has_the_command_of_the_run(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    run(root, "population_size=4", "max_speed=0.5")
    [row] = sql(root, "SELECT run, seed FROM runs")
    shown = json.loads(quick(root, "show", str(row["run"]), "--json").stdout)
    assert shown["command"][1:] == [
        "{project}/sim.py", "--robots=4", "--speed", "0.5", "--seed", str(row["seed"]), "--last",
    ]  # fmt: skip


@pytest.mark.nightly
def test_values_and_a_template_can_be_mixed(tmp_path: Path) -> None:
    root = make(
        tmp_path / "p",
        'template = "arena.xml"\ncommand = "python3 sim.py {input}"\nruns = 1\nseed = "//random/@seed"\n'
        '[variables]\npopulation_size = { set = "//swarm/@count", argument = "-n {value}" }\nnoise = "//noise"\n',
    )
    (root / "arena.xml").write_text(TEMPLATE)
    run(root, "population_size=4", "noise=1")
    words = told(root)[0][0]
    assert isinstance(words, list)
    assert words[1:] == ["-n", "4"]
    run(root, "noise=1")  # the same specification, but without the argument
    assert [row["files"] for row in sql(root, "SELECT files FROM specs ORDER BY len(files)")] == [
        ["input.xml"],
        ["input.xml", "sierra_values.json"],
    ]
    assert quick(root, "fsck").returncode == 0


@pytest.mark.nightly
def test_names_of_controllers_can_be_in_the_command(tmp_path: Path) -> None:
    root = make(tmp_path / "p", 'command = "python3 sim.py {controller} {seed}"\nruns = 1\n')
    run(root, "controller=calm,wild")
    assert [words[0] for words, *_ in told(root)] == ["calm", "wild"]  # type: ignore[index]


@pytest.mark.nightly
def test_braces_of_a_value_stay_as_they_are(tmp_path: Path) -> None:
    config = 'command = "python3 sim.py {label} {seed} {{label}} {Other}"\nruns = 1\n[per_run]\nlabel = ["{seed} \'x; y"]\n'
    root = make(tmp_path / "p", config)
    run(root, "montecarlo.C1")
    words = told(root)[0][0]
    assert isinstance(words, list)
    assert [words[0], *words[2:]] == ["{seed} 'x; y", "{label}", "{Other}"]


@pytest.mark.parametrize(
    ("old", "new", "query", "told"),
    [
        ("population_size = {}", "population_size = {}\nidle = { label = 'x' }", "population_size=1",
         "variables.idle: it changes nothing; give it"),
        ("{arguments} ", "", "max_speed=1", "the command uses {population_size}; add population_size=… to the query"),
        ("--speed {value}", "--speed", "population_size=1", "'--speed' should contain {value}, as in --robots {value}"),
        ("--speed {value}", "--speed '{value}", "population_size=1", "variables.max_speed.argument: No closing quotation"),
        ('"SPEED"', '"PATH"', "population_size=1", "no value can be given in PATH"),
        ('"SPEED"', '"SEED"', "population_size=1", "seed and max_speed both set the environment variable SEED"),
        ("python3 sim.py", "python3 sim.py {input}", "population_size=1",
         "command: {input} in '{input}': there is no template; remove it, or set template"),
        ("python3 sim.py", "{population_size} sim.py", "population_size=1",
         "command: a value of 'population_size' cannot choose the program"),
        ("python3 sim.py", "sh -c 'python3 sim.py {population_size}'", "population_size=1",
         "command: sh would execute a value of 'population_size' in 'python3 sim.py {population_size}' as code"),
        ("[variables]", "[variables]\nspeed = '//speed'", "population_size=1 speed=1", "there is no template for '//speed'"),
        ("[variables]", "[variables]\noutput = { argument = '-o {value}' }", "population_size=1",
         "variables.output: in a command, {output} has another meaning"),
        ("[variables]", "[environment]\nset = { SPEED = 1 }\n[variables]", "population_size=1",
         "[environment] and max_speed both set the environment variable SPEED"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_before_anything_runs(tmp_path: Path, old: str, new: str, query: str, told: str) -> None:
    assert old in CONFIG
    root = make(tmp_path / "p", CONFIG.replace(old, new, 1))
    assert told in refused(root, *query.split())


def test_set_without_a_template_is_refused(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    assert "there is no template for '//a'" in refused(root, "population_size=1", "--set", "//a=1")


def test_a_file_that_only_a_value_names_is_reported(tmp_path: Path) -> None:
    root = make(tmp_path / "p", 'command = "python3 sim.py {project}/data/{map}.txt {seed}"\nruns = 1\n[variables]\nmap = {}\n')
    (root / "data").mkdir()
    (root / "data" / "one.txt").write_text("1")
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + '[source]\npaths = ["sim.py"]\n')
    done = quick(root, "run", "map=one,two", "--dry-run")
    assert "data/one.txt is named only by the query: changes of this file are not detected" in done.stderr


@pytest.mark.integration
def test_doctor_accepts_a_project_without_a_template(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    done = quick(root, "doctor")
    assert "template" in done.stdout
    assert "unknown placeholder" not in done.stdout


PLACED = """
command = "python3 tell.py"
template = "in.json"
seed = "/seed"
runs = 2
[variables]
robots = "/robots"
[environment]
pass = ["CALLER"]
set = { TOLD = "{robots} {seed} {input} {output} {{seed}} {other} {project}", SPEED = "{speed}" }
"""


TELL = """
import os
robots, seed, file, folder, literal, other, project = os.environ["TOLD"].split()
same = (os.path.dirname(file) == os.path.dirname(folder), os.path.samefile(folder, "."), os.path.exists(project + "/tell.py"))
with open("told.csv", "w") as told:
    print("tick,robots,seed,placed_in,literal,other,same,caller", file=told)
    print(0, robots, seed, os.path.basename(file), literal, other, all(same), os.environ.get("CALLER"), sep=",", file=told)
"""


def placed(folder: Path, config: str = PLACED) -> Path:
    folder.mkdir()
    (folder / "tell.py").write_text(TELL)
    (folder / "in.json").write_text('{"robots": 1, "seed": 1}')
    (folder / "sierra.toml").write_text(config.replace('SPEED = "{speed}"', 'SPEED = "{robots}"'))
    return folder


def test_variables_of_the_environment_have_the_placeholders_of_commands(tmp_path: Path) -> None:
    root = placed(tmp_path / "p")
    run(root, "robots=2,4")
    right = "r.robots = t.robots AND r.seed = t.seed AND same AS fits"
    rows = sql(root, f"SELECT r.seed, {right}, placed_in, literal, other FROM told t JOIN runs r USING (run)")
    assert len({row.pop("seed") for row in rows}) == 2
    expected = {"fits": True, "placed_in": "input.json", "literal": "{seed}", "other": "{other}"}
    assert rows == [expected] * 4
    assert run(root, "robots=2,4")[0]["executed"] == 0
    assert quick(root, "replay", str(sql(root, "SELECT batch FROM batches")[0]["batch"])).returncode == 0


def test_what_is_passed_from_the_caller_is_a_text_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CALLER", "{seed} {run.seed} {run..robots} {robots} {Robots}")
    root = placed(tmp_path / "p")
    run(root, "robots=2")
    assert {row["caller"] for row in sql(root, "SELECT caller FROM told")} == {
        "{seed} {run.seed} {run..robots} {robots} {Robots}"
    }


def test_passed_texts_use_no_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = 'command = "python3 sim.py {a}"\nruns = 1\n[variables]\na = {}\n[environment]\npass = ["CALLER"]\n'
    root = make(tmp_path / "p", config)
    monkeypatch.setenv("CALLER", "{run.seed} {run.a}")
    done = quick(root, "run", "a=1", "--runs", "2", "--dry-run")
    assert "neither inputs nor command contain the seed" in done.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{input.other} {speed}", "[environment] TOLD: {input.other} in '{input.other} {speed}' is no template"),
        ("{speed}", "[environment] TOLD uses {speed}; add speed=… to the query"),
        ("{robots} {speed} {controller}", "[environment] TOLD uses {controller}, but no controller is chosen"),
    ],
)
def test_a_placeholder_that_nothing_fills_in_is_refused(tmp_path: Path, text: str, message: str) -> None:
    config = PLACED.replace("{robots} {seed} {input} {output} {{seed}} {other} {project}", text)
    root = placed(tmp_path / "p", config.replace('robots = "/robots"', 'robots = "/robots"\nspeed = {}'))
    varied = ("speed=1",) if " {speed}" in text else ()
    assert message in refused(root, "robots=2", *varied)


def test_programs_are_not_looked_for_where_values_say(tmp_path: Path) -> None:
    root = placed(tmp_path / "p", PLACED.replace("SPEED =", "PATH ="))
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text().replace('"{speed}"', '"/x/{robots}:/bin"'))
    assert "[environment] PATH: {robots} differs between runs, but PATH says where programs are" in refused(root, "robots=2")


def test_files_that_values_name_in_variables_are_noted(tmp_path: Path) -> None:
    config = 'command = "sh sim.sh"\nruns = 1\n[source]\npaths = ["sim.sh"]\n[variables]\nmap = {}\n[environment]\n'
    root = make(tmp_path / "p", config + 'set = { MAP = "{project}/maps/{map}.csv" }\n')
    (root / "sim.sh").write_text('cp "$MAP" out.csv\n')
    (root / "maps").mkdir()
    (root / "maps" / "a.csv").write_text("tick,value\n0,1\n")
    done = quick(root, "run", "map=a", "--dry-run")
    assert "maps/a.csv" in done.stderr
    assert "changes of" in done.stderr
