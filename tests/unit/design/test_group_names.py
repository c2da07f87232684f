"""Names of controllers and scenarios: dots, categories, parameters and labels."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from lxml import etree

from sierra.cli import complete
from sierra.config import project_file
from sierra.config.group_names import resolve
from sierra.errors import ConfigError
from tests import projects

CONFIG = """
[[controllers.depth0.changes]]
set = "//arena/@depth"
value = "0"
[controllers."depth0.CRW"]
label = "random walk"
[[controllers."depth0.CRW".changes]]
set = "//swarm/@controller"
value = "{controller}"
[[controllers."depth0.DPO-2".changes]]
set = "//swarm/@controller"
value = "other"
[[scenarios."Low.{x}x{y}".changes]]
set = "//arena/@size"
value = "{x},{y * 2}"
[[scenarios.Plain.changes]]
set = "//arena/@size"
value = "1"
"""
TEMPLATE = projects.TEMPLATE.replace("<arena ", '<arena depth="" ')


SIMULATOR = """\
import sys
arena = open(sys.argv[1]).read()
found = [arena.split(name + '="')[1].split('"')[0].replace(",", ";") for name in (" depth", " size", " controller")]
open("arena.csv", "w").write("depth,size,controller,value\\n" + ",".join(found) + ",1\\n")
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return projects.make(tmp_path / "p", projects.CONFIG + CONFIG, template=TEMPLATE, simulator=SIMULATOR)


def inputs(folder: Path, *words: str) -> list[dict[str, Any]]:
    """Return what the run of each experiment read from its input."""
    summary, _ = projects.run(folder, *words, "--runs", "1")
    join = f"FROM arena JOIN batch_runs USING (run) WHERE batch_runs.batch = '{summary['batch']}'"
    return projects.sql(folder, f"SELECT arena.depth, arena.size, arena.controller {join} ORDER BY ordinal")


def refused(folder: Path, *words: str) -> str:
    done = projects.quick(folder, "run", *words, "--dry-run")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done
    return done.stderr


@pytest.mark.integration
def test_the_changes_of_a_category_come_before_those_of_its_controller(folder: Path) -> None:
    (made,) = inputs(folder, "population_size=2", "--controller", "depth0.CRW")
    assert (made["depth"], made["controller"]) == (0, "depth0.CRW")


def test_a_category_cannot_be_chosen_itself(folder: Path) -> None:
    said = refused(folder, "population_size=2", "--controller", "depth0")
    assert "controller 'depth0' is a category; use one of depth0.CRW, depth0.DPO-2" in said


def test_an_unknown_name_of_a_category_is_refused(folder: Path) -> None:
    said = refused(folder, "population_size=2", "--controller", "depth0.XYZ")
    assert "unknown controller 'depth0.XYZ'; known are depth0.CRW, depth0.DPO-2" in said


@pytest.mark.nightly
def test_numbers_in_a_scenarios_name_are_values_in_its_changes(folder: Path) -> None:
    (made,) = inputs(folder, "population_size=2", "--scenario", "Low.10x5")
    assert made["size"] == "10;10"
    (made,) = inputs(folder, "population_size=2", "--scenario", "Low.0.5x5")
    assert made["size"] == "0.5;10"


@pytest.mark.nightly
def test_scenarios_with_numbers_can_be_an_axis(folder: Path) -> None:
    made = inputs(folder, "scenario=Low.10x5,Plain,Low.3x3", "--controller", "depth0.CRW")
    assert [row["size"] for row in made] == ["10;10", "1", "3;6"]
    rows = projects.sql(folder, "SELECT DISTINCT scenario FROM points ORDER BY ALL")
    assert [row["scenario"] for row in rows] == ["Low.10x5", "Low.3x3", "Plain"]


@pytest.mark.parametrize("name", ["Low.010x5", "Low.10x", "Low.-1x5", "Low.1e3x5", "Low.10x5x2", "low.10x5", "Low.{x}x{y}"])
def test_other_texts_are_not_names_of_a_scenario_with_numbers(folder: Path, name: str) -> None:
    assert f"unknown scenario {name!r}; known are Low.{{x}}x{{y}}, Plain" in refused(
        folder, "population_size=2", "--scenario", name
    )


def test_a_name_that_fits_two_declarations_is_refused(tmp_path: Path) -> None:
    both = '[scenarios."A{x}"]\nchanges = []\n[scenarios."A{y}"]\nchanges = []\n'
    folder = projects.make(tmp_path / "p", projects.CONFIG + both)
    assert "scenario 'A1' is ambiguous: it fits A{x} and A{y}" in refused(folder, "population_size=2", "--scenario", "A1")


def test_a_declared_name_precedes_one_with_parameters() -> None:
    (found,) = resolve("A1", ["A{x}", "A1"])
    assert (found.declared, found.parameters) == (("A1",), {})


def test_a_parameter_that_a_variable_has_too_is_refused() -> None:
    table = {"template": "t", "variables": {"x": "//x"}, "scenarios": {"A{x}": {}}}
    with pytest.raises(ConfigError, match=r"'A\{x\}': \{x\} is also a variable"):
        project_file.parse(table, "sierra.toml")


def test_one_parameter_in_both_names_is_refused(tmp_path: Path) -> None:
    both = '[scenarios."A{x}"]\nchanges = []\n[controllers."B{x}"]\nchanges = []\n'
    folder = projects.make(tmp_path / "p", projects.CONFIG + both)
    said = refused(folder, "population_size=2", "--scenario", "A1", "--controller", "B2")
    assert "'x' has two values" in said
    assert "'x' has two values" in refused(folder, "scenario=A1", "controller=B2")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("A{x}{y}", "can be read in several ways"),
        ("A{x}.{y}", "can be read in several ways"),
        ("A{x}x{x}", "has a parameter twice"),
        ("A{seed}", "{seed} already has a meaning"),
        ("A..b", "not a valid name"),
        ("A.", "not a valid name"),
        (".A", "not a valid name"),
        ("-A", "not a valid name"),
        ("../A", "not a valid name"),
        ("A b", "not a valid name"),
        ("A{x y}", "not a valid name"),
    ],
)
def test_invalid_names_are_refused(name: str, said: str) -> None:
    with pytest.raises(ConfigError, match="(?s)" + said.replace("{", r"\{")):
        project_file.parse({"template": "t", "scenarios": {name: {}}}, "sierra.toml")


def test_a_dotted_name_without_quotes_is_explained() -> None:
    table = tomllib.loads('template = "t"\n[[controllers.depth0.CRW.changes]]\nset = "//x"\nvalue = "1"\n')
    with pytest.raises(ConfigError, match=r'write a name with dots in quotes: controllers\."depth0\.CRW"'):
        project_file.parse(table, "sierra.toml")


def test_completion_offers_names_that_can_be_chosen(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert complete.controllers("") == ["depth0.CRW", "depth0.DPO-2"]
    assert complete.scenarios("") == ["Low.", "Plain"]


@pytest.mark.integration
def test_figures_show_the_labels_of_controllers(folder: Path) -> None:
    summary, _ = projects.run(folder, "controller=depth0.CRW,depth0.DPO-2", "--scenario", "Plain")
    done = projects.quick(folder, "figures", summary["batch"], "--json")
    assert done.returncode == 0, done.stderr
    drawn: list[str] = json.loads(done.stdout)
    texts = [text for path in drawn if path.endswith(".svg") for text in _texts(Path(folder, path))]
    assert any("random walk" in text for text in texts)
    assert any("depth0.DPO-2" in text for text in texts)
    assert not any("depth0.CRW" in text for text in texts)


def _texts(path: Path) -> list[str]:
    return ["".join(text.itertext()) for text in etree.parse(path).iter("{*}text")]


VARIABLE = """
scenario = {}
[variables.controller]
set = "//swarm/@controller"
label = "Behaviour"
labels = { crw = "random walk" }
"""


@pytest.fixture
def varied(tmp_path: Path) -> Path:
    config = projects.CONFIG.replace("{input}", "{input} {scenario}") + VARIABLE
    return projects.make(tmp_path / "p", config, template=TEMPLATE, simulator=SIMULATOR)


def test_a_controller_may_be_a_variable(varied: Path) -> None:
    words = ("controller=crw,levy", "--scenario", "open")
    assert [row["controller"] for row in inputs(varied, *words)] == ["crw", "levy"]
    table = projects.quick(varied, "stats", "arena", "value").stdout
    assert "random walk" in table
    assert "crw" not in table
    chosen = projects.quick(varied, "run", *words, "--runs", "1", "--only", "controller=random walk", "--dry-run").stdout
    assert "\ncrw" in chosen
    assert "\nlevy" not in chosen
    alone = projects.quick(varied, "run", "noise=0.1", "--controller", "crw", "--scenario", "open", "--runs", "1", "--json")
    assert json.loads(alone.stdout)["reused"] == 1


def test_a_controller_is_a_variable_or_a_table(folder: Path) -> None:
    (folder / "sierra.toml").write_text(projects.CONFIG + 'controller = "//swarm/@controller"\n' + CONFIG)
    said = refused(folder, "population_size=2")
    assert "variable 'controller': a controller is [variables.controller] or [controllers.NAME], not both" in said


def test_names_of_numbers_are_shown_as_texts(tmp_path: Path) -> None:
    labels = '\n[variables.count]\nset = "//swarm/@count"\nlabels = { 1 = "alone" }\n'
    config = projects.CONFIG.replace('population_size = "//swarm/@count"\n', "") + labels
    folder = projects.make(tmp_path / "p", config)
    projects.run(folder, "count=1,2", "--runs", "2")
    table = projects.quick(folder, "stats", "swarm", "coverage").stdout
    assert [line.split()[1] for line in table.splitlines()] == ["count", "alone", "2"]
    drawn = projects.quick(folder, "figures")
    assert drawn.returncode == 0, drawn.stderr


def test_a_label_that_is_another_value_selects_nothing_else(tmp_path: Path) -> None:
    labels = '\n[variables.count]\nset = "//swarm/@count"\nlabels = { 1 = "2", 2 = "4" }\n'
    config = projects.CONFIG.replace('population_size = "//swarm/@count"\n', "") + labels
    folder = projects.make(tmp_path / "p", config)
    lines = projects.quick(folder, "run", "count=1,2", "--only", "count=2", "--dry-run").stdout.splitlines()
    after_header = next(number for number, line in enumerate(lines, 1) if line.startswith("count"))
    assert lines[after_header].split()[0] == "2"


def test_a_controller_without_a_change_for_the_target_is_refused(tmp_path: Path) -> None:
    more = '\n[variables.controller.targets.sim]\nset = "//swarm/@controller"\n[targets.sim]\n[targets.real]\n'
    folder = projects.make(tmp_path / "p", projects.CONFIG + more)
    assert projects.quick(folder, "run", "noise=1", "--controller", "a", "--target", "sim", "--dry-run").returncode == 0
    assert "'controller' has no change for target 'real'" in refused(folder, "noise=1", "--controller", "a", "--target", "real")
