"""Tests of targets: one query for two simulators, one that reads JSON and one that takes arguments."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.cli import complete
from sierra.errors import QueryError, UsageError
from tests import projects

SIM = """\
import json, sys

given = json.load(open(sys.argv[1]))
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    for tick in range(3):
        print(tick, given["count"] * tick + given["seed"] % 7, sep=",", file=file)
"""
ROBOTS = """\
import sys

given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
with open("log.txt", "w") as file:
    print("tick coverage", file=file)
    for tick in range(3):
        print(tick, int(given["--robots"]) * tick + int(given["--seed"]) % 7 - 1, file=file)
"""
CONFIG = """\
target = "sim"
runs = 2
[targets.sim]
template = "params.json"
command = "python3 {project}/sim.py {input}"
outputs.swarm = { file = "swarm.csv", time = "tick" }
[targets.robots]
command = "python3 {project}/robots.py {arguments}"
outputs.swarm = { file = "log.txt", format = "csv", delimiter = " ", time = "tick", units = { coverage = "m2" } }
[seed.targets]
sim = "/seed"
robots = { argument = "--seed {value}" }
[variables.population_size.targets]
sim = "/count"
robots = { argument = "--robots {value}" }
[variables.noise.targets]
sim = "/noise"
[controllers.avoid.targets.sim]
changes = [{ set = "/noise", value = 3 }]
"""
BOTH = ("--target", "sim,robots")


def make(folder: Path, config: str = CONFIG) -> Path:
    folder.mkdir()
    (folder / "sim.py").write_text(SIM)
    (folder / "robots.py").write_text(ROBOTS)
    (folder / "params.json").write_text('{"count": 1, "seed": 0, "noise": 0}\n')
    (folder / "sierra.toml").write_text(config)
    return folder


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project in which one query was run for both targets."""
    folder = make(tmp_path_factory.mktemp("targets") / "p")
    answers, _ = projects.run(folder, "population_size=1,2", *BOTH)
    assert {name: (one["target"], one["executed"]) for name, one in answers["targets"].items()} == {
        "sim": ("sim", 4),
        "robots": ("robots", 4),
    }
    return folder


@pytest.fixture
def project(executed: Path, tmp_path: Path) -> Path:
    """Return a copy of that project."""
    return shutil.copytree(executed, tmp_path / "p", symlinks=True)


def listed(folder: Path) -> list[dict[str, Any]]:
    done = projects.quick(folder, "ls", "--json")
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


def batch(folder: Path, target: str) -> str:
    return str(next(one["batch"] for one in listed(folder) if one["targets"] == [target]))


PAIRS = """
WITH last AS (
    SELECT target, arg_max(batch, lamport) AS batch FROM sessions WHERE query = 'population_size=1,2' GROUP BY target
), final AS (
    SELECT target, population_size, seed, arg_max(coverage, tick) AS coverage
    FROM last JOIN batch_runs USING (batch) JOIN swarm USING (run) GROUP BY ALL
)
SELECT population_size, seed, sim.coverage - robots.coverage AS difference
FROM final AS sim JOIN final AS robots USING (population_size, seed)
WHERE sim.target = 'sim' AND robots.target = 'robots' ORDER BY ALL
"""


@pytest.mark.integration
def test_the_runs_of_targets_are_pairs_with_the_same_values_and_seeds(executed: Path) -> None:
    rows = projects.sql(executed, PAIRS)
    assert [(row["population_size"], row["difference"]) for row in rows] == [(1, 1), (1, 1), (2, 1), (2, 1)]
    assert len({row["seed"] for row in rows}) == 2


@pytest.mark.integration
def test_the_same_query_again_executes_nothing(project: Path) -> None:
    answers, _ = projects.run(project, "population_size=1,2", *BOTH)
    assert [(one["executed"], one["reused"]) for one in answers["targets"].values()] == [(0, 4), (0, 4)]
    assert [one["targets"] for one in listed(project)] == [["sim"], ["robots"]]


@pytest.mark.integration
def test_without_the_option_the_default_target_is_used(project: Path) -> None:
    answer, _ = projects.run(project, "population_size=1,2")
    assert (answer["batch"], answer["target"], answer["executed"]) == (batch(project, "sim"), "sim", 0)
    (project / "sierra.toml").write_text(CONFIG.replace('target = "sim"', 'target = "robots"'))
    answer, _ = projects.run(project, "population_size=1,2")
    assert (answer["batch"], answer["target"], answer["executed"]) == (batch(project, "robots"), "robots", 0)


@pytest.mark.integration
def test_one_target_prints_one_object(project: Path) -> None:
    answer, _ = projects.run(project, "population_size=1,2", "--target", "robots")
    assert (answer["target"], answer["reused"]) == ("robots", 4)


@pytest.mark.integration
def test_the_name_of_a_target_is_no_part_of_an_id(project: Path) -> None:
    before = batch(project, "robots")
    (project / "sierra.toml").write_text(CONFIG.replace("robots]", "swarm]").replace("robots = {", "swarm = {"))
    answer, _ = projects.run(project, "population_size=1,2", "--target", "swarm")
    assert (answer["batch"], answer["executed"]) == (before, 0)
    assert {one["batch"]: one["targets"] for one in listed(project)}[before] == ["robots", "swarm"]


@pytest.mark.nightly
def test_keys_outside_targets_are_a_target_of_their_own(tmp_path: Path) -> None:
    config = """
        runs = 1
        template = "params.json"
        command = "python3 {project}/sim.py {input}"
        seed = "/seed"
        variables.population_size = "/count"
        [targets.slow.limits]
        wall = 600
    """
    folder = make(tmp_path / "p", config)
    answer, _ = projects.run(folder, "population_size=1")
    assert (answer["target"], answer["executed"]) == (None, 1)
    other, _ = projects.run(folder, "population_size=1", "--target", "slow")
    assert (other["batch"], other["target"], other["executed"]) == (answer["batch"], "slow", 0)


@pytest.mark.integration
def test_list_show_statistics_and_figures_say_the_target(project: Path) -> None:
    identity = batch(project, "robots")
    assert "robots" in projects.quick(project, "ls").stdout
    shown = json.loads(projects.quick(project, "show", identity, "--json").stdout)
    assert (shown["targets"], [one["target"] for one in shown["sessions"]]) == (["robots"], ["robots"])
    of_sim = projects.quick(project, "stats", "swarm", "coverage", "--target", "sim")
    assert (of_sim.returncode, "target sim" in of_sim.stderr) == (0, True)
    statistics = projects.quick(project, "stats", "swarm", "coverage", "--batch", identity)
    assert (statistics.returncode, "target robots" in statistics.stderr) == (0, True)
    drawn = projects.quick(project, "figures", identity, "swarm_coverage_summary", "--json")
    refused = projects.quick(project, "figures", identity[:10], "--target", "sim")
    assert (refused.returncode, "leave out --target" in refused.stderr) == (2, True)
    assert drawn.returncode == 0, drawn.stderr
    image = Path(next(path for path in json.loads(drawn.stdout) if path.endswith(".svg"))).read_text()
    assert "target robots" in image
    assert "m2" in image


@pytest.mark.integration
def test_the_target_that_is_executed_is_named_before_its_runs(project: Path) -> None:
    done = projects.quick(project, "run", "population_size=1,2", *BOTH, "--no-figures")
    said = [line for line in done.stderr.splitlines() if "target" in line]
    assert said == ["note: target sim (1 of 2): 4 runs", "note: target robots (2 of 2): 4 runs"]


@pytest.mark.nightly
def test_figures_of_several_targets_have_a_line_for_each(project: Path) -> None:
    config = CONFIG.replace(', units = { coverage = "m2" }', "")
    (project / "sierra.toml").write_text(config)
    drawn = projects.quick(project, "figures", "--target", "sim,robots", "--json")
    assert drawn.returncode == 0, drawn.stderr
    found = {Path(path).name: Path(path) for path in json.loads(drawn.stdout)}
    assert {"swarm_coverage_timeseries_sim_robots.svg", "swarm_coverage_summary_sim_robots.svg"} <= found.keys()
    folder = f"{batch(project, 'sim')[:10]}-{batch(project, 'robots')[:10]}"
    for name in ("swarm_coverage_timeseries_sim_robots.svg", "swarm_coverage_summary_sim_robots.svg"):
        text = found[name].read_text()
        assert [f">{word}</text>" in text for word in ("target", "sim", "robots")] == [True, True, True]
        assert found[name].parent.name == folder
    named = (batch(project, "robots"), "swarm_coverage_summary", *BOTH, "--format", "pdf,html")
    one = projects.quick(project, "figures", *named)
    assert [Path(path).suffix for path in one.stdout.splitlines()] == [".pdf", ".html"], one.stderr
    page = found["swarm_coverage_summary_sim_robots.svg"].with_suffix(".html").read_text()
    assert f"<dd>{batch(project, 'sim')} (sim), {batch(project, 'robots')} (robots)</dd>" in page
    for identity in (batch(project, "sim"), batch(project, "robots")):
        assert projects.quick(project, "figures", identity, "--check").returncode == 0
    found["swarm_coverage_summary_sim_robots.svg"].write_text("changed")
    checked = projects.quick(project, "figures", batch(project, "sim"), "--check")
    assert (checked.returncode, "swarm_coverage_summary_sim_robots" in checked.stdout + checked.stderr) == (1, True)


@pytest.mark.nightly
def test_a_query_for_several_targets_draws_them_together_at_its_end(tmp_path: Path) -> None:
    folder = make(tmp_path / "p", CONFIG.replace(', units = { coverage = "m2" }', ""))
    done = projects.quick(folder, "run", "population_size=1", *BOTH, "--figures", "--json")
    assert done.returncode == 0, done.stderr
    drawn = [Path(path) for path in json.loads(done.stdout)["figures"]]
    assert {path.stem for path in drawn} == {f"swarm_coverage_{kind}_sim_robots" for kind in ("summary", "timeseries")}
    assert all("-" in path.parent.name for path in drawn)


@pytest.mark.integration
def test_figures_of_targets_with_other_units_are_not_drawn(project: Path) -> None:
    drawn = projects.quick(project, "figures", *BOTH)
    assert (drawn.returncode, drawn.stdout) == (0, "")
    assert "targets 'sim' and 'robots' have different units: none and coverage in m2" in drawn.stderr


@pytest.mark.integration
@pytest.mark.parametrize(
    ("query", "message"),
    [
        (
            ("population_size=3", "--target", "sim"),
            "population_size=3 was not run for target robots; record all batches with: ",
        ),
        (("population_size=1,2", "--target", "sim", "--runs", "3"), "the runs for targets 'sim' and 'robots' are no pairs: "),
    ],
)
def test_batches_that_are_no_pairs_are_not_drawn_together(project: Path, query: tuple[str, ...], message: str) -> None:
    assert projects.quick(project, "run", *query, "--no-figures").returncode == 0
    refused = projects.quick(project, "figures", *BOTH)
    assert refused.returncode in (2, 3)
    assert message in refused.stderr


@pytest.mark.integration
def test_recorded_batches_need_no_target(project: Path) -> None:
    identity = batch(project, "robots")
    replayed = projects.quick(project, "replay", identity, "--json")
    assert (replayed.returncode, json.loads(replayed.stdout)["verdict"]) == (0, "identical"), replayed.stderr
    answer, _ = projects.run(project, identity[:10])
    assert (answer["batch"], answer["target"], answer["executed"]) == (identity, "robots", 0)
    refused = projects.quick(project, "run", identity[:10], "--target", "sim")
    assert refused.returncode == 2
    assert "leave out --runs, --controller, --scenario, --set and --target" in refused.stderr


@pytest.mark.integration
def test_recorded_batches_can_be_replayed_after_their_target_is_gone(project: Path) -> None:
    identity = batch(project, "robots")
    (project / "sierra.toml").write_text('template = "params.json"\ncommand = "python3 {project}/sim.py {input}"\n')
    replayed = projects.quick(project, "replay", identity, "--json")
    assert (replayed.returncode, json.loads(replayed.stdout)["verdict"]) == (0, "identical"), replayed.stderr
    answer, _ = projects.run(project, identity[:10])
    assert (answer["target"], answer["executed"]) == ("robots", 0)


@pytest.mark.nightly
def test_a_note_says_whose_declarations_are_used_for_a_batch_without_a_target(tmp_path: Path) -> None:
    folder = make(tmp_path / "p", CONFIG.replace('target = "sim"\n', ""))
    identity = projects.run(folder, "population_size=1", "--target", "robots", "--no-figures")[0]["batch"]
    (folder / "sierra.toml").write_text(CONFIG.replace("robots]", "field]").replace("robots =", "field ="))
    words = ("stats", "swarm", "coverage", "--batch", identity)
    note = (
        "the batch was requested for target 'robots', which sierra.toml no longer has; "
        "its outputs, units and times are taken to be those of the default target 'sim'"
    )
    assert note in projects.quick(folder, *words).stderr
    drawn = projects.quick(folder, "figures", identity)
    assert (drawn.returncode, drawn.stderr.count(note)) == (0, 1), drawn.stderr
    (folder / "sierra.toml").write_text(CONFIG)
    assert "taken to be those" not in projects.quick(folder, *words).stderr


@pytest.mark.nightly
def test_a_template_of_one_of_two_batches_is_named(tmp_path: Path) -> None:
    config = """
        runs = 1
        command = "python3 {project}/robots.py {arguments}"
        seed.argument = "--seed {value}"
        variables.population_size.argument = "--robots {value}"
        source.paths = ["robots.py"]
    """
    folder = make(tmp_path / "p", config)
    words = ("run", "population_size=1", "--no-figures")
    assert projects.quick(folder, *words).returncode == 0
    (folder / "sierra.toml").write_text(config + '\ntemplate = "params.json"\n')
    assert _templates(projects.quick(folder, *words, "--explain").stdout) == ["template: nothing → params.json"]
    (folder / "sierra.toml").write_text(config + "environment.set.A = '1'\n")
    assert _templates(projects.quick(folder, *words, "--explain").stdout) == ["template: params.json → nothing"]


def _templates(said: str) -> list[str]:
    return [line.strip() for line in said.splitlines() if line.strip().startswith("template:")]


@pytest.mark.nightly
def test_why_repeats_the_query_for_its_target(project: Path) -> None:
    for name in ("sim", "robots"):
        answer = json.loads(projects.quick(project, "why", batch(project, name), "--json").stdout)
        assert any("4 runs: reused" in line for line in answer["next_run"]), answer["next_run"]


@pytest.mark.integration
def test_a_changed_target_is_compared_with_itself(project: Path) -> None:
    (project / "sierra.toml").write_text(CONFIG.replace("robots.py {arguments}", "robots.py --gain 2 {arguments}"))
    previewed = projects.quick(project, "run", "population_size=1,2", *BOTH, "--dry-run", "--explain", "--json")
    answers = json.loads(previewed.stdout)["targets"]
    assert (answers["sim"]["to_execute"], answers["robots"]["to_execute"]) == (0, 4)
    assert any("--gain 2" in line for line in answers["robots"]["new_because"])
    assert not any("target" in line for line in answers["robots"]["new_because"])


@pytest.mark.nightly
def test_targets_are_differences_between_batches(executed: Path) -> None:
    compared = projects.quick(executed, "diff", batch(executed, "sim"), batch(executed, "robots"))
    assert "target: sim → robots" in compared.stdout


@pytest.mark.integration
def test_a_request_in_a_file_names_its_target(project: Path, tmp_path: Path) -> None:
    previewed = projects.quick(project, "run", "population_size=1,2", "--target", "robots", "--dry-run", "--json")
    (tmp_path / "query.json").write_text(previewed.stdout)
    answer, _ = projects.run(project, str(tmp_path / "query.json"))
    assert (answer["target"], answer["executed"]) == ("robots", 0)
    refused = projects.quick(project, "run", str(tmp_path / "query.json"), "--target", "sim")
    assert (refused.returncode, "leave out --target" in refused.stderr) == (2, True)


@pytest.mark.integration
def test_a_failure_in_one_target_fails_the_command_and_not_the_other(tmp_path: Path) -> None:
    folder = make(tmp_path / "p")
    (folder / "sim.py").write_text("raise SystemExit(3)\n")
    done = projects.quick(folder, "run", "population_size=1", *BOTH, "--no-figures", "--json")
    answers = json.loads(done.stdout)["targets"]
    assert done.returncode == 1
    assert (answers["sim"]["failed"], answers["robots"]["failed"], answers["robots"]["executed"]) == (2, 0, 2)


def test_inputs_of_targets_are_written_to_folders_with_their_names(executed: Path, tmp_path: Path) -> None:
    done = projects.quick(executed, "inputs", "population_size=1,2", *BOTH, "--to", str(tmp_path / "inputs"))
    assert done.returncode == 0, done.stderr
    commands = {
        name: json.loads((tmp_path / "inputs" / name / "runs" / "1" / "0" / "command.json").read_text())["argv"]
        for name in ("sim", "robots")
    }
    assert commands["sim"][-1] == "../input.json"
    assert commands["robots"][-4:-1] == ["--robots", "2", "--seed"]


@pytest.mark.integration
def test_outputs_are_those_of_the_target(project: Path) -> None:
    found = json.loads(projects.quick(project, "outputs", "--target", "sim", "--json").stdout)
    assert (found["batch"], found["target"]) == (batch(project, "sim"), "sim")
    asked = json.loads(projects.quick(project, "outputs", "population_size=1,2", "--target", "robots", "--json").stdout)
    [table] = asked["tables"]
    assert (asked["target"], table["file"], table["declared"]) == ("robots", "log.txt", True)
    refused = projects.quick(project, "outputs", "--target", "x")
    assert (refused.returncode, refused.stderr) == (2, "sierra: unknown target 'x'; known are sim, robots\n")


@pytest.mark.nightly
def test_outputs_are_declared_for_the_target_that_wrote_them(tmp_path: Path) -> None:
    config = CONFIG.replace('outputs.swarm = { file = "swarm.csv", time = "tick" }\n', "")
    folder = make(tmp_path / "p", config)
    projects.run(folder, "population_size=1", *BOTH)
    done = projects.quick(folder, "outputs", "--target", "sim", "--write")
    assert (done.returncode, "added [targets.sim.outputs.swarm]" in done.stdout) == (0, True), done.stderr
    written = tomllib.loads((folder / "sierra.toml").read_text())
    assert written["targets"]["sim"]["outputs"] == {"swarm": {"file": "swarm.csv"}}
    assert {**written, "targets": 0} == {**tomllib.loads(config), "targets": 0}
    answers, _ = projects.run(folder, "population_size=1", *BOTH)
    assert [one["executed"] for one in answers["targets"].values()] == [0, 0]


@pytest.mark.nightly
def test_the_doctor_checks_each_target(project: Path) -> None:
    (project / "sierra.toml").write_text(CONFIG.replace("python3 {project}/robots.py", "no-such-robots"))
    checks = {one["name"]: one for one in json.loads(projects.quick(project, "doctor", "--json").stdout)}
    assert (checks["command"]["state"], checks["command of target robots"]["state"]) == ("ok", "missing")
    assert "no-such-robots" in checks["command of target robots"]["found"]


@pytest.mark.nightly
def test_a_trial_uses_a_target(executed: Path) -> None:
    done = projects.quick(executed, "try", "population_size=2", "--target", "robots", "--json")
    assert done.returncode == 0, done.stderr
    assert [one["path"] for one in json.loads(done.stdout)["files"]] == ["log.txt"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("population_size=1", "--target", "robot"), "unknown target 'robot'; known are sim, robots"),
        (("population_size=1", "--target", "sim,sim"), "--target has 'sim' twice; name each target once"),
        (("population_size=1", "--target", "sim,"), "--target needs names of targets, as in --target sim,robots"),
        (("population_size=1", "--target", ""), "--target needs names of targets, as in --target sim,robots"),
        (
            ("noise=1,2", *BOTH),
            "variable 'noise' has no change for target 'robots'; add [variables.noise.targets.robots]",
        ),
        (
            ("population_size=1", *BOTH, "--controller", "avoid"),
            "controller 'avoid' has no change for target 'robots'; add [controllers.avoid.targets.robots]",
        ),
        (
            ("controller=avoid", "--target", "robots"),
            "controller 'avoid' has no change for target 'robots'; add [controllers.avoid.targets.robots]",
        ),
    ],
)
def test_wrong_targets_are_named_in_one_line_before_anything_runs(executed: Path, words: tuple[str, ...], message: str) -> None:
    done = projects.quick(executed, "run", *words)
    assert (done.returncode, done.stderr) == (2, f"sierra: {message}\n")
    assert len(listed(executed)) == 2


@pytest.mark.nightly
def test_a_target_names_where_its_runs_execute(tmp_path: Path) -> None:
    folder = make(tmp_path / "p", CONFIG.replace("[targets.robots]", '[targets.robots]\nrunner = "field"'))
    done = projects.quick(folder, "run", "population_size=1", *BOTH)
    assert (done.returncode, done.stderr) == (
        2,
        "sierra: unknown runner 'field'; known are local, collected, robots, slurm, pbs, lab\n",
    )
    assert not (folder / ".sierra" / "segments").exists()
    answers, _ = projects.run(folder, "population_size=1", *BOTH, "--on", "local")
    assert [one["executed"] for one in answers["targets"].values()] == [2, 2]
    refused = projects.quick(folder, "run", "population_size=1", *BOTH, "--on", "local", "--detach")
    assert (refused.returncode, "cannot detach from runner 'local'" in refused.stderr) == (2, True)


def test_a_variable_of_targets_only_needs_a_target(tmp_path: Path) -> None:
    folder = make(tmp_path / "p", CONFIG.replace('target = "sim"', 'command = "true"'))
    done = projects.quick(folder, "run", "noise=1,2")
    assert done.returncode == 2
    assert "variable 'noise' has no change without a target; use --target with sim or robots" in done.stderr


def test_a_project_without_targets_has_none(tmp_path: Path) -> None:
    done = projects.quick(projects.make(tmp_path / "p"), "run", "population_size=1", "--target", "sim")
    assert done.returncode == 2
    assert "unknown target 'sim'; sierra.toml declares no [targets.NAME]" in done.stderr


@pytest.mark.nightly
def test_a_target_may_vary_what_its_platform_knows_itself(tmp_path: Path) -> None:
    config = """
        runs = 1
        [targets.sim]
        platform = "argos"
        template = "arena.argos"
        command = "python3 {project}/sim.py {input}"
        platforms.argos.length = 10
        [targets.robots]
        command = "python3 {project}/robots.py {arguments}"
        [seed.targets]
        robots = { argument = "--seed {value}" }
        [variables.population_size]
        label = "Robots"
        targets.robots.argument = "--robots {value}"
    """
    folder = make(tmp_path / "p", config)
    (folder / "arena.argos").write_text(ARENA)
    (folder / "sim.py").write_text("import shutil, sys\nshutil.copy(sys.argv[1], 'seen.xml')\n")
    answers, _ = projects.run(folder, "population_size=3", *BOTH)
    assert [one["executed"] for one in answers["targets"].values()] == [1, 1]
    written = projects.quick(folder, "inputs", "population_size=3", "--target", "sim", "--to", str(tmp_path / "inputs"))
    assert written.returncode == 0, written.stderr
    assert 'quantity="3"' in next((tmp_path / "inputs" / "runs").rglob("*.argos")).read_text()


ARENA = """<?xml version="1.0"?>
<argos-configuration>
  <framework><system threads="1"/><experiment length="60" ticks_per_second="10" random_seed="1"/></framework>
  <controllers><c id="c" library="libc"><actuators/><params/></c></controllers>
  <arena size="5, 5, 2" center="0,0,1">
    <distribute>
      <position method="uniform" min="-2,-2,0" max="-1,2,0"/>
      <entity quantity="20" max_trials="100"><foot-bot id="fb"><controller config="c"/></foot-bot></entity>
    </distribute>
  </arena>
</argos-configuration>
"""


def test_completion_offers_targets_that_are_not_named_yet(executed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(executed)
    assert complete.targets("") == ["robots", "sim"]
    assert complete.targets("sim,") == ["sim,robots"]
    assert complete.targets("sim,x") == []


def test_python_has_targets_and_plans_for_them(executed: Path) -> None:
    project = sierra.open(executed)
    assert project.targets == ("sim", "robots")
    plans = project.plans.of_targets("population_size=1,2", targets=["robots", "sim"])
    assert [(plan.target, plan.batch.id) for plan in plans] == [(name, batch(executed, name)) for name in ("robots", "sim")]
    assert project.plan("population_size=1,2", target="robots").batch.id == plans[0].batch.id
    with pytest.raises(UsageError, match="unknown target 'x'"):
        project.plan("population_size=1", target="x")
    with pytest.raises(QueryError, match="no change for target 'robots'"):
        project.plans.of_targets("noise=1", targets=["sim", "robots"])
