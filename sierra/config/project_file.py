"""The models of `sierra.toml`, which is validated once when it is read.

The same table can be in `pyproject.toml` as `[tool.sierra]`. Unknown keys are errors that name the most similar valid key.
`schemas/sierra.toml.schema.json` is generated from these classes, and their docstrings are its descriptions.
"""

from __future__ import annotations

import contextlib
import difflib
import fnmatch
import json
import os
import re
import shlex
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PositiveInt,
    StringConstraints,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from sierra.config import forbidden_directives as directives
from sierra.errors import ConfigError, Missing
from sierra.store.layout import CONFIG, PYPROJECT, STORE

NAME = r"^[A-Za-z_][A-Za-z0-9_]*$"
Name = Annotated[str, StringConstraints(pattern=NAME)]
"""A name that is also a column in SQL."""
VariableName = Annotated[str, StringConstraints(pattern=r"^[^=]+$")]
Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Scalar = str | int | float
Words = str | tuple[str, ...]
"""A list of texts, or its short form."""
OptionsT = TypeVar("OptionsT", bound=BaseModel)
SAME_FORMAT = {"tsv": "csv", "ndjson": "jsonl"}
"""Endings of output files with the format that another ending is named after."""
SETTINGS: Mapping[int | str, str] = {
    **dict.fromkeys(("queue", "partitions"), "partition"),
    **dict.fromkeys(("time", "walltime", "time_limit"), "wall"),
    **dict.fromkeys(("ncpus", "ppn", "ntasks", "cpus_per_task", "cores", "procs"), "cpus"),
    **dict.fromkeys(("nodes", "array", "jobs", "elements"), "array_tasks"),
    **dict.fromkeys(("gres", "ngpus", "gpu"), "gpus"),
    **dict.fromkeys(("features", "select"), "constraint"),
    "project": "account",
    "mem": "memory",
}
"""Schedulers' names for settings of clusters, with the name in `sierra.toml`."""
SYSTEM = ("proc", "sys", "dev", "tmp")
"""Folders in a container where nothing can be mounted."""
KINDS = {
    "int_type": "should be a whole number",
    "float_type": "should be a number",
    "string_type": "should be a text",
    "bool_type": "should be true or false",
    "tuple_type": "should be a list",
    "dict_type": "should be a table",
    "mapping_type": "should be a table",
    "model_type": "should be a table",
    "model_attributes_type": "should be a table",
    "too_short": "should not be empty",
    "string_too_short": "should not be empty",
}
"""Messages in the terms of TOML for the error types of pydantic."""


def _as_words(value: Any) -> Any:
    """Split a command that is written as one line. The rules are those of a shell, but no shell executes it."""
    return tuple(shlex.split(value)) if isinstance(value, str) else value


def _set_to(value: Any) -> Any:
    """Expand the short form of a table, which is the XPath alone."""
    return {"set": value} if isinstance(value, str) else value


def _inside(path: str) -> str:
    """Check that a path or glob stays in the output folder."""
    if path.startswith("/") or ".." in PurePosixPath(path).parts:
        raise ValueError(f"{path!r} should be a path within the run's output folder, as in results.csv")
    return path


def _inner(path: str) -> str:
    """Check that something can be mounted at a path in a container."""
    parts = PurePosixPath(path).parts
    if parts[:1] != ("/",) or len(parts) < 2 or ".." in parts or parts[:3] == ("/", "run", "sierra") or parts[1] in SYSTEM:
        raise ValueError(f"{path!r} should be a path in the container such as /data (not in {', '.join(SYSTEM)} or run/sierra)")
    return str(PurePosixPath(path))


def _on_node(path: str) -> str:
    """Check that a path does not depend on the folder in which a task begins."""
    if not path.startswith(("/", "$")):
        raise ValueError(f"{path!r} should be an absolute path on the node, as in /scratch or $TMPDIR/x")
    return path


def _elsewhere(path: str) -> str:
    """Check that a path does not depend on the folder in which a command begins."""
    if not path.startswith(("/", "~", "$")):
        raise ValueError(f"{path!r} should be an absolute path, as in /scratch/me, ~/scratch or $SCRATCH")
    return path


def _device(path: str) -> str:
    if not path.startswith("/dev/") or ".." in PurePosixPath(path).parts:
        raise ValueError(f"{path!r} should be a device, as in /dev/dri")
    return path


def _once(names: tuple[str, ...]) -> tuple[str, ...]:
    if len({name.lower() for name in names}) < len(names):
        raise ValueError("each column should be named once; SQL takes no notice of case")
    return names


def size(text: Any) -> Any:
    """Return a size in bytes from `500 MB`, `2 GiB`, or a plain number. Raises ValueError."""
    if not isinstance(text, str):
        return text
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kKMGT]?i?)B?\s*", text)
    if not match:
        raise ValueError(f"{text!r} is not a size; write it as 500 MB or 2 GiB")
    number, prefix = match.groups()
    base = 1024 if prefix.endswith("i") else 1000
    return int(float(number) * base ** " kmgt".index(prefix[:1].lower() or " "))


def _as_text(value: Any) -> Any:
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value) if isinstance(value, int | float) else value


Text = Annotated[str, BeforeValidator(_as_text, json_schema_input_type=str | int | float | bool)]
Size = Annotated[
    PositiveInt,
    BeforeValidator(size),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "integer", "exclusiveMinimum": 0}]}),
]
Line = Annotated[str, StringConstraints(pattern=r"^[^\n\r]+$")]
Inside = Annotated[str, AfterValidator(_inside)]
Inner = Annotated[str, AfterValidator(_inner)]
Device = Annotated[str, AfterValidator(_device)]


class Table(BaseModel):
    """A table of `sierra.toml`: unknown keys are errors, and it is immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ChangeTable(Table):
    """One change to the template: exactly one of `set`, `add`, `remove`, `rename`, each an XPath."""

    set: str | None = Field(None, description="XPath of attributes or elements to give `value` to")
    add: str | None = Field(None, description="XPath of the parents that `xml` is put into")
    remove: str | None = Field(None, description="XPath of elements or attributes to take away")
    rename: str | None = Field(None, description="XPath of elements to give the tag `to`")
    value: Text | None = Field(
        None,
        description="for `set`: the new value; `{…}` is an expression of axes, as in `{population_size * 2}`; `{{` is a brace",
    )
    attribute: str | None = Field(None, description="for `set`: the attribute, added where it is absent")
    xml: str | None = Field(None, description="for `add`: the element, as XML")
    at: int | None = Field(None, ge=0, description="for `add`: the index among the children, from 0; last where absent")
    to: str | None = Field(None, description="for `rename`: the new tag")
    expect: PositiveInt | None = Field(None, description="how many matches there must be; at least one where absent")

    @model_validator(mode="after")
    def _one_operation(self) -> ChangeTable:
        needs = {
            "set": {"value", "attribute"},
            "add": {"xml", "at"},
            "remove": set[str](),
            "rename": {"to"},
        }
        given = [name for name in needs if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError("a change has exactly one of set, add, remove, rename")
        operation = given[0]
        for other in ("value", "attribute", "xml", "at", "to"):
            if getattr(self, other) is not None and other not in needs[operation]:
                raise ValueError(f"{other!r} does not go with {operation!r}")
        required = {"add": "xml", "rename": "to"}.get(operation)
        if required and getattr(self, required) is None:
            raise ValueError(f"{operation!r} needs {required!r}")
        return self


class Variable(Table):
    """An independent variable: what one value of it changes in the template.

    The short form `name = "XPATH"` sets what the XPath selects to the value.
    """

    set: str | None = Field(None, description="XPath of what gets the value itself")
    changes: tuple[ChangeTable, ...] = Field((), description="further changes; `{name}` is the value")
    label: str = Field("", description="what figures call it; its name where absent")
    unit: str = Field("", description="its unit, for figures")

    @model_validator(mode="after")
    def _something(self) -> Variable:
        if not self.set and not self.changes:
            raise ValueError('a variable needs "set" or "changes"')
        if any(change.set and change.value is None for change in self.changes):
            raise ValueError('a "set" in "changes" needs a "value"')
        return self


class Seed(Table):
    """The place and the origin of the seed. The short form is the XPath alone."""

    set: str | None = Field(None, description="XPath of what gets the seed")
    base: int = Field(0, ge=0, description="the number that all seeds derive from")
    independent: bool = Field(False, description="other seeds in each experiment; else the same, common random numbers")


class Group(Table):
    """A controller or a scenario: a named group of changes."""

    changes: tuple[ChangeTable, ...] = Field((), description="what it changes in the template; may be nothing")


class Tolerance(Table):
    """The maximum distance of a number from the recorded one in a replay; one of these limits must hold."""

    abs: float = Field(0.0, ge=0, allow_inf_nan=False, description="the difference itself, in the column's unit")
    rel: float = Field(0.0, ge=0, allow_inf_nan=False, description="the difference divided by the recorded number's size")
    ulp: float = Field(0.0, ge=0, allow_inf_nan=False, description="the difference in units in the last place of a double")


class Output(Table):
    """One kind of file that runs write, and the table that it becomes."""

    file: Inside = Field(min_length=1, description="path or glob, relative to the run's output folder")
    format: Annotated[str, WithJsonSchema({"type": "string", "enum": ["csv", "parquet", "jsonl", "file"]})] | None = Field(
        None, description="how it is read; `file` is kept and no table; by its ending where absent"
    )
    delimiter: str = Field("", max_length=1, description="what separates the columns of a CSV; found out where absent")
    header: bool = Field(True, description="whether a CSV's first line holds the columns' names")
    columns: Annotated[tuple[Name, ...], AfterValidator(_once)] = Field(
        (), description="the columns' names of a CSV without header"
    )
    time: str = Field("", description="the column that is the time axis; the row's number where there is none")
    required: bool = Field(True, description="whether a run without it has failed")
    min_rows: int = Field(0, ge=0, description="a run with fewer has failed")
    mismatch: Literal["strict", "ragged"] = Field(
        "strict", description="other row counts or columns than its siblings: fail the run, or keep it and report n"
    )
    units: Mapping[str, str] = Field(default_factory=dict, description="the unit of each column, for figures")
    tolerance: Mapping[str, Tolerance] = Field(
        default_factory=dict,
        description="by column (`*`: all others), how far a replay may be from the record: abs, rel or ulp",
    )
    ordered: bool = Field(True, description="whether a replay heeds the order of rows")
    volatile: tuple[str, ...] = Field(
        (),
        description="what a replay does not compare: columns of a table; in another file, regular expressions of lines",
    )

    def matches(self, path: str) -> bool:
        """Return True if a file of the output folder belongs to this output, by its name or as a glob; `*` matches slashes."""
        file = self.file.removeprefix("./")
        return path == file or fnmatch.fnmatchcase(path, file)

    @property
    def kind(self) -> str:
        """Return the name of its format: as declared, or from the ending of the file. There may be no reader of that name."""
        ending = self.file.rsplit(".", 1)[-1].lower()
        return self.format or SAME_FORMAT.get(ending, ending)


class Success(Table):
    """The evidence that a run succeeded, in addition to its exit status and its required outputs."""

    marker: Inside = Field("", description="a file in the output folder (or `stdout`, `stderr`) that must be there")
    contains: str = Field("", description="a text that the marker file must contain")
    exit_status: tuple[int, ...] = Field((0,), min_length=1, description="exit statuses that are success")


class LimitsTable(Table):
    """Limits of one execution; a missing limit means no limit."""

    wall: Seconds | None = Field(None, description="seconds from its start to its end")
    cpu: Seconds | None = Field(None, description="seconds of CPU time of all its processes")
    memory: Size | None = Field(None, description="resident bytes of all its processes, a number or as in `2 GiB`")
    output: Size | None = Field(None, description="bytes of the files in its folder, holes included, as in `500 MB`")
    grace: Seconds = Field(5.0, description="seconds between SIGTERM and SIGKILL")


class Environment(Table):
    """The variables that a run sees in addition to SIERRA's own, and the variables that are recorded."""

    set: Mapping[VariableName, Text] = Field(default_factory=dict, description="given to every run; part of its identity")
    pass_: tuple[str, ...] = Field(
        (), alias="pass", description="taken from the caller's environment, by name; part of its identity"
    )
    record: tuple[str, ...] = Field(
        (), description="variables of the caller's (`*` stands for any characters) that are recorded; runs do not see them"
    )


class Container(Table):
    """The image in which runs execute, and their access to the host; by default they reach neither network nor devices."""

    image: str = Field(
        min_length=1, description="a tag, an archive, a SIF or squashfs file, or the folder of a recipe; see `sierra image pin`"
    )
    engine: str = Field("podman", description="what contains runs: `podman`, `apptainer`, `none`, or one that is installed")
    isolation: Literal["run", "worker"] = Field(
        "run", description="a container for each run, or one for each slot that its runs share (quicker, and weaker)"
    )
    mounts: Mapping[Inner, str] = Field(
        default_factory=dict,
        description="files and folders that runs may read, by their path in the container; as seen from the project's root",
    )
    variables: Mapping[VariableName, Text] = Field(
        default_factory=dict, description="given to every run in the container; part of its identity"
    )
    network: bool = Field(False, description="whether runs reach the network; part of their identity")
    devices: tuple[Device, ...] = Field((), description="devices that runs may use, as in `/dev/dri`; part of their identity")
    gpu: bool = Field(False, description="whether runs reach NVIDIA's graphics processors; part of their identity")
    cpus: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = Field(
        None, description="cores that a container may use at a time"
    )
    pids: PositiveInt | None = Field(None, description="processes and threads that a container may have")


class ClusterTable(Table):
    """A cluster: the resources of each array task, and the sharding of a batch into tasks."""

    scheduler: str | None = Field(
        None, description="`slurm`, `pbs`, or one that is installed; where absent, the one that the table is called after"
    )
    array_tasks: PositiveInt | None = Field(
        None, description="shares of a batch, each executed by one task; where absent, so many that each takes 5 to 10 minutes"
    )
    cpus: PositiveInt = Field(1, description="cores of an element: so many of its runs execute at a time")
    memory: Size | None = Field(None, description="memory of an element, a number or as in `4 GiB`")
    wall: Seconds | None = Field(None, description="seconds that an element may take; where absent, estimated, or the site's")
    partition: Line | None = Field(None, description="the partition (PBS: the queue)")
    account: Line | None = Field(None, description="the account (PBS: as well) that is charged")
    qos: Line | None = Field(None, description="the quality of service (SLURM)")
    constraint: Line | None = Field(
        None, description="features that nodes must have (SLURM), or what is added to `select` (PBS)"
    )
    gpus: PositiveInt | None = Field(None, description="graphics processors of an element")
    modules: tuple[Line, ...] = Field((), description="environment modules to load before anything else")
    directives: tuple[Line, ...] = Field(
        (), description="further lines, as they stand after `#SBATCH` or `#PBS`: what no setting is for"
    )
    python: str = Field("python3", min_length=1, description="a Python 3.8 or newer on the nodes")
    scratch: Annotated[str, AfterValidator(_on_node)] | None = Field(
        None,
        description="folder on the node for runs, as in `$TMPDIR/x`, made in one that is there; where absent, $SLURM_TMPDIR, "
        "$TMPDIR or /tmp",
    )
    cancelled: Literal["stop", "resubmit"] = Field(
        "stop",
        description="what to do when somebody else cancels an element: `stop` the session, or `resubmit` it",
    )
    attempts: PositiveInt = Field(
        3, description="times that a run is begun, the last one alone, or an element without any, before it has failed"
    )


class Source(Table):
    """The part of the project that is the source of a run."""

    paths: tuple[str, ...] = Field((), description="files and folders; the whole project where absent")
    dirty: Literal["record", "refuse", "ignore"] = Field(
        "record",
        description="changes that git has no commit of: count, are an error, or neither count nor execute (a checkout does)",
    )
    max_untracked: Size = Field(
        50_000_000, description="an untracked file of more bytes is an error, a number or as in `50 MB`"
    )


class StoreTable(Table):
    """The settings of the store."""

    raw: bool = Field(
        True,
        description="whether the bytes of files that become tables are kept too, so that changed [outputs] and [success] "
        "execute nothing again",
    )
    work_folder: Annotated[str, AfterValidator(_elsewhere)] | None = Field(
        None,
        description="where runs of this machine execute: a folder for each project is made in it; `~` and variables as in "
        "`$SCRATCH` are filled in; in the store where absent",
    )

    def place(self) -> Path | None:
        """Return the folder where runs execute, or None for the store's. Raises Missing for a variable that is not set."""
        if self.work_folder is None:
            return None
        filled = Path(os.path.expandvars(self.work_folder))
        with contextlib.suppress(RuntimeError):  # the user does not exist
            filled = filled.expanduser()
        if not filled.is_absolute() or "$" in str(filled):
            raise Missing(f"[store] work: {self.work_folder!r} is {str(filled)!r} here, and no absolute path; set the variable")
        return filled


class Determinism(Table):
    """The check that runs with the same seed give the same bytes."""

    probe: bool = Field(False, description="execute one run twice before a batch, and say whether it came out the same")


class Equivalence(Table):
    """A metric that compares nondeterministic runs in a replay, over the runs of a whole experiment."""

    table: str = Field(description="the output")
    column: str = Field(description="the column of it")
    measure: Literal["final", "mean", "time_to"] = Field("final", description="what a run is reduced to, as in figures")
    threshold: Annotated[float, Field(allow_inf_nan=False)] | None = Field(None, description="for `time_to`, as in figures")
    margin: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = Field(
        None, description="means this far apart are still the same, in the column's unit"
    )
    relative: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = Field(
        None, description="the same as a part of the recorded mean (0.05: 5 %)"
    )
    alpha: Annotated[float, Field(gt=0, lt=0.5)] = Field(
        0.05, description="the probability at most to take for the same what is a margin apart"
    )

    @model_validator(mode="after")
    def _fitting(self) -> Equivalence:
        if (self.margin is None) == (self.relative is None):
            raise ValueError('say either "margin" or "relative"')
        if (self.measure == "time_to") != (self.threshold is not None):
            raise ValueError('measure "time_to" and "threshold" go together')
        return self


Argv = Annotated[tuple[str, ...], BeforeValidator(_as_words, json_schema_input_type=Words)]


class ProgramsTable(Table):
    """The arguments that make programs in a command print their versions, which are recorded."""

    version: Argv = Field(("--version",), description="what an installed program is asked with; empty: none is asked")
    versions: Mapping[str, Argv] = Field(
        default_factory=dict,
        description="by the program's name, with what else it is asked (empty: not at all); scripts and programs of the "
        "project are only asked where they stand here",
    )


class QueryTable(Table):
    """A research query with a name, for `sierra run NAME`."""

    criteria: Annotated[
        tuple[str, ...],
        BeforeValidator(lambda v: tuple(v.split()) if isinstance(v, str) else v, json_schema_input_type=Words),
        Field(min_length=1),
    ] = Field(description="one for each axis, as on the command line; a text is split at blanks")
    runs: PositiveInt | None = Field(None, description="runs per experiment; the project's `runs` where absent")
    controller: str | None = Field(None, description="its name; the project's `controller` where absent")
    scenario: str | None = Field(None, description="its name; the project's `scenario` where absent")


class Figure(Table):
    """One figure. Without any, each numeric column of each output gets a time series and a summary."""

    kind: Literal["timeseries", "summary", "box", "violin", "heatmap", "stacked"] = Field(
        "timeseries", description="lines over time; points, boxes or violins over the first variable; a map of two; areas"
    )
    table: str = Field("", description="the output; may be left out where there is only one")
    columns: Annotated[
        tuple[str, ...], BeforeValidator(lambda v: (v,) if isinstance(v, str) else v, json_schema_input_type=Words)
    ] = Field((), alias="column", description="the column (for `stacked`: the columns)")
    times: Literal["own", "carry", "linear"] | None = Field(
        None,
        description="what is drawn over time is drawn at the runs' own times, or at common ones, with the last values carried "
        "forward, or interpolated linearly; where absent, `own`, or `carry` where most times differ between runs",
    )
    measure: Literal["final", "mean", "time_to"] = Field(
        "final", description="what a run is reduced to: its last value, its mean over time, the time until `threshold`"
    )
    threshold: Annotated[float, Field(allow_inf_nan=False)] | None = Field(
        None, description="for `time_to`: the value that has to be reached or exceeded, in the column's unit"
    )
    center: Literal["mean", "median", "iqm"] = Field(
        "mean", description="mean with its 95 % interval, median with quartiles, or interquartile mean with its 95 % interval"
    )
    title: str = Field("", description="what stands above it")
    xlabel: str = Field("", description="below the x axis; the time's or the variable's name and unit where absent")
    ylabel: str = Field("", description="what the values are; the column's name and unit where absent")
    log_x: bool = Field(False, description="a logarithmic x axis; variables whose values are 1, 2, 4, … have one anyway")
    log_y: bool = Field(False, description="logarithmic values (in a heatmap: colours)")

    @model_validator(mode="after")
    def _fitting(self) -> Figure:
        if self.measure == "time_to" and self.threshold is None:
            raise ValueError('measure "time_to" needs a "threshold"')
        if self.measure != "time_to" and self.threshold is not None:
            raise ValueError('"threshold" goes with measure = "time_to"')
        if self.kind == "timeseries" and self.measure != "final":
            raise ValueError(f'measure {self.measure!r} needs another kind, as in: kind = "summary"')
        if self.times and self.kind not in ("timeseries", "stacked"):
            raise ValueError(f'"times" goes with kind "timeseries" or "stacked", not {self.kind!r}')
        return self


class Project(Table):
    """`sierra.toml`."""

    template: str = Field(description="the XML file that every run's input is made from")
    command: Annotated[tuple[str, ...], BeforeValidator(_as_words, json_schema_input_type=Words)] = Field(
        (),
        description="the program and its arguments; {input}, {output}, {seed}, {project}, {python} stand for the run's own",
    )
    requires: tuple[Annotated[str, Field(pattern=r"^[A-Za-z0-9]")], ...] = Field(
        (), description="Python packages that `{python}` needs, as pip takes them; checked before anything executes"
    )
    platform: str = Field("command", description="how the simulator is driven: `command`, `argos`, or one that is installed")
    runs: PositiveInt = Field(10, description="runs per experiment")
    controller: str | None = Field(None, description="the controller, where none is asked for")
    scenario: str | None = Field(None, description="the scenario, where none is asked for")
    seed: Annotated[Seed, BeforeValidator(_set_to, json_schema_input_type=str | Seed)] = Seed()
    variables: Mapping[Name, Annotated[Variable, BeforeValidator(_set_to, json_schema_input_type=str | Variable)]] = Field(
        default_factory=dict, description="what queries vary, by name"
    )
    changes: tuple[ChangeTable, ...] = Field((), description="made in every run of every batch")
    per_run: Mapping[Name, Annotated[tuple[Scalar, ...], Field(min_length=1)]] = Field(
        default_factory=dict, description="lists: run number n may use item n, as `{name}` in `run_changes`"
    )
    run_changes: tuple[ChangeTable, ...] = Field(
        (), description="made in each run; may use {seed}, {run} and the lists of per_run"
    )
    controllers: Mapping[Name, Group] = Field(
        default_factory=dict, description="for `controller` and --controller, by name; `{controller}` in changes is the name"
    )
    scenarios: Mapping[Name, Group] = Field(default_factory=dict, description="for `scenario` and --scenario, by name")
    outputs: Mapping[Name, Output] = Field(
        default_factory=dict,
        description="what runs write, by the table's name; where absent, each .csv, .parquet and .jsonl of the output folder",
    )
    success: Success = Success()
    limits: LimitsTable = LimitsTable()
    environment: Environment = Environment()
    container: Container | None = Field(None, description="the image that runs execute in; on this machine where absent")
    source: Source = Source()
    store: StoreTable = StoreTable()
    determinism: Determinism = Determinism()
    equivalence: Mapping[Name, Equivalence] = Field(
        default_factory=dict, description="for runs that are not deterministic: what must be the same in a replay, by name"
    )
    programs: ProgramsTable = ProgramsTable()
    queries: Mapping[Name, QueryTable] = Field(default_factory=dict, description="research queries, by name")
    figures: Mapping[Name, Figure] = Field(default_factory=dict, description="figures, by name")
    platforms: Mapping[str, Mapping[str, Any]] = Field(default_factory=dict, description="options of platforms, by name")
    runners: Mapping[str, Mapping[str, Any]] = Field(
        default_factory=dict, description="clusters for `--on`, by name: `slurm`, `pbs`, or one of your own with a `scheduler`"
    )
    templates: Mapping[str, Mapping[str, Any]] = Field(default_factory=dict, description="options of template formats, by name")
    engines: Mapping[str, Mapping[str, Any]] = Field(default_factory=dict, description="options of container engines, by name")
    readers: Mapping[str, Mapping[str, Any]] = Field(
        default_factory=dict, description="options of the readers of output formats, by name"
    )


@dataclass(frozen=True, slots=True)
class LoadedProject:
    """A project: its root (absolute), its file, and its configuration."""

    root: Path
    file: Path
    config: Project
    written: bool = True
    """True if the file exists. A store without a file can be read too."""

    def check_written(self) -> None:
        """Raise Missing if there is no `sierra.toml`, so that nothing can be executed."""
        if not self.written:
            raise Missing(f"no {CONFIG} in {self.root}, only a store, which can be read; make one with: sierra init")


def load(folder: Path) -> LoadedProject:
    """Return the project that contains `folder`: the nearest `sierra.toml` or `[tool.sierra]` here or above.

    Raises ConfigError if it is invalid, Missing if there is none.
    """
    folder = folder.resolve()
    for root in (folder, *folder.parents):
        file = root / CONFIG
        if file.is_file():
            return LoadedProject(root, file, parse(read_toml(file), str(file)))
        file = root / PYPROJECT
        if file.is_file() and (table := read_toml(file).get("tool", {}).get("sierra")) is not None:
            return LoadedProject(root, file, parse(table, f"{file} [tool.sierra]"))
    raise Missing(f"no {CONFIG} in {folder} or above it; make one with: sierra init")


def load_store(folder: Path) -> LoadedProject:
    """Return the project that contains `folder`, like `load`, or the nearest store as a project without declarations.

    Raises ConfigError, and Missing if there is neither.
    """
    try:
        return load(folder)
    except Missing:
        for root in (folder.resolve(), *folder.resolve().parents):
            if any((root / name).exists() for name in (CONFIG, PYPROJECT)):
                raise
            if (root / STORE).is_dir():
                return LoadedProject(root, root / CONFIG, Project(template=""), written=False)
        raise


def parse(table: Mapping[str, Any], origin: str) -> Project:
    """Validate a table from TOML; messages call it `origin`.

    The tables of plug-ins are validated when they are used (see `sierra.config.plugins`), those of shipped schedulers here too.
    """
    project = options(Project, table, origin)
    for name, runner in project.runners.items():
        if (scheduler := runner.get("scheduler", name)) in directives.CHECKED:
            cluster = options(ClusterTable, runner, origin, ("runners", name))
            check_directives(cluster, partial(directives.complaint, scheduler), f"{origin}: runners", name)
    return project


def check_directives(table: ClusterTable, complaint: Callable[[str], str | None], where: str, name: str) -> None:
    """Raise ConfigError if a line of a cluster contradicts lines that SIERRA writes itself; `complaint` returns the reason."""
    for line in table.directives:
        if why := complaint(line):
            raise ConfigError(f"{where}: directive {line!r} of {name!r} can't be added: {why}")


def options(model: type[OptionsT], table: Mapping[str, Any], origin: str, within: tuple[str, ...] = ()) -> OptionsT:
    """Validate a table by its model: the project's, or that of a plug-in. A text is not accepted as a number.

    `within` is the place of the table in `origin`, for messages.
    """
    try:
        return model.model_validate(_frozen(table, origin), strict=True)
    except ValidationError as error:
        raise ConfigError(f"{origin}: {_explain(error, model, within)}") from error


def _frozen(value: Any, origin: str) -> Any:
    """Return lists as tuples, which are immutable.

    Raises ConfigError for a text with the character NUL, which no file or argument can contain.
    """
    match value:
        case str() if "\0" in value:
            raise ConfigError(f"{origin}: {value[:40]!r} has the character NUL in it; leave it out")
        case dict():
            return {_frozen(name, origin): _frozen(inner, origin) for name, inner in value.items()}
        case list() | tuple():
            return tuple(_frozen(inner, origin) for inner in value)
        case _:
            return value


def read_toml(file: Path) -> dict[str, Any]:
    """Return the content of a TOML file. Raises ConfigError if it is not TOML, Missing if it cannot be read."""
    try:
        with file.open("rb") as stream:
            return tomllib.load(stream)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: not TOML: {error}") from error
    except OSError as error:
        raise Missing(f"{file}: {error.strerror}") from error


def _explain(error: ValidationError, model: type[BaseModel], within: tuple[str, ...] = ()) -> str:
    """Return the first error in one line; for an unknown key, with the most similar valid key."""
    complaint = error.errors()[0]
    where = ".".join(str(part) for part in (*within, *complaint["loc"]))
    if complaint["type"] == "extra_forbidden":
        return f"unknown key {where!r}{_nearest(model, complaint['loc'])}"
    if complaint["type"] == "missing":
        return f"{where!r} is missing"
    if complaint["type"] == "value_error":
        return f"{where or 'table'}: {complaint['ctx']['error']}"
    if complaint["loc"][-1:] == ("[key]",):
        table = ".".join(map(str, complaint["loc"][:-2]))
        return f"{table}: {_no_name(complaint['input'])}"
    if complaint.get("ctx", {}).get("pattern") == NAME:
        return f"{where}: {_no_name(complaint['input'])}"
    message = KINDS.get(complaint["type"]) or complaint["msg"].replace("Input", "it").replace("it should", "should", 1)
    return f"{where or 'table'} {message}, not {_written(complaint['input'])}"


def _no_name(value: object) -> str:
    """Return a message for an invalid name, with a proposal."""
    letters = re.sub(r"[^A-Za-z0-9]+", "_", str(value)).strip("_").lstrip("0123456789_")
    return f"{value!r} is not a name; use letters, digits and _, as in {letters or 'my_name'}"


def _written(value: Any) -> str:
    """Return a value nearly in the form of TOML, shortened."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _nearest(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    """Return a hint with the known keys of the table that contains `location`, or the most similar one."""
    known = sorted(_keys(model, location[:-1]))
    if issubclass(model, ClusterTable) and location[-1] in SETTINGS:
        return f"; here it is {SETTINGS[location[-1]]!r}"
    close = difflib.get_close_matches(str(location[-1]), known, 1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known are {', '.join(known)}" if known else ""


def _keys(model: type[BaseModel], location: tuple[int | str, ...]) -> set[str]:
    found = _models(model)
    current: Any = model
    for part in location:
        if not (isinstance(current, type) and issubclass(current, BaseModel)):
            break
        inner = next((f.annotation for n, f in current.model_fields.items() if part in (n, f.alias)), None)
        current = next((m for m in found if inner is not None and m.__name__ in str(inner)), current)
    return {field.alias or name for name, field in current.model_fields.items()}


def _models(model: type[BaseModel]) -> list[type[BaseModel]]:
    return [m for m in Table.__subclasses__() if m is not model]
