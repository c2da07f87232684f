"""The platform for any program that reads the generated file and writes into its output folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.config.project_file import Project
from sierra.design.platforms.base import Reader
from sierra.errors import ConfigError
from sierra.model import Axis, Change, Criterion, Point


class Command:
    """The platform `command`: arguments with placeholders; the project defines everything else."""

    Options: ClassVar[type[Table]] = NoOptions
    usual_files: ClassVar = ("input.xml",)

    def __init__(self, project: Project, options: NoOptions) -> None:
        if not project.command:
            raise ConfigError('platform "command" needs a command, as in: command = "python3 sim.py {input}"')
        self._command = project.command
        self._file = "input" + (PurePosixPath(project.template or "").suffix or ".xml")

    def changes(self, template: Reader) -> tuple[Change, ...]:
        return ()

    def seed_changes(self) -> tuple[Change, ...]:
        return ()

    def criterion(self, criterion: Criterion, template: Reader) -> tuple[Axis, tuple[Point, ...]] | None:
        return None

    def criteria(self) -> Mapping[str, str]:
        return {}

    def check(self, document: Reader, template: Reader) -> None:
        """Accept every input, because nothing is known about the format that a program reads."""

    def command(self) -> tuple[str, ...]:
        return self._command

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        return ((self._file, document),)

    def environment(self) -> Mapping[str, str]:
        return {}
