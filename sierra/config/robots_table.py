"""The table `[robots]` of `sierra.toml`: how many robots a run takes, and what each of them executes.

A robot has a place in its run: 1, 2, … up to the number of robots; a base station has the place 0. Which robot of the fleet
takes a place is decided when the run is executed (`[runners.robots]`), and is no part of the run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, Field, PositiveInt, WithJsonSchema, model_validator

from sierra.config.change_tables import Changes
from sierra.config.field_types import NAME, Name, OwnCommand, Table, distinct

ROBOT, BASE = "robot", "base"
"""The groups of places that belong to no declared group, and of the base station."""


def _count(value: object) -> object:
    """Return a number of robots, or the name of a variable. Raises ValueError for anything else."""
    is_number = isinstance(value, int) and not isinstance(value, bool) and value > 0
    if not (is_number or (isinstance(value, str) and re.fullmatch(NAME, value))):
        raise ValueError(f"{value!r} should be a whole number from 1, or the name of a variable")
    return value


Count = Annotated[
    int | str,
    BeforeValidator(_count),
    WithJsonSchema({"anyOf": [{"type": "integer", "exclusiveMinimum": 0}, {"type": "string", "pattern": NAME}]}),
]


class BaseStation(Table):
    """A base station, which takes part in each run on robots; its place is 0."""

    command: OwnCommand = ()


class GroupOfPlaces(Table):
    """Places of robots that execute another command, or get other inputs. Their changes are made after `run_changes`."""

    places: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = Field(
        description="the places of its robots, from 1; a place that a run does not have is left out"
    )
    command: OwnCommand = ()
    changes: Changes = ()

    @model_validator(mode="after")
    def _complete(self) -> GroupOfPlaces:
        if any(change.set and change.value is None for change in self.changes):
            raise ValueError('a "set" in "changes" needs a "value"')
        return self


class RobotsTable(Table):
    """Runs on robots: each run takes several, each of which executes the command with inputs of its own.

    `{robot}` in commands and in changes of single runs is the robot's place in the run: 1, 2, …; 0 is the base station.
    """

    count: Count = Field(
        description="how many robots a run takes: a number, or the name of a variable of the query, such as `population_size`"
    )
    command: OwnCommand = ()
    base: BaseStation | None = Field(None, description="a base station that takes part in each run; default: none")
    groups: Annotated[Mapping[Name, GroupOfPlaces], AfterValidator(distinct)] = Field(
        default_factory=dict, description="places with other commands or inputs, by the group's name"
    )

    @model_validator(mode="after")
    def _one_group_each(self) -> RobotsTable:
        seen: dict[int, str] = {}
        for name, group in self.groups.items():
            if name in (ROBOT, BASE):
                raise ValueError(f"groups.{name}: this name is taken; use another one")
            for place in group.places:
                if seen.setdefault(place, name) != name:
                    raise ValueError(f"groups: place {place} is in {seen[place]} and in {name}; it can be in one group")
        return self

    @property
    def words(self) -> Iterator[str]:
        """Yield the words of all commands."""
        return chain.from_iterable((self.command, *self.commands.values()))

    def group(self, place: int) -> str:
        """Return the name of the group of a robot's place."""
        return next((name for name, group in self.groups.items() if place in group.places), ROBOT)

    @property
    def commands(self) -> Mapping[str, tuple[str, ...]]:
        """Return the commands that are not that of all robots, by group."""
        base = {BASE: self.base.command} if self.base and self.base.command else {}
        return base | {name: group.command for name, group in self.groups.items() if group.command}
