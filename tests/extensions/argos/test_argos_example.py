"""The example for ARGoS: its inputs and its script, its figures with an imitation of `argos3`, and real runs where ARGoS is."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from lxml import etree

from tests import projects

ARGOS = """\
import random, re, sys
import xml.etree.ElementTree as tree

assert sys.argv[1:3] == ["-n", "-c"]
root = tree.parse(sys.argv[3]).getroot()
params = root.find("controllers/lua_controller/params")
script = open(params.get("script")).read()
header = re.search(r'file:write\\("(.*)\\\\n"\\)', script)[1]
experiment = root.find("framework/experiment")
chance = random.Random(int(experiment.get("random_seed")))
ticks = int(experiment.get("length")) * int(experiment.get("ticks_per_second"))
for robot in range(int(root.find("arena/distribute/entity").get("quantity"))):
    collected = 0
    with open(f"fb{robot}.csv", "w") as file:
        print(header, file=file)
        for tick in range(10, ticks + 1, 10):
            collected += chance.random() < 0.02
            print(tick, *[f"{chance.uniform(-1.7, 1.7):.6f}" for _ in "xy"], 0, collected, 0, sep=",", file=file)
if params.get("speed") == "13":
    print('[FATAL] Error calling "step"', file=sys.stderr)
"""
"""A program with the command line, the input and the files of the example in ARGoS; 13 cm/s is an error in the script."""

ROOT = Path(__file__).parents[3]
TICKS = range(10, 1201, 10)
ENDS = "SELECT population_size AS n, sum(collected) AS food FROM foragers WHERE tick = 1200 GROUP BY run, n ORDER BY n"


@pytest.fixture
def demo(tmp_path: Path) -> Path:
    done = projects.quick(tmp_path, "init", "--example", "argos", "demo")
    assert done.returncode == 0, done.stderr
    return tmp_path / "demo"


@pytest.fixture
def without_argos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))


@pytest.fixture
def imitated(demo: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the example; a script stands for `argos3`."""
    program = demo.parent / "bin" / "argos3"
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\n{ARGOS}")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    return demo


@pytest.mark.integration
@pytest.mark.usefixtures("without_argos")
def test_the_inputs_have_their_population_seed_length_and_script_without_argos(demo: Path) -> None:
    planned = projects.quick(demo, "run", "population_size.Log8", "--runs", "2", "--dry-run")
    assert (planned.returncode, "8 of 8 runs would execute" in planned.stdout) == (0, True), planned.stderr
    done = projects.quick(demo, "run", "population_size.Log8", "speed=5,20", "--runs", "2", "--inputs", "../inputs")
    assert done.returncode == 0, done.stderr
    folders = sorted(demo.parent.glob("inputs/runs/*/*"))
    inputs = [etree.parse(folder / "input.argos") for folder in folders]
    commands = [json.loads((folder / "command.json").read_text()) for folder in folders]

    def values(path: str) -> list[str]:
        return [str(value) for document in inputs for value in document.xpath(path)]

    assert values("//entity[foot-bot]/@quantity") == [str(n) for n in (1, 2, 4, 8) for _ in range(4)]
    assert values("//params/@speed") == ["5", "5", "20", "20"] * 4
    assert values("//experiment/@random_seed") == [command["environment"]["SIERRA_SEED"] for command in commands]
    assert len(set(values("//experiment/@random_seed"))) == 2, "all experiments have the same seeds"
    assert set(values("//experiment/@length")) == {"120"}
    assert set(values("//params/@script")) == {"../forage.lua"}
    assert {(command["line"], command["folder"]) for command in commands} == {("argos3 -n -c ../input.argos", "output")}
    assert {(folder / "forage.lua").read_bytes() for folder in folders} == {(demo / "forage.lua").read_bytes()}


def test_the_template_and_the_script_fit(demo: Path) -> None:
    template = etree.parse(demo / "forage.argos").getroot()
    script = re.sub("--.*", "", (demo / "forage.lua").read_text())
    [params] = template.findall(".//lua_controller/params")
    assert set(re.findall(r"robot\.params\.(\w+)", script)) == {*params.attrib} - {"script"}
    readings = {"proximity": "footbot_proximity", "light": "footbot_light", "positioning": "positioning"}
    used = {readings[name] for name in re.findall(r"robot\.(\w+)", script) if name in readings}
    assert used == {part.tag for part in template.find(".//lua_controller/sensors")}
    [controlled] = template.findall(".//foot-bot/controller")
    assert controlled.get("config") == template.find(".//lua_controller").get("id")
    assert {medium.get("id") for medium in template.find("media")} == set(template.xpath("//@medium"))


def test_the_script_has_what_argos_calls_and_its_blocks_end(demo: Path) -> None:
    script = re.sub(r'--.*|"[^"]*"', "", (demo / "forage.lua").read_text())
    defined = re.findall(r"^function (\w+)\(", script, re.MULTILINE)
    assert {"init", "step", "reset", "destroy"} <= set(defined)
    assert set(re.findall(r"(?<![.:\w])(\w+)\(", script)) - set(defined) == {"assert", "tonumber"}
    words = re.findall(r"\w+", script)
    assert words.count("end") == sum(words.count(word) for word in ("function", "if", "for"))
    assert all(script.count(left) == script.count(right) for left, right in ("()", "[]"))


def test_the_page_on_argos_shows_the_settings_of_the_example(demo: Path) -> None:
    page = (ROOT / "docs" / "extensions" / "argos.md").read_text()
    [shown] = [block for block in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if "forage.argos" in block]
    assert set(shown.splitlines()) <= set((demo / "sierra.toml").read_text().splitlines())


@pytest.mark.integration
def test_the_example_goes_from_a_query_to_figures_with_an_imitation(imitated: Path) -> None:
    done = projects.quick(imitated, "run", "population_size=1,4", "--runs", "2")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in imitated.glob("figures/*/*.png")) == ["collected.png", "each.png"]
    assert [row["n"] for row in projects.sql(imitated, ENDS)] == [1, 1, 4, 4]
    robots = "SELECT DISTINCT robot FROM foragers WHERE population_size = 4 ORDER BY robot"
    assert [row["robot"] for row in projects.sql(imitated, robots)] == [0, 1, 2, 3]
    sums = "SELECT count(*) AS n FROM swarm JOIN runs USING (run) GROUP BY run"
    assert [row["n"] for row in projects.sql(imitated, sums)] == [len(TICKS)] * 4


@pytest.mark.integration
def test_a_run_with_an_error_in_the_script_fails(imitated: Path) -> None:
    done = projects.quick(imitated, "run", "speed=13,20", "--runs", "1")
    assert (done.returncode, "2 runs: 2 executed, 0 reused, 1 failed" in done.stdout) == (1, True)
    assert '[FATAL] Error calling "step"' in done.stdout + done.stderr


def replace(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


@pytest.fixture
def real(demo: Path, require: Callable[..., str]) -> Path:
    """Return the example, whose runs use the ARGoS of this machine."""
    require("argos3")
    if "LD_LIBRARY_PATH" in os.environ:
        settings = (demo / "sierra.toml").read_text()
        (demo / "sierra.toml").write_text(f'environment.pass = ["LD_LIBRARY_PATH"]\n{settings}')
    return demo


@pytest.mark.real
@pytest.mark.nightly
def test_a_larger_swarm_collects_more_in_argos_and_its_replay_is_identical(real: Path) -> None:
    done = projects.quick(real, "run", "population_size=1,8", "--runs", "4")
    assert done.returncode == 0, done.stderr
    assert len(list(real.glob("figures/*/*.png"))) == 2
    food = [(row["n"], int(row["food"])) for row in projects.sql(real, ENDS)]
    assert sum(pieces for n, pieces in food if n == 8) > 2 * sum(pieces for n, pieces in food if n == 1)
    paths = "SELECT list(tick ORDER BY tick) AS ticks, max(abs(x)) AS x, max(abs(y)) AS y FROM foragers GROUP BY run, robot"
    robots = projects.sql(real, paths)
    assert len(robots) == 4 * (1 + 8)
    assert all(row["ticks"] == list(TICKS) and max(row["x"], row["y"]) < 1.9 for row in robots)
    assert len(projects.values(real, "SELECT sum(x) AS x FROM foragers GROUP BY run")) == 8, "seeds make runs differ"
    batch = str(projects.sql(real, "SELECT batch FROM batches")[0]["batch"])
    replayed = projects.quick(real, "replay", batch)
    assert (replayed.returncode, "identical (8 runs: 8 identical)" in replayed.stdout) == (0, True), replayed.stderr


@pytest.mark.real
@pytest.mark.nightly
@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("   tick = tick + 1\n", "   tick = tick + one\n", '[FATAL] Error calling "step"'),
        ("function init()\n", "function inti()\n", "[FATAL] Error setting Lua script"),
        ("function drive()\n", "function drive(\n", "[FATAL] Error setting Lua script"),
    ],
)
def test_a_run_with_an_error_in_the_script_fails_in_argos(real: Path, before: str, after: str, message: str) -> None:
    replace(real / "forage.lua", before, after)
    done = projects.quick(real, "run", "population_size=2", "--runs", "1", "--no-figures")
    assert (done.returncode, message in done.stdout + done.stderr) == (1, True), done


@pytest.mark.real
@pytest.mark.nightly
def test_criteria_of_the_platform_vary_the_example_in_argos(real: Path) -> None:
    summary, _ = projects.run(real, "population_constant_density.50p0.I2.C2", "--runs", "1")
    assert (summary["executed"], summary["failed"]) == (2, 0)
    reached = "SELECT population_constant_density AS n, max(abs(x)) > 2 AS beyond FROM foragers GROUP BY n ORDER BY n"
    assert projects.sql(real, reached) == [{"n": 8, "beyond": False}, {"n": 18, "beyond": True}]


@pytest.mark.real
@pytest.mark.nightly
def test_argos_accepts_shared_arenas_and_inputs_without_devices(real: Path) -> None:
    replace(real / "forage.argos", "</sensors>", '<range_and_bearing implementation="medium" medium="rab"/></sensors>')
    replace(real / "forage.argos", "</media>", '<range_and_bearing id="rab"/></media>')
    options = "libraries = [], physics_engines = 4, physics_iterations = 20, spatial_hash = { cell_size = 0.2, cell_num = 100 }"
    replace(real / "sierra.toml", "libraries = []", f'{options}, remove_devices = ["range_and_bearing"]')
    summary, _ = projects.run(real, "population_size=8", "--runs", "2")
    assert (summary["executed"], summary["failed"]) == (2, 0)
    assert projects.values(real, "SELECT count(*) AS n FROM foragers GROUP BY run") == {8 * len(TICKS)}
    replayed = projects.quick(real, "replay", summary["batch"])
    assert (replayed.returncode, "identical (2 runs: 2 identical)" in replayed.stdout) == (0, True), replayed.stderr
