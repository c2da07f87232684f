"""Checks of a plan before anything executes: names, paths and arguments that cannot work."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from sierra.config.project_file import LoadedProject, Project
from sierra.design import run_values
from sierra.design.factorial_design import GROUPED
from sierra.errors import ConfigError, Missing
from sierra.execution import commands, input_texts
from sierra.model import IN_PROJECT, Batch, Query
from sierra.provenance import referenced_files
from sierra.store.layout import ProjectPaths
from sierra.store.schema import RESERVED, check_name
from sierra.templates.base import ARGUMENTS
from sierra.util.text import few


def check_paths(config: Project, query: Query, root: Path) -> None:
    """Raise ConfigError if a template or a change names a file of the project by its absolute path on this machine."""
    inside = re.compile("(?:" + "|".join(re.escape(f"{folder}/") for folder in {root, root.resolve()}) + r")([^\s\"'<>,;]+)")
    texts = [(path, referenced_files.text(root / path)) for path in config.template_paths]
    texts += [("sierra.toml", text) for text in input_texts.written(config)]
    texts += [(change.why, change.value) for change in query.sets]
    for where, text in texts:
        if path_here := inside.search(text):
            raise ConfigError(
                f"{where}: {path_here[0]} is a path of this machine, and ids must not depend on it; "
                f'write value = "{IN_PROJECT}{path_here[1]}" in a change'
            )


def check_arguments(batch: Batch, config: Project, command: Sequence[str], declared: run_values.Declared) -> None:
    """Raise ConfigError if `{arguments}` stands for nothing, or if both template and variables give arguments."""
    given = ARGUMENTS in batch.runs[0].names
    if given and declared.arguments is not None:
        raise ConfigError(f'{few(config.template_paths, 1)} provides arguments; use no "argument" of variables or the seed too')
    if commands.SPLICED in command and not given:
        of = f"{config.template} provides none" if config.template else "there is none"
        raise ConfigError(f"command: {commands.SPLICED} needs a template that provides arguments; {of}")


def check_names(project: LoadedProject) -> None:
    """Check the names of outputs and variables against the store's own, and that the store's path is not a file.

    Also checks that an output has no column names together with a header. Raises ConfigError, Missing.
    """
    for name, output in project.config.outputs.items():
        if not check_name(name):
            raise ConfigError(f"{project.file}: [outputs.{name}]: the store itself has a table {name!r}; use another name")
        if output.columns and output.header:
            hint = "columns is only for a CSV without header; set header = false too, or remove columns"
            raise ConfigError(f"{project.file}: [outputs.{name}]: {hint}")
    for name in project.config.variables:
        if name.lower() in RESERVED:
            raise ConfigError(
                f"{project.file}: variable {name!r}: the store itself has a column of that name; use another name"
            )
        if (group := name.lower()) in GROUPED and (name != group or getattr(project.config, f"{group}s")):
            cure = f"is [variables.{name}] or [{group}s.NAME], not both" if name == group else f"is written {group!r}"
            raise ConfigError(f"{project.file}: variable {name!r}: a {group} {cure}")
    root = ProjectPaths(project.root)
    if root.store.exists() and not root.store.is_dir():
        raise Missing(f"{root.store} is a file, but the store must be a folder with this path")
