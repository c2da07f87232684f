"""The table `[capture]` of `sierra.toml`: how the simulator of a recorded run renders frames, for `sierra video --capture`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from sierra.config.change_tables import ChangeTable
from sierra.config.execution_tables import OwnLimits
from sierra.config.field_types import Argv, Positive, Text, VariableName

Pixels = Annotated[int, Field(ge=16, le=8192)]
"""The length of a side of a frame, in pixels."""


class Capture(OwnLimits):
    """Rendering of recorded runs, which are executed once more for it. Measured runs and their identity do not change.

    Limits take the place of those in `[limits]`.
    """

    files: str = Field(
        "",
        description="names of the frames, relative to the output folder: `frames/{tick}.png` with a number in each name, or a "
        "glob; default: those of the platform",
        examples=["frames/{tick}.png"],
    )
    ticks_per_second: Positive | None = Field(
        None, description="number of ticks, as the names of frames have them, in a simulated second; default: the platform's"
    )
    arguments: Argv = Field((), description="words that are added to the command, such as `--frames {output}/frames`")
    command: Argv = Field((), description="the command that takes the place of the recorded one; default: the recorded one")
    changes: tuple[ChangeTable, ...] = Field(
        (), description="changes to the input of each run, such as one that turns rendering on; values are plain texts"
    )
    environment: Mapping[VariableName, Text] = Field(default_factory=dict, description="further variables")
    display: bool = Field(
        False, description="whether each run gets an X display of its own (Xvfb) in DISPLAY; needs Xvfb where runs execute"
    )
    camera: str = Field(
        "", description="name of the camera, for platforms that render (`sierra schema` has their cameras); default: theirs"
    )
    size: tuple[Pixels, Pixels] = Field((640, 480), description="width and height of frames, and of the display, in pixels")
    interval: Positive | None = Field(
        None, description="simulated time between two frames in seconds, for platforms that render; default: theirs"
    )
