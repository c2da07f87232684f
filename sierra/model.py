"""The nouns: query, batch, experiment, run, execution, and the changes that make a run's input.

A *query* names one or more *criteria*. Each criterion spans one *axis*: an ordered list of values of an independent variable.
The Cartesian product of the axes is a *batch* of *experiments*. An experiment is repeated in *runs* that differ in their seed.
A run is the unit of identity: the hash of its input, command, platform, seed, source, image and declared environment. An
*execution* is one time that a run was executed.

All dataclasses here are frozen. This module reads no files and imports only the standard library.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from sierra.util.lazy_definitions import dataclass, field, replace

if TYPE_CHECKING:
    from sierra.util.random_poses import PlanePose, RandomPoses

Value = int | float | str
"""A value of an independent variable: a number, or the name of a group of changes."""
Measure = Literal["final", "mean", "time_mean", "time_to"]
"""The number that a run becomes: its last value, the mean of its rows, its mean over time, or the time until a threshold."""
FOLDER = "sierraFolder7d1c0e4b"
"""The beginning of the marks that stand for folders in generated inputs. No template may contain it."""
IN_PROJECT = "{project}/"
"""The beginning of a path in the project, wherever the project is."""
REDACTED = "/redacted/"
"""The folder of the pseudonyms of folders in redacted records."""


# ---------------------------------------------------------------- the query


@dataclass(frozen=True, slots=True)
class Log:
    """The scale `.Log8`: 1, 2, 4, … up to `end`, a power of two."""

    end: int


@dataclass(frozen=True, slots=True)
class Linear:
    """The scale `.Linear100.C10`: `count` equal whole steps up to `end`: 10, 20, … 100."""

    end: int
    count: int


@dataclass(frozen=True, slots=True)
class Steps:
    """The scale `.1.9.C5`: `count` whole numbers from `start` to `end` with equal gaps: 1, 3, 5, 7, 9."""

    start: int
    end: int
    count: int


@dataclass(frozen=True, slots=True)
class Span:
    """The scale `=0:1:5`: `count` numbers from `start` to `end` with equal gaps: 0, 0.25, … 1."""

    start: Fraction
    end: Fraction
    count: int


@dataclass(frozen=True, slots=True)
class Listed:
    """The scale `=0.2,0.4,1.6` or `=low,high`: a list of values, all numbers or all names."""

    values: tuple[Value, ...]


@dataclass(frozen=True, slots=True)
class MonteCarlo:
    """The criterion `montecarlo.C20`: `count` experiments that differ only in their seeds."""

    count: int


@dataclass(frozen=True, slots=True)
class ConstantDensity:
    """The scale `.5p0.I16.C4`: `count` arenas, each with sides `increment` m longer, at `density` percent of robots per m²."""

    density: Fraction
    increment: Fraction
    count: int


@dataclass(frozen=True, slots=True)
class VariableDensity:
    """The scale `.1p0.5p0.C4`: one arena, `count` densities from `start` to `end` percent of robots per m²."""

    start: Fraction
    end: Fraction
    count: int


@dataclass(frozen=True, slots=True)
class Computed:
    """A scale that a plug-in computed, as in `.Primes5`: its values, each with the changes that it causes."""

    points: tuple[Point, ...]
    text: str = ""
    """The text after the dot, as it is in the query."""

    @classmethod
    def of(cls, *values: Value) -> Computed:
        """Return a scale of these values, without changes: those of the variable are made."""
        return cls(tuple(Point(value) for value in values))

    @property
    def has_changes(self) -> bool:
        """Return True if a value brings changes of its own."""
        return any(point.changes for point in self.points)


Scale = Log | Linear | Steps | Span | Listed | MonteCarlo | ConstantDensity | VariableDensity | Computed


@dataclass(frozen=True, slots=True)
class Criterion:
    """One independent variable and its range; `sierra.design.query.grammar` reads and writes it."""

    name: str
    scale: Scale


@dataclass(frozen=True, slots=True)
class Query:
    """A research query: criteria, runs per experiment, and the settings that all experiments share."""

    criteria: tuple[Criterion, ...]
    runs: int
    controller: str | None = None
    scenario: str | None = None
    sets: tuple[Set, ...] = ()
    base_seed: int = 0


# ---------------------------------------------------------------- changes to a template


@dataclass(frozen=True, slots=True)
class Set:
    """A change that sets the value of all attributes or texts that `path` (XPath 1.0) selects.

    If the path selects attributes, their values are set. If it selects elements, their text is set; with `attribute`, that
    attribute of the elements is set instead, and added if absent. `value` may contain `{expressions}`.
    """

    path: str
    value: str
    attribute: str | None = None
    expect: int | None = None
    why: str = ""


@dataclass(frozen=True, slots=True)
class Add:
    """A change that adds a new child `xml` to each element that `path` selects: before the child element `at`, or last.

    Attributes and texts in `xml` may contain `{expressions}`.
    """

    path: str
    xml: str
    at: int | None = None
    expect: int | None = None
    why: str = ""


@dataclass(frozen=True, slots=True)
class Remove:
    """A change that removes the elements or attributes that `path` selects."""

    path: str
    expect: int | None = None
    why: str = ""


@dataclass(frozen=True, slots=True)
class Rename:
    """A change that renames the tag of the elements that `path` selects. `to` may be one `{name}` of a value."""

    path: str
    to: str
    expect: int | None = None
    why: str = ""


INDEX = "{index}"
"""The text that stands for the number of a copy."""
POSE = ("{x}", "{y}", "{yaw}")
"""The texts that stand for the pose of a copy."""


@dataclass(frozen=True, slots=True)
class Repeat:
    """A change that puts `count` copies of the one element that `path` selects in its place, with the numbers from 0.

    `count` may contain `{expressions}`; 0 removes the element. The following elements of its name go, or in a list of a tree,
    all other items. In the attributes and texts of a copy, `{index}` is its number, and `{x}`, `{y}` and `{yaw}` are its pose.
    Random poses are drawn from `seed`, which may contain `{expressions}`.
    """

    path: str
    count: str
    expect: int | None = 1
    why: str = ""
    poses: tuple[PlanePose, ...] | RandomPoses = ()
    seed: str = "{seed}"


Change = Set | Add | Remove | Rename | Repeat
"""A change to the template. `expect`: required number of matches (None: at least one). `why`: its origin, for messages."""


# ---------------------------------------------------------------- the batch


@dataclass(frozen=True, slots=True)
class Axis:
    """One independent variable of a query: its values in order, and its label."""

    name: str
    values: tuple[Value, ...]
    label: str = ""
    unit: str = ""

    @property
    def numeric(self) -> bool:
        return all(not isinstance(value, str) for value in self.values)


@dataclass(frozen=True, slots=True)
class Point:
    """One value of an axis, and all changes to the template that it causes."""

    value: Value
    changes: tuple[Change, ...] = ()
    stream: int = 0
    """The number of the stream of seeds: the run numbers for its seeds begin at this multiple of `seeds.streams`."""
    parameters: Mapping[str, Value] = field(default_factory=dict)
    """Further values for expressions, by name: the numbers in the name of a scenario."""
    replaces: frozenset[Change] = frozenset()
    """Those of the changes that may replace values of a controller or scenario on another axis, which sets only the rest."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One experiment before it has an id: a point in the space of the axes, and its changes."""

    ordinal: int
    values: Mapping[str, Value]
    changes: tuple[Change, ...]
    stream: int = 0


@dataclass(frozen=True, slots=True)
class Design:
    """The expansion of a query before any input is generated."""

    query: Query
    axes: tuple[Axis, ...]
    cells: tuple[Cell, ...]
    per_run: tuple[Change, ...]
    """Changes whose values may use `seed` and `run` (the run's number), applied last."""
    lists: Mapping[str, tuple[Value, ...]] = field(default_factory=dict)
    """Lists of values, by name: run number n takes item n (modulo the list's length)."""
    independent_seeds: bool = False
    largest_seed: int = 2**31 - 1
    on_robots: bool = False
    """True if the changes of runs may also use `robot`, the place of a robot."""


@dataclass(frozen=True, slots=True)
class Service:
    """A program that runs in the background as long as a run, or as long as its worker, for example a display or a server."""

    name: str
    command: tuple[str, ...]
    """Its command with its placeholders, before any path of this machine is filled in."""
    ready: tuple[str, ...]
    """When it is ready: the kind (`file`, `port`, `output` or `command`), and the path, port, pattern or command."""
    shared: bool = False
    """True if all runs of a worker share it."""

    def preimage(self) -> dict[str, Any]:
        scope = {"scope": "batch"} if self.shared else {}
        return {"name": self.name, "command": list(self.command), "ready": list(self.ready), **scope}


@dataclass(frozen=True, slots=True)
class Around:
    """Everything that is executed around the command of each run, in the same surroundings and within the same limits."""

    before: tuple[tuple[str, ...], ...] = ()
    """Commands, one after the other, before the run's command."""
    after: tuple[tuple[str, ...], ...] = ()
    """Commands, one after the other, after the run's command has succeeded."""
    services: tuple[Service, ...] = ()
    """Services, in the order in which they are started."""

    def __bool__(self) -> bool:
        return bool(self.before or self.after or self.services)

    @property
    def commands(self) -> tuple[tuple[str, ...], ...]:
        """Return all commands, also those that test whether a service is ready."""
        tests = (one.ready[1:] for one in self.services if one.ready[0] == "command")
        return (*(one.command for one in self.services), *tests, *self.before, *self.after)

    @property
    def words(self) -> tuple[str, ...]:
        """Return all words of these commands, and the files that show that services are ready."""
        files = (one.ready[1] for one in self.services if one.ready[0] == "file")
        return (*(word for words in self.commands for word in words), *files)

    def preimage(self) -> dict[str, Any]:
        services = [one.preimage() for one in self.services]
        return {"before": [list(words) for words in self.before], "after": [list(words) for words in self.after]} | {
            "services": services
        }

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Around:
        """Return what a pre-image describes."""
        services = (
            Service(one["name"], tuple(one["command"]), tuple(one["ready"]), one.get("scope") == "batch")
            for one in record["services"]
        )
        before, after = (tuple(map(tuple, record[name])) for name in ("before", "after"))
        return cls(before, after, tuple(services))


@dataclass(frozen=True, slots=True)
class RunSpec:
    """The run specification that all runs of a batch share. An input and a seed complete it to a run."""

    platform: str
    command: tuple[str, ...]
    """The command with its placeholders, before any path of this machine is filled in."""
    environment: Mapping[str, str]
    source: str | None
    """The id of the source's tree (`swh:1:dir:…`), or None if the source is not part of the identity."""
    image: str | None = None
    """The content identity of the container image; None without an image."""
    host_access: tuple[str, ...] = ()
    """The host access of runs beyond the image and their own folder, sorted: `network`, `device /dev/dri`, `mount /data`."""
    named_inputs: tuple[str, ...] = ()
    """The names of input files, unless they are the only ones that the platform ever gives (`input.xml`). Also the folder of
    the input, if it has one of its own."""

    shared_files: str | None = None
    """The id of the files that lie beside the inputs of all runs; None without any."""
    around: Around = Around()
    robots: Mapping[str, tuple[str, ...]] | None = None
    """For runs on robots: the commands of groups of places that differ from `command`; None for runs without robots."""

    @property
    def words(self) -> tuple[str, ...]:
        """Return all words of the command, of the commands of single robots, and of the commands around them."""
        of_groups = (word for argv in (self.robots or {}).values() for word in argv)
        return (*self.command, *of_groups, *self.around.words)

    def preimage(self) -> dict[str, Any]:
        named = {"named_inputs": list(self.named_inputs)} if self.named_inputs else {}
        shared = {"shared_files": self.shared_files} if self.shared_files else {}
        around = {"around": self.around.preimage()} if self.around else {}  # specs without it keep their ids
        robots = {} if self.robots is None else {"robots": {group: list(argv) for group, argv in self.robots.items()}}
        return {
            **named,
            **shared,
            "platform": self.platform,
            "command": list(self.command),
            "environment": dict(self.environment),
            "source": self.source,
            "image": {"id": self.image, "reach": list(self.host_access)} if self.image else None,
            **around,
            **robots,
        }


class Pose(NamedTuple):
    """A place of a robot: x and y in m, and the heading in degrees, counterclockwise from the direction of x."""

    x: float
    y: float
    heading: float | None = None


@dataclass(frozen=True, slots=True)
class Run:
    """One template with changes and a seed: the unit that executes, and the unit of identity."""

    id: str
    experiment: int
    """The ordinal of its experiment in the batch."""
    number: int
    """The number of the run in its experiment, from 0."""
    seed: int
    names: tuple[str, ...]
    """The names of its input files. All runs of a batch share one tuple, because 100,000 of them may be in memory."""
    digests: bytes
    """The SHA-256 of each input file, 32 bytes each."""

    @property
    def inputs(self) -> tuple[tuple[str, str], ...]:
        """Return the name and SHA-256 of each input file."""
        digests = (self.digests[at : at + 32].hex() for at in range(0, len(self.digests), 32))
        return tuple(zip(self.names, digests, strict=True))


@dataclass(frozen=True, slots=True)
class Experiment:
    """One point in the space of the independent variables, with its runs."""

    id: str
    ordinal: int
    values: Mapping[str, Value]
    runs: tuple[Run, ...]


@dataclass(frozen=True, slots=True)
class Times:
    """The expected durations of runs, in the order in which they are distributed over elements."""

    each: tuple[float, ...]
    """The seconds of each run."""
    new: tuple[int, ...]
    """The positions of runs whose values were never timed; their durations are estimated."""
    how: str
    """The origin of these durations, in words."""
    there: float | None = None
    """The longest of those that were measured where the runs are to execute; None if none was."""
    continues: bool = False
    """True if the runs have checkpoints: one that is cut off continues, so that it may take longer than an array task."""

    @property
    def mean(self) -> float:
        return sum(self.each) / len(self.each)

    @property
    def measured(self) -> float | None:
        """The longest duration that was measured; None if all are estimated."""
        new = set(self.new)
        return max((seconds for position, seconds in enumerate(self.each) if position not in new), default=None)


@dataclass(frozen=True, slots=True)
class Batch:
    """The ordered set of experiments that a query expands to."""

    id: str
    axes: tuple[Axis, ...]
    experiments: tuple[Experiment, ...]
    spec: RunSpec
    spec_id: str

    runs: tuple[Run, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "runs", tuple(run for experiment in self.experiments for run in experiment.runs))


# ---------------------------------------------------------------- execution


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of one execution; None means no limit. A limit is never part of an identity."""

    wall_s: float | None = None
    cpu_s: float | None = None
    memory_bytes: int | None = None
    output_bytes: int | None = None
    grace_s: float = 5.0
    """The seconds between SIGTERM and SIGKILL."""
    after_marker_s: float | None = None
    """The run is ended so many seconds after its marker is met, and counts as ended by itself."""
    marker: str | None = None
    """That marker: a path in the output folder, or `stdout` or `stderr`. None if the run is not ended by a marker."""
    contains: str | None = None
    """The text that the marker contains when it is met; None if it only needs to exist."""
    gpus: float | None = None
    """The GPUs that a run holds while it executes: a whole number, or its share of one. None: it requests none."""
    cores: int | None = None
    """The cores that a run holds while it executes. None: one."""


@dataclass(frozen=True, slots=True)
class Helps:
    """A tracer and hashes of files that one machine remembers for observing runs. Without them, a worker finds both out."""

    tracer: str | None
    """The path of a tracer that works there; None if that is not known."""
    digests: str
    """The path of a file with the SHA-256 of files: see `sierra.provenance.hash_cache`."""


@dataclass(frozen=True, slots=True)
class Client:
    """A program that starts a container and exists as long as the container."""

    argv: tuple[str, ...]
    environment: Mapping[str, str]
    stop: tuple[str, ...] = ()
    """The command that ends the container if the client cannot do it any more."""
    start_pipe: str = ""
    """The named pipe from which a line lets the program in the container begin; empty if it begins at once."""


BASE = 0
"""The place of the base station in a run on robots; the robots have the places 1, 2, …"""
ON_ROBOT = "\1"
"""The mark (which no argument contains) that stands for the folder of the code on a robot."""
ARCH_ON_ROBOT = "\3"
"""The mark that stands for the name of a robot's processor."""


@dataclass(frozen=True, slots=True)
class Member:
    """The part of one robot, or of the base station, in a run on robots.

    The place is part of the run's identity, but no robot's name is: which robot took the place is recorded with the execution.
    In `argv`, in the values of `environment` and in those of `folders`, the character NUL stands for the run's directory on the
    robot, `ON_ROBOT` for the folder of the code there, and `ARCH_ON_ROBOT` for its processor. PATH is only in `environment` if
    the project declares it.
    """

    place: int
    group: str
    """The group of its place: `robot`, `base`, or the name of a table in `[robots.groups]`."""
    argv: tuple[str, ...]
    environment: Mapping[str, str]
    """Its variables; SIERRA_ROBOT is its place, SIERRA_ROBOTS the number of robots without the base station."""
    files: tuple[tuple[str, bytes], ...]
    folders: Mapping[str, str] | None = None
    """The texts that take the place of marks in its input files, as in `Job`."""

    def at(self, run: str, code: str, arch: str) -> Member:
        """Return the member with the run's directory, the folder of the code and the processor in place of the marks.

        `arch` is the name of the processor of its robot, as in `sierra.util.processors`.
        """

        def filled(text: str) -> str:
            return text.replace("\0", run).replace(ON_ROBOT, code).replace(ARCH_ON_ROBOT, arch)

        environment = {name: filled(value) for name, value in self.environment.items()}
        folders = None if self.folders is None else {mark: filled(text) for mark, text in self.folders.items()}
        return replace(self, argv=tuple(map(filled, self.argv)), environment=environment, folders=folders)


@dataclass(frozen=True, slots=True)
class Job:
    """A run that is ready for a worker, on any host.

    In `argv`, `environment` and those of `client`, the character NUL (which no argument can contain) stands for the run's
    directory, which only the worker knows.
    """

    run: str
    execution: str
    """The id of this execution, on any host."""
    argv: tuple[str, ...]
    environment: Mapping[str, str]
    files: tuple[tuple[str, bytes], ...]
    limits: Limits
    client: Client | None = None
    """The client that starts the run's container.

    If `shared`, the container is that of a slot, where a worker executes all runs.
    """
    shared: bool = False
    observe: Mapping[str, str] | None = None
    """Folders by name, if it is to be observed which files the run uses; their names stand for the folders in the record."""
    budget: float | None = None
    """The part of the runs' time that the observations of a sample may take: the run is observed if this one fits.

    None: the run is not in the sample, and observed in any case, or by `affordable`.
    """
    affordable: float | None = None
    """The run is observed if this takes at most so many times the mean time of a run. None: whatever it takes."""
    experiment: int | None = None
    """The number of its experiment, if one run of each is observed: should that fail, the worker observes another one."""
    beside: str | None = None
    """The folder with the files that lie beside the input files of all runs."""
    checkpoint: str | None = None
    """The folder of the run's checkpoint, which all of its executions share; None if it needs none, or begins anew."""
    folders: Mapping[str, str] | None = None
    """The texts that take the place of marks in the input files; None if there are no marks."""
    helps: Helps | None = None
    """The tracer and hashes that this machine remembers, so that observing takes less time; None for another machine."""
    members: tuple[Member, ...] = ()
    """The parts of a run on robots, in the order of their places, the base station first; empty for all other runs.

    They start together, and the run is successful if all of them are. The outputs of a member are in a folder of the run's
    outputs that has the name of its place: `2/swarm.csv`. A runner that cannot execute members refuses such a job. `argv` is
    empty then, and `files` are those of the whole run; each member has the files that it needs.
    """


@dataclass(frozen=True, slots=True)
class Requirement:
    """A file that must be the same on the executing host as it is here."""

    name: str
    path: str
    sha256: str = ""
    """The SHA-256 of the file; empty if it only has to exist."""
    search: str = ""
    """The PATH by which runs find the name, if they call the file by name. The file that is found there is checked."""
    link: bool = False
    """True for a symbolic link that is itself required. `sha256` is then the hash of the path that it contains."""
    holds: tuple[str, ...] | None = None
    """The packages installed in the folders of a Python (`path`, written like a PATH): see `required_files.installed`."""


class Purpose(StrEnum):
    """The purpose of an execution. Only executions for runs are effective."""

    RUN = "run"
    REPLAY = "replay"
    CAPTURE = "capture"
    """An execution with rendering, for its frames alone."""


ACCEPTED = "_accepted"
"""The end of the name of a table that has an output's rows of accepted ends."""


class Status(StrEnum):
    """The outcome of an execution."""

    OK = "ok"
    ACCEPTED = "accepted"
    """An end that is no success, but a result: `accept` in [success] names it. The reason of such an execution is this end."""
    FAILED = "failed"
    """A failure: by its exit status, a missing output or marker, or too few rows."""
    TIMEOUT = "timeout"
    MEMORY = "memory"
    CPU = "cpu"
    OUTPUT = "output"
    """More bytes written than the limit allows."""
    MISMATCH = "mismatch"
    """A program that ended successfully, but wrote a table that is cut short or has another shape than its siblings."""
    STOPPED = "stopped"
    """An end by the operator of a supervised trial."""
    INTERRUPTED = "interrupted"
    INVALID = "invalid"
    """A success that does not count, because somebody marked the trial as invalid."""

    @property
    def is_result(self) -> bool:
        """True if the execution may be effective, so that its run is not executed again."""
        return self in (Status.OK, Status.ACCEPTED)


@dataclass(frozen=True, slots=True)
class OutputFile:
    """A file that an execution left in its output folder, as the worker saw it."""

    path: str
    bytes: int
    sha256: str
    lines: int
    """The number of line feeds in it."""
    ended: bool
    """True if its last byte is a line feed, or if it is empty."""
    head: str
    """The first line, at most 4096 bytes."""
    quotes: int | None = None
    """The number of double quotes. It and the fields below are None for a file that is not text, or from an older worker."""
    blank: int | None = None
    """The number of lines without a character."""
    alike: bool | None = None
    """True if all its lines end in the same way, in LF or in CR LF."""


@dataclass(frozen=True, slots=True)
class LateFiles:
    """Files of a lost robot, which were collected after its execution was recorded."""

    execution: str
    place: int
    robot: str
    directory: str
    """A run's folder."""


@dataclass(frozen=True, slots=True)
class Result:
    """A worker's report on one execution."""

    run: str
    execution: str
    directory: str
    """The folder of its files until they are recorded."""
    started: float
    """Seconds since the epoch."""
    ended: float
    exit_code: int | None
    signal: int | None
    stopped: str | None
    """The reason why the worker ended it, a `Status`; None if the program ended by itself."""
    user_s: float | None
    """CPU seconds; None if the program ended in a container before its usage could be measured."""
    system_s: float | None
    max_rss_bytes: int | None
    host: str
    slot: int
    outputs: tuple[OutputFile, ...]
    error: str | None = None
    """The reason why the program could not be started, or why its outputs cannot be read."""
    attempt: str | None = None
    """On a cluster, the attempt at an element in which it was executed."""
    environment: str | None = None
    """The environment of the execution, if it differs from that of this process."""
    observed: bool = False
    """True if its folder has the list of the files that it used."""
    elsewhere: tuple[str, ...] = ()
    """Names of files that it wrote, but not among its outputs: `{run}/…`, and others if it was observed. Perhaps not all."""
    left_out: tuple[str, ...] = ()
    """Entries of its output folder that are neither files nor folders: links, sockets. A long list is incomplete."""
    isolation: str | None = None
    """The isolation of the execution, if it differs from that of this process."""
    robots: Mapping[int, str] = field(default_factory=dict)
    """The names of the robots that took the places of the run; empty for a run without robots."""
    left_running: tuple[str, ...] = ()
    """Some of the processes that still ran when its command had ended, and were ended: their programs with the first words."""
    ports: tuple[int, ...] = ()
    """Its ports in the places of `{port}`, `{port2}`, …, as far as its command, inputs and variables have these."""
    after_marker: float | None = None
    """It was ended so many seconds after its marker was met, which counts as an end by itself; None if it was not."""
    gpus: tuple[str, ...] = ()
    """The GPUs that it was given, by index or UUID."""
    gpu_limit: float | None = None
    """`Limits.gpus`, if it was given GPUs for that."""
    gpu_s: float | None = None
    """Seconds in which it kept GPUs busy; None if this is unknown."""
    gpu_memory_bytes: int | None = None
    resumed: bool = False
    """True if it began with files in its checkpoint, which an earlier execution had left."""
    printed: tuple[int, str] | None = None
    """The size and the SHA-256 of standard output, for a result without a folder."""
