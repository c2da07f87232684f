"""Seconds on the time axis of figures, where a column counts ticks."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from lxml import etree

from sierra.config import project_file
from sierra.errors import ConfigError
from tests import projects

TEMPLATE = projects.TEMPLATE.replace("<arena ", '<arena rate="10" ')
CONFIG = projects.CONFIG + 'rate = "//arena/@rate"\n[outputs.swarm]\nfile = "swarm.csv"\ntime = "tick"\n'


def texts(folder: Path, config: str, *words: str) -> list[str]:
    """Return the texts in the time series of a query."""
    made = projects.make(folder, config, template=TEMPLATE)
    projects.run(made, *words)
    done = projects.quick(made, "figures", "--json")
    assert done.returncode == 0, done.stderr + done.stdout
    (path,) = [made / path for path in json.loads(done.stdout) if path.endswith("swarm_coverage_timeseries.svg")]
    return ["".join(text.itertext()) for text in etree.parse(path).iter("{*}text")]


@pytest.mark.integration
@pytest.mark.parametrize("given", ["10", '"//arena/@rate"'])
def test_ticks_are_shown_as_seconds(tmp_path: Path, given: str) -> None:
    shown = texts(tmp_path / "p", CONFIG + f"ticks_per_second = {given}\n", "population_size=1,2")
    assert "tick [s]" in shown
    assert "0.40" in shown  # the last of five ticks
    assert any("seconds: tick / 10 per second" in text for text in shown)


@pytest.mark.integration
def test_each_experiment_has_its_own_ticks_per_second(tmp_path: Path) -> None:
    shown = texts(tmp_path / "p", CONFIG + 'ticks_per_second = "//arena/@rate"\n', "rate=2,4")
    assert any("seconds: tick / 2 to 4 per second" in text for text in shown)
    assert "2.00" in shown  # tick 4 at 2 ticks per second
    assert "1.75" in shown


@pytest.mark.nightly
def test_times_until_a_threshold_stay_ticks_and_nothing_else_is_said(tmp_path: Path) -> None:
    keys = 'kind = "survival"\ncolumn = "coverage"\nmeasure = "time_to"\nthreshold = 3\n'
    config = f"{CONFIG}ticks_per_second = 10\n[figures.swarm_coverage_timeseries]\n{keys}"
    shown = texts(tmp_path / "p", config, "population_size=1,2")
    assert "tick until coverage ≥ 3" in shown
    assert not any("second" in text for text in shown)


@pytest.mark.nightly
def test_without_the_key_ticks_stay_ticks(tmp_path: Path) -> None:
    shown = texts(tmp_path / "p", CONFIG, "population_size=1,2")
    assert "tick" in shown
    assert not any("second" in text for text in shown)


@pytest.mark.nightly
def test_the_key_executes_nothing_again(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "p", CONFIG, template=TEMPLATE)
    projects.run(folder, "population_size=1")
    (folder / "sierra.toml").write_text(CONFIG + "ticks_per_second = 10\n")
    summary, _ = projects.run(folder, "population_size=1")
    assert (summary["executed"], summary["reused"]) == (0, 2)


@pytest.mark.integration
@pytest.mark.parametrize(("path", "said"), [("//arena/@none", "selects nothing"), ("//swarm/@controller", "selects 'none'")])
def test_a_path_without_a_number_is_reported(tmp_path: Path, path: str, said: str) -> None:
    folder = projects.make(tmp_path / "p", CONFIG + f'ticks_per_second = "{path}"\n', template=TEMPLATE)
    summary, _ = projects.run(folder, "population_size=1")
    done = projects.quick(folder, "figures", summary["batch"], "swarm_coverage_timeseries")
    assert done.returncode != 0
    assert said in done.stderr


@pytest.mark.integration
def test_runs_that_differ_are_reported(tmp_path: Path) -> None:
    change = 'run_changes = [{ set = "//arena/@rate", value = "{run + 1}" }]\n'
    folder = projects.make(tmp_path / "p", change + CONFIG + 'ticks_per_second = "//arena/@rate"\n', template=TEMPLATE)
    summary, _ = projects.run(folder, "population_size=1")
    done = projects.quick(folder, "figures", summary["batch"], "swarm_coverage_timeseries")
    assert done.returncode != 0
    assert "runs of an experiment have 1 and 2" in done.stderr


@pytest.mark.nightly
def test_a_path_needs_one_template(tmp_path: Path) -> None:
    several = CONFIG.replace('template = "arena.xml"', 'templates = { arena = "arena.xml" }').replace('= "//', '= "arena://')
    several = several.replace("{input}", "{input.arena}")
    folder = projects.make(tmp_path / "p", several + 'ticks_per_second = "//arena/@rate"\n', template=TEMPLATE)
    summary, _ = projects.run(folder, "population_size=1")
    done = projects.quick(folder, "figures", summary["batch"], "swarm_coverage_timeseries")
    assert done.returncode == 2
    assert "an XPath needs a project with one template; use a number" in done.stderr


@pytest.mark.parametrize(
    "table", [{"ticks_per_second": 10}, {"time": "t", "ticks_per_second": 0}, {"time": "t", "ticks_per_second": ""}]
)
def test_invalid_keys_are_refused(table: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        project_file.parse({"template": "t", "outputs": {"a": {"file": "a.csv", **table}}}, "sierra.toml")
