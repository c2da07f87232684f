"""Types of the keys of `sierra.toml`, with their checks, and the base class of its tables."""

from __future__ import annotations

import re
import shlex
import unicodedata
from collections.abc import Callable, Iterable, Mapping
from pathlib import PurePosixPath
from typing import Annotated, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveInt,
    StringConstraints,
    WithJsonSchema,
    model_validator,
)

from sierra.config import group_names, targets
from sierra.model import Measure
from sierra.store.layout import STORE
from sierra.util.quoted_values import words

NAME = r"^[A-Za-z_][A-Za-z0-9_]*$"
Name = Annotated[str, StringConstraints(pattern=NAME)]
"""A name that is also a column in SQL."""
_SIGNS = r"\x00-\x2f\x3a-\x40\x5b-\x5e\x60\x7b-\x7f"
"""All characters of ASCII but letters, digits and `_`; editors' regular expressions have no other class of letters."""


def _name_of_table(name: str) -> str:
    """Return a name in the normal form of its letters. Raises ValueError if it has other characters than letters and digits."""
    name = unicodedata.normalize("NFC", name)
    if odd := [c for c in name if c != "_" and unicodedata.category(c)[0] not in "LMN"]:
        raise ValueError(f"names of tables have letters, digits and _, not {odd[0]!r}")
    return name


OutputName = Annotated[str, StringConstraints(pattern=rf"^[^0-9{_SIGNS}][^{_SIGNS}]*$"), AfterValidator(_name_of_table)]
"""A name of a table, with letters and digits of any script."""
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
Label = Annotated[str, Field(description="name in figures; default: the table's own name")]
OF_WALL = Field(description="limit of the wall-clock time, in seconds")
Grace = Annotated[Positive, Field(description="time between SIGTERM and SIGKILL, in seconds")]
OF_PYTHON = Field(description="the command for Python 3.8 or newer where runs execute")
OF_RUNS = Field(description="runs per experiment")
OfController = Annotated[str | None, Field(description="name of the controller, unless another one is requested")]
OfScenario = Annotated[str | None, Field(description="name of the scenario, unless another one is requested")]
OF_TARGET = Field(description="name of the target; default: `target` at the top level, or else no target")
Labels = Annotated[Mapping[str, str], Field(description="names of groups and other values in figures, by the value")]
OfTable = Annotated[str, Field(description="name of the output or derived table; default: the only one with the columns")]
OfColumn = Annotated[str, Field(description="column; default: the only one")]
OF_RUN = Field(
    description="how a run is reduced to one number: its last value, the mean of its rows, its mean over time (`time_mean`), "
    "or the time until `threshold`; default: `final`, or `mean` in a table of events"
)
Threshold = Annotated[Finite | None, Field(description="for `time_to`: the value that must be reached or exceeded")]
Where = Annotated[str, Field(description="rows that count, as an SQL condition on columns and variables; default: all rows")]
Experiments = Annotated[
    str, Field(description="experiments that count, as in `sierra run --only`: `noise=0 and size<=4`; default: all")
]
Alpha = Annotated[float, Field(gt=0, lt=0.5, description="significance level: accepted probability of a false finding")]
T = TypeVar("T")


def check_distinct(names: Iterable[str], table: str = "") -> None:
    """Raise ValueError if two names differ only in upper and lower case: SQL and some file systems take them for the same."""
    first: dict[str, str] = {}
    for name in names:
        if (other := first.setdefault(name.lower(), name)) != name:
            places = " and ".join(f"{table and table + '.'}{one}" for one in (other, name))
            raise ValueError(f"{places}: these names differ only in upper and lower case, which SQL ignores; rename one")


def distinct(tables: Mapping[str, T]) -> Mapping[str, T]:
    """Check that no two tables have names that differ only in upper and lower case."""
    check_distinct(tables)
    return tables


def as_words(value: object) -> object:
    """Split a command that is written as one line. The rules are those of a shell, but no shell executes it."""
    return tuple(shlex.split(value)) if isinstance(value, str) else value


def _as_commands(value: object) -> object:
    """Return a list of commands from one that is written as one line."""
    return (as_words(value),) if isinstance(value, str) else value


def valid_path(is_valid: Callable[[str], bool], expected: str) -> AfterValidator:
    """Return a validator that refuses a path with a message that says what was expected."""

    def check(path: str) -> str:
        if not is_valid(path):
            raise ValueError(f"{path!r} should be {expected}")
        return path

    return AfterValidator(check)


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


def regular_expression(text: str) -> str:
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
Argv = Annotated[tuple[str, ...], BeforeValidator(as_words, json_schema_input_type=Words)]
Inside = Annotated[
    str,
    valid_path(
        lambda path: not path.startswith("/") and ".." not in PurePosixPath(path).parts,
        "a path within the run's output folder, such as results.csv",
    ),
]
InProject = Annotated[
    str,
    valid_path(
        lambda path: (
            bool(path)
            and not path.startswith("/")
            and ".." not in PurePosixPath(path).parts
            and not {".git", STORE} & set(PurePosixPath(path).parts)
        ),
        "a path within the project, such as build/sim",
    ),
]
OfStatement = Annotated[InProject | None, Field(description="file of the project with the statement; it is no source of runs")]
Command = Annotated[tuple[str, ...], BeforeValidator(as_words, json_schema_input_type=Words), Field(min_length=1)]
OwnCommand = Annotated[Argv, Field(description="the program and its arguments; default: as outside this table")]
ONE_OR_MORE = BeforeValidator(lambda v: (v,) if isinstance(v, str) else v, json_schema_input_type=Words)
"""Reads a text as a list of it alone."""
ListOfWords = Annotated[tuple[str, ...], ONE_OR_MORE]
Criteria = Annotated[
    tuple[str, ...],
    BeforeValidator(lambda v: words(v) if isinstance(v, str) else v, json_schema_input_type=Words),
]
"""Criteria as words, or as text that is split at blanks outside of quotes."""
Commands = Annotated[
    tuple[Annotated[tuple[str, ...], Field(min_length=1)], ...],
    BeforeValidator(_as_commands, json_schema_input_type=str | tuple[tuple[str, ...], ...]),
]
Absolute = Annotated[
    str,
    valid_path(lambda path: path.startswith(("/", "~", "$")), "an absolute path, such as /scratch/me, ~/scratch or $SCRATCH"),
]


class Table(BaseModel):
    """A table of `sierra.toml`: unknown keys are errors, and it is immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


def check_threshold(measure: Measure | None, threshold: float | None) -> None:
    """Raise ValueError if one of both is given that needs the other."""
    if (measure == "time_to") != (threshold is not None):
        raise ValueError('measure "time_to" and "threshold" must be used together')


class Reduced(Table):
    """The values of runs: one column, and how each run is reduced to one number."""

    table: OfTable = ""
    column: OfColumn = ""
    measure: Annotated[Measure | None, OF_RUN] = None
    threshold: Threshold = None

    @model_validator(mode="after")
    def _reduced(self) -> Self:
        check_threshold(self.measure, self.threshold)
        return self


class Measured(Reduced):
    """The values of the runs that count."""

    where: Where = ""
    experiments: Experiments = ""


class OfQuery(Table):
    """The keys of a query beside its criteria; those that are not given are as for all queries."""

    runs: Annotated[PositiveInt | None, OF_RUNS] = None
    controller: OfController = None
    scenario: OfScenario = None
    target: Annotated[str | None, OF_TARGET] = None
