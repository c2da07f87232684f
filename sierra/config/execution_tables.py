"""Tables of `sierra.toml` about how runs are executed: limits, environment, container, source, store, build, services."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, InstanceOf, PositiveInt, WithJsonSchema, model_validator

from sierra.config.field_types import (
    OF_WALL,
    ONE_OR_MORE,
    Absolute,
    Argv,
    Command,
    Grace,
    InProject,
    NotNegative,
    Positive,
    Size,
    SizeOrNone,
    Table,
    Text,
    VariableName,
    regular_expression,
    valid_path,
)
from sierra.errors import Missing
from sierra.util import processors
from sierra.util.processors import ARCH

SYSTEM = ("proc", "sys", "dev", "tmp")
"""Folders in a container where nothing can be mounted."""


def _in_container(path: str) -> str:
    """Check that something can be mounted at a path in a container."""
    parts = PurePosixPath(path).parts
    if parts[:1] != ("/",) or len(parts) < 2 or ".." in parts or parts[:3] == ("/", "run", "sierra") or parts[1] in SYSTEM:
        raise ValueError(f"{path!r} should be a path in the container such as /data (not in {', '.join(SYSTEM)} or run/sierra)")
    return str(PurePosixPath(path))


InContainer = Annotated[str, AfterValidator(_in_container)]
Device = Annotated[
    str,
    valid_path(lambda path: path.startswith("/dev/") and ".." not in PurePosixPath(path).parts, "a device, such as /dev/dri"),
]


def _whole_or_share(gpus: float) -> float:
    """Check that more than one GPU is a whole number of them."""
    if gpus > 1 and gpus != int(gpus):
        raise ValueError(f"{gpus:g} should be a whole number of GPUs, or a share of one such as 0.5")
    return gpus


class Varying(str):
    """A limit that depends on the variables of a query: a text with expressions in braces, as in the values of changes."""

    __slots__ = ()


OfVariables = Annotated[
    InstanceOf[Varying],
    BeforeValidator(lambda value: Varying(value) if isinstance(value, str) and "{" in value else value),
    WithJsonSchema({"type": "string", "pattern": r"\{"}),
]


class OwnLimits(Table):
    """Limits of one execution, each of which may depend on variables (`"{population_size * 4} MiB"`); missing: no limit."""

    wall: Annotated[Positive | OfVariables | None, OF_WALL] = None
    cpu: Positive | OfVariables | None = Field(None, description="CPU time of all its processes, in seconds")
    memory: Size | OfVariables | None = Field(
        None, description="resident memory of all its processes, in bytes or as in `2 GiB`"
    )
    output: Size | OfVariables | None = Field(
        None,
        description="total size of the files in its folder, in bytes or as in `500 MB`; holes of sparse files are included",
    )


class LimitsTable(OwnLimits):
    """Limits of one execution, each of which may depend on variables (`"{population_size * 4} MiB"`); missing: no limit."""

    grace: Grace = 5.0
    after_marker: NotNegative | None = Field(
        None,
        description="time from the moment when the marker of `[success]` is met until the run is ended and counts, in seconds, "
        "for a program that does not end by itself; default: a run is never ended for its marker",
    )
    cores: Positive | OfVariables | None = Field(
        None,
        description="cores that a run holds while it executes, rounded up: as many runs execute at a time as cores suffice "
        "for; default: one",
    )
    gpus: Annotated[Positive, AfterValidator(_whole_or_share)] | OfVariables | None = Field(
        None,
        description="GPUs that a run holds while it executes, a whole number or a share of one such as `0.25`; as many runs "
        "execute at a time as GPUs suffice for; default: runs are given no GPU of their own",
    )


class Environment(Table):
    """Environment variables that runs get in addition to SIERRA's own, and variables that are recorded."""

    set: Mapping[VariableName, Text] = Field(
        default_factory=dict,
        description="variables that every run gets; part of its identity; may use the placeholders of `command`",
    )
    pass_: tuple[str, ...] = Field(
        (), alias="pass", description="names of variables that runs get from the caller's environment; part of their identity"
    )
    record: tuple[str, ...] = Field(
        (), description="names of the caller's variables to record (`*` matches any characters); runs do not get them"
    )


class Container(Table):
    """The image in which runs execute, and their access to the host; by default they can use neither network nor devices."""

    image: str = Field(
        min_length=1,
        description="a tag, an archive, a SIF or squashfs file, or the folder of a recipe; see `sierra image pin`. {arch} in "
        "it is the processor of the host that executes a run: a name for several images",
    )
    engine: str = Field("podman", description="container engine: `podman`, `apptainer`, `none`, or an installed plug-in")
    isolation: Literal["run", "worker"] = Field(
        "run", description="`run`: a container for each run; `worker`: one for all runs of a slot (faster, weaker isolation)"
    )
    mounts: Mapping[InContainer, str] = Field(
        default_factory=dict,
        description="files and folders that runs may read: path in the container = path on the host, from the project's root",
    )
    variables: Mapping[VariableName, Text] = Field(
        default_factory=dict, description="variables that every run in the container gets; part of its identity"
    )
    network: bool = Field(False, description="whether runs can use the network; part of their identity")
    devices: tuple[Device, ...] = Field((), description="devices that runs may use, such as `/dev/dri`; part of their identity")
    gpu: bool = Field(False, description="whether runs can use NVIDIA GPUs; part of their identity")
    cpus: Positive | None = Field(None, description="maximum number of cores that a container may use at a time")
    pids: PositiveInt | None = Field(None, description="maximum number of processes and threads in a container")


class Source(Table):
    """The part of the project that is the source of runs: the code that is part of their identity."""

    paths: tuple[str, ...] = Field(
        (),
        description="files and folders; default: the whole project without files that describe it, for example `*.md`; "
        '`["."]` is everything',
    )
    dirty: Literal["record", "refuse", "ignore"] = Field(
        "record",
        description="uncommitted changes: `record` them, `refuse` them with an error, or `ignore` them and execute a checkout",
    )
    git: bool = Field(
        True,
        description="whether git identifies the source of a project in a git repository; with `false`, all files, also those "
        "that git ignores, are hashed and stored as in a folder outside git",
    )
    max_untracked: Size = Field(
        50_000_000, description="maximum size of an untracked file, in bytes or as in `50 MB`; a larger file is an error"
    )
    max_ignored: SizeOrNone = Field(
        50_000_000,
        description="maximum total size of the project's programs that git ignores and a session's runs use, in bytes or as in "
        "`50 MB`; the store keeps these for replays, the smallest first; 0 keeps none",
    )


def _plugin_class(text: str) -> str:
    """Check the place of a class in a file of the project."""
    path, _, name = text.partition(":")
    parts = PurePosixPath(path).parts
    words = (*parts[:-1], parts[-1].removesuffix(".py") if path.endswith(".py") else "", name)
    if "/".join(parts) != path or not all(word.isidentifier() and word.isascii() for word in words):
        raise ValueError(f"{text!r} should be a Python file of the project and a class in it, such as robosim.py:RoboSim")
    return text


PluginClass = Annotated[str, AfterValidator(_plugin_class)]


def _each_once(places: tuple[str, ...]) -> tuple[str, ...]:
    names = [place.partition(":")[2] for place in places]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"two classes are called {twice[0]}; rename one")
    return places


PluginClasses = Annotated[tuple[PluginClass, ...], AfterValidator(_each_once)]


class PluginsTable(Table):
    """Plug-ins in Python files of the project: `PATH.py:CLASS`; the name of the class is the name of the plug-in.

    The files, and those that they import, belong to the source of runs."""

    platforms: PluginClasses = Field((), description="platforms, for `platform`")
    templates: PluginClasses = Field((), description="template formats, for `template_format`")
    criteria: PluginClasses = Field((), description="ranges of criteria, for queries")

    readers: PluginClasses = Field((), description="readers of outputs, for `format` in `[outputs.…]`, or for an ending")
    figures: PluginClasses = Field((), description="kinds of figures, for `kind` in `[figures.…]`")
    statistics: PluginClasses = Field((), description="statistics, for figures, tables and `sierra stats`")
    comparisons: PluginClasses = Field((), description="methods of comparisons, for `method` in `[comparisons.…]`")
    runners: PluginClasses = Field((), description="runners, for `runner`")
    schedulers: PluginClasses = Field((), description="schedulers of clusters, for `scheduler` in `[runners.…]`")
    links: PluginClasses = Field((), description="links to hosts of robots, for `link`")
    engines: PluginClasses = Field((), description="engines of containers, for `engine` in `[container]`")

    @property
    def declared(self) -> dict[str, tuple[str, ...]]:
        """Return the classes by kind, of kinds that have any."""
        return {key: places for key in type(self).model_fields if (places := getattr(self, key))}

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """Return the kind and the name of each plug-in."""
        return tuple((key, place.partition(":")[2]) for key, places in self.declared.items() for place in places)


class StoreTable(Table):
    """The settings of the store."""

    raw: bool = Field(
        True,
        description="whether the bytes of files that become tables are stored too, so that changes to [outputs] and [success] "
        "need no new executions",
    )
    work_folder: Absolute | None = Field(
        None,
        description="folder in which runs of this machine execute; SIERRA makes a folder for each project in it; `~` and "
        "variables such as `$SCRATCH` are expanded; default: in the store",
    )

    def place(self) -> Path | None:
        """Return the folder where runs execute, or None for the store's. Raises Missing for a variable that is not set."""
        if self.work_folder is None:
            return None
        filled = Path(os.path.expandvars(self.work_folder))
        with contextlib.suppress(RuntimeError):  # the user does not exist
            filled = filled.expanduser()
        if not filled.is_absolute() or "$" in str(filled):
            raise Missing(
                f"[store] work_folder: {self.work_folder!r} is {str(filled)!r} here, not an absolute path; set the variable"
            )
        return filled


class Determinism(Table):
    """The check that runs with the same seed write the same bytes."""

    probe: bool = Field(False, description="execute one run twice before a batch, and report whether both results are the same")


class ProgramsTable(Table):
    """The arguments that make programs in a command print their versions, which are recorded."""

    version: Argv = Field(
        ("--version",),
        description="arguments that make an installed program print its version; empty: do not start programs for that",
    )
    versions: Mapping[str, Argv] = Field(
        default_factory=dict,
        description="other arguments for single programs, by the program's name (empty: do not start it); scripts and programs "
        "of the project are only started for their version if they are listed here",
    )


def _processor(text: str) -> str:
    """Return the name of a processor. Raises ValueError for an unknown one."""
    if (name := processors.name_of(text)) not in processors.NAMES:
        raise ValueError(f"{text!r} should be a processor: {', '.join(processors.NAMES)}")
    return name


Processor = Annotated[str, AfterValidator(_processor)]


class BuildTable(Table):
    """The command that makes programs or libraries of the project from its source, before runs use them."""

    command: Command = Field(description="the program and its arguments; {project}, {python} and {arch} are filled in")
    produces: Annotated[tuple[InProject, ...], ONE_OR_MORE, Field(min_length=1)] = Field(
        description="the products: paths or globs (`**`: any folders), relative to the project; git must ignore them"
    )
    arch: Annotated[tuple[Processor, ...], ONE_OR_MORE] = Field(
        (),
        description="the processors for which the command is executed, once for each, as {arch} in `command`, `produces` and "
        "variables; default: this machine's",
        examples=[["x86_64", "aarch64"]],
    )
    folder: InProject = Field(
        ".", alias="in", description="the folder in which the command is executed, relative to the project"
    )
    wall: Annotated[Positive | None, OF_WALL] = None

    @model_validator(mode="after")
    def _one_product_each(self) -> BuildTable:
        if self.arch and (shared := [pattern for pattern in self.produces if ARCH not in pattern]):
            raise ValueError(f"produces: {shared[0]!r} needs {ARCH}, because each processor in arch has a product of its own")
        return self


class Ready(Table):
    """The sign that a service is ready: exactly one of `file`, `port`, `output` and `command`."""

    file: str | None = Field(
        None, min_length=1, description="a file or socket that appears; relative to {output}, the working directory"
    )
    port: Annotated[Text, Field(pattern=r"^(\{port\}|[1-9][0-9]{0,4})$")] | None = Field(
        None, description="a TCP port of this host that accepts connections: `{port}`, or a number"
    )
    output: Annotated[str, Field(min_length=1), AfterValidator(regular_expression)] | None = Field(
        None, description="a regular expression that matches a line of its output"
    )
    command: Command | None = Field(None, description="a command that is repeated until its exit status is 0")

    @model_validator(mode="after")
    def _one_kind(self) -> Ready:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"needs exactly one of file, port, output, command, not {' and '.join(given) or 'none'}")
        return self

    @property
    def kind(self) -> Literal["file", "port", "output", "command"]:
        return "file" if self.file else "port" if self.port else "output" if self.output else "command"

    @property
    def words(self) -> tuple[str, ...]:
        """Return the path, port, pattern or command."""
        return self.command or (self.file or self.port or self.output or "",)


class ServiceTable(Table):
    """A program that runs in the background as long as each run, for example a display, a bridge or a licence server."""

    command: Command = Field(
        description="the program and its arguments; {port} is a free port, and the placeholders of `command` are filled in"
    )
    ready: Ready = Field(description="when it is ready, and the next one is started")
    timeout: Positive = Field(30.0, description="time until it must be ready, in seconds")
    scope: Literal["run", "batch"] = Field(
        "run",
        description="`run`: each run starts its own; `batch`: the runs of a session share one (on a cluster, of an array task)",
    )
