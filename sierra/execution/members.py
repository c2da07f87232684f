"""Members of runs, which are robots: their commands and outputs, and what is refused.

Each robot writes into a folder of its own, named by its place. An output with `file = "swarm.csv"` is therefore read from
`{robot}/swarm.csv`: the files of all robots become one table with the column `robot`. A `file` that begins with a place
(`0/tracking.csv`), or with `{robot}/` or `{place}/`, stays as it is.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from sierra.config.output_tables import PLACEHOLDER, Output
from sierra.config.project_file import Project
from sierra.config.robots_table import ROBOT
from sierra.design import robots
from sierra.design.factorial_design import changes, mentions
from sierra.design.run_values import Declared
from sierra.errors import ConfigError
from sierra.execution import commands
from sierra.execution.plan import Plan
from sierra.ingest.robot_files import FOLDERS, OF_ROBOT
from sierra.runners.base import Runner, RunsMembers, check_members
from sierra.templates.base import Files
from sierra.util.lazy_definitions import regex

OF_PLACE = regex(rf"(\./)?([0-9]+/|{'|'.join(map(re.escape, FOLDERS))})")


def configured(config: Project) -> Project:
    """Return the project with the command and the outputs of its robots, if its runs take robots. Raises ConfigError."""
    if config.robots is None:
        return config
    _check(config)
    outputs = {name: _of_robots(name, output) for name, output in config.outputs.items()}
    return config.model_copy(update={"command": config.robots.command or config.command, "outputs": outputs})


def _check(config: Project) -> None:
    """Raise ConfigError for settings that runs on robots do not have."""
    around = {"before": config.before, "after": config.after, "[services]": config.services, "files": config.files}
    for name in (name for name, used in around.items() if used):
        raise ConfigError(f"{name} has no effect on robots; remove it there, or let the robots' own commands do it")
    _check_changes(config)


def _check_changes(config: Project) -> None:
    """Raise ConfigError for `{robot}` in a change that is made once for all runs of an experiment."""
    tables = {"changes": config.changes} | {
        f"variables.{name}": variable.changes for name, variable in config.variables.items()
    }
    for kind, groups in (("controllers", config.controllers), ("scenarios", config.scenarios)):
        tables |= {f"{kind}.{name}": group.changes for name, group in groups.items()}
    for key, table in tables.items():
        if any(mentions(change, robots.VALUE) for change in changes(table, key, "")):
            raise ConfigError(
                f"{key}: {{{robots.VALUE}}} differs between the robots of a run; use it in run_changes, or in the changes of "
                "[robots.groups.NAME]"
            )


def _of_robots(name: str, output: Output) -> Output:
    """Return an output as it is read from the folders of all robots. Raises ConfigError."""
    if OF_PLACE.match(output.file):
        return output
    if any(character in output.file for character in "*?["):
        raise ConfigError(
            f"[outputs.{name}] file: {output.file!r} cannot have * ? [ in runs on robots; name the file, or put a name in "
            "braces in place of a number"
        )
    if ROBOT in PLACEHOLDER.findall(output.file):
        raise ConfigError(f"[outputs.{name}] file: {{{ROBOT}}} is the folder of a robot; begin with it, or use another name")
    if ROBOT in output.own_columns:
        raise ConfigError(f"[outputs.{name}]: the column {ROBOT} is the place of a robot; use another name in braces")
    return output.model_copy(update={"file": OF_ROBOT + "/" + output.file.removeprefix("./")})


def of_groups(
    config: Project, root: Path, declared: Declared, produced: Iterable[str] = (), *, contained: bool = False
) -> Mapping[str, tuple[str, ...]] | None:
    """Return the commands of groups of places in the form that is part of a run's identity; None for runs without robots.

    Raises ConfigError and QueryError as `commands.checked`.
    """
    if config.robots is None:
        return None

    def checked(group: str, argv: tuple[str, ...]) -> tuple[str, ...]:
        key = f"[robots.{group}] command" if group == "base" else f"[robots.groups.{group}] command"
        known = (*commands.KNOWN_ON_ROBOTS, *declared.names)
        return commands.checked(
            argv, root, key, known, contained=contained, produced=tuple(produced), declared=declared, project=config
        )

    return {group: checked(group, argv) for group, argv in config.robots.commands.items()}


def check_paths(words: Iterable[str]) -> None:
    """Raise ConfigError for a word that names a file outside the project, which a robot does not have."""
    for word in words:
        if commands.ABOVE.search(word):
            raise ConfigError(f"command: {word!r} is outside of the project, which is all that a robot gets")


def check_fleet(runner: Runner, name: str, plan: Plan) -> None:
    """Raise UsageError if a runner cannot execute the runs of a plan, ConfigError if its fleet does not fit them."""
    on_robots, contained = plan.batch.spec.robots is not None, plan.engine.name != "none"
    check_members(runner, name, on_robots=on_robots, contained=contained)
    if isinstance(runner, RunsMembers):
        first = {experiment.runs[0].id for experiment in plan.batch.experiments}
        inputs = (files for _, files in plan.inputs.files(plan.batch, lambda run: run.id in first))
        check_places(runner, inputs, plan.project.robot_groups)


def places(files: Files) -> tuple[tuple[int, str], ...]:
    """Return the numbers of the places in the input files of a run, with their groups."""
    return tuple((place.number, place.group) for place, _ in robots.read(files))


def check_places(runner: RunsMembers, inputs: Iterable[Files], groups: Collection[str]) -> None:
    """Raise ConfigError if a fleet cannot take the places of runs with these inputs.

    `groups` are the groups of places that the project declares; recorded runs may have others.
    """
    runs = {places(files) for files in inputs}
    runner.check_robots(runs, dict.fromkeys((*groups, *sorted({group for places in runs for _, group in places}))))
