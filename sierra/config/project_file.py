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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveInt,
    StringConstraints,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from sierra.config import forbidden_directives as directives
from sierra.config import group_names, targets
from sierra.config.find_project import ProjectFolder, find, settings
from sierra.errors import ConfigError, Missing, UsageError
from sierra.store.layout import CONFIG, PYPROJECT, STORE

NAME = r"^[A-Za-z_][A-Za-z0-9_]*$"
Name = Annotated[str, StringConstraints(pattern=NAME)]
"""A name that is also a column in SQL."""
GroupName = Annotated[str, StringConstraints(pattern=group_names.GROUP_NAME)]
"""A name of a controller or a scenario: see `sierra.config.group_names`."""
VariableName = Annotated[str, StringConstraints(pattern=r"^[^=]+$")]
Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Scalar = str | int | float
Words = str | tuple[str, ...]
"""A list of texts, or its short form."""
RawTable = targets.RawTable
OptionsT = TypeVar("OptionsT", bound=BaseModel)
SAME_FORMAT = {"tsv": "csv", "ndjson": "jsonl"}
"""Endings of output files with the format that another ending is named after."""
FILE_FORMAT = "file"
"""The format of outputs that are kept as files and become no table."""
NAMED_FORMATS = ("json", "xml", "graphml", "npy", "arrow", "sqlite", "hdf5", "netcdf")
"""Formats that are only read if they are named, because such files were kept as files before there was a reader."""
PLACEHOLDER = re.compile(r"\{([A-Za-z_][A-Za-z0-9_]*)\}")
"""A name in braces that stands for a number in the name of an output file."""
ELEMENTS = re.compile(r"(//?(\*|[^\W\d][\w.:-]*))+")
"""A path of elements in XML."""
CSV_KEYS = ("skip", "comment", "header_lines", "units_row", "decimal", "na", "widths")
KEYS_OF_FORMATS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(CSV_KEYS, ("csv",)),
    "rows": ("json", "xml", "graphml", "sqlite", "hdf5", "netcdf"),
    **dict.fromkeys(("flatten", "unnest"), ("json", "jsonl")),
}
"""Keys of `[outputs.NAME]` that are only for certain formats."""
LATER_KEYS = tuple(KEYS_OF_FORMATS)
"""Keys of `[outputs.NAME]` that were added after rules had been recorded."""
Delimiter = Annotated[str, StringConstraints(pattern=r"^(.|blanks)?$|^[\t\n]$")]
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
VALUE = "{value}"
"""The text that stands for the value in the `argument` of a variable or of the seed."""
OWN_PLACEHOLDERS = ("input", "output", "run", "seed", "project", "python", "arguments")
"""Names in braces that have a meaning of their own in a command."""
NO_CHANGE = 'it changes nothing; give it "set", "changes", "argument" or "environment"'
NOT_VARIED = ("HOME", "TMPDIR", "PATH", "LD_LIBRARY_PATH", "LD_PRELOAD", "PYTHONPATH", "PYTHONHOME")
"""Environment variables that no variable of a query can set: the programs that runs use depend on them, or SIERRA sets them."""
OF_TARGETS = "for single targets, by name: other changes than the ones here"
SYSTEM = ("proc", "sys", "dev", "tmp")
"""Folders in a container where nothing can be mounted."""
KINDS = {
    "int_type": "should be a whole number",
    "float_type": "should be a number",
    "string_type": "should be text",
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


def _as_words(value: object) -> object:
    """Split a command that is written as one line. The rules are those of a shell, but no shell executes it."""
    return tuple(shlex.split(value)) if isinstance(value, str) else value


def _as_commands(value: object) -> object:
    """Return a list of commands from one that is written as one line."""
    return (_as_words(value),) if isinstance(value, str) else value


def _set_to(value: object) -> object:
    """Expand the short form of a table, which is the XPath alone."""
    return {"set": value} if isinstance(value, str) else value


def _with_value(words: tuple[str, ...]) -> tuple[str, ...]:
    if words and not any(VALUE in word for word in words):
        raise ValueError(f"{shlex.join(words)!r} should contain {VALUE}, as in --robots {VALUE}")
    if any("{arguments}" in word for word in words):
        raise ValueError("{arguments} can only be a word of the command")
    return words


def _not_fixed(name: str) -> str:
    if name in NOT_VARIED or name.startswith("SIERRA_"):
        raise ValueError(f"no value can be given in {name}, which SIERRA or the loader of programs uses; use another name")
    return name


def _not_options(table: object) -> object:
    """Refuse options of formats, which an earlier version had under this name."""
    for name, value in table.items() if isinstance(table, dict) else ():
        if isinstance(value, dict):
            raise ValueError(f"the options of formats have another name now: [template_formats.{name}]")
    return table


def _only_own(tables: Mapping[str, RawTable]) -> Mapping[str, RawTable]:
    """Check that targets have no keys that are shared by all."""
    for name, key in ((name, key) for name, table in tables.items() for key in table if key in targets.SHARED):
        if key in targets.PER_TARGET:
            place = key if key == "seed" else f"{key}.…"
            raise ValueError(f"{name}.{key} cannot be in a target; write [{place}.targets.{name}]")
        raise ValueError(f"{name}.{key} cannot be in a target; it is the same for all targets")
    return tables


def _path(is_valid: Callable[[str], bool], expected: str) -> AfterValidator:
    """Return a validator that refuses a path with a message that says what was expected."""

    def check(path: str) -> str:
        if not is_valid(path):
            raise ValueError(f"{path!r} should be {expected}")
        return path

    return AfterValidator(check)


def _in_container(path: str) -> str:
    """Check that something can be mounted at a path in a container."""
    parts = PurePosixPath(path).parts
    if parts[:1] != ("/",) or len(parts) < 2 or ".." in parts or parts[:3] == ("/", "run", "sierra") or parts[1] in SYSTEM:
        raise ValueError(f"{path!r} should be a path in the container such as /data (not in {', '.join(SYSTEM)} or run/sierra)")
    return str(PurePosixPath(path))


def _once(names: tuple[str, ...]) -> tuple[str, ...]:
    if len({name.lower() for name in names}) < len(names):
        raise ValueError("column names should be unique; SQL ignores upper and lower case")
    return names


def size(text: object) -> object:
    """Return a size in bytes from `500 MB`, `2 GiB`, or a plain number. Raises ValueError."""
    if not isinstance(text, str):
        return text
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kKMGT]?i?)B?\s*", text)
    if not match:
        raise ValueError(f"{text!r} is not a size; use one such as 500 MB or 2 GiB")
    number, prefix = match.groups()
    base = 1024 if prefix.endswith("i") else 1000
    return int(float(number) * base ** " kmgt".index(prefix[:1].lower() or " "))


def _as_text(value: object) -> object:
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value) if isinstance(value, int | float) else value


def _pattern(text: str) -> str:
    try:
        re.compile(text.encode())
    except re.error as error:
        raise ValueError(f"{text!r} is not a regular expression: {error}") from error
    return text


Text = Annotated[str, BeforeValidator(_as_text, json_schema_input_type=str | int | float | bool)]
Size = Annotated[
    PositiveInt,
    BeforeValidator(size),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "integer", "exclusiveMinimum": 0}]}),
]
SizeOrNone = Annotated[
    NonNegativeInt,
    BeforeValidator(size),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "integer", "minimum": 0}]}),
]
Line = Annotated[str, StringConstraints(pattern=r"^[^\n\r]+$")]
Argv = Annotated[tuple[str, ...], BeforeValidator(_as_words, json_schema_input_type=Words)]
Inside = Annotated[
    str,
    _path(
        lambda path: not path.startswith("/") and ".." not in PurePosixPath(path).parts,
        "a path within the run's output folder, such as results.csv",
    ),
]
InProject = Annotated[
    str,
    _path(
        lambda path: (
            bool(path)
            and not path.startswith("/")
            and ".." not in PurePosixPath(path).parts
            and not {".git", STORE} & set(PurePosixPath(path).parts)
        ),
        "a path within the project, such as build/sim",
    ),
]
Command = Annotated[tuple[str, ...], BeforeValidator(_as_words, json_schema_input_type=Words), Field(min_length=1)]
Commands = Annotated[
    tuple[Annotated[tuple[str, ...], Field(min_length=1)], ...],
    BeforeValidator(_as_commands, json_schema_input_type=str | tuple[tuple[str, ...], ...]),
]
InContainer = Annotated[str, AfterValidator(_in_container)]
Device = Annotated[
    str, _path(lambda path: path.startswith("/dev/") and ".." not in PurePosixPath(path).parts, "a device, such as /dev/dri")
]
OnNode = Annotated[
    str, _path(lambda path: path.startswith(("/", "$")), "an absolute path on the node, such as /scratch or $TMPDIR/x")
]
Absolute = Annotated[
    str, _path(lambda path: path.startswith(("/", "~", "$")), "an absolute path, such as /scratch/me, ~/scratch or $SCRATCH")
]


class Table(BaseModel):
    """A table of `sierra.toml`: unknown keys are errors, and it is immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ChangeTable(Table):
    """One change to the template: exactly one of `set`, `add`, `remove`, `rename`, each an XPath."""

    set: str | None = Field(None, description="XPath of the attributes, elements or keys that get `value`")
    add: str | None = Field(
        None, description="XPath of the parent elements that get `xml` as a child; of the lists and mappings that get `json`"
    )
    remove: str | None = Field(None, description="XPath of the elements, attributes, keys or items to remove")
    rename: str | None = Field(None, description="XPath of the elements or keys to rename to `to`")
    value: Text | None = Field(
        None,
        description="for `set`: the new value; `{…}` is an expression of axes, as in `{population_size * 2}`; `{{` is a brace",
    )
    attribute: str | None = Field(None, description="for `set`: the attribute's name; added if it is missing")
    xml: str | None = Field(None, description="for `add`: the new element, as XML")
    json_: str | None = Field(
        None, alias="json", description="for `add` in other formats than XML: the new item of a list, or the new keys, as JSON"
    )
    at: int | None = Field(None, ge=0, description="for `add`: the index among the children, from 0; default: last")
    to: str | None = Field(None, description="for `rename`: the new tag or key")
    expect: PositiveInt | None = Field(None, description="exact number of matches required; default: at least one")

    @model_validator(mode="after")
    def _one_operation(self) -> ChangeTable:
        accepted = {"set": ("value", "attribute"), "add": ("xml", "json_", "at"), "remove": (), "rename": ("to",)}
        given = [name for name in accepted if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError("a change needs exactly one of set, add, remove, rename")
        operation = given[0]
        for other in ("value", "attribute", "xml", "json_", "at", "to"):
            if getattr(self, other) is not None and other not in accepted[operation]:
                raise ValueError(f"{other.rstrip('_')!r} cannot be used with {operation!r}")
        if operation == "add" and (self.xml is None) == (self.json_ is None):
            raise ValueError("'add' needs either 'xml' or 'json'" if self.xml else "'add' needs 'xml' (or 'json')")
        if operation == "rename" and self.to is None:
            raise ValueError("'rename' needs 'to'")
        return self


Argument = Annotated[Argv, AfterValidator(_with_value)]
EnvironmentName = Annotated[str, StringConstraints(pattern=NAME), AfterValidator(_not_fixed)]


class ValueOfVariable(Table):
    """The changes that a value of a variable makes for one target. The short form is the XPath alone."""

    set: str | None = Field(None, description="XPath of the attributes or elements that get the value itself")
    changes: tuple[ChangeTable, ...] = Field((), description="further changes; `{name}` is the value")
    argument: Argument = Field(
        (), description="words of the command with the value, as in `--robots {value}`; a value is never split into words"
    )
    environment: EnvironmentName | None = Field(
        None, description="name of the environment variable of runs that gets the value"
    )

    @property
    def is_given(self) -> bool:
        """Return True if the variable itself says what its values change."""
        return bool(self.set or self.changes or self.argument or self.environment)

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if any(change.set and change.value is None for change in self.changes):
            raise ValueError('a "set" in "changes" needs a "value"')
        return self


class Variable(ValueOfVariable):
    """An independent variable: what one of its values changes in the template, the command or the environment of a run.

    The short form `name = "XPATH"` sets the attributes or elements that the XPath selects to the value. `{}` is a variable that
    the command or other changes use as `{name}`.
    """

    label: str = Field("", description="name in figures; default: the variable's name")
    unit: str = Field("", description="unit in figures")
    targets: Mapping[
        Name, Annotated[ValueOfVariable, BeforeValidator(_set_to, json_schema_input_type=str | ValueOfVariable)]
    ] = Field(default_factory=dict, description=OF_TARGETS)


class PlaceOfSeed(Table):
    """Where the seed goes for a target. The short form is the XPath alone."""

    set: str | None = Field(None, description="XPath of the attribute or element that gets the seed")
    argument: Argument = Field((), description="words of the command with the seed, as in `--seed {value}`")
    environment: EnvironmentName | None = Field(None, description="name of the environment variable of runs that gets the seed")


class Seed(PlaceOfSeed):
    """Where the seed goes, and how seeds are derived. The short form is the XPath alone."""

    base: int = Field(0, ge=0, description="base seed: the number that all seeds derive from")
    independent: bool = Field(
        False,
        description="different seeds in each experiment; by default, all experiments use the same seeds: common random numbers",
    )
    targets: Mapping[Name, Annotated[PlaceOfSeed, BeforeValidator(_set_to, json_schema_input_type=str | PlaceOfSeed)]] = Field(
        default_factory=dict, description=OF_TARGETS
    )


class ChangesOfGroup(Table):
    """The changes of a controller or a scenario for a target."""

    changes: tuple[ChangeTable, ...] = Field((), description="changes to the template; may be empty")


class Group(ChangesOfGroup):
    """A controller or a scenario: a named group of changes."""

    label: str = Field("", description="name in figures; default: the group's name")
    targets: Mapping[Name, ChangesOfGroup] = Field(default_factory=dict, description=OF_TARGETS)


class Tolerance(Table):
    """The largest difference of a replayed number from the recorded one; one of these limits must be met."""

    abs: NotNegative = Field(0.0, description="maximum absolute difference, in the column's unit")
    rel: NotNegative = Field(0.0, description="maximum difference divided by the absolute value of the recorded number")
    ulp: NotNegative = Field(0.0, description="maximum difference in units in the last place of a double")


@cache
def _numbered(file: str) -> re.Pattern[str]:
    """Return the regular expression for the names of files in which names in braces stand for whole numbers."""
    literals = PLACEHOLDER.split(file)[::2]
    return re.compile("([0-9]{1,18})".join(map(re.escape, literals)))


class Output(Table):
    """One kind of file that runs write, and the table that it becomes."""

    file: Inside = Field(
        min_length=1,
        description="path or glob, from the run's output folder; `{tick}` in `floor-{tick}.csv` is a number and a column",
    )
    format: (
        Annotated[
            str,
            WithJsonSchema(
                {
                    "type": "string",
                    "enum": [
                        "csv",
                        "parquet",
                        "jsonl",
                        "json",
                        "xml",
                        "graphml",
                        "npy",
                        "arrow",
                        "sqlite",
                        "hdf5",
                        "netcdf",
                        "file",
                    ],
                }
            ),
        ]
        | None
    ) = Field(
        None,
        description="format; `file` is stored but does not become a table; default: by the file's extension, "
        "if it is csv, parquet or jsonl",
    )
    delimiter: Delimiter = Field(
        "",
        description="separator between the columns of a CSV file; `blanks`: one or more blanks or tabs; default: detected",
    )
    header: bool = Field(True, description="whether the first line of a CSV file contains the column names")
    columns: Annotated[tuple[Name, ...], AfterValidator(_once)] = Field(
        (), description="column names of a CSV file without a header"
    )
    skip: int = Field(0, ge=0, description="number of lines at the beginning of a CSV file that are not read")
    comment: str = Field("", description="beginning of lines of a CSV file that are not read, such as `#`")
    header_lines: int = Field(
        1, ge=1, description="number of lines of a CSV file that make up the column names; their texts are joined by a dot"
    )
    units_row: bool = Field(False, description="whether a line with units follows the column names of a CSV file")
    decimal: Literal[".", ","] = Field(".", description="decimal separator of a CSV file")
    na: tuple[str, ...] = Field((), description="texts that stand for a missing value in a CSV file, such as `NA`")
    widths: tuple[PositiveInt, ...] = Field(
        (), description="number of characters of each column of a text file without separators (fixed width)"
    )
    rows: str = Field(
        "",
        description="part of a file that has the rows: in JSON, keys such as `results.steps`; in XML, `//NAME` or `/A/B`; "
        "in GraphML, `nodes` or `edges`; in SQLite, a table or a SELECT statement; "
        "in HDF5, the path of a dataset or group; in NetCDF, variables separated by commas",
    )
    flatten: bool | None = Field(
        None, description="whether objects in JSON become columns such as `pose.x`; default: yes in `json`, no in `jsonl`"
    )
    unnest: str = Field("", description="list in each JSON object whose items become rows, such as `robots`")
    time: str = Field("", description="column that is the time axis; default: the row number")
    ticks_per_second: Positive | Annotated[str, Field(min_length=1)] | None = Field(
        None,
        description="ticks per second, if the time column counts ticks: a number, or the XPath of one in the runs' inputs; "
        "figures over time then show seconds; needs `time`",
    )
    required: bool = Field(True, description="whether a run fails without this output")
    min_rows: int = Field(0, ge=0, description="minimum number of rows; a run with fewer rows fails")
    mismatch: Literal["strict", "ragged"] = Field(
        "strict",
        description="if row count or columns differ from those of sibling runs: `strict` fails the run, `ragged` keeps it "
        "and reports n",
    )
    units: Mapping[str, str] = Field(default_factory=dict, description="unit of each column in figures")
    tolerance: Mapping[str, Tolerance] = Field(
        default_factory=dict,
        description="maximum difference between replay and record, by column (`*`: all other columns): abs, rel or ulp",
    )
    ordered: bool = Field(True, description="whether a replay compares the order of rows")
    volatile: tuple[str, ...] = Field(
        (), description="not compared by a replay: columns of a table; for other files, regular expressions that match lines"
    )

    @model_validator(mode="after")
    def _fitting(self) -> Output:
        for key, known in KEYS_OF_FORMATS.items():
            if getattr(self, key) and key not in self.unused_later_keys and self.kind not in known:
                formats = " or ".join(f'format = "{name}"' for name in known)
                raise ValueError(f"{key} needs {formats}, but the format is {self.kind!r}")
        if not self.header and (self.units_row or self.header_lines > 1):
            raise ValueError(f"{'units_row' if self.units_row else 'header_lines'} needs header = true")
        if self.kind == "xml" and not ELEMENTS.fullmatch(self.rows):
            raise ValueError(f'format = "xml" needs rows, a path of element names such as "//tripinfo", not {self.rows!r}')
        if self.kind == "graphml" and self.rows not in ("nodes", "edges"):
            raise ValueError('format = "graphml" needs rows = "nodes" or rows = "edges"')
        if self.kind == "sqlite" and not self.rows:
            raise ValueError('format = "sqlite" needs rows, the name of a table or a SELECT statement')
        if self.kind in ("hdf5", "netcdf") and not self.rows.strip(" ,"):
            what = "the path of a dataset or group" if self.kind == "hdf5" else "one or more variables, separated by commas"
            raise ValueError(f'format = "{self.kind}" needs rows, {what}')
        if self.ticks and any(character in self.file for character in "*?["):
            raise ValueError(f"file: {{{self.ticks[0]}}} and the characters * ? [ exclude each other: {self.file!r}")
        if len(set(map(str.lower, self.ticks))) < len(self.ticks):
            raise ValueError(f"file: a name in braces occurs twice: {self.file!r}")
        if self.ticks_per_second is not None and not self.time:
            raise ValueError('ticks_per_second needs time = "COLUMN"')
        if self.widths and self.delimiter:
            raise ValueError("widths and delimiter exclude each other")
        if self.decimal == "," == self.delimiter:
            raise ValueError('decimal = "," needs another delimiter')
        return self

    @property
    def unused_later_keys(self) -> frozenset[str]:
        """Return the keys of `LATER_KEYS` that have their default; hashes of rules do not contain them, and stay the same."""
        return frozenset(key for key in LATER_KEYS if getattr(self, key) == type(self).model_fields[key].default)

    @property
    def ticks(self) -> tuple[str, ...]:
        """Return the names of the numbers in the names of its files, such as `tick` in `floor-{tick}.csv`."""
        return tuple(PLACEHOLDER.findall(self.file))

    def ticks_of(self, path: str) -> tuple[int, ...] | None:
        """Return the numbers in the name of a file; None if the file does not belong to this output."""
        found = _numbered(self.file.removeprefix("./")).fullmatch(path)
        return None if found is None else tuple(map(int, found.groups()))

    def matches(self, path: str) -> bool:
        """Return True if a file of the output folder belongs to this output, by its name or as a glob; `*` matches slashes."""
        if self.ticks:
            return self.ticks_of(path) is not None
        file = self.file.removeprefix("./")
        return path == file or fnmatch.fnmatchcase(path, file)

    @property
    def kind(self) -> str:
        """Return the name of its format: as declared, or from the ending of the file. There may be no reader of that name."""
        ending = self.file.rsplit(".", 1)[-1].lower()
        return self.format or (FILE_FORMAT if ending in NAMED_FORMATS else SAME_FORMAT.get(ending, ending))


def _apart(outputs: Mapping[str, Output]) -> Mapping[str, Output]:
    """Check that no two outputs have the same file. Raises ValueError."""
    owners: dict[str, str] = {}
    for name, output in outputs.items():
        file = output.file.removeprefix("./")
        if (first := owners.setdefault(file, name)) != name:
            raise ValueError(f"{first!r} and {name!r} have the same file {file!r}; a file becomes one table")
    return outputs


class Success(Table):
    """Conditions for a successful run, in addition to its required outputs."""

    marker: Inside = Field("", description="a file in the output folder (or `stdout`, `stderr`) that must exist")
    contains: str = Field("", description="text that the marker file must contain")
    exit_status: tuple[int, ...] = Field((0,), min_length=1, description="exit statuses that mean success")


class LimitsTable(Table):
    """Limits of one execution; a missing limit means no limit."""

    wall: Positive | None = Field(None, description="wall-clock time, in seconds")
    cpu: Positive | None = Field(None, description="CPU time of all its processes, in seconds")
    memory: Size | None = Field(None, description="resident memory of all its processes, in bytes or as in `2 GiB`")
    output: Size | None = Field(
        None,
        description="total size of the files in its folder, in bytes or as in `500 MB`; holes of sparse files are included",
    )
    grace: Positive = Field(5.0, description="time between SIGTERM and SIGKILL, in seconds")


class Environment(Table):
    """Environment variables that runs get in addition to SIERRA's own, and variables that are recorded."""

    set: Mapping[VariableName, Text] = Field(
        default_factory=dict, description="variables that every run gets; part of its identity"
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
        min_length=1, description="a tag, an archive, a SIF or squashfs file, or the folder of a recipe; see `sierra image pin`"
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


class ClusterTable(Table):
    """A cluster: the resources of each array task, and the division of a batch into array tasks."""

    scheduler: str | None = Field(None, description="`slurm`, `pbs`, or an installed plug-in; default: the name of the table")
    array_tasks: PositiveInt | None = Field(
        None, description="number of array tasks; each executes a share of the batch; default: enough for 5 to 10 minutes each"
    )
    cpus: PositiveInt = Field(1, description="cores of an array task; it executes as many runs at a time")
    memory: Size | None = Field(None, description="memory of an array task, in bytes or as in `4 GiB`")
    wall: Positive | None = Field(
        None, description="time limit of an array task, in seconds; default: estimated, or the site's default"
    )
    partition: Line | None = Field(None, description="partition (PBS: queue)")
    account: Line | None = Field(None, description="account that is charged (SLURM and PBS)")
    qos: Line | None = Field(None, description="quality of service (SLURM)")
    constraint: Line | None = Field(
        None, description="features that nodes must have (SLURM), or text that is added to `select` (PBS)"
    )
    gpus: PositiveInt | None = Field(None, description="GPUs of an array task")
    modules: tuple[Line, ...] = Field((), description="environment modules that are loaded first")
    directives: tuple[Line, ...] = Field(
        (), description="further directives for which there is no setting: the text after `#SBATCH` or `#PBS`"
    )
    python: str = Field("python3", min_length=1, description="the command for Python 3.8 or newer on the nodes")
    scratch: OnNode | None = Field(
        None,
        description="folder on the node in which runs execute, such as `$TMPDIR/x`; its parent folder must exist; default: "
        "$SLURM_TMPDIR, $TMPDIR or /tmp",
    )
    cancelled: Literal["stop", "resubmit"] = Field(
        "stop", description="if somebody else cancels an array task: `stop` the session, or `resubmit` the task"
    )
    attempts: PositiveInt = Field(
        3,
        description="number of attempts at a run (the last one alone), or at an array task that starts no run, before it fails",
    )


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
    max_untracked: Size = Field(
        50_000_000, description="maximum size of an untracked file, in bytes or as in `50 MB`; a larger file is an error"
    )
    max_ignored: SizeOrNone = Field(
        50_000_000,
        description="maximum total size of the project's programs that git ignores and a session's runs use, in bytes or as in "
        "`50 MB`; the store keeps these for replays, the smallest first; 0 keeps none",
    )


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


class Equivalence(Table):
    """A metric by which a replay compares nondeterministic runs, over all runs of an experiment."""

    table: str = Field(description="name of the output")
    column: str = Field(description="column of the output")
    measure: Literal["final", "mean", "time_to"] = Field(
        "final", description="how a run is reduced to one number, as in figures"
    )
    threshold: Finite | None = Field(None, description="for `time_to`, as in figures")
    margin: Positive | None = Field(
        None, description="maximum difference between means that are still equivalent, in the column's unit"
    )
    relative: Positive | None = Field(None, description="the margin as a fraction of the recorded mean (0.05: 5 %)")
    alpha: Annotated[float, Field(gt=0, lt=0.5)] = Field(
        0.05, description="significance level: maximum probability of finding means equivalent that differ by the margin"
    )

    @model_validator(mode="after")
    def _fitting(self) -> Equivalence:
        if (self.margin is None) == (self.relative is None):
            raise ValueError('give either "margin" or "relative"')
        if (self.measure == "time_to") != (self.threshold is not None):
            raise ValueError('measure "time_to" and "threshold" must be used together')
        return self


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


class BuildTable(Table):
    """The command that makes programs or libraries of the project from its source, before runs use them."""

    command: Annotated[Argv, Field(min_length=1)] = Field(
        description="the program and its arguments, as in `command`; {project} and {python} are filled in"
    )
    produces: Annotated[
        tuple[InProject, ...],
        BeforeValidator(lambda v: (v,) if isinstance(v, str) else v, json_schema_input_type=Words),
        Field(min_length=1),
    ] = Field(description="the products: paths or globs (`**`: any folders), relative to the project; git must ignore them")
    folder: InProject = Field(
        ".", alias="in", description="the folder in which the command is executed, relative to the project"
    )
    wall: Positive | None = Field(None, description="time limit of the command, in seconds; default: none")


class Ready(Table):
    """The sign that a service is ready: exactly one of `file`, `port`, `output` and `command`."""

    file: str | None = Field(
        None, min_length=1, description="a file or socket that appears; relative to {output}, the working directory"
    )
    port: Annotated[Text, Field(pattern=r"^(\{port\}|[1-9][0-9]{0,4})$")] | None = Field(
        None, description="a TCP port of this host that accepts connections: `{port}`, or a number"
    )
    output: Annotated[str, Field(min_length=1), AfterValidator(_pattern)] | None = Field(
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


class QueryTable(Table):
    """A named query, for `sierra run NAME`."""

    criteria: Annotated[
        tuple[str, ...],
        BeforeValidator(lambda v: tuple(v.split()) if isinstance(v, str) else v, json_schema_input_type=Words),
        Field(min_length=1),
    ] = Field(description="criteria, one for each axis, as on the command line; text is split at spaces")
    runs: PositiveInt | None = Field(None, description="runs per experiment; default: the project's `runs`")
    controller: str | None = Field(None, description="name of the controller; default: the project's `controller`")
    scenario: str | None = Field(None, description="name of the scenario; default: the project's `scenario`")


class Figure(Table):
    """One figure. If there are none, each numeric column of each output gets a time series and a summary."""

    kind: Literal["timeseries", "summary", "box", "violin", "heatmap", "stacked"] = Field(
        "timeseries",
        description="`timeseries`: lines over time; `summary`, `box`, `violin`: points, boxes or violins over the first "
        "variable; `heatmap`: a map of two variables; `stacked`: areas",
    )
    table: str = Field("", description="name of the output; may be omitted if there is only one")
    columns: Annotated[
        tuple[str, ...], BeforeValidator(lambda v: (v,) if isinstance(v, str) else v, json_schema_input_type=Words)
    ] = Field((), alias="column", description="column (for `stacked`: columns)")
    times: Literal["own", "carry", "linear"] | None = Field(
        None,
        description="times of values drawn over time: `own`: each run's own times; `carry`, `linear`: common times, with the "
        "last values carried forward or linear interpolation; default: `own`, or `carry` if most times differ between runs",
    )
    measure: Literal["final", "mean", "time_to"] = Field(
        "final",
        description="how a run is reduced to one number: its last value, its mean over time, or the time until `threshold`",
    )
    threshold: Finite | None = Field(
        None, description="for `time_to`: the value that must be reached or exceeded, in the column's unit"
    )
    center: Literal["mean", "median", "iqm"] = Field(
        "mean", description="mean with its 95 % interval, median with quartiles, or interquartile mean with its 95 % interval"
    )
    title: str = Field("", description="title above the figure")
    xlabel: str = Field("", description="label of the x axis; default: name and unit of the time or the variable")
    ylabel: str = Field("", description="label of the values; default: the column's name and unit")
    log_x: bool = Field(False, description="logarithmic x axis; variables with the values 1, 2, 4, … always have one")
    log_y: bool = Field(False, description="logarithmic scale of the values (in a heatmap: of the colours)")

    @model_validator(mode="after")
    def _fitting(self) -> Figure:
        if self.measure == "time_to" and self.threshold is None:
            raise ValueError('measure "time_to" needs a "threshold"')
        if self.measure != "time_to" and self.threshold is not None:
            raise ValueError('"threshold" needs measure = "time_to"')
        if self.kind == "timeseries" and self.measure != "final":
            raise ValueError(f'measure {self.measure!r} needs another kind, such as kind = "summary"')
        if self.times and self.kind not in ("timeseries", "stacked"):
            raise ValueError(f'"times" needs kind "timeseries" or "stacked", not {self.kind!r}')
        return self


class Project(Table):
    """`sierra.toml`."""

    template: Annotated[str, Field(min_length=1)] | None = Field(
        None, description="the file from which the inputs of all runs are generated; default: none"
    )
    templates: Annotated[Mapping[Name, InProject], BeforeValidator(_not_options)] = Field(
        default_factory=dict,
        description="several files instead of one `template`, by name: changes select in `NAME:/…`, and {input.NAME} in the "
        "command is the path of the file",
    )
    files: Annotated[
        tuple[InProject, ...],
        BeforeValidator(lambda v: (v,) if isinstance(v, str) else v, json_schema_input_type=Words),
    ] = Field(
        (),
        description="files, folders or globs of the project that lie beside the inputs of each run, with the same paths as in "
        "the project; part of the identity of runs",
    )
    template_format: str | None = Field(
        None,
        description="format of the template: `xml`, `json`, `yaml`, `toml`, `ini`, `properties`, `text` or a plug-in; "
        "default: by the ending of the file",
    )
    command: Annotated[tuple[str, ...], BeforeValidator(_as_words, json_schema_input_type=Words)] = Field(
        (),
        description="the program and its arguments; {input}, {output}, {seed}, {project}, {python} and the query's "
        "variables are filled in",
    )
    before: Commands = Field(
        (),
        description="commands that are executed before the command in each run, one after the other; "
        "one line, or a list of lists of words",
    )
    after: Commands = Field(
        (), description="commands that are executed in each run after the command has succeeded; written like `before`"
    )
    services: Mapping[Name, ServiceTable] = Field(
        default_factory=dict, description="programs that run in the background of each run, by name; started in this order"
    )
    requires: tuple[Annotated[str, Field(pattern=r"^[A-Za-z0-9]")], ...] = Field(
        (), description="Python packages that `{python}` needs, as for pip; checked before anything executes"
    )
    platform: str = Field(
        "command",
        description="platform, which drives the simulator: `command`, `argos`, `sumo`, `mujoco`, `jsbsim`, or a plug-in",
    )
    runner: str = Field(
        "local", description="where runs execute unless `--on` says otherwise: `local`, or a cluster of `runners`"
    )
    target: Name | None = Field(
        None, description="target of queries that name none; default: the keys outside `targets`, as they are"
    )
    targets: Annotated[Mapping[Name, RawTable], AfterValidator(_only_own)] = Field(
        default_factory=dict,
        description="targets, by name: other values of the keys that say how runs execute, for one platform; "
        "a table such as `limits` is merged key by key",
    )
    runs: PositiveInt = Field(10, description="runs per experiment")
    controller: str | None = Field(None, description="default controller, if none is requested")
    scenario: str | None = Field(None, description="default scenario, if none is requested")
    seed: Annotated[Seed, BeforeValidator(_set_to, json_schema_input_type=str | Seed)] = Seed()
    variables: Mapping[Name, Annotated[Variable, BeforeValidator(_set_to, json_schema_input_type=str | Variable)]] = Field(
        default_factory=dict, description="independent variables that queries vary, by name"
    )
    changes: tuple[ChangeTable, ...] = Field((), description="changes for every run of every batch")
    per_run: Mapping[Name, Annotated[tuple[Scalar, ...], Field(min_length=1)]] = Field(
        default_factory=dict, description="lists of values, by name: `{name}` in `run_changes` is item n for run number n"
    )
    run_changes: tuple[ChangeTable, ...] = Field(
        (), description="changes for each single run; may use {seed}, {run} and the lists of per_run"
    )
    controllers: Mapping[GroupName, Group] = Field(
        default_factory=dict,
        description="controllers for `controller` and --controller, by name; `{controller}` in changes is the name. The "
        'changes of `depth0` come before those of `"depth0.CRW"`',
    )
    scenarios: Mapping[GroupName, Group] = Field(
        default_factory=dict,
        description='scenarios for `scenario` and --scenario, by name; `"LowBlockCount.{x}x{y}"` stands for all names with '
        "numbers in these places, and `{x}` in its changes is such a number",
    )
    outputs: Annotated[Mapping[Name, Output], AfterValidator(_apart)] = Field(
        default_factory=dict,
        description="files that runs write, by the table's name; default: each .csv, .parquet and .jsonl of the output folder",
    )
    success: Success = Success()
    limits: LimitsTable = LimitsTable()
    environment: Environment = Environment()
    container: Container | None = Field(None, description="the image in which runs execute; default: no container")
    source: Source = Source()
    build: BuildTable | None = Field(None, description="the build of products from the source; default: nothing is built")
    store: StoreTable = StoreTable()
    determinism: Determinism = Determinism()
    equivalence: Mapping[Name, Equivalence] = Field(
        default_factory=dict, description="metrics that must be equivalent in a replay of nondeterministic runs, by name"
    )
    programs: ProgramsTable = ProgramsTable()
    observe: Literal["none", "first", "all"] = Field(
        "first",
        description="the runs of which SIERRA records all files that they execute, read, look for and write: `first` is the "
        "first run that executes, the first of each experiment, and a sample of the others. Needs strace (on a cluster on its "
        "nodes), else it sees only files that are mapped into memory; not in containers",
    )
    observe_budget: float = Field(
        0.02,
        ge=0,
        allow_inf_nan=False,
        description='the time that observing may take with observe = "first", as a part of the time that the runs take; '
        "0: only the first run that executes is observed",
    )
    queries: Mapping[Name, QueryTable] = Field(default_factory=dict, description="named queries")
    figures: Mapping[Name, Figure] = Field(default_factory=dict, description="figures, by name")
    platforms: Mapping[str, RawTable] = Field(default_factory=dict, description="options of platforms, by name")
    runners: Mapping[str, RawTable] = Field(
        default_factory=dict, description="clusters for `--on`, by name: `slurm`, `pbs`, or your own name with a `scheduler`"
    )
    template_formats: Mapping[str, RawTable] = Field(default_factory=dict, description="options of template formats, by name")
    engines: Mapping[str, RawTable] = Field(default_factory=dict, description="options of container engines, by name")
    readers: Mapping[str, RawTable] = Field(
        default_factory=dict, description="options of the readers of output formats, by name"
    )

    @property
    def template_paths(self) -> tuple[str, ...]:
        """Return the paths of all templates; `templates` has paths in the project only."""
        return (self.template,) if self.template is not None else tuple(self.templates.values())

    @model_validator(mode="after")
    def _templates(self) -> Project:
        if self.template is not None and self.templates:
            raise ValueError('"template" and "templates" exclude each other; give the file a name in "templates"')
        if self.template_format is not None and self.template is None:
            raise ValueError('"template_format" needs "template"; the endings of "templates" say their formats')
        paths = [os.path.normpath(path) for path in self.templates.values()]
        if twice := [name for name, path in zip(self.templates, paths, strict=True) if paths.count(path) > 1]:
            raise ValueError(f"templates: {twice[0]} and {twice[1]} are the same file; changes to it need one name")
        return self

    @model_validator(mode="after")
    def _useful(self) -> Project:
        for name, variable in self.variables.items():
            if variable.argument and name in OWN_PLACEHOLDERS:
                raise ValueError(f"variables.{name}: in a command, {{{name}}} has another meaning; use another name")
            if not (self.targets or self.target) and not self.changes_with(name):
                raise ValueError(f"variables.{name}: {NO_CHANGE}, or write {{{name}}} in the command")
        return self

    @model_validator(mode="after")
    def _one_value_each(self) -> Project:
        given = [("seed", self.seed.environment), *((name, one.environment) for name, one in self.variables.items())]
        setters = dict.fromkeys((*self.environment.set, *self.environment.pass_), "[environment]")
        for name, variable in given:
            if variable is not None and (other := setters.setdefault(variable, name)) != name:
                raise ValueError(f"{other} and {name} both set the environment variable {variable}; use one of them")
        return self

    def for_target(self, name: str) -> Project:
        """Return the project with one target merged over its other keys, and without targets. Raises UsageError."""
        if name not in self.targets:
            raise UsageError(self._unknown(name))
        return options(Project, targets.merged(self._written(), name), f"target {name!r}")

    def changes_with(self, name: str) -> bool:
        """Return True if the values of a variable change something in runs."""
        return self.variables[name].is_given or self._uses(name)

    def _written(self) -> RawTable:
        return self.model_dump(exclude_unset=True, by_alias=True)

    def _unknown(self, name: str) -> str:
        known = f"known are {', '.join(self.targets)}" if self.targets else "sierra.toml declares no [targets.NAME]"
        return f"unknown target {name!r}; {known}"

    def _uses(self, name: str) -> bool:
        """Return True if a command uses a variable, or if a change does that does not belong to a variable."""
        services = (word for one in self.services.values() for word in (*one.command, *one.ready.words))
        words = (*self.command, *(word for command in (*self.before, *self.after) for word in command), *services)
        if name not in OWN_PLACEHOLDERS and any(f"{{{name}}}" in word for word in words):
            return True
        groups = (*self.controllers.values(), *self.scenarios.values())
        tables = (*self.changes, *self.run_changes, *(change for group in groups for change in group.changes))
        texts = (text or "" for table in tables for text in (table.value, table.xml, table.json_, table.to))
        return any(re.search(rf"\{{[^}}]*\b{name}\b", text) for text in texts)

    @model_validator(mode="after")
    def _readable_names(self) -> Project:
        taken = {*self.variables, *self.per_run}
        for name in (*self.controllers, *self.scenarios):
            if wrong := group_names.complaint(name):
                raise ValueError(wrong)
            if both := next((one for one in group_names.parameters(name) if one in taken), None):
                raise ValueError(f"{name!r}: {{{both}}} is also a variable; use another name for one of them")
        return self


@dataclass(frozen=True, slots=True)
class LoadedProject:
    """A project: its root (absolute), its file, and its configuration."""

    root: Path
    file: Path
    config: Project
    """The configuration: that of the default target, or of the one that was chosen."""
    written: bool = True
    """True if the file exists. A store without a file can be read too."""
    declared: Project | None = None
    """The content of the file, with all targets; None if it has no targets."""

    @property
    def targets(self) -> tuple[str, ...]:
        """Return the names of the targets."""
        return tuple(self.declared.targets) if self.declared else ()

    def for_target(self, name: str | None) -> LoadedProject:
        """Return the project for another target; with None, the project itself. Raises UsageError for an unknown name."""
        if name is None or name == self.config.target:
            return self
        return replace(self, config=(self.declared or self.config).for_target(name))

    def check_written(self) -> None:
        """Raise Missing if there is no `sierra.toml`, so that nothing can be executed."""
        if not self.written:
            raise Missing(f"no {CONFIG} in {self.root}, only a store, which can be read; create one with: sierra init")


def load(folder: Path) -> LoadedProject:
    """Return the project that contains `folder`. Raises ConfigError if its file is invalid, Missing if there is none."""
    return read(find(folder))


def read(found: ProjectFolder) -> LoadedProject:
    """Return a project with its configuration; a store alone is a project without declarations. Raises ConfigError."""
    root, file, written = found
    if not written:
        return LoadedProject(root, file, Project(), written=False)
    origin = f"{file} [tool.sierra]" if file.name == PYPROJECT else str(file)
    whole = parse(settings(file) or {}, origin)
    if not whole.targets:
        return LoadedProject(root, file, whole)
    return LoadedProject(root, file, whole.for_target(whole.target) if whole.target else whole, declared=whole)


def parse(table: object, origin: str) -> Project:
    """Validate a table from TOML; messages call it `origin`.

    The tables of plug-ins are validated when they are used (see `sierra.config.plugin_registry`),
    those of shipped schedulers here too.
    """
    project = options(Project, table, origin)
    _check_clusters(project, origin)
    _check_names_of_targets(project, origin)
    each = {name: _resolved(project, name, origin) for name in project.targets}
    for name in project.variables if each else ():
        if not any(one.changes_with(name) for one in (project, *each.values())):
            raise ConfigError(f"{origin}: variables.{name}: {NO_CHANGE}, here or in [variables.{name}.targets.{min(each)}]")
    return project


def _check_names_of_targets(project: Project, origin: str) -> None:
    """Raise ConfigError if a key names a target that is not declared."""
    given = [("target", (project.target,))] if project.target else []
    for place, names in (*given, *((f"{place}.targets", names) for place, names in targets.named(project._written()))):
        if unknown := [name for name in names if name not in project.targets]:
            raise ConfigError(f"{origin}: {place}: {project._unknown(unknown[0])}")


def _resolved(project: Project, name: str, origin: str) -> Project:
    """Return a target of a project after checking its keys. Raises ConfigError."""
    within = ("targets", name)
    found = options(Project, targets.merged(project._written(), name), origin, within)
    _check_clusters(found, origin, within)
    return found


def _check_clusters(project: Project, origin: str, within: tuple[str, ...] = ()) -> None:
    """Check the tables of clusters of shipped schedulers. Raises ConfigError."""
    for name, runner in project.runners.items():
        scheduler = runner.get("scheduler", name)
        if isinstance(scheduler, str) and scheduler in directives.CHECKED:
            cluster = options(ClusterTable, runner, origin, (*within, "runners", name))
            where = ".".join((*within, "runners"))
            check_directives(cluster, partial(directives.complaint, scheduler), f"{origin}: {where}", name)


def check_directives(table: ClusterTable, complaint: Callable[[str], str | None], where: str, name: str) -> None:
    """Raise ConfigError if a line of a cluster contradicts lines that SIERRA writes itself; `complaint` returns the reason."""
    for line in table.directives:
        if why := complaint(line):
            raise ConfigError(f"{where}: directive {line!r} of {name!r} cannot be added: {why}")


def options(model: type[OptionsT], table: object, origin: str, within: tuple[str, ...] = ()) -> OptionsT:
    """Validate a table strictly: a text is not a number. Messages name `origin`, and `within` in it. Raises ConfigError."""
    try:
        return model.model_validate(_frozen(table, origin), strict=True)
    except ValidationError as error:
        raise ConfigError(f"{origin}: {_explain(error, model, within)}") from error


def _frozen(value: object, origin: str) -> object:
    """Return lists as tuples. Raises ConfigError for a text with NUL, which no file or argument can contain."""
    match value:
        case str() if "\0" in value:
            raise ConfigError(f"{origin}: {value[:40]!r} contains the character NUL; remove it")
        case dict():
            return {_frozen(name, origin): _frozen(inner, origin) for name, inner in value.items()}
        case list() | tuple():
            return tuple(_frozen(inner, origin) for inner in value)
        case _:
            return value


def _explain(error: ValidationError, model: type[BaseModel], within: tuple[str, ...] = ()) -> str:
    """Return the first error in one line; for an unknown key, with the most similar valid key."""
    complaint = error.errors()[0]
    where = ".".join(str(part) for part in (*within, *complaint["loc"]))
    if complaint["type"] == "extra_forbidden":
        return f"unknown key {where!r}{_dotted(complaint['loc'], complaint['input']) or _nearest(model, complaint['loc'])}"
    if complaint["type"] == "missing":
        return f"{where!r} is missing"
    if complaint["type"] == "value_error":
        return f"{where or 'table'}: {complaint['ctx']['error']}"
    if complaint["loc"][-1:] == ("[key]",):
        table = ".".join(map(str, complaint["loc"][:-2]))
        if complaint.get("ctx", {}).get("pattern") == group_names.GROUP_NAME:
            return f"{table}: {complaint['input']!r} is not a valid name; use letters, digits, _, and . or - between them"
        return f"{table}: {_no_name(complaint['input'])}"
    if complaint.get("ctx", {}).get("pattern") == NAME:
        return f"{where}: {_no_name(complaint['input'])}"
    message = KINDS.get(complaint["type"]) or complaint["msg"].replace("Input", "it").replace("it should", "should", 1)
    return f"{where or 'table'} {message}, not {_written(complaint['input'])}"


def _dotted(location: tuple[int | str, ...], value: object) -> str:
    """Return a hint for a name of a controller or scenario that has dots but no quotes: in TOML, a table in a table."""
    if location[0] not in ("controllers", "scenarios") or len(location) != 3 or not isinstance(value, Mapping):
        return ""
    return f'; write a name with dots in quotes: {location[0]}."{location[1]}.{location[2]}"'


def _no_name(value: object) -> str:
    """Return a message for an invalid name, with a proposal."""
    letters = re.sub(r"[^A-Za-z0-9]+", "_", str(value)).strip("_").lstrip("0123456789_")
    return f"{value!r} is not a valid name; use letters, digits and _, as in {letters or 'my_name'}"


def _written(value: object) -> str:
    """Return a value nearly in the form of TOML, shortened."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _nearest(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    """Return a hint with the known keys of the table that contains `location`, or the most similar one."""
    known = sorted(_keys(model, location[:-1]))
    if issubclass(model, ClusterTable) and location[-1] in SETTINGS:
        return f"; use {SETTINGS[location[-1]]!r} instead"
    close = difflib.get_close_matches(str(location[-1]), known, 1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known are {', '.join(known)}" if known else ""


def _keys(model: type[BaseModel], location: tuple[int | str, ...]) -> set[str]:
    for part in location:
        inner = next((f.annotation for n, f in model.model_fields.items() if part in (n, f.alias)), None)
        model = next((other for other in _tables() if re.search(rf"\b{other.__name__}\b", str(inner))), model)
    return {field.alias or name for name, field in model.model_fields.items()}


def _tables() -> Iterator[type[BaseModel]]:
    """Yield the models of tables."""
    pending = Table.__subclasses__()
    while pending:
        pending += (model := pending.pop(0)).__subclasses__()
        yield model
