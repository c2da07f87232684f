"""The platform `jsbsim`: a script of JSBSim in which SIERRA sets the seed, the end and the recorded properties.

A small program lies beside the script of each run and simulates it, because the command `jsbsim` does not find the aircraft of
its own package. The program is an input file, so it is part of the identity of runs, and a replay uses the recorded one.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, StringConstraints

from sierra.config.field_types import Positive
from sierra.design.platforms.base import Platform, driver_files, driver_path
from sierra.plugin import Add, Change, ConfigError, Project, Set, Table, TemplateError, TemplateView

INPUT, DRIVER = "input.xml", "jsbsim_driver.py"
RUN = "/runscript/run"
SEED = f"{RUN}/property[normalize-space()='simulation/randomseed']/@value"
TABLE = "flight.csv"

Property = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][\w/.\[\]-]*$")]
Inside = Annotated[str, StringConstraints(pattern=r"^\w[\w./-]*$")]


class JsbsimOptions(Table):
    """The options of JSBSim."""

    end: Positive | None = Field(None, description="end of the simulated time in seconds; default: as in the template")
    properties: tuple[Property, ...] = Field(
        (), description=f"properties that {TABLE} records, such as position/h-sl-ft, in addition to the outputs of the script"
    )
    rate: Positive = Field(10.0, description=f"rows of {TABLE} for each simulated second")
    root: Inside | None = Field(
        None,
        description="folder of the project with aircraft, engine and systems; default: those of the package jsbsim",
        examples=["jsb"],
    )


class Jsbsim(Platform):
    """The platform `jsbsim`."""

    contract = 1
    Options: ClassVar[type[Table]] = JsbsimOptions

    def __init__(self, project: Project, options: JsbsimOptions) -> None:
        if project.template is None:
            raise ConfigError('platform "jsbsim" needs one template, as in: template = "flight.xml"')
        driver = driver_path(project.template, DRIVER, is_among_files=bool(project.files))
        root = ("--root", f"{{project}}/{options.root}") if options.root else ()
        self._command = (*(project.command or ("{python}",)), driver, "{input}", "{output}", *root)
        self._options = options

    def changes(self, template: TemplateView) -> tuple[Change, ...]:
        changes: list[Change] = []
        if not template.find(SEED):
            seed = '<property value="0">simulation/randomseed</property>'
            changes.append(Add(RUN, seed, at=0, expect=1, why="platform jsbsim: the seed"))
        if self._options.end is not None:
            end = repr(self._options.end).removesuffix(".0")
            changes.append(Set(RUN, end, attribute="end", expect=1, why="[platforms.jsbsim] end"))
        if self._options.properties:
            inner = "".join(f"<property>{name}</property>" for name in self._options.properties)
            output = f'<output name="{TABLE}" type="CSV" rate="{self._options.rate:g}">{inner}</output>'
            changes.append(Add("/runscript", output, expect=1, why="[platforms.jsbsim] properties"))
        return tuple(changes)

    def seed_changes(self) -> tuple[Change, ...]:
        return (Set(SEED, "{seed}", expect=1, why="the seed"),)

    def check(self, document: TemplateView, template: TemplateView) -> None:
        """Refuse a script without an end, without an output, or with one that other runs would overwrite."""
        if not document.find(f"{RUN}/@end"):
            raise TemplateError(f"{RUN} has no end, so that runs would never end; set end in [platforms.jsbsim]")
        names = document.find("/runscript/output/@name")
        if not names:
            raise TemplateError("the script has no output; set properties in [platforms.jsbsim]")
        for name in names:
            if "/" in name or names.count(name) > 1:
                raise TemplateError(f"two outputs or two runs would write {name!r}; use a name of its own, without a folder")

    def command(self) -> tuple[str, ...]:
        return self._command

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        return (INPUT, document), *driver_files(__file__, DRIVER)
