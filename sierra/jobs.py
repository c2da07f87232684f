"""From a run to a job: the command and the environment of one execution, with placeholders filled in.

Placeholders of a command: `{input}` the first input file, `{output}` the folder to write to (also the working
directory), `{run}` the run's own folder, `{seed}`, `{project}` the project's root, `{python}` the Python that
runs SIERRA; `{{name}}` stands for `{name}` itself. A word that names a file, as seen from the project's root,
stands for `{project}/word`: runs have folders of their own.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from sierra.config import Project
from sierra.engines import Engine
from sierra.errors import ConfigError
from sierra.hashing import digest
from sierra.model import Job, Limits, Recipe, Run
from sierra.paths import RUN_HOME, RUN_OUTPUT, RUN_TMP
from sierra.platforms import Platform

PLACEHOLDER = re.compile(r"\{\{([a-z_]+)\}\}|\{([a-z_]+)\}")
ABOVE = re.compile(r"(?<!\{)\{project\}((?:/\.\.)+)(?=/|$)")
KNOWN = ("input", "output", "run", "seed", "project", "python")
FIXED = {
    "PYTHONHASHSEED": "0",
    "PYTHONDONTWRITEBYTECODE": "1",
    "TZ": "UTC",
    "LC_ALL": "C.UTF-8",
    "LANG": "C.UTF-8",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
}
"""What every run sees, whoever asks; part of its identity."""
OWN = ("HOME", "TMPDIR")
HERE = "\0"
"""The run's folder, which only the worker knows."""


def command(platform: Platform, root: Path) -> tuple[str, ...]:
    """The command as a run's identity holds it. Raises ConfigError for an unknown placeholder."""
    words = tuple(_in_project(word, root) for word in platform.command())
    for word in words:
        for _, name in PLACEHOLDER.findall(word):
            if name and name not in KNOWN:
                known = ", ".join("{" + known + "}" for known in KNOWN)
                told = f"known are {known}; {{{{{name}}}}} stands for {{{name}}} itself"
                raise ConfigError(f"command: unknown placeholder {{{name}}} in {word!r}; {told}")
    return words


def environment(platform: Platform, project: Project) -> dict[str, str]:
    """The declared variables of a run: SIERRA's fixed ones, the platform's, the project's.

    Raises ConfigError for one that each run has of its own.
    """
    for name in (*project.environment.pass_, *project.environment.set):
        if name in OWN or name.startswith("SIERRA_"):
            raise ConfigError(f"[environment] {name}: each run has its own; take another name")
    passed = {name: os.environ[name] for name in project.environment.pass_ if name in os.environ}
    return {**FIXED, **platform.environment(), **passed, **project.environment.set}


def declared(variables: Mapping[str, str], root: Path, project: Path | None = None) -> dict[str, str]:
    """The declared variables with the paths of this machine, and the PATH of runs."""
    filled = {name: fill((value,), root, project=project)[0] for name, value in variables.items()}
    return {**filled, "PATH": search_path(filled)}


def search_path(variables: Mapping[str, str]) -> str:
    """The PATH of runs: the declared one, or the caller's."""
    return variables.get("PATH", os.environ.get("PATH", os.defpath))


def fill(
    words: Iterable[str], root: Path, values: Mapping[str, str] | None = None, *, project: Path | None = None
) -> tuple[str, ...]:
    """The placeholders of the machine filled in; those of a run too, where `values` are given.

    The code lies in `root`; what is outside of it (`{project}/../build`) is where the user has the `project`.
    """
    known = {"project": str(root), "python": sys.executable, **(values or {})}

    def filled(match: re.Match[str]) -> str:
        return f"{{{match[1]}}}" if match[1] else known.get(match[2], match[0])

    def above(match: re.Match[str]) -> str:
        return os.path.normpath(f"{(project or root).resolve()}{match[1]}")

    return tuple(PLACEHOLDER.sub(filled, ABOVE.sub(above, word)) for word in words)


def limits(project: Project) -> Limits:
    """The limits of each execution."""
    table = project.limits
    return Limits(table.wall, table.cpu, table.memory, table.output, table.grace)


class Maker:
    """Makes the jobs of one session."""

    def __init__(
        self, recipe: Recipe, root: Path, engine: Engine, bounds: Limits, session: str, project: Path | None = None
    ) -> None:
        """`root` is where the code is, `project` where the user has it."""
        self._recipe = recipe
        self._root = root
        self._project = project
        self._engine = engine
        self._bounds = bounds
        self._session = session
        self._environment = {
            **declared(recipe.environment, root, project),
            "HOME": f"{HERE}/{RUN_HOME}",
            "TMPDIR": f"{HERE}/{RUN_TMP}",
            "SIERRA_RUN_DIR": HERE,
            "SIERRA_SESSION": session,
        }

    def job(self, run: Run, files: tuple[tuple[str, bytes], ...]) -> Job:
        """The job that executes a run in this session."""
        execution = digest("execution", {"session": self._session, "run": run.id})
        values = {
            "input": f"{HERE}/{files[0][0]}",
            "output": f"{HERE}/{RUN_OUTPUT}",
            "run": HERE,
            "seed": str(run.seed),
        }
        own = {"SIERRA_RUN_ID": run.id, "SIERRA_SEED": str(run.seed), "SIERRA_EXECUTION": execution}
        argv = self._engine.argv(fill(self._recipe.command, self._root, values, project=self._project))
        return Job(run.id, execution, argv, {**self._environment, **own}, files, self._bounds)


def _in_project(word: str, root: Path) -> str:
    """`sim.py` is `{project}/sim.py` where there is such a file, and `../build/sim` likewise."""
    if "{" in word or not word or word.startswith(("/", "-")):
        return word
    try:
        there = (root / word).is_file()
    except (OSError, ValueError):
        return word
    return "{project}/" + word.removeprefix("./") if there else word
