"""Simulators with odd inputs and outputs: `sierra init` and `sierra run` are enough to get the right tables."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.projects import quick

ODD = Path(__file__).parents[2] / "data" / "odd"
USUAL = ("--command", "python3 sim.py --robots 4 --seed 1")
SHEEP = "sheep=//enumeratedValueSet[@variable='initial-sheep']/value/@value"
UNITY = "python3 unity_sim.py -batchmode -nographics -config scenario.json"
pytestmark = pytest.mark.integration


class Simulator(NamedTuple):
    """One of the folders: the words of `sierra init`, a query, and each table's rows of a run, columns and time."""

    folder: str
    words: Sequence[str]
    query: str
    tables: Mapping[str, tuple[int, Sequence[str], str]]


SIMULATORS = (
    Simulator("a_comment", USUAL, "population_size=2,4", {"log": (20, ["time", "x", "energy"], "time")}),
    Simulator("b_decimal", USUAL, "population_size=2,4", {"log": (20, ["Zeit", "Energie", "Ort"], "Zeit")}),
    Simulator("c_timestep", USUAL, "population_size=2,4", {"log": (20, ["run_id", "timestep", "found", "alive"], "timestep")}),
    Simulator("e_header", USUAL, "population_size=2,4", {"log": (20, ["time", "score"], "time")}),
    Simulator("g3_ignores", USUAL, "population_size=2,4", {"log": (10, ["time", "score"], "time")}),
    Simulator(
        "h_stdout",
        USUAL,
        "population_size=2,4",
        {"lines": (5, ["step", "score"], "step"), "result": (1, ["coverage", "collisions"], "")},
    ),
    Simulator(
        "i_env",
        ("--command", "python3 sim.py", "--variable", "robots=N_ROBOTS"),
        "robots=2,4",
        {"log": (10, ["time", "score"], "time")},
    ),
    Simulator("i2_envfile", ("--command", "python3 sim.py"), "population_size=5,10", {"log": (10, ["time", "score"], "time")}),
    Simulator("k_success", USUAL, "population_size=2,4", {"result": (1, ["success", "steps"], "")}),
    Simulator(
        "netlogo",
        ("--variable", SHEEP),
        "sheep=50,100",
        {"wolf": (31, ["[run number]", "initial-sheep", "[step]", "count sheep"], "[step]")},
    ),
    Simulator(
        "px4",
        ("--template", "iris.params", "--format", "text"),
        "rollrate_p=0.1,0.2",
        {"log": (50, ["timestamp", "att_err"], "timestamp")},
    ),
    Simulator(
        "unity",
        ("--command", UNITY, "--variable", "maxSpeed=//agents//maxSpeed"),
        "maxSpeed=1,2",
        {
            "result": (
                60,
                [
                    "tick",
                    "time",
                    "agents.name",
                    "agents.pose.x",
                    "agents.pose.z",
                    "metrics.spread",
                    "metrics.collisions",
                ],
                "tick",
            )
        },
    ),
)


def made(tmp_path: Path, name: str) -> Path:
    return Path(shutil.copytree(ODD / name, tmp_path / name))


def outputs(folder: Path) -> dict[str, Any]:
    return {table["name"]: table for table in json.loads(quick(folder, "outputs", "--json").stdout)["tables"]}


@pytest.mark.parametrize("simulator", [pytest.param(one, id=one.folder) for one in SIMULATORS])
def test_two_commands_lead_to_the_right_tables(tmp_path: Path, simulator: Simulator) -> None:
    folder = made(tmp_path, simulator.folder)
    init = quick(folder, "init", "-y", *simulator.words)
    assert init.returncode == 0, init.stderr
    ran = quick(folder, "run", simulator.query, "--runs", "2")
    assert ran.returncode == 0, ran.stderr
    found = outputs(folder)
    told = {
        name: (table["most"], [column["name"] for column in table["columns"]], table["time"]) for name, table in found.items()
    }
    assert told == dict(simulator.tables)
    assert all(table["least"] == table["most"] for table in found.values())
    numbers = {column["type"] for table in found.values() for column in table["columns"] if column["name"] != "agents.name"}
    assert numbers <= {"BIGINT", "DOUBLE"}
    assert "run_id" not in ran.stdout.partition("figures:")[2]


def test_files_of_robots_become_one_table_whose_figures_show_the_mean_of_the_robots(tmp_path: Path) -> None:
    folder = made(tmp_path, "d_robots")
    assert quick(folder, "init", "-y", *USUAL).returncode == 0
    ran = quick(folder, "run", "population_size=2,4", "--runs", "2")
    assert ran.returncode == 0
    assert {(row["robot"], row["n"]) for row in _rows(folder, "SELECT robot, count(*) / 2 AS n FROM robot GROUP BY robot")} == {
        (0, 40),
        (1, 40),
        (2, 20),
        (3, 20),
    }
    figures = [line.split()[0] for line in ran.stdout.partition("figures:")[2].splitlines() if ".png" in line]
    assert len(figures) == 6, "two of each of x, y and battery"
    mean = quick(folder, "stats", "robot", "battery", "--json").stdout
    own = "SELECT avg(m) AS m FROM (SELECT run, avg(battery) AS m FROM robot WHERE population_size = 4 AND t = 19 GROUP BY run)"
    assert json.loads(mean)[-1]["mean"] == pytest.approx(_rows(folder, own)[0]["m"], rel=1e-12)


def test_other_numbers_of_agents_are_copies_of_the_first(tmp_path: Path) -> None:
    folder = made(tmp_path, "unity")
    assert quick(folder, "init", "-y", "--command", UNITY).returncode == 0
    written = (folder / "sierra.toml").read_text()
    assert '# population_size = { repeat = "/agents/item[1]" }\n' in written
    (folder / "sierra.toml").write_text(written.replace("# population_size = { repeat", "population_size = { repeat"))
    assert quick(folder, "run", "population_size=1,4", "--runs", "2", "--no-figures").returncode == 0
    rows = _rows(folder, "SELECT population_size AS p, count(*) / count(DISTINCT run) AS n FROM result GROUP BY p ORDER BY p")
    assert [(row["p"], row["n"]) for row in rows] == [(1, 20), (4, 80)]


def test_a_file_elsewhere_is_named_with_the_way_to_record_it(tmp_path: Path) -> None:
    folder = made(tmp_path, "f_abspath")
    elsewhere = tmp_path / "elsewhere"
    (folder / "sim.py").write_text((folder / "sim.py").read_text().replace("/tmp/out_fixed", str(elsewhere)))
    init = quick(folder, "init", "-y", *USUAL)
    assert init.returncode == 0
    assert f"note: runs wrote files elsewhere: {elsewhere}" in init.stderr
    assert "to keep such a file, pass {output} to the program in command" in init.stderr
    assert quick(folder, "run", "population_size=2,4", "--runs", "1", "--no-figures").returncode == 0
    assert outputs(folder) == {}


def test_a_seed_without_effect_is_noted_at_once(tmp_path: Path) -> None:
    folder = made(tmp_path, "g3_ignores")
    assert "does the program use its seed?" in quick(folder, "init", "-y", *USUAL).stderr
    assert "does the program use its seed" in quick(folder, "run", "population_size=2,4", "--runs", "2").stderr


def test_a_column_of_0_and_1_is_a_rate(tmp_path: Path) -> None:
    folder = made(tmp_path, "k_success")
    (folder / "sim.py").write_text(
        (folder / "sim.py")
        .read_text()
        .replace("r.random()<0.7", "SEED%2")
        .replace("import sys,random", "import sys,random\nSEED=int(sys.argv[sys.argv.index('--seed')+1])")
    )
    assert quick(folder, "init", "-y", *USUAL).returncode == 0
    assert 'rates = ["success"]' in (folder / "sierra.toml").read_text()


def script(tmp_path: Path, text: str) -> Path:
    (tmp_path / "sim.py").write_text(f"import random, sys\nseed = int(sys.argv[-1])\nrandom.seed(seed)\n{text}")
    return tmp_path


SEEDED = ("--command", "python3 sim.py --robots 4 --seed 1")


def test_a_table_that_is_read_stays_as_it_is(tmp_path: Path) -> None:
    folder = script(tmp_path, "open('hits.csv', 'w').write('colour,count\\n#ff0000,3\\nred,4\\n#00ff00,5\\n')\n")
    assert quick(folder, "init", "-y", *SEEDED).returncode == 0
    assert "\n[outputs." not in (folder / "sierra.toml").read_text()
    assert quick(folder, "run", "population_size=1", "--runs", "2", "--no-figures").returncode == 0
    quick(folder, "outputs", "--write")
    assert "comment" not in (folder / "sierra.toml").read_text()
    assert quick(folder, "run", "population_size=1", "--runs", "2", "--no-figures").returncode == 0
    assert outputs(folder)["hits"]["most"] == 3


def test_many_files_of_robots_and_those_in_folders_have_robots_and_not_ticks(tmp_path: Path) -> None:
    text = "for r in range(30):\n    open(f'robot_{r}.csv', 'w').write(f'distance\\n{r}\\n')\n"
    folder = script(tmp_path, text)
    assert quick(folder, "init", "-y", *SEEDED).returncode == 0
    assert 'file = "robot_{robot}.csv"' in (folder / "sierra.toml").read_text()
    assert quick(folder, "run", "population_size=1", "--runs", "2", "--no-figures").returncode == 0
    stats = json.loads(quick(folder, "stats", "robot", "distance", "--json").stdout)
    assert [row["mean"] for row in stats] == [14.5]


def test_names_beyond_ascii_are_valid_toml(tmp_path: Path) -> None:
    folder = script(tmp_path, "open('größe.csv', 'w').write('Zeit;E\\n0;1,5\\n1;2,5\\n')\n")
    assert quick(folder, "init", "-y", *SEEDED).returncode == 0
    assert '[outputs."größe"]' in (folder / "sierra.toml").read_text()
    assert quick(folder, "run", "population_size=1", "--runs", "2", "--no-figures").returncode == 0


def test_a_seed_with_which_the_run_fails_is_noted(tmp_path: Path) -> None:
    folder = script(tmp_path, "print('result=success time=3.5' if seed % 2 == 0 else 'result=timeout time=60.5')\n")
    said = json.loads(quick(folder, "init", "--json", *SEEDED).stdout)
    assert [note for note in said["notes"] if note.startswith("a run with seed ") and "failed: " in note]
    assert list(said["outputs"]) == ["result"]


SHELL = """\
#!/bin/sh
: "${ROBOTS:=3}" "${FAIL:=0.01}" "${SEED:=1}"
LENGTH=${LENGTH:-40}
OUT=log.csv
printf 'time,alive\\n0,%s\\n1,%s%s\\n' "$ROBOTS" "$LENGTH" "$SEED" > $OUT
"""


@pytest.mark.parametrize("command", ["./patrol.sh", "ROBOTS=2 FAIL=0.5 SEED=7 ./patrol.sh"])
def test_defaults_of_a_shell_script_stay(tmp_path: Path, command: str) -> None:
    (tmp_path / "patrol.sh").write_text(SHELL)
    (tmp_path / "patrol.sh").chmod(0o755)
    assert quick(tmp_path, "init", "-y", "--command", command).returncode == 0
    written = (tmp_path / "sierra.toml").read_text()
    assert 'seed = { environment = "SEED" }' in written
    assert 'population_size = { environment = "ROBOTS" }' in written
    assert "LENGTH = " not in written
    assert ('set = { FAIL = "0.5" }' in written) == command.startswith("ROBOTS")
    assert quick(tmp_path, "run", "population_size=1,4", "--runs", "2", "--no-figures").returncode == 0
    assert outputs(tmp_path)["log"]["most"] == 2


def test_an_option_of_the_command_and_of_a_variable_is_noted(tmp_path: Path) -> None:
    folder = made(tmp_path, "g3_ignores")
    assert quick(folder, "init", "-y", *USUAL).returncode == 0
    written = (folder / "sierra.toml").read_text()
    (folder / "sierra.toml").write_text(written.replace("{arguments}", "{arguments} --robots 4"))
    said = quick(folder, "run", "population_size=1,2", "-n").stderr
    assert (
        "note: the command has '--robots', which the variable 'population_size' adds too: one of the two has no effect" in said
    )


@pytest.mark.nightly
def test_the_output_of_ngspice_is_a_table_without_names(tmp_path: Path, require: Callable[..., str]) -> None:
    require("ngspice", there=shutil.which("ngspice") is not None)
    folder = made(tmp_path, "ng")
    words = ("--template", "rc.cir", "--format", "text", "--command", "ngspice -b {input}")
    assert quick(folder, "init", "-y", *words).returncode == 0
    written = (folder / "sierra.toml").read_text()
    assert '# columns = ["time", "x"]  # the file has no names; write one for each column\n' in written
    (folder / "sierra.toml").write_text(written.replace('# columns = ["time", "x"]', 'columns = ["time", "v"]'))
    assert quick(folder, "run", "rval=1000,2000", "--runs", "2", "--no-figures").returncode == 0
    [table] = outputs(folder).values()
    assert ([column["name"] for column in table["columns"]], table["time"]) == (["time", "v"], "time")


def _rows(folder: Path, query: str) -> list[dict[str, Any]]:
    return list(json.loads(quick(folder, "sql", query, "--format", "json").stdout))
