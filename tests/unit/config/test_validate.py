"""All errors of a sierra.toml are printed at once, in the order of the file, one line each."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.config import project_file
from sierra.errors import ConfigError
from tests import projects

CONFIG = """
template = "arena.xml"
command = "python3 sim.py {input}"
rnus = 3
limits.wall = -1
[outputs.swarm]
colums = 5
[variables.population_size]
set = "//swarm/@count"
unit = 3
[per_run]
pairs = [[1], [2]]
[[changes]]
value = 3
"""
ERRORS = [
    "unknown key 'rnus'; did you mean 'runs'?",
    "limits.wall should be greater than 0, not -1",
    "unknown key 'outputs.swarm.colums'; did you mean 'columns'?",
    "'outputs.swarm.file' is missing",
    "variables.population_size.unit should be text, not 3",
    "per_run.pairs.0 should be text, not [1]",
    "per_run.pairs.1 should be text, not [2]",
    "changes.0: a change needs exactly one of set, add, remove, rename",
]
TARGETS = """
[targets.sim]
command = 3
[targets.field]
limits.wall = -1
limits.wal = 3
"""
CLUSTERS = """
[targets.sim]
[runners.slurm]
wal = 3
wall = "long"
[runners.pbs]
cpus = 0
"""


def complaints(folder: Path, config: str) -> list[str]:
    """Return what the command line says about a configuration, without the name of the file."""
    done = projects.quick(projects.make(folder, config), "run", "-n", "population_size=1")
    assert (done.returncode, done.stdout) == (2, "")
    begin = f"sierra: {folder}/sierra.toml: "
    lines = done.stderr.splitlines()
    assert all(line.startswith(begin) or "more" in line for line in lines), lines
    return [line.removeprefix(begin) for line in lines]


def test_all_errors_are_printed_in_the_order_of_the_file(tmp_path: Path) -> None:
    assert complaints(tmp_path, CONFIG) == ERRORS


def test_an_error_that_follows_from_another_is_left_out(tmp_path: Path) -> None:
    """The list `pairs` has no valid item, and would therefore be too short."""
    assert not [line for line in complaints(tmp_path, CONFIG) if "not be empty" in line]


def test_errors_in_several_targets_are_printed(tmp_path: Path) -> None:
    config = projects.CONFIG.replace("[variables]", f"{TARGETS}[variables]")
    assert complaints(tmp_path, config) == [
        "targets.sim.command should be a list, not 3",
        "targets.field.limits.wall should be greater than 0, not -1",
        "unknown key 'targets.field.limits.wal'; did you mean 'wall'?",
    ]


def test_errors_in_several_clusters_are_printed_once(tmp_path: Path) -> None:
    head, _, tables = projects.CONFIG.partition("[variables]")
    assert complaints(tmp_path, f'{head}target = "nowhere"\n{CLUSTERS}[variables]{tables}') == [
        "unknown key 'runners.slurm.wal'; did you mean 'wall'?",
        'runners.slurm.wall should be a number, not "long"',
        "runners.pbs.cpus should be greater than 0, not 0",
        "target: unknown target 'nowhere'; known are sim",
    ]


def test_at_most_20_errors_are_printed(tmp_path: Path) -> None:
    many = "".join(f"unknown{number} = 1\n" for number in range(30))
    lines = complaints(tmp_path, f"{many}{projects.CONFIG}")
    assert len(lines) == 21
    assert lines[19].startswith("unknown key 'unknown19'; known are ")
    assert lines[20] == "sierra: … and 10 more"


def test_the_error_for_python_has_the_others_as_notes() -> None:
    with pytest.raises(ConfigError, match="unknown key 'rnus'") as raised:
        project_file.parse({"rnus": 3, "template": 5, "command": "true"}, "sierra.toml")
    assert raised.value.__notes__ == ["sierra.toml: template should be text, not 5"]


def test_errors_in_the_tables_of_several_plugins_are_printed(tmp_path: Path) -> None:
    config = f"{projects.CONFIG}[platforms.commnd]\n[links.shh]\n[readers.sv]\n[statistics.mode]\n"
    done = projects.quick(projects.make(tmp_path, config), "run", "-n", "population_size=1")
    assert done.returncode == 2
    lines = done.stderr.splitlines()
    assert [line.partition("]")[0] for line in lines] == [
        f"sierra: [{name}" for name in ("platforms.commnd", "links.shh", "readers.sv", "statistics.mode")
    ]
