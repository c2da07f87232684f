"""Rendered runs: recorded runs with the command, variables, display and inputs that make their simulator render."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import PurePosixPath

from sierra.config.capture_table import Capture
from sierra.config.change_tables import OWN_PLACEHOLDERS, WORKER_NAMES
from sierra.config.output_tables import FILE_FORMAT, Output
from sierra.config.project_file import LoadedProject, Project
from sierra.config.validate import options
from sierra.design.factorial_design import changes
from sierra.design.platforms import base as platforms
from sierra.design.platforms.base import Platform, Rendering, Renders
from sierra.design.run_values import Declared
from sierra.errors import ConfigError, Missing, TemplateError
from sierra.execution import commands, run_limits
from sierra.execution.run_limits import RunLimits
from sierra.model import Purpose, RunSpec, Service
from sierra.replay.compare_values import Agreement
from sierra.replay.variation import Variation
from sierra.store.store import Store
from sierra.templates import several
from sierra.templates.base import Files, Template
from sierra.util.hashing import digest, sha256
from sierra.util.text import few

DISPLAY = "capture_display"
"""The name of the service that is the display of a run."""
OF_PLATFORM = ("camera", "interval")
"""The keys of `[capture]` that only platforms that render have."""

TABLE: tuple[object, object] = (Capture, Capture.model_construct())
"""The key `capture` of `sierra.toml`."""


class RenderedRuns(Variation):
    """The variation with which the runs of one specification render."""

    purpose = Purpose.CAPTURE

    def __init__(self, project: LoadedProject, recorded: RunSpec) -> None:
        """Raises ConfigError if neither the platform nor `[capture]` says how runs render."""
        self._project = project
        self._table = _declared(project)
        self.rendering = _rendering(project, recorded)
        self._spec = _with_rendering(recorded, self.rendering)
        self._frames = options(Output, {"file": self.rendering.files, "format": FILE_FORMAT}, "[capture] files")
        self._template: Template | None = None

    def spec(self, recorded: RunSpec) -> RunSpec:
        del recorded
        return self._spec

    def limits(self, project: Project, store: Store, batch: str) -> RunLimits:
        """Return the limits of the runs of a recorded batch: those of `[limits]`, unless `[capture]` has others."""
        own = self._table.model_dump(include={"wall", "cpu", "memory", "output"}, exclude_none=True)
        limits = project.limits.model_copy(update=own)
        return run_limits.recorded(project.model_copy(update={"limits": limits}), store, batch)

    def compared(self, outputs: Mapping[str | None, Agreement]) -> Mapping[str | None, Agreement]:
        """Return the outputs that are not frames."""
        return {path: one for path, one in outputs.items() if path is None or not self.is_frame(path)}

    def is_frame(self, path: str) -> bool:
        """Return whether a file of the output folder is a frame."""
        return self._frames.matches(path)

    def files(self, recorded: Files) -> Files:
        """Return the input files of a run that renders. Raises TemplateError, ConfigError for changes that do not fit."""
        changed, replaced = self._changed(recorded), dict(self.rendering.replaced)
        return tuple(
            (name, changed.get(name) or replaced.get(PurePosixPath(name).name) or content) for name, content in recorded
        )

    def identity(self, recorded: Files) -> str:
        """Return the hash of everything that is executed, for a run with these recorded input files."""
        inputs = [[name, sha256(content)] for name, content in self.files(recorded)]
        return digest("rendering", {"spec": self._spec.preimage(), "inputs": inputs, "files": self.rendering.files})

    def ticks_per_second(self, recorded: Files) -> float | None:
        """Return the ticks of frames in a second of simulated time; None if that is unknown."""
        return self._table.ticks_per_second or self.rendering.ticks_per_second(_Document(self._read, recorded))

    def _changed(self, recorded: Files) -> dict[str, bytes]:
        """Return the changed input files by name."""
        own = changes(self._table.changes, "[capture] changes")
        wanted = (*self.rendering.changes(_Document(self._read, recorded)), *own)
        if not wanted:
            return {}
        names = _names(self._project.config, recorded)
        rendered = self._read(recorded).changed(wanted, {}).render()
        if isinstance(rendered, bytes):
            return {names[0]: rendered}
        if [name for name, _ in rendered] != names:
            raise TemplateError("[capture] changes: the format of the template makes several files, which cannot be changed")
        return dict(rendered)

    def _read(self, recorded: Files) -> Template:
        """Return the recorded input as a template."""
        config = self._project.config
        if self._template is None:
            self._template = several.of_project(config, self._project.root)
        names, contents = _names(config, recorded), dict(recorded)
        whole = contents[names[0]] if config.template is not None else tuple((name, contents[name]) for name in names)
        return self._template.reread(whole, "the recorded input")


class _Document:
    """A recorded input that is read when it is needed first."""

    def __init__(self, read: Callable[[Files], Template], recorded: Files) -> None:
        self._read, self._recorded = read, recorded

    def find(self, path: str) -> tuple[str, ...]:
        """Return the texts that a path selects: see `sierra.design.platforms.base.Reader`."""
        return self._template.find(path)

    @cached_property
    def _template(self) -> Template:
        return self._read(self._recorded)


def _names(config: Project, recorded: Files) -> list[str]:
    """Return the names of the input files that are made from templates. Raises TemplateError if a run lacks one."""
    if config.template is not None:
        return [recorded[0][0]]
    names = [os.path.normpath(path) for path in config.templates.values()]
    if lacking := sorted(set(names) - {name for name, _ in recorded}):
        raise TemplateError(f"[capture] changes: the recorded runs have no input {few(lacking, 3)}")
    return names


def _declared(project: LoadedProject) -> Capture:
    found: Capture = project.config.added("capture", TABLE[1])
    return found


def _rendering(project: LoadedProject, recorded: RunSpec) -> Rendering:
    table, config = _declared(project), project.config
    contained = recorded.image is not None
    produced = config.build.produces if config.build else ()
    known = (*OWN_PLACEHOLDERS, *WORKER_NAMES)

    def checked(words: Sequence[str], key: str) -> tuple[str, ...]:
        return commands.checked(
            words, project.root, key, known, contained=contained, produced=produced, declared=Declared(), project=config
        )

    command = checked(table.command, "[capture] command") or recorded.command
    command = (*command, *checked(table.arguments, "[capture] arguments"))
    if own := [name for name in table.environment if name in commands.OWN or name.startswith("SIERRA_")]:
        raise ConfigError(f"[capture] environment {own[0]}: SIERRA sets this variable for each run; use another name")
    with project.plugins("recorded runs are rendered by the platforms of installed packages only"):
        rendering = _of_platform(platforms.find(recorded.platform, config), recorded.platform, table, command)
    return replace(
        rendering,
        files=table.files or rendering.files,
        environment={**rendering.environment, **table.environment},
        display=rendering.display or (table.size if table.display else None),
    )


def _of_platform(platform: Platform, name: str, table: Capture, command: tuple[str, ...]) -> Rendering:
    """Return the rendering of a platform, or one by `[capture]` alone. Raises ConfigError if that says nothing."""
    if isinstance(platform, Renders) and not table.command:
        return platform.rendering(table, command)
    if alone := [key for key in OF_PLATFORM if key in table.model_fields_set]:
        raise ConfigError(f"[capture] {alone[0]}: platform {name!r} has no rendering of its own; write it in arguments")
    if not table.files:
        raise ConfigError(
            f"nothing says how runs of platform {name!r} render; in [capture], set files to the names of the frames, such as "
            '"frames/{tick}.png", and arguments to what makes the simulator write them'
        )
    return Rendering(command, table.files)


def _with_rendering(recorded: RunSpec, rendering: Rendering) -> RunSpec:
    """Return the specification that renders."""
    spec = replace(recorded, command=rendering.command, environment={**recorded.environment, **rendering.environment})
    if rendering.display is None:
        return spec
    width, height = rendering.display
    words = ("Xvfb", ":{port}", "-screen", "0", f"{width}x{height}x24", "-nolisten", "tcp")
    service = Service(DISPLAY, words, ("file", "/tmp/.X11-unix/X{port}"))  # noqa: S108 - where X servers put their sockets
    return replace(
        spec,
        environment={**spec.environment, "DISPLAY": f":{{services.{DISPLAY}.port}}"},
        around=replace(spec.around, services=(service, *spec.around.services)),
    )


def check_display(rendering: Rendering) -> None:
    """Raise Missing if runs on this machine need a display and cannot get one."""
    if rendering.display is not None and shutil.which("Xvfb") is None:
        raise Missing("rendering needs Xvfb, which is not installed here (Debian, Ubuntu: apt install xvfb)")
