"""The platform `mujoco`: a model (MJCF) that a small program simulates; SIERRA lays the program beside the model of each run.

The program is an input file, so it is part of the identity of runs, and a replay uses the recorded one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field, StringConstraints

from sierra.config.field_types import NotNegative, Positive
from sierra.design.platforms.base import Platform, Spanned, driver_files, driver_path, population_size
from sierra.plugin import Capture, ConfigError, Criterion, Project, QueryError, Rendering, Table, TemplateError, TemplateView

INPUT, DRIVER = "input.xml", "mujoco_driver.py"
POPULATION = "//worldbody//replicate/@count"
CRITERIA: Mapping[str, str] = {"population_size": "number of copies that <replicate> makes"}

Element = Annotated[str, StringConstraints(pattern=r"^[^-{}\s][^{}\s]*$")]
"""The name of an element of the model, or a pattern such as `robot*`."""
Inside = Annotated[str, StringConstraints(pattern=r"^[\w][\w./-]*\.py$")]


class MujocoOptions(Table):
    """The options of MuJoCo."""

    duration: Positive = Field(10.0, description="simulated time in seconds")
    interval: Positive = Field(0.1, description="simulated time between two rows of an output, in seconds")
    sensors: tuple[Element, ...] = Field(("*",), description="sensors that sensors.csv records, such as `speed` or `touch_*`")
    joints: tuple[Element, ...] = Field((), description="joints whose positions joints.csv records")
    bodies: tuple[Element, ...] = Field((), description="bodies whose places bodies.csv records")
    keyframe: Element | None = Field(
        None, description="name of the keyframe to begin with; default: as in the model", examples=["home"]
    )
    position_noise: NotNegative = Field(0.0, description="standard deviation of the first positions, in metres or radians")
    control_noise: NotNegative = Field(0.0, description="standard deviation that each control gets in each step")
    control: Inside | None = Field(
        None,
        description="Python file of the project with the function control(model, data, random), called before each step",
        examples=["walk.py"],
    )
    population: str = Field(POPULATION, description="XPath of the attribute that population_size sets")


class Mujoco(Platform):
    """The platform `mujoco`."""

    contract = 1
    Options: ClassVar[type[Table]] = MujocoOptions

    def __init__(self, project: Project, options: MujocoOptions) -> None:
        if project.template is None:
            raise ConfigError('platform "mujoco" needs one template, as in: template = "robot.xml"; others belong to files')
        self._driver = driver_path(project.template, DRIVER, is_among_files=bool(project.files))
        self._python = project.command or ("{python}",)
        self._options = options

    def criterion(self, criterion: Criterion, template: TemplateView) -> Spanned | None:
        if criterion.name not in CRITERIA:
            return None
        spanned = population_size(criterion.scale, path := self._options.population)
        if (count := len(template.find(path))) != 1:
            raise QueryError(f"population_size: {path} selects {count} attributes; set population in [platforms.mujoco]")
        return spanned

    def criteria(self) -> Mapping[str, str]:
        return CRITERIA

    def check(self, document: TemplateView, template: TemplateView) -> None:
        """Refuse a file that is no model."""
        if not document.find("/mujoco/self::*"):
            raise TemplateError("the root of a model of MuJoCo must be mujoco")

    def command(self) -> tuple[str, ...]:
        options = self._options
        numbers = ("duration", "interval", "position_noise", "control_noise")
        words = [word for name in numbers for word in (f"--{name.replace('_', '-')}", repr(getattr(options, name)))]
        lists = [("--sensors", options.sensors), ("--joints", options.joints), ("--bodies", options.bodies)]
        chosen = [word for name, wanted in lists if wanted for word in (name, *wanted)]
        keyframe = ("--keyframe", options.keyframe) if options.keyframe else ()
        control = ("--control", f"{{project}}/{options.control}") if options.control else ()
        return (*self._python, self._driver, "{input}", "{output}", "--seed", "{seed}", *words, *chosen, *keyframe, *control)

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        return (INPUT, document), *driver_files(__file__, DRIVER)

    def rendering(self, capture: Capture, command: tuple[str, ...]) -> Rendering:
        """Return the rendering off screen by the program of this version, which simulates like that of earlier ones."""
        interval = float(command[command.index("--interval") + 1])
        every = round((capture.interval or interval) / interval)
        if every < 1 or not math.isclose(every * interval, capture.interval or interval, rel_tol=1e-6):
            rows = f"the {interval:g} s between two rows of the outputs"
            raise ConfigError(f"[capture] interval: {capture.interval:g} s is not a multiple of {rows}")
        size = (str(side) for side in capture.size)
        camera = ("--camera", capture.camera) if capture.camera else ()
        words = (*command, "--frames", "{output}/frames", "--size", *size, "--every", str(every), *camera)
        driver = self.files(b"")[1]
        return Rendering(words, "frames/{tick}.png", replaced=(driver,), ticks_per_second=lambda document: 1 / interval)
