"""How one simulator or robot stack is driven: the Platform contract, and the door to find one by name.

Shipped: `command` (any program) and `argos`. Others come as entry points of the group `sierra.platforms`,
each naming a class that fulfils `Platform`; `sierra.testing.platforms` holds them to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from sierra.config.project_file import Project, Table, options
from sierra.errors import ConfigError
from sierra.model import Axis, Change, Criterion, Point
from sierra.util import entry_points

SHIPPED = {
    "command": "sierra.platforms.command:Command",
    "argos": "sierra.platforms.argos:Argos",
}


class Reader(Protocol):
    """What a platform may ask of a template, be it as it is in its file or as changes have left it."""

    def find(self, path: str) -> tuple[str, ...]:
        """The text of each attribute, text or element that an XPath 1.0 expression selects, in document order."""
        ...


class Platform(Protocol):
    """One way to drive a simulator. Made once per batch from the project; holds no state of a run.

    All methods may be called many times and must give the same answer for the same project and template:
    what they return becomes part of what a run's identity is made from.
    """

    Options: ClassVar[type[Table]]
    """What `[platforms.NAME]` may hold. Such a table is checked wherever it stands, whichever platform drives."""

    def __init__(self, project: Project) -> None:
        """Raises ConfigError where the project's options for this platform are not as they should be."""
        ...

    def changes(self, template: Reader) -> tuple[Change, ...]:
        """What this platform changes in every run's input, before anybody else does; `template` is as in its file."""
        ...

    def seed_changes(self) -> tuple[Change, ...]:
        """Where the seed (`{seed}`) goes by this platform's own rules; may be none."""
        ...

    def criterion(self, criterion: Criterion, template: Reader) -> tuple[Axis, tuple[Point, ...]] | None:
        """What a criterion of this platform's own means, or None where it has none of that name.

        `template` is what an experiment's input is without this criterion: with all changes made, this platform's
        own, the project's, controller's, scenario's, variables' and `--set`, but those that use a value of this
        platform's criteria. It may be asked with several templates for one batch; the axis must be the same for all.
        A variable of the project of the same name goes first. Raises QueryError where the criterion is the
        platform's, but its scale does not fit. `sierra.query.ranges.values` gives a scale's numbers.
        """
        ...

    def criteria(self) -> Mapping[str, str]:
        """The names of the criteria that `criterion` knows, each with a sentence."""
        ...

    def check(self, document: Reader, template: Reader) -> None:
        """Raise TemplateError where the input of a run, with all changes made, can't be right.

        `template` is as in its file. Where only the seed differs between the runs of an experiment, one of them is checked.
        """
        ...

    def command(self) -> tuple[str, ...]:
        """The program and its arguments, with placeholders: `{input}`, `{output}`, `{seed}`, `{project}`, …"""
        ...

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        """The input files that one generated document becomes, by name; the first is `{input}`."""
        ...

    def environment(self) -> Mapping[str, str]:
        """Variables that this simulator needs; part of a run's identity, so without paths of this machine."""
        ...


def find(name: str, project: Project) -> Platform:
    """The platform of that name, made for a project.

    Raises ConfigError where there is none, and where a table `[platforms.NAME]` is not as that platform's should be.
    """
    for other, table in project.platforms.items():
        if other not in names():
            raise ConfigError(f"[platforms.{other}]: unknown platform {other!r}; known are {', '.join(names())}")
        options(_load(other).Options, table, f"[platforms.{other}]")
    made: Platform = _load(name)(project)
    return made


def names() -> tuple[str, ...]:
    """All platforms that can be named here, the shipped ones first."""
    return entry_points.names("platform", SHIPPED)


def _load(name: str) -> Any:
    return entry_points.find("platform", SHIPPED, name)
