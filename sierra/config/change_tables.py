"""Tables of `sierra.toml` that change inputs, command or environment of runs: variables, seed, controllers, scenarios."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Annotated, Self

from pydantic import AfterValidator, BeforeValidator, Field, PositiveInt, StringConstraints, model_validator

from sierra.config.field_types import NAME, Argv, Finite, Label, Labels, Name, NotNegative, RawTable, Table, Text
from sierra.util.random_poses import PlanePose, RandomPoses

ListedPose = Annotated[tuple[Finite, ...], Field(min_length=2, max_length=3)]
Span = Annotated[tuple[Finite, Finite], Field()]
VALUE = "{value}"
"""The text that stands for the value in the `argument` of a variable or of the seed."""
OWN_PLACEHOLDERS = ("input", "output", "run", "seed", "project", "python", "arch", "arguments")
"""Names in braces that have a meaning of their own in a command."""
PORT_NAMES = ("port", *(f"port{number}" for number in range(2, 17)))
"""Names in braces that stand for free ports of a run, unless a variable or a list of `per_run` has the name."""
CHECKPOINT = "checkpoint"
"""The name in braces that stands for the folder of a run's checkpoint, with the same exception."""
WORKER_NAMES = (*PORT_NAMES, CHECKPOINT)
"""Names in braces that the worker fills in where it executes the run."""
NO_CHANGE = 'it changes nothing; give it "set", "repeat", "changes", "argument" or "environment"'
NOT_VARIED = ("HOME", "TMPDIR", "PATH", "LD_LIBRARY_PATH", "LD_PRELOAD", "PYTHONPATH", "PYTHONHOME")
"""Environment variables that no variable of a query can set: the programs that runs use depend on them, or SIERRA sets them."""
FARTHEST = 1e100
"""The largest number for random poses; the square of a larger one may be no number."""
OF_TARGETS = "for single targets, by name: other changes than the ones here"


def set_to(value: object) -> object:
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
Changes = Annotated[
    tuple[ChangeTable, ...], Field(description="changes to the template; `{name}` is the value of a variable of this name")
]
EnvironmentName = Annotated[str, StringConstraints(pattern=NAME), AfterValidator(_not_fixed)]


class PlaceOfSeed(Table):
    """Where the seed goes for a target. The short form is the XPath alone."""

    set: str | None = Field(None, description="XPath of the attributes or elements that get the value itself, or the seed")
    argument: Argument = Field(
        (), description="words of the command with the value or the seed, as in `--robots {value}`; a value is never split"
    )
    environment: EnvironmentName | None = Field(
        None, description="name of the environment variable of runs that gets the value or the seed"
    )


class RandomPosesTable(Table):
    """Poses that are drawn from the seed of each run, uniformly in a rectangle."""

    x: Span = Field((-1.0, 1.0), description="smallest and largest x, in m")
    y: Span = Field((-1.0, 1.0), description="smallest and largest y, in m")
    yaw: Span = Field((-3.1416, 3.1416), description="smallest and largest angle in radians")
    distance: NotNegative = Field(0.0, description="smallest distance between the centres of two robots, in m")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("x", "y", "yaw"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"the limits of {name} are in the wrong order; use [{high:g}, {low:g}]")
            if max(-low, high, self.distance) > FARTHEST:
                raise ValueError(f"numbers for {name} and distance must be at most {FARTHEST:g}")
        return self


class StartPoses(Table):
    """The poses of robots that are copies of one part of the template."""

    poses: tuple[ListedPose, ...] = Field(
        (),
        description="poses [x, y] or [x, y, yaw] of the copies: `{x}`, `{y}` and `{yaw}` in texts that are repeated; in ROS, "
        "$(arg x), $(arg y) and $(arg yaw)",
    )
    random_poses: RandomPosesTable | None = Field(
        None,
        description="poses that are drawn from the seed of each run",
        examples=[{"x": [-2, 2], "y": [-2, 2], "distance": 0.3}],
    )

    @property
    def start(self) -> tuple[PlanePose, ...] | RandomPoses:
        """The poses of copies, in order."""
        if (drawn := self.random_poses) is not None:
            return RandomPoses(drawn.x, drawn.y, drawn.yaw, drawn.distance)
        return tuple((pose[0], pose[1], pose[2] if len(pose) == 3 else 0.0) for pose in self.poses)

    @model_validator(mode="after")
    def _declared_once(self) -> Self:
        if self.poses and self.random_poses:
            raise ValueError("poses and random_poses exclude each other")
        return self


class ValueOfVariable(PlaceOfSeed, StartPoses):
    """The changes that a value of a variable makes for one target. The short form is the XPath alone."""

    repeat: str | None = Field(
        None,
        description="XPath of the element or item that is repeated as often as the value says, in the place of those after it "
        "with its name, or of all items of its list; `{index}` in its texts is the number of the copy, from 0, and "
        "`{x}`, `{y}`, `{yaw}` are its pose",
    )
    changes: Changes = ()

    @property
    def is_given(self) -> bool:
        """Return True if the variable itself says what its values change."""
        return bool(self.set or self.repeat or self.changes or self.argument or self.environment)

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

    label: Label = ""
    labels: Labels = Field(default_factory=dict)
    unit: str = Field("", description="unit in figures")
    targets: Mapping[
        Name, Annotated[ValueOfVariable, BeforeValidator(set_to, json_schema_input_type=str | ValueOfVariable)]
    ] = Field(default_factory=dict, description=OF_TARGETS)


class Seed(PlaceOfSeed):
    """Where the seed goes, and how seeds are derived. The short form is the XPath alone."""

    base: int = Field(0, ge=0, description="base seed: the number that all seeds derive from")
    independent: bool = Field(
        False,
        description="different seeds in each experiment; by default, all experiments use the same seeds: common random numbers",
    )
    max: int = Field(
        2**31 - 1,
        ge=1,
        le=2**31 - 1,
        description="the largest seed, for a program that takes no larger one; another value gives all runs other seeds",
    )
    targets: Mapping[Name, Annotated[PlaceOfSeed, BeforeValidator(set_to, json_schema_input_type=str | PlaceOfSeed)]] = Field(
        default_factory=dict, description=OF_TARGETS
    )


class ChangesOfGroup(Table):
    """The changes of a controller or a scenario for a target."""

    changes: Changes = ()
    platform: RawTable = Field(
        default_factory=dict, description="options of the platform, merged over `[platforms.NAME]`; see `sierra schema`"
    )


class Group(ChangesOfGroup):
    """A controller or a scenario: a named group of changes."""

    label: Label = ""
    targets: Mapping[Name, ChangesOfGroup] = Field(default_factory=dict, description=OF_TARGETS)
