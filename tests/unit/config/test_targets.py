"""Tests of targets: the merged configuration, and messages for tables that cannot be targets."""

from __future__ import annotations

import tomllib

import pytest

from sierra.config import project_file
from sierra.config.project_file import Project
from sierra.errors import ConfigError, UsageError

BASE = """\
template = "arena.xml"
template_format = "xml"
command = "sim {input}"
[limits]
wall = 10
memory = "1 GiB"
[outputs.swarm]
file = "swarm.csv"
time = "tick"
[outputs.energy]
file = "energy.csv"
[seed]
set = "//random/@seed"
base = 7
[variables.noise]
set = "//noise"
label = "Noise"
[controllers.avoid]
changes = [{ set = "//swarm/@controller", value = "avoid" }]
"""


def parse(*parts: str) -> Project:
    return project_file.parse(tomllib.loads("\n".join((BASE, *parts))), "sierra.toml")


def test_an_empty_target_is_the_project_itself() -> None:
    plain, target = parse(), parse("[targets.sim]").for_target("sim")
    assert target == plain.model_copy(update={"target": "sim"})


def test_a_key_of_a_target_replaces_the_key_of_the_same_name() -> None:
    found = parse('[targets.robots]\ncommand = "robots"\nplatform = "argos"').for_target("robots")
    assert (found.command, found.platform, found.template) == (("robots",), "argos", "arena.xml")


def test_a_table_of_a_target_is_merged_key_by_key() -> None:
    found = parse("[targets.robots.limits]\nwall = 60").for_target("robots")
    assert (found.limits.wall, found.limits.memory) == (60, 2**30)


def test_what_is_within_a_key_of_a_table_is_replaced_as_a_whole() -> None:
    found = parse('[targets.robots.outputs.swarm]\nfile = "log.csv"').for_target("robots")
    assert (found.outputs["swarm"].file, found.outputs["swarm"].time) == ("log.csv", "")
    assert found.outputs["energy"].file == "energy.csv"


@pytest.mark.parametrize(
    ("keys", "template", "templates"),
    [
        ('template = "robots.yaml"', "robots.yaml", {}),
        ('templates = { world = "w.sdf", params = "p.yaml" }', None, {"world": "w.sdf", "params": "p.yaml"}),
        ("templates = {}", None, {}),
        ('files = ["maps"]', "arena.xml", {}),
    ],
)
def test_templates_of_a_target_replace_all_templates_and_their_format(
    keys: str, template: str | None, templates: dict[str, str]
) -> None:
    found = parse(f"[targets.robots]\n{keys}").for_target("robots")
    assert (found.template, found.templates) == (template, templates)
    assert found.template_format == ("xml" if template == "arena.xml" else None)


def test_the_changes_of_a_target_replace_the_changes_of_a_variable() -> None:
    project = parse('[variables.noise.targets.robots]\nargument = "--noise {value}"', "[targets]\nsim = {}\nrobots = {}")
    robots, sim = (project.for_target(name).variables["noise"] for name in ("robots", "sim"))
    assert (robots.set, robots.argument, robots.label) == (None, ("--noise", "{value}"), "Noise")
    assert (sim.set, sim.argument, sim.label) == ("//noise", (), "Noise")


def test_the_short_form_of_a_change_for_a_target_is_the_path_alone() -> None:
    project = parse('[variables.noise.targets]\nrobots = "/noise"', '[seed.targets]\nrobots = "/seed"', "[targets.robots]")
    found = project.for_target("robots")
    assert (found.variables["noise"].set, found.seed.set, found.seed.base) == ("/noise", "/seed", 7)


def test_a_controller_has_other_changes_for_a_target() -> None:
    project = parse(
        '[controllers.avoid.targets.robots]\nchanges = [{ set = "/controller", value = "avoid" }]', "[targets.robots]"
    )
    assert [change.set for change in project.for_target("robots").controllers["avoid"].changes] == ["/controller"]


ASKING = (
    "runs",
    "controller",
    "scenario",
    "per_run",
    "queries",
    "numbers",
    "paper",
    "figure_formats",
    "figures",
    "figure_defaults",
    "paper_tables",
    "comparison_methods",
    "criteria",
    "equivalence",
    "determinism",
    "store",
    "tables",
    "sql",
    "comparisons",
    "claims",
    "plugins",
)
OWN_TARGETS = ("target", "targets", "variables", "controllers", "scenarios", "seed")


@pytest.mark.parametrize("key", Project.model_fields)
def test_only_keys_that_say_how_runs_execute_can_be_in_a_target(key: str) -> None:
    with pytest.raises(ConfigError) as raised:
        project_file.parse({"targets": {"robots": {key: {"?": None}}}}, "sierra.toml")
    refused = f"robots.{key} cannot be in a target" in str(raised.value)
    assert refused == (key in ASKING + OWN_TARGETS)
    assert f"unknown key 'targets.robots.{key}'" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[targets.robots]\ncomand = 'x'", "unknown key 'targets.robots.comand'; did you mean 'command'?"),
        ("[targets.robots.limits]\nwal = 3", "unknown key 'targets.robots.limits.wal'; did you mean 'wall'?"),
        ("[targets.robots.limits]\nwall = '3'", 'targets.robots.limits.wall should be a number, not "3"'),
        ("[targets.robots]\nruns = 3", "targets: robots.runs cannot be in a target; it is the same for all targets"),
        (
            "[targets.robots.variables.noise]\nset = '/n'",
            "targets: robots.variables cannot be in a target; write [variables.….targets.robots]",
        ),
        ("[targets.robots.seed]\nset = '/n'", "targets: robots.seed cannot be in a target; write [seed.targets.robots]"),
        (
            "[targets.robots]\n[variables.noise.targets.robot]\nset = '/n'",
            "variables.noise.targets: unknown target 'robot'; known are robots",
        ),
        ("[seed.targets]\nrobots = '/n'", "seed.targets: unknown target 'robots'; sierra.toml declares no [targets.NAME]"),
        (
            "[targets.robots]\n[variables.noise.targets.robots]\nsett = '/n'",
            "unknown key 'variables.noise.targets.robots.sett'; did you mean 'set'?",
        ),
        (
            "[targets.robots]\n[variables.speed]\nlabel = 'Speed'",
            'variables.speed: it changes nothing; give it "set", "repeat", "changes", "argument" or "environment", '
            "here or in [variables.speed.targets.robots]",
        ),
        (
            "[targets.robots]\ntemplate = 'a'\ntemplates = { b = 'b' }",
            'targets.robots: "template" and "templates" exclude each other; give the file a name in "templates"',
        ),
        ("[targets.robots.runners.slurm]\ndirectives = ['--array=1-3']", "targets.robots.runners: directive '--array=1-3'"),
        ("[targets]\nrobots = 3", "targets.robots should be a table, not 3"),
        ("[targets]\nsim.target = 'x'", "targets: sim.target cannot be in a target"),
        ("[targets]\nsim.services.bridge.command = 'bridge'", "'targets.sim.services.bridge.ready' is missing"),
        ("[targets.'a-b']", "'a-b' is not a valid name"),
    ],
)
def test_what_is_wrong_in_a_target_is_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        parse(text)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_an_unknown_default_target_is_an_error() -> None:
    for text, known in (("", "sierra.toml declares no [targets.NAME]"), ("[targets.sim]", "known are sim")):
        with pytest.raises(ConfigError, match="target: unknown target 'robots'") as raised:
            project_file.parse(tomllib.loads(f'target = "robots"\n{text}'), "sierra.toml")
        assert known in str(raised.value)


def test_the_name_of_the_default_target_cannot_be_empty() -> None:
    with pytest.raises(ConfigError, match="target: '' is not a valid name"):
        project_file.parse({"target": "", "targets": {"sim": {}}}, "sierra.toml")


def test_services_and_commands_around_a_run_can_be_in_a_target() -> None:
    bridge = '{ command = "bridge", ready = { output = "listening" } }'
    found = parse(f'[targets.robots]\nservices.bridge = {bridge}\nbefore = "calibrate"').for_target("robots")
    assert (list(found.services), found.before) == (["bridge"], (("calibrate",),))


def test_an_unknown_target_is_named_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match="unknown target 'robot'; known are sim, robots"):
        parse("[targets.sim]\n[targets.robots]").for_target("robot")
