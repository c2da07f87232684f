"""Checks of the requirements and options on this machine and in this project, with a remedy for each missing one."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections.abc import Callable, Container, Iterator
from importlib import metadata
from pathlib import Path
from typing import Literal

from sierra.config import extensions, find_project, plugin_registry, project_file, user
from sierra.config.execution_tables import BuildTable
from sierra.config.project_file import LoadedProject
from sierra.containers.engines.base import Capabilities
from sierra.errors import SierraError
from sierra.store.layout import ProjectPaths, StorePaths, user_settings
from sierra.util import processors
from sierra.util.lazy_definitions import dataclass
from sierra.worker.machine import granted_cores
from sierra.worker.temporary_folders import TEMPORARY_LENGTH, temporary_folders

State = Literal["ok", "absent", "missing"]


@dataclass(frozen=True, slots=True)
class Check:
    """The result of one check. State `missing` means needed but not found, `absent` means optional and not found."""

    name: str
    state: State
    found: str
    remedy: str = ""


LIBRARIES = ("duckdb", "pyarrow", "lxml", "pydantic", "matplotlib", "scipy", "gitpython", "typer", "rich")
OPTIONAL = {
    "mujoco": "needed for the example: pip install 'sierra-experiments[example]'",
    "pandas": "needed for data frames and statistical figures: pip install 'sierra-experiments[figures]'",
    "seaborn": "needed for statistical figures (box, violin, ecdf, …): pip install 'sierra-experiments[figures]'",
}
"""Libraries of extras, and what they are needed for."""


def all_checks() -> list[Check]:
    """Return the results of all checks, those of the machine first."""
    return [check for part in (_machine, _settings, _installed, _plugins, _engines, _project) for check in part()]


def _machine() -> Iterator[Check]:
    version = f"{platform.python_version()} ({sys.executable})"
    yield _check("python", sys.version_info >= (3, 11), version, "install 3.11 or newer")
    yield Check("cores", "ok", f"{granted_cores()} usable")
    free = shutil.disk_usage(Path.cwd()).free
    yield _check("disk", free > 1 << 30, f"{free / 1e9:.1f} GB free here", "free some disk space")
    reaper = Path(f"/proc/self/task/{os.getpid()}/children").exists()
    temporary = next(iter(temporary_folders()), None)
    shown = f"those of runs are below {temporary}" if temporary else "those of runs are in their own folders"
    cure = f"needed for Unix sockets: set TMPDIR to a folder whose path has at most {TEMPORARY_LENGTH} characters"
    yield _check("temporary files", temporary is not None, shown, cure, "absent")
    shown = f"processes that leave their process group are {'found and ended' if reaper else 'not found'}"
    yield _check("process supervision", reaper, shown, "use a Linux kernel with CONFIG_PROC_CHILDREN", "absent")
    yield _observation()


def _observation() -> Check:
    """Return how the files that runs use can be observed here."""
    from sierra.worker.observers import usable

    way, reasons = usable()
    if way and not reasons:
        return Check("observation of files", "ok", f"all files that runs use, by {way.name}")
    shown = "only files that are mapped into memory" if way else "not possible"
    return Check("observation of files", "absent", shown, f"needed for observe: {'; '.join(reasons)}")


def _settings() -> Iterator[Check]:
    file = user_settings()
    if not file.is_file():
        yield Check("settings", "ok", f"no settings file at {file}")
        return
    yield _tried("settings", lambda: ", ".join(f"{name} = {value}" for name, value in user.load()) + f" ({file})")


def _installed() -> Iterator[Check]:
    for name in (*LIBRARIES, *OPTIONAL):
        try:
            yield Check(name, "ok", metadata.version(name))
        except metadata.PackageNotFoundError:
            state: State = "absent" if name in OPTIONAL else "missing"
            yield Check(name, state, "not installed", OPTIONAL.get(name, f"pip install {name}"))
    path = shutil.which("git")
    yield _check("git", path is not None, path or "not installed", "needed for projects in git: install git", "absent")


def _plugins(of_project: Container[tuple[str, str]] | None = None) -> Iterator[Check]:
    """Yield the plug-ins of other packages, or those of the project, each loaded.

    One that cannot be used affects only the commands that use it.
    """
    for kind in plugin_registry.KINDS:
        for name in kind.added():
            if of_project is not None and (kind.key, name) not in of_project:
                continue
            try:
                plugin = kind.load(name)
                own = plugin.Options.model_fields.keys() - kind.options_base.model_fields.keys()
                keys = ", ".join(key for key in plugin.Options.model_fields if key in own) or "none"
                yield Check(f"{kind.word} {name}", "ok", f"from {kind.packages(name)[0]}, options: {keys}")
            except SierraError as error:
                problem, _, remedy = str(error).rpartition("; ")
                yield Check(f"{kind.word} {name}", "missing", problem, remedy)


def _engines() -> Iterator[Check]:
    """Yield the state of each engine, found by starting something with it. An engine is needed only by projects that use it."""
    from sierra.containers import engines
    from sierra.containers.images import podman_images

    for name in engines.names():
        if name == "none":
            continue
        try:
            able = engines.find(name).probe()
        except SierraError:  # it cannot be loaded, or needs options: reported as a plug-in, or with the project
            continue
        if able.trouble:
            problem, _, remedy = able.trouble.partition("; ")
            yield Check(name, "absent", problem, remedy)
        else:
            slow = name == "podman" and podman_images.driver() == "vfs"
            warning = ["SLOW: its storage driver vfs copies whole images, so runs take 2 to 3 times as long"] if slow else []
            remedy = 'install fuse-overlayfs, or set driver = "overlay" in storage.conf' if slow else ""
            yield Check(name, "ok", ", ".join([able.version, *_properties(able), *warning]), remedy)


def _properties(able: Capabilities) -> Iterator[str]:
    """Yield the properties and limitations of an engine's containers."""
    yield f"{'rootless' if able.rootless else 'as root'}, outputs belong to {able.user}"
    ignored = {"cpus", "pids"} - able.enforced
    yield f"enforces {', '.join(sorted(able.enforced)) or 'no limits'}"
    if ignored:
        yield f"ignores {', '.join(sorted(ignored))}"
    if "memory" not in able.enforced:
        yield "SIERRA monitors memory itself"
    if not able.isolated:
        yield "NOT ISOLATED from the network"


def _project() -> Iterator[Check]:
    import sierra

    try:
        project = sierra.open()
        loaded = project_file.read(find_project.find_store(Path()))
    except SierraError as error:
        every = "; ".join((str(error), *getattr(error, "__notes__", ())))
        yield Check("project", "absent" if error.exit_code == 3 else "missing", every)
        return
    yield Check("project", "ok", str(project.root))
    try:
        with loaded.plugins():
            loaded.plugin_files()
            yield from _plugins(set(loaded.config.plugins.names))
            yield from _targets(loaded)
    except SierraError as error:
        problem, _, remedy = str(error).rpartition("; ")
        yield Check("plug-ins of the project", "missing", problem or remedy, remedy if problem else "")
    if project.paths.store.exists():
        yield _tried("store", lambda: f"{len(project.batches)} batches")


def _targets(loaded: LoadedProject) -> Iterator[Check]:
    if loaded.config.target or loaded.config.command or not loaded.targets:
        yield from _configured(loaded, "")
    for name in loaded.targets:
        if name != loaded.config.target:
            yield from _configured(loaded.for_target(name), f" of target {name}")


def _configured(project: LoadedProject, of: str) -> Iterator[Check]:
    """Check what a project needs for its default target, or for another target, which `of` names."""
    from sierra import runners, templates
    from sierra.containers import container_setup, images
    from sierra.design import platforms, run_values
    from sierra.execution import commands
    from sierra.ingest.base import used, with_files
    from sierra.provenance import fingerprint_programs, required_packages

    config = project.config

    def find_program() -> str:
        platform = platforms.find(config.platform, config)
        declared = run_values.declared(config)
        if config.container is not None:
            pinned = images.pinned_for_hosts(project.root, config.container.image)
            image = images.every(pinned)[0] if config.robots else pinned.on(processors.here())
            (images.unchanged if config.robots else images.verify)(project.root, image)
            inside = images.examine(project.root, StorePaths(ProjectPaths(project.root).store), image)
            command = commands.command(platform, project.root, contained=True, declared=declared, project=config)
            path = commands.environment(platform, config).get("PATH")
            return f"{container_setup.program(command, path, inside)} in {image.name}"
        built = config.build.produces if config.build else ()
        command = commands.command(platform, project.root, produced=built, declared=declared, project=config)
        words = commands.fill(command, project.root)
        if built and not Path(words[0]).exists() and Path(words[0]).is_relative_to(project.root):
            return f"{words[0]}, which [build] makes"
        variables = commands.declared(commands.environment(platform, config), project.root)
        return fingerprint_programs.find(words, variables, project.root).all[0].path

    def find_builder(table: BuildTable) -> str:
        word = table.command[0]
        if "/" in word and not word.startswith("{"):
            word = str(project.root / table.folder / word)
        if config.container is not None and not Path(word).is_relative_to(project.root):
            image = images.pinned_for_hosts(project.root, config.container.image).on(processors.here())
            inside = images.examine(project.root, StorePaths(ProjectPaths(project.root).store), image)
            return f"{container_setup.program((word,), None, inside)} in {image.name}"
        variables = commands.declared(commands.environment(platforms.find(config.platform, config), config), project.root)
        return fingerprint_programs.find(commands.fill((word,), project.root), variables, project.root).all[0].path

    def check_options() -> str:
        project_file.check_plugins(config)
        runners.check(config.runners)
        used(config.outputs, config.readers)
        with_files(config.outputs, project.root)
        return "the options of all plug-ins are valid"

    yield _tried(f"options{of}", check_options)
    yield _tried(
        f"template{of}",
        lambda: f"{', '.join(config.template_paths) or 'none'}, {templates.of_project(config, project.root).sha256[:10]}",
    )
    table = config.build
    if table is not None:
        yield _tried(f"build{of}", lambda: find_builder(table))
    yield _tried(f"command{of}", find_program)
    if config.requires:
        absent = required_packages.missing(config, contained=config.container is not None)
        shown = f"not installed: {', '.join(absent)}" if absent else ", ".join(config.requires)
        yield _check(f"requires{of}", not absent, shown, required_packages.remedy(absent))
    others = plugin_registry.RUNNERS.names()
    clusters = [name for name in config.runners if name not in others and not extensions.absent("runners", name)]
    if clusters and config.observe != "none":
        shown = f"{', '.join(clusters)}: checked on the node when a run is observed"
        yield Check(f"observation on clusters{of}", "ok", shown)


def _check(name: str, fits: bool, found: str, remedy: str, otherwise: State = "missing") -> Check:
    return Check(name, "ok" if fits else otherwise, found, "" if fits else remedy)


def _tried(name: str, what: Callable[[], str]) -> Check:
    try:
        return Check(name, "ok", what())
    except SierraError as error:
        return Check(name, "missing", str(error))
