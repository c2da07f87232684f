"""The nouns: query, batch, experiment, run, execution, and the changes that make a run's input.

A *query* names one or more *criteria*. Each criterion spans one *axis*: an ordered list of values of an
independent variable. The Cartesian product of the axes is a *batch* of *experiments*; an experiment is
repeated in *runs* that differ in their seed. A run is the unit of identity: its input, command, platform,
seed, source, image and declared environment, hashed. An *execution* is one time that a run was executed.

All here is frozen; nothing here reads a file or knows a library.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from fractions import Fraction
from typing import Any

Value = int | float | str
"""A value of an independent variable: numeric or the name of a group of changes."""


# ---------------------------------------------------------------- the query


@dataclass(frozen=True, slots=True)
class Log:
    """`.Log8`: 1, 2, 4, … up to `end`, a power of two."""

    end: int


@dataclass(frozen=True, slots=True)
class Linear:
    """`.Linear100.C10`: `count` equal whole steps up to `end`: 10, 20, … 100."""

    end: int
    count: int


@dataclass(frozen=True, slots=True)
class Steps:
    """`.1.9.C5`: `count` whole numbers from `start` to `end` with equal gaps: 1, 3, 5, 7, 9."""

    start: int
    end: int
    count: int


@dataclass(frozen=True, slots=True)
class Span:
    """`=0:1:5`: `count` numbers from `start` to `end` with equal gaps: 0, 0.25, … 1."""

    start: Fraction
    end: Fraction
    count: int


@dataclass(frozen=True, slots=True)
class Listed:
    """`=0.2,0.4,1.6` or `=low,high`: the values themselves, all numbers or all names."""

    values: tuple[Value, ...]


@dataclass(frozen=True, slots=True)
class MonteCarlo:
    """`montecarlo.C20`: `count` experiments that differ in nothing but their seeds."""

    count: int


@dataclass(frozen=True, slots=True)
class ConstantDensity:
    """`.5p0.I16.C4`: `count` arenas, each side `increment` m longer, at `density` percent of robots per m²."""

    density: Fraction
    increment: Fraction
    count: int


@dataclass(frozen=True, slots=True)
class VariableDensity:
    """`.1p0.5p0.C4`: one arena, `count` densities from `start` to `end` percent of robots per m²."""

    start: Fraction
    end: Fraction
    count: int


Scale = Log | Linear | Steps | Span | Listed | MonteCarlo | ConstantDensity | VariableDensity


@dataclass(frozen=True, slots=True)
class Criterion:
    """One independent variable and its range; `sierra.query.grammar` reads and writes it."""

    name: str
    scale: Scale


@dataclass(frozen=True, slots=True)
class Query:
    """What a researcher asks: criteria, runs per experiment, and what holds for all experiments."""

    criteria: tuple[Criterion, ...]
    runs: int
    controller: str | None = None
    scenario: str | None = None
    sets: tuple[Set, ...] = ()
    base_seed: int = 0


# ---------------------------------------------------------------- changes to a template


@dataclass(frozen=True, slots=True)
class Set:
    """Give attributes or texts a value: of all that `path` (XPath 1.0) selects.

    A path that selects attributes sets them; one that selects elements sets their text, or, with
    `attribute`, that attribute of them, adding it where it is absent. `value` may hold `{expressions}`.
    """

    path: str
    value: str
    attribute: str | None = None
    expect: int | None = None
    why: str = ""


@dataclass(frozen=True, slots=True)
class Add:
    """Put a new child, `xml`, into each element that `path` selects: before child element `at`, or last.

    Attributes and texts in `xml` may hold `{expressions}`.
    """

    path: str
    xml: str
    at: int | None = None
    expect: int | None = None
    why: str = ""


@dataclass(frozen=True, slots=True)
class Remove:
    """Take away the elements or attributes that `path` selects."""

    path: str
    expect: int | None = None
    why: str = ""


@dataclass(frozen=True, slots=True)
class Rename:
    """Give the elements that `path` selects another tag; `to` may be one `{name}` of a value."""

    path: str
    to: str
    expect: int | None = None
    why: str = ""


Change = Set | Add | Remove | Rename
"""`expect`: how many matches there must be (None: at least one). `why`: who asks, for messages."""


# ---------------------------------------------------------------- the batch


@dataclass(frozen=True, slots=True)
class Axis:
    """One independent variable as it is spanned: its values in order, and how to label it."""

    name: str
    values: tuple[Value, ...]
    label: str = ""
    unit: str = ""

    @property
    def numeric(self) -> bool:
        return all(not isinstance(value, str) for value in self.values)


@dataclass(frozen=True, slots=True)
class Point:
    """One value of an axis, and all that it changes in the template."""

    value: Value
    changes: tuple[Change, ...]
    stream: int = 0
    """Which run numbers it takes its seeds from: `stream * 2**16` onwards."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One experiment before it has an id: a point in the space of the axes, and its changes."""

    ordinal: int
    values: Mapping[str, Value]
    changes: tuple[Change, ...]
    stream: int = 0


@dataclass(frozen=True, slots=True)
class Design:
    """What a query expands to, before any input is made."""

    query: Query
    axes: tuple[Axis, ...]
    cells: tuple[Cell, ...]
    per_run: tuple[Change, ...]
    """Changes whose values may use `seed` and `run` (the run's number), applied last."""
    lists: Mapping[str, tuple[Value, ...]] = field(default_factory=dict)
    """Values from a list, by name: run number n takes item n (modulo its length)."""
    independent_seeds: bool = False


@dataclass(frozen=True, slots=True)
class Recipe:
    """What all runs of a batch have in common; with an input and a seed it makes a run."""

    platform: str
    command: tuple[str, ...]
    """With placeholders: before any path of this machine is filled in."""
    environment: Mapping[str, str]
    source: str | None
    """The id of the source's tree (`swh:1:dir:…`), or None where nothing of the source counts."""
    image: str | None = None
    """The content identity of the container image; None without one."""
    reach: tuple[str, ...] = ()
    """What runs reach beyond the image and their own folder, sorted: `network`, `device /dev/dri`, `mount /data`."""

    def preimage(self) -> dict[str, Any]:
        return {
            "platform": self.platform,
            "command": list(self.command),
            "environment": dict(self.environment),
            "source": self.source,
            "image": {"id": self.image, "reach": list(self.reach)} if self.image else None,
        }


@dataclass(frozen=True, slots=True)
class Run:
    """One template + changes + seed: the unit that executes, and the unit of identity."""

    id: str
    experiment: int
    """The ordinal of its experiment in the batch."""
    number: int
    """Counts from 0 within the experiment."""
    seed: int
    names: tuple[str, ...]
    """Its input files; one tuple for all runs of a batch, which may be 100,000 in memory."""
    digests: bytes
    """Their SHA-256, 32 bytes each."""

    @property
    def inputs(self) -> tuple[tuple[str, str], ...]:
        """Name and SHA-256 of each input file."""
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
    """What runs are expected to take, in the order in which they are dealt out."""

    each: tuple[float, ...]
    """Seconds of each run."""
    new: tuple[int, ...]
    """The places of those whose values were never timed: they are estimated."""
    how: str
    """Where all of this comes from, in words."""

    @property
    def mean(self) -> float:
        return sum(self.each) / len(self.each)


@dataclass(frozen=True, slots=True)
class Batch:
    """What a query expands to: an ordered set of experiments."""

    id: str
    axes: tuple[Axis, ...]
    experiments: tuple[Experiment, ...]
    recipe: Recipe
    recipe_id: str

    runs: tuple[Run, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "runs", tuple(run for experiment in self.experiments for run in experiment.runs))


# ---------------------------------------------------------------- executing


@dataclass(frozen=True, slots=True)
class Limits:
    """What one execution may use; None is no limit. A limit is never part of an identity."""

    wall_s: float | None = None
    cpu_s: float | None = None
    memory_bytes: int | None = None
    output_bytes: int | None = None
    grace_s: float = 5.0
    """Between SIGTERM and SIGKILL."""


@dataclass(frozen=True, slots=True)
class Client:
    """A program that starts a container, and stays as long as it."""

    argv: tuple[str, ...]
    environment: Mapping[str, str]
    stop: tuple[str, ...] = ()
    """What ends the container where the client can't any more."""


@dataclass(frozen=True, slots=True)
class Job:
    """A run made ready for a worker, on any host.

    In these, and in those of `client`, the character NUL (which no argument can hold) stands for the run's
    directory, which only the worker knows.
    """

    run: str
    execution: str
    """The id that this execution will have, wherever it is executed."""
    argv: tuple[str, ...]
    environment: Mapping[str, str]
    files: tuple[tuple[str, bytes], ...]
    limits: Limits
    client: Client | None = None
    """What starts the container of the run, or, where `shared`, that of all runs of a slot, in which a worker executes it."""
    shared: bool = False


@dataclass(frozen=True, slots=True)
class Requirement:
    """A file that must be where runs execute as it is here."""

    name: str
    path: str
    sha256: str = ""
    """Empty: it is enough that it is there."""
    search: str = ""
    """The PATH by which the name is found, where runs call it by that: what is found there counts."""
    link: bool = False
    """Whether it is a link, and not what it leads to: its hash is that of the path that it says."""
    holds: tuple[str, ...] | None = None
    """What is installed in the folders of a Python (`path`, as in a PATH), as `array_task.installed` lists it."""


class Status(StrEnum):
    """How an execution ended."""

    OK = "ok"
    FAILED = "failed"
    """Its exit status, a missing output or marker, or too few rows says so."""
    TIMEOUT = "timeout"
    MEMORY = "memory"
    CPU = "cpu"
    OUTPUT = "output"
    """More bytes written than the limit allows."""
    MISMATCH = "mismatch"
    """It ended well, but a table it wrote is cut short, or not shaped like its siblings'."""
    INTERRUPTED = "interrupted"


@dataclass(frozen=True, slots=True)
class OutputFile:
    """A file that an execution left in its output folder, as the worker saw it."""

    path: str
    bytes: int
    sha256: str
    lines: int
    """Line feeds in it."""
    ended: bool
    """Whether its last byte is a line feed (or it is empty)."""
    head: str
    """Its first line, at most 4096 bytes of it."""
    quotes: int | None = None
    """Double quotes in it; None, as what follows, of what is no text, and where an older worker did not count."""
    blank: int | None = None
    """Lines in it without a character."""
    alike: bool | None = None
    """Whether all its lines end alike, in LF or in CR LF."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a worker says of one execution."""

    run: str
    execution: str
    directory: str
    """Where its files are, until they are recorded."""
    started: float
    """Seconds since the epoch."""
    ended: float
    exit_code: int | None
    signal: int | None
    stopped: str | None
    """Why the worker ended it: a `Status`, or None where the program ended by itself."""
    user_s: float | None
    """CPU seconds; None where the program ended in a container before anything was seen of it."""
    system_s: float | None
    max_rss_bytes: int | None
    host: str
    slot: int
    outputs: tuple[OutputFile, ...]
    error: str | None = None
    """Why the program could not be started, or why what it left can't be read."""
    attempt: str | None = None
    """On a cluster, the attempt at an element in which it was executed."""
    environment: str | None = None
    """What was around it, where that is not what is around this process."""
    left_out: tuple[str, ...] = ()
    """What it left that is no output, as it is neither a file nor a folder: links, sockets; not all where there are many."""
