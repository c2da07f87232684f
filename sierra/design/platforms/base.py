"""The Platform contract for driving one simulator or robot stack, and the function to find one by name.

The core has the platform `command` (any program), extensions have those of simulators, and others are entry points of the group
`sierra.platforms` (see `sierra.plugin`). `sierra.testing.platforms` checks that they fulfil the contract.

Two class attributes are optional. `usual_files` are the names of input files that are no part of specifications: two platforms
have it since format 1 of ids, and classes that inherit from them have not. `finds_files` is True if a platform finds all files
that a template names, so that `sierra init` need not.
"""

from __future__ import annotations

import os.path
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from sierra.config.capture_table import Capture
from sierra.config.field_types import Table
from sierra.config.plugin_registry import PLATFORMS
from sierra.config.project_file import Project
from sierra.design.query.ranges import values
from sierra.errors import QueryError
from sierra.model import Axis, Change, Criterion, Point, Pose, Scale, Set
from sierra.util.lazy_definitions import dataclass, field

Spanned = tuple[Axis, tuple[Point, ...]]
"""The axis of a criterion, with a point for each of its values."""


class Reader(Protocol):
    """Read access to a template, either as in its file or after changes."""

    def find(self, path: str) -> tuple[str, ...]:
        """Return the text of each attribute, text or element that an XPath 1.0 expression selects, in document order."""


class Platform(Protocol):
    """One way to drive a simulator. It is created once per batch from the project, and holds no state of a run.

    All methods may be called many times, and must return the same for the same project and template, because a run's identity
    is made from their results. A class that inherits from this one needs only `command`, `files` and what differs.
    """

    Options: ClassVar[type[Table]]
    """The model of `[platforms.NAME]`. Such a table is always checked, even if another platform is used."""

    def __init__(self, project: Project, options: Table) -> None:
        """Make the platform; `options` is an object of `Options`. Raises ConfigError for an invalid project or option."""

    def changes(self, template: Reader) -> tuple[Change, ...]:
        """Return the platform's changes to every run's input; they are made before all others. `template` is as in its file."""
        return ()

    def seed_changes(self) -> tuple[Change, ...]:
        """Return the changes that write the seed (`{seed}`) by this platform's own rules; may be empty."""
        return ()

    def criterion(self, criterion: Criterion, template: Reader) -> Spanned | None:
        """Return the axis and the points of one of this platform's own criteria, or None for an unknown name.

        `template` is the experiment's input without this criterion. All changes of the platform, the project, controller,
        scenario, variables and `--set` are made, except those that use a value of this platform's criteria. The method may be
        called with several templates for one batch; the axis must be the same for all. A variable of the project with the same
        name takes precedence. Raises QueryError if the criterion is the platform's but its scale does not fit.
        `sierra.design.query.ranges.values` returns a scale's numbers, `population_size` the answer for that criterion.
        """
        return None

    def criteria(self) -> Mapping[str, str]:
        """Return the names of the criteria that `criterion` accepts, each with a description."""
        return {}

    def check(self, document: Reader, template: Reader) -> None:
        """Raise TemplateError if the input of a run, after all changes, cannot be correct.

        `template` is as in its file. If the runs of an experiment differ only in the seed, one of them is checked.
        """

    def command(self) -> tuple[str, ...]:
        """Return the program and its arguments, with placeholders: `{input}`, `{output}`, `{seed}`, `{project}`, …"""
        raise NotImplementedError

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        """Return the names and contents of the input files for one generated document; the first is `{input}`."""
        raise NotImplementedError

    def environment(self) -> Mapping[str, str]:
        """Return variables that this simulator needs. They are part of a run's identity, so they contain no local paths."""
        return {}


@runtime_checkable
class Following(Protocol):
    """A platform whose inputs have parts that follow other changes, for example walls that follow the arena."""

    def follow(self, document: Reader, base: Reader) -> tuple[Change, ...]:
        """Return the changes that make parts of an input fit what other changes made of it; they are made after all others.

        `document` is an experiment's input with all changes, without those of single runs. `base` is the template with only the
        platform's own changes. What another change has set must stay as it is.
        """


@dataclass(frozen=True, slots=True)
class Rendering:
    """The differences between a measured execution of a run and one with rendering."""

    command: tuple[str, ...]
    """The command, with its placeholders."""
    files: str
    """The names of the frames, relative to the output folder: `frames/{tick}.png`, or a glob."""
    changes: Callable[[Reader], Sequence[Change]] = lambda document: ()
    """The changes to the input of a run, which the function reads. They must not change what is simulated."""
    ticks_per_second: Callable[[Reader], float | None] = lambda document: None
    """The number of ticks, as the names of frames have them, in a second of a run's simulated time; None if unknown."""
    replaced: tuple[tuple[str, bytes], ...] = ()
    """Input files that take the place of those with the same names, in any folder."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Further variables."""
    display: tuple[int, int] | None = None
    """Width and height in pixels of an X display that is started for each run, in DISPLAY; None without one."""


@runtime_checkable
class Renders(Protocol):
    """A platform whose simulator can render frames, for `sierra video --capture`."""

    def rendering(self, capture: Capture, command: tuple[str, ...]) -> Rendering:
        """Return how a run with this recorded command is executed with rendering, as `[capture]` says.

        Raises ConfigError for a camera, a size or an interval that is not possible.
        """


@runtime_checkable
class Placing(Protocol):
    """A platform whose inputs tell robots where they start, so that a person places them there.

    It refuses start poses in `[trials]` that would say another place: a run has one declaration of them.
    """

    def start_poses(self, document: bytes) -> tuple[Pose, ...]:
        """Return the start poses in the first input file of a run, in the order of its robots; none if none are declared.

        In a run on robots, each robot has its own input file, with its own pose.
        """


def find(name: str, project: Project) -> Platform:
    """Return a project's platform. Raises ConfigError for an unknown name, or for an invalid table `[platforms.NAME]`."""
    PLATFORMS.check(project.platforms)
    platform: Platform = PLATFORMS.make(name, project.platforms, project)
    return platform


def driver_path(template: str, name: str, *, is_among_files: bool) -> str:
    """Return the path of a driver in a command: beside the input, which lies in its template's folder among other files."""
    folder = os.path.dirname(os.path.normpath(template)) if is_among_files else ""  # noqa: PTH120
    return "/".join(("{run}", *filter(None, (folder,)), name))


def driver_files(platform: str, *names: str) -> tuple[tuple[str, bytes], ...]:
    """Return programs that runs need, as input files: those in the folder `drivers` beside the module `platform`, its path."""
    return tuple((name, (Path(platform).parent / "drivers" / name).read_bytes()) for name in names)


def population_size(scale: Scale, path: str) -> Spanned:
    """Return the axis and the points of the criterion `population_size` for a platform that writes it at a path.

    Raises QueryError for a value that is not a whole number of 1 or more.
    """
    sizes = values(scale)
    for size in sizes:
        if isinstance(size, str) or size < 1 or size != int(size):
            raise QueryError(f"population_size: {size} is not a whole number of 1 or more; use population_size=1,2,4")
    points = tuple(Point(size, (Set(path, str(size), expect=1, why="population_size"),)) for size in sizes)
    return Axis("population_size", sizes, "population size"), points
