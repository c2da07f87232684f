"""The platform `sumo`: a configuration of SUMO in which SIERRA sets the seed, the end, the outputs and the traffic.

SUMO resolves all names in a configuration from the configuration's own folder. Networks and routes therefore lie beside it, as
further templates or as `files`, and outputs are named by their path from there to the run's output folder.
"""

from __future__ import annotations

import os.path
from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Annotated, ClassVar

from pydantic import Field, StringConstraints

from sierra.config.field_types import Positive
from sierra.design.platforms.base import Platform, Spanned
from sierra.plugin import (
    Add,
    Axis,
    Change,
    ConfigError,
    Criterion,
    Point,
    Project,
    QueryError,
    Set,
    Table,
    TemplateError,
    TemplateView,
    values,
)
from sierra.util.text import short_number

ENDING = ".sumocfg"
INPUT = f"input{ENDING}"
QUIET = ("--no-step-log", "--duration-log.disable")
ROOT = "/configuration"
OUTPUTS = f"{ROOT}//*[substring(name(), string-length(name()) - 6) = '-output']/@value"
FILES = ("net-file", "net", "n", "route-files", "routes", "r", "additional-files", "additional", "a")
"""Options that name files which SUMO reads, with their short names."""
NOWHERE = ("", "/dev/null", "nul", "NUL", "stdout", "-", "stderr")
OUTPUT_FOLDER = "output"
CRITERIA: Mapping[str, str] = {
    "population_size": "number of vehicles of a flow (number)",
    "vehicles_per_hour": "vehicles that a flow inserts each hour (vehsPerHour)",
    "scale": "factor of all traffic: 0.5 inserts half of the vehicles",
}
ATTRIBUTES = {"population_size": "number", "vehicles_per_hour": "vehsPerHour"}

OutputName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z-]*$")]


class SumoOptions(Table):
    """The options of SUMO."""

    end: Positive | None = Field(None, description="end of the simulated time in seconds; default: as in the template")
    step_length: Positive | None = Field(None, description="length of a step in seconds; default: as in the configuration")
    outputs: tuple[OutputName, ...] = Field(
        ("summary", "tripinfo"),
        description="outputs that each run writes as NAME.xml, in addition to those of the configuration",
    )
    flow: Annotated[str, StringConstraints(pattern=r"^[^'\"{}]+$")] | None = Field(
        None,
        description="id of the flow that population_size and vehicles_per_hour set; default: the only flow",
        examples=["main"],
    )


class Sumo(Platform):
    """The platform `sumo`."""

    contract = 1
    Options: ClassVar[type[Table]] = SumoOptions

    def __init__(self, project: Project, options: SumoOptions) -> None:
        self._options = options
        self._beside = (*map(os.path.normpath, project.templates.values()), *map(os.path.normpath, project.files))
        self._prefix, path = _configuration(project)
        self._folder = os.path.dirname(os.path.normpath(path)) if project.templates or project.files else ""  # noqa: PTH120
        self._output = "".join("../" for part in self._folder.split("/") if part) + OUTPUT_FOLDER
        self._routes = [name for name in project.templates if f"{name}:" != self._prefix]
        given = f"{{input.{self._prefix[:-1]}}}" if self._prefix else "{input}"
        self._command = project.command or ("sumo", "-c", given, *QUIET)

    def changes(self, template: TemplateView) -> tuple[Change, ...]:
        wanted = {"end": self._options.end, "step-length": self._options.step_length}
        times = (
            self._option(template, "time", name, short_number(value, 17)) for name, value in wanted.items() if value is not None
        )
        seed = () if self._find(template, f"{ROOT}//seed") else (self._option(template, "random_number", "seed", "0"),)
        return (*times, *seed, *self._moved(template), *self._added(template))

    def seed_changes(self) -> tuple[Change, ...]:
        return (Set(f"{self._prefix}{ROOT}//seed/@value", "{seed}", expect=1, why="the seed"),)

    def criterion(self, criterion: Criterion, template: TemplateView) -> Spanned | None:
        if criterion.name not in CRITERIA:
            return None
        numbers = values(criterion.scale)
        whole = criterion.name == "population_size"
        for value in numbers:
            if isinstance(value, str) or value < 0 or (whole and value != int(value)):
                kind = "a whole number" if whole else "a number"
                raise QueryError(f"{criterion.name}: {value} is not {kind} of 0 or more; use {criterion.name}=1,2,4")
        points = tuple(Point(value, (self._traffic(criterion.name, template, value),)) for value in numbers)
        return Axis(criterion.name, numbers), points

    def criteria(self) -> Mapping[str, str]:
        return CRITERIA

    def check(self, document: TemplateView, template: TemplateView) -> None:
        """Refuse a configuration whose runs do not repeat, lack a file, or write outside of their output folder."""
        if [text for text in self._find(document, f"{ROOT}//random/@value") if text not in ("false", "0", "off", "no")]:
            raise TemplateError("the option random of SUMO makes each execution different; remove it")
        for option in FILES:
            for text in self._find(document, f"{ROOT}//{option}/@value"):
                for name in text.replace(",", " ").split():
                    self._check_beside(option, name)
        for text in self._find(document, OUTPUTS):
            if not (text in NOWHERE or ":" in text or os.path.normpath(text).startswith(f"{self._output}/")):
                raise TemplateError(
                    f"SUMO would write {text!r} outside of the run's output folder; use a name without a folder"
                )

    def command(self) -> tuple[str, ...]:
        return self._command

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        return ((INPUT, document),)

    def _find(self, template: TemplateView, path: str) -> tuple[str, ...]:
        return template.find(f"{self._prefix}{path}")

    def _option(self, template: TemplateView, section: str, name: str, value: str) -> Change:
        """Return the change that gives an option its value; sections have no meaning for SUMO."""
        why = f"platform sumo: {name}"
        if self._find(template, f"{ROOT}//{name}"):
            return Set(f"{self._prefix}{ROOT}//{name}", value, attribute="value", expect=1, why=why)
        return Add(f"{self._prefix}{ROOT}", f'<{section}><{name} value="{value}"/></{section}>', expect=1, why=why)

    def _moved(self, template: TemplateView) -> tuple[Change, ...]:
        """Return the changes that move the configuration's own outputs into the output folder."""
        return tuple(
            Set(f"{self._prefix}({OUTPUTS})[{number}]", f"{self._output}/{name}", expect=1, why="platform sumo: an output")
            for number, name in enumerate(self._find(template, OUTPUTS), 1)
            if name not in NOWHERE and ":" not in name and "/" not in name
        )

    def _added(self, template: TemplateView) -> tuple[Change, ...]:
        wanted = [name for name in self._options.outputs if not self._find(template, f"{ROOT}//{name}-output|{ROOT}//{name}")]
        return tuple(self._option(template, "output", f"{name}-output", f"{self._output}/{name}.xml") for name in wanted)

    def _traffic(self, name: str, template: TemplateView, value: float | str) -> Change:
        """Return the change that sets one value of a criterion."""
        if name == "scale":
            return self._option(template, "processing", "scale", str(value))
        attribute, wanted = ATTRIBUTES[name], f"[@id='{self._options.flow}']" if self._options.flow else ""
        paths = [f"{routes}:/*/flow{wanted}" for routes in self._routes]
        flows = [f"{path}/@{attribute}" for path in paths for _ in template.find(f"{path}/@id")]
        if not self._routes:
            raise QueryError(f'{name} needs the routes as a template, as in: templates = {{ routes = "my.rou.xml" }}')
        if len(flows) != 1:
            raise QueryError(f"{name}: {len(flows)} flows are selected; set flow in [platforms.sumo] to the id of one")
        if not template.find(flows[0]):
            raise QueryError(f"{name}: the flow has no {attribute}, and may have another rate; give it {attribute}")
        return Set(flows[0], str(value), expect=1, why=name)

    def _check_beside(self, option: str, name: str) -> None:
        there = os.path.normpath(f"{self._folder}/{name}" if self._folder else name)
        if not (name.startswith("/") or any(fnmatchcase(there, one) or there.startswith(f"{one}/") for one in self._beside)):
            raise TemplateError(
                f"{option}: {name!r} is not beside the configuration of runs; add {there!r} to files or templates"
            )


def _configuration(project: Project) -> tuple[str, str]:
    """Return the prefix of paths in the configuration, and its file. Raises ConfigError."""
    if project.template is not None:
        return "", project.template
    found = [(f"{name}:", path) for name, path in project.templates.items() if path.endswith(ENDING)]
    if len(found) != 1:
        raise ConfigError(f'platform "sumo" needs one configuration, as in: template = "traffic{ENDING}"')
    return found[0]
