"""Any extension can be deleted: nothing else needs it, and what was made with it can be read."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

import sierra
from sierra.config.extensions import ADDS
from tests import projects

ROOT = Path(__file__).parents[2]
PROGRAM = """
import importlib, json, os, pkgutil, sys, tempfile
import sierra
from sierra.config.extensions import is_there
for module in pkgutil.walk_packages(sierra.__path__, "sierra."):
    extension = module.name.removeprefix("sierra.extensions.").partition(".")[0]
    if not module.name.startswith("sierra.extensions.") or is_there(extension):
        importlib.import_module(module.name)
from sierra.cli.main import program
ended = []
for folder, *words in json.loads(sys.argv[1]):
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        if not (child := os.fork()):
            os.dup2(out.fileno(), 1), os.dup2(err.fileno(), 2), os.chdir(folder)
            sys.argv = ["sierra", *words]
            program()
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        ended.append([code, *(os.pread(file.fileno(), 1 << 20, 0).decode() for file in (out, err))])
print(json.dumps(ended))
"""
"""Imports all modules, and executes the commands in its argument, each in a process of its own; prints what they said."""


class Use(NamedTuple):
    """The use of an extension by a project."""

    traces: tuple[str, ...]
    """Words in `--help`, `init --help`, `files --help` and `schema sierra.toml` that only appear where it exists."""
    config: str = ""
    """The lines of sierra.toml that need it."""
    refused: str = ""
    """The beginning of the message without it."""
    refuses: tuple[str, ...] = ("run", "-n", "population_size=5")
    """The command that is refused without it."""


USES = {
    "argos": Use(("[platforms.argos]",), "[platforms.argos]\nthreads = 1\n", "[platforms.argos]: the platform 'argos'"),
    "collect": Use(
        ("collect  ",),
        "[runners.collected]\n",
        "[runners.collected]: the runner 'collected'",
        ("run", "--on", "collected", "population_size=5"),
    ),
    "explorer": Use(
        ("sierra explore", "explore  "),
    ),
    "figures": Use(
        ('kind = "ridge"', '"pareto"'),
        '[figures.densities]\nkind = "ridge"\ntable = "swarm"\ncolumn = "coverage"\n[figures.some]\ninherit = "densities"\n',
        "[figures.densities]: the figure 'ridge'",
    ),
    "formats": Use(
        ('"sqlite"',),
        '[outputs.notes]\nfile = "notes.db"\nformat = "sqlite"\nrows = "notes"\n',
        "[outputs.notes] format: 'sqlite'",
    ),
    "gazebo": Use(("[platforms.gazebo]",), "[platforms.gazebo]\nlength = 1.0\n", "[platforms.gazebo]: the platform 'gazebo'"),
    "hosts": Use(("--hosts", "--link"), "[links.openssh]\nsessions = 4\n", "[links.openssh]: the link 'openssh'"),
    "lab": Use(
        ("hosts_file",),
        '[runners.lab]\nhosts = ["a"]\n',
        "[runners.lab]: the scheduler 'lab'",
        ("run", "-n", "--on", "lab", "population_size=5"),
    ),
    "robots": Use(
        ("[runners.robots]",),
        '[runners.robots]\nstop = []\n[runners.robots.fleet.a]\nhost = "a"\n',
        "[runners.robots]: the runner 'robots'",
        ("run", "--on", "robots", "population_size=5"),
    ),
    "ros": Use(
        ("[platforms.ros]", "--recover"),
        '[outputs.goals]\nfile = "run.bag"\nformat = "bag"\ntopics = ["/goal"]\nrequired = false\n'
        '[outputs.odom]\nfile = "run.bag"\nformat = "bag"\ntopics = ["/odom"]\nrequired = false\n',
        "[outputs.goals] format: 'bag'",
    ),
    "sierra1": Use(("--from-sierra1",)),
    "simulators": Use(("[platforms.sumo]",), "[platforms.sumo]\nend = 1.0\n", "[platforms.sumo]: the platform 'sumo'"),
    "trials": Use(
        ("trial  ", "[trials]"),
        '[trials]\norder = "random"\n',
        "'trials'",
    ),
    "videos": Use(
        ("video  ", "capture  ", "[videos", "[capture]"),
        '[capture]\nwall = 60\n[videos.map]\nkind = "poses"\ntable = "swarm"\ncolumn = ["tick", "coverage"]\n',
        "'videos'",
    ),
}
PACKAGE = '[package]\ntitle = "A study"\nauthors = [{ name = "Ada Lovelace" }]\nlicense = "MIT"\n'
SIMULATOR = f"""{projects.SIMULATOR}
import sqlite3
with sqlite3.connect("notes.db") as notes:
    notes.execute("CREATE TABLE notes AS SELECT 1 AS line")
notes.close()
"""


@pytest.fixture(scope="module")
def used(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project that uses all extensions, with a batch, its deliverables and a package of it."""
    config = "\n".join([projects.CONFIG, *(use.config for use in USES.values()), PACKAGE])
    root = projects.make(tmp_path_factory.mktemp("used") / "project", config, simulator=SIMULATOR)
    batch = projects.run(root, "population_size=4", "noise=0.5,0.6")[0]["batch"]
    for words in (("figures",), ("video",), ("package", batch, "--yes", "--no-report", "-o", "p.zip")):
        ended = projects.quick(root, *words)
        assert ended.returncode == 0, (words, ended.stderr)
    return root


def without(name: str, folder: Path, *commands: tuple[Path | str, ...]) -> list[tuple[int, str, str]]:
    """Return the exit code, output and errors of commands, each in a folder, with a copy of SIERRA without an extension."""
    shutil.copytree(ROOT / "sierra", folder / "sierra", copy_function=os.link)
    shutil.rmtree(folder / "sierra" / "extensions" / name)
    words = [[str(word) for word in command] for command in commands]
    variables = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "", "SIERRA_FIGURES": "no"}
    argv = [sys.executable, "-c", PROGRAM, json.dumps(words)]
    ended = subprocess.run(argv, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return [(code, out, err) for code, out, err in json.loads(ended.stdout)]


def test_each_extension_is_deleted_by_a_test() -> None:
    folders = {path.name for path in (ROOT / "sierra" / "extensions").iterdir() if path.is_dir()}
    assert USES.keys() == ADDS.keys() == folders - {"__pycache__"}


@pytest.mark.each_case
@pytest.mark.parametrize("name", ADDS)
def test_an_extension_can_be_deleted(name: str, used: Path, tmp_path: Path) -> None:
    use, batch = USES[name], sierra.open(used).batches[-1].batch
    plain = shutil.copytree(used, tmp_path / "plain")
    config = plain / "sierra.toml"
    config.write_text(config.read_text().replace(use.config, ""))
    *told, refused, ls, run, opened, ls_opened, notes, check, _, example = without(
        name,
        tmp_path / "copy",
        (tmp_path, "--help"),
        (tmp_path, "doctor", "--help"),
        (tmp_path, "init", "--help"),
        (tmp_path, "files", "--help"),
        (tmp_path, "schema", "sierra.toml"),
        (used, *use.refuses),
        (plain, "ls"),
        (plain, "run", "population_size=5", "--runs", "1"),
        (plain, "open", "p.zip"),
        (plain, "open", "p.zip", "ls"),
        (plain, "open", "p.zip", "sql", "SELECT count(line) AS n FROM notes"),
        (plain, "figures", batch, "--check"),
        (tmp_path, "init", "--example", "swarm", "demo"),
        (tmp_path / "demo", "doctor"),
    )
    assert [(code, word) for code, out, _ in told for word in use.traces if code or word in out] == []
    if use.config:
        assert refused[0] == 2
        assert use.refused in refused[2]
        assert f"belongs to the extension {name!r}, which is not installed; install sierra-{name}" in refused[2]
    assert "ok       options: the options of all plug-ins are valid" in example[1]
    for ended in (ls, run, opened, ls_opened, notes):
        assert ended[0] == 0, ended[2]
    assert notes[1].split() == ["n", "4"]
    if name in ("videos", "figures"):
        assert f"is ignored: the extension {name!r} is not installed" in opened[1]
    if name == "videos":
        assert "the extension that makes deliverables of kind" in check[1]
