"""The platform for any program that reads the generated file and writes into its output folder."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.config.project_file import Project
from sierra.design.platforms.base import Platform
from sierra.errors import ConfigError


class Command(Platform):
    """The platform `command`: arguments with placeholders; the project defines everything else."""

    Options: ClassVar[type[Table]] = NoOptions
    usual_files: ClassVar = ("input.xml",)

    def __init__(self, project: Project, options: NoOptions) -> None:
        if not project.command:
            raise ConfigError('platform "command" needs a command, as in: command = "python3 sim.py {input}"')
        self._command = project.command
        self._file = "input" + (PurePosixPath(project.template or "").suffix or ".xml")

    def command(self) -> tuple[str, ...]:
        return self._command

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        return ((self._file, document),)
