"""The table `[trials]` of `sierra.toml`: runs that a person prepares, watches and judges, one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, PositiveInt, model_validator

from sierra.config.change_tables import ListedPose, Span
from sierra.config.field_types import Command, InProject, Line, Name, NotNegative, Table, distinct


class DrawnPoses(Table):
    """Start poses that are drawn from the run's seed: uniformly distributed positions and headings."""

    count: PositiveInt | Name = Field(description="number of robots, or the name of a variable of the query")
    x: Span = Field(description="smallest and largest x, in m")
    y: Span = Field(description="smallest and largest y, in m")
    apart: NotNegative = Field(0.0, description="smallest distance between two robots, in m")

    @model_validator(mode="after")
    def _ordered(self) -> DrawnPoses:
        for name in ("x", "y"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name}: the smallest value comes first: [{high:g}, {low:g}]")
        return self


class Trials(Table):
    """Supervised trials: each run is executed when a person says so, and counts only if this person says that it is valid."""

    supervised: bool = Field(False, description="whether a person prepares, watches and judges each run")
    order: Literal["blocked", "random", "as-designed"] = Field(
        "blocked",
        description="order of runs: `blocked` shuffles within blocks that have the same number of runs of each experiment, "
        "`random` shuffles all, `as-designed` takes experiment after experiment",
    )
    block: PositiveInt = Field(1, description='runs of each experiment in a block, with order = "blocked"')
    reasons: Annotated[tuple[Line, ...], Field(min_length=1)] = Field(
        ("wrong start", "hardware failure", "disturbed from outside"),
        description="reasons why a trial is not valid, to choose from; another one can be typed",
    )
    pause: NotNegative = Field(0.0, description="least time from the end of a trial to the start of the next, in seconds")
    countdown: NotNegative = Field(3.0, description="time from the operator's go to the start of a trial, in seconds")
    stop: Literal["fails", "ends"] = Field(
        "fails",
        description="what it means that the operator stops a trial: it has failed, or it ends as planned, and its exit status "
        "decides",
    )
    arena: Line | None = Field(None, description="name or version of the arena; recorded")
    poses: tuple[ListedPose, ...] = Field((), description="start poses, one per robot: x, y in m, and a heading in degrees")
    draw_poses: DrawnPoses | None = Field(
        None, description="start poses that are drawn from each run's seed; with platform `ros`, declare start poses there"
    )
    files: tuple[InProject, ...] = Field(
        (), description="files whose SHA-256 is recorded before each trial, for example a calibration"
    )
    commands: Annotated[Mapping[Name, Command], AfterValidator(distinct)] = Field(
        default_factory=dict,
        description="commands that this machine executes before each trial; what they print is recorded, for example the "
        "version of a firmware",
    )

    @model_validator(mode="after")
    def _one_kind_of_poses(self) -> Trials:
        if self.poses and self.draw_poses:
            raise ValueError('"poses" and "draw_poses" exclude each other')
        return self


TABLE: tuple[object, object] = (Trials, Trials.model_construct())
"""The key `trials` of `sierra.toml`."""
