"""The plan of a reproduction: the recorded runs of each batch, how they would be executed, and what this machine lacks."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import NamedTuple

from sierra.config.project_file import LoadedProject
from sierra.containers import engines
from sierra.containers.container_setup import DEVICE, GPU, MOUNT, NETWORK
from sierra.containers.engines.base import Engine
from sierra.containers.images.image import AnyImage, Image, ImageVariants, Kind
from sierra.errors import Missing, NotFound, PluginError, SierraError
from sierra.execution import commands, plan_from_record, row_queries, targets
from sierra.execution.plan_from_record import Recalled
from sierra.packages.layout import IMAGE_FILES
from sierra.provenance.dependency_model import INSTALLED, normalized, versions
from sierra.store.store import Store
from sierra.util import processors
from sierra.util.hashing import sha256_file, short
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import one_line

NONE = "none"
ENDINGS = {Kind.OCI: (".tar",), Kind.SQUASHFS: (".sif", ".sqfs")}
INSTALLERS = {"pip", "setuptools", "wheel"}
"""Packages that an environment may contain for installing others. Python reads a file of setuptools whenever it starts."""
CONTAINERS = ("podman", "apptainer")
"""Engines that are tried if the recorded one does not work on this machine."""

RUNS = """
SELECT f.batch, f.ordinal, m.number, f.run, coalesce(e.wall_s, 0.0) AS seconds
FROM ended f JOIN batch_runs m USING (batch, ordinal, run) JOIN all_judgements e ON e.judgement = f.judgement
WHERE f.batch = $b ORDER BY f.ordinal, m.number
"""
USED = """
SELECT DISTINCT e.programs, e.ingest_rules FROM ended f JOIN all_judgements e ON e.judgement = f.judgement
WHERE f.batch = $b ORDER BY ALL LIMIT 1
"""
BATCHES = """
SELECT b.batch, b.query, count(DISTINCT m.run) AS runs FROM batches b JOIN batch_runs m USING (batch)
GROUP BY b.batch, b.query, b.lamport ORDER BY b.lamport, b.batch
"""


class RecordedRun(NamedTuple):
    """A run with its position in a batch, and the recorded duration of its execution in seconds."""

    batch: str
    ordinal: int
    number: int
    run: str
    seconds: float


class _Used(NamedTuple):
    programs: str
    ingest_rules: str


class RecordedBatch(NamedTuple):
    """A batch of a package, with the number of its runs."""

    batch: str
    query: str
    runs: int


@dataclass(frozen=True, slots=True)
class PlannedBatch:
    """A batch that is to be executed again."""

    batch: str
    query: str
    runs: tuple[RecordedRun, ...]
    """Its runs with an execution that can be repeated."""
    of: int
    """The number of all its runs."""
    commands: tuple[tuple[str, ...], ...] = ()
    """The recorded commands that a run executes, and that of the build."""
    engine: str = NONE
    access: tuple[str, ...] = ()
    """Things beyond the package that a container may use, as `network`; empty without a container."""
    image: AnyImage | None = None
    """The image of the containers, at its place in the package; None without a container."""
    missing: tuple[str, ...] = ()
    """One line for each thing that this machine lacks, and the remedy. If there is one, the batch is not executed."""

    @property
    def isolated(self) -> bool:
        """True if its programs can reach nothing but their own files."""
        return self.engine != NONE and not self.access

    @property
    def place(self) -> str:
        """Where its programs would be executed, in words."""
        if self.engine == NONE:
            return "on this machine without a container"
        return f"in containers of {self.engine}" + (f" with access to: {', '.join(self.access)}" if self.access else "")

    @property
    def lines(self) -> tuple[str, ...]:
        """Lines for the user: the place and the commands, or what is missing."""
        name = f"batch {short(self.batch)} ({one_line(self.query)})"
        if self.missing:
            return tuple(f"{name}: {one_line(line)}" for line in self.missing)
        return tuple(f"{name}, {self.place}: {one_line(' '.join(words))}" for words in self.commands)


def batches(store: Store) -> list[RecordedBatch]:
    """Return the batches of a package."""
    return store.select(RecordedBatch, BATCHES)


def plan(project: LoadedProject, store: Store, batch: RecordedBatch, engine: str | None, *, local: bool) -> PlannedBatch:
    """Return the plan for a batch. `engine` is the requested one. `local`: runs execute on this machine.

    Executes nothing of the package, and starts nothing with its variables. Raises Damaged.
    """
    planned = PlannedBatch(batch.batch, batch.query, tuple(store.select(RecordedRun, RUNS, b=batch.batch)), batch.runs)
    used = store.select(_Used, USED, b=batch.batch)
    if not used:
        return _lacking(planned, "it has no run to execute again")
    try:
        recalled = plan_from_record.recall(store, batch.batch, *used[0])
        return _with_engine(project, store, planned, recalled, engine, local=local)
    except (Missing, NotFound, PluginError) as error:
        return _lacking(planned, str(error))


def _lacking(planned: PlannedBatch, *missing: str) -> PlannedBatch:
    return replace(planned, missing=missing)


def _with_engine(
    project: LoadedProject, store: Store, planned: PlannedBatch, recalled: Recalled, requested: str | None, *, local: bool
) -> PlannedBatch:
    project = targets.of_batch(project, store, planned.batch)
    spec = recalled.spec
    if spec.image is None and requested not in (None, NONE):
        return _lacking(planned, f"it was executed without an image: leave out --engine {requested}")
    if spec.robots is not None:
        return _lacking(planned, "its runs take robots, and a package must not move these: unpack it, and use sierra replay")
    engine, trouble = _engine(project, store, planned.batch, recalled, requested)
    if engine is None:
        return _lacking(planned, trouble)
    missing = [*_uncontained(recalled), *_without_mount(project, recalled)] if engine.name != NONE else []
    if engine.name == NONE and local:
        missing += _lacking_program(project, recalled)
    image = None if engine.name == NONE else packed_image(project, store, recalled)
    if image is not None and not missing:
        engine.prepare(image.on(processors.here()), project.root, store.paths)
    if missing:
        return _lacking(planned, *missing)
    access = [resource for resource in _host_access(recalled) if resource in (NETWORK, GPU) or resource.startswith(DEVICE)]
    if engine.name != NONE and not engine.probe().isolated and NETWORK not in access:
        access.append(f"{NETWORK} ({engine.name} cannot isolate it here)")
    built = (tuple(recalled.build.row.command),) if recalled.build else ()
    words = (*built, *spec.around.commands, spec.command)
    allowed = tuple(access) if engine.name != NONE else ()
    return replace(planned, commands=words, engine=engine.name, access=allowed, image=image)


def packed_image(project: LoadedProject, store: Store, recalled: Recalled) -> AnyImage | None:
    """Return the image of a batch with its file in the package; without a file, if the recorded one is outside the package."""
    image = plan_from_record.image(project, store, recalled.spec)
    if isinstance(image, ImageVariants):
        return replace(image, known={processor: _packed(project, one) for processor, one in image.known.items()})
    return _packed(project, image) if image else None


def _packed(project: LoadedProject, image: Image) -> Image:
    for ending in ENDINGS[image.kind]:
        name = f"../{IMAGE_FILES}{image.folder}{ending}"
        if (project.root / name).is_file():
            return replace(image, file=name, sha256=sha256_file(project.root / name))
    path = PurePosixPath(image.file)
    return replace(image, file="", sha256="") if path.is_absolute() or ".." in path.parts else image


def _engine(
    project: LoadedProject, store: Store, batch: str, recalled: Recalled, requested: str | None
) -> tuple[Engine | None, str]:
    """Return an engine that works here: the requested or recorded one, else another one for containers; or the reason."""
    tables = project.config.engines
    first = plan_from_record.engine(store, batch, recalled.spec, requested, tables, hosted=True)
    others = CONTAINERS if requested is None and first.name != NONE else ()
    troubles = []
    for engine in (first, *(engines.find(name, tables) for name in others if name != first.name)):
        if not (trouble := engine.probe().trouble):
            return engine, ""
        troubles.append(trouble)
    remedy = "install podman or apptainer; --engine none executes programs of this machine without a container"
    return None, f"it needs a container engine: {'; '.join(troubles)}; {remedy}"


def _host_access(recalled: Recalled) -> tuple[str, ...]:
    """Return the access to the host that the runs and the build have beyond their image."""
    build = recalled.build.row.host_access if recalled.build else ()
    return tuple(dict.fromkeys((*recalled.spec.host_access, *build)))


def _uncontained(recalled: Recalled) -> Iterator[str]:
    """Yield a line for each part of a batch that would not execute in the image of its runs. SIERRA records no such batch."""
    if recalled.build and recalled.build.row.image != recalled.spec.image:
        yield "its build was not executed in the image of its runs; --engine none executes it on this machine"
    if any(service.shared for service in recalled.spec.around.services):
        yield "its services for all runs would not execute in containers; --engine none executes it on this machine"


def _without_mount(project: LoadedProject, recalled: Recalled) -> Iterator[str]:
    given = project.config.container.mounts if project.config.container else {}
    for target in (one.removeprefix(MOUNT) for one in _host_access(recalled) if one.startswith(MOUNT)):
        if target not in given:
            yield f"its containers need {target} from outside the package, which a package must not choose"


def _lacking_program(project: LoadedProject, recalled: Recalled) -> Iterator[str]:
    """Yield a line if the program of the command is not in the project, and this machine lacks it."""
    [word, *_] = recalled.spec.command
    search = commands.declared(recalled.spec.environment, project.root)["PATH"]
    [program] = commands.fill((word,), project.root)
    if "{project}" not in word and shutil.which(program, path=search) is None:
        yield f"the program {program!r} is not installed: install it"


def lacking_packages(project: LoadedProject, store: Store, planned: PlannedBatch) -> tuple[str, ...]:
    """Return a line if this machine lacks Python packages that runs used. Starts the Python of the runs.

    Raises Missing for other files that runs need.
    """
    [used] = store.select(_Used, USED, b=planned.batch)
    recalled = plan_from_record.recall(store, planned.batch, *used)
    if planned.engine != NONE or recalled.spec.image or recalled.build:
        return ()  # products appear when they are built
    checkout = recalled.checkout(targets.of_batch(project, store, planned.batch), store)
    now = checkout.programs()
    with store.snapshot() as snapshot:
        names = {normalized(name) for name in row_queries.used_distributions(snapshot, [recalled.fingerprint])}
    was = {name: version for program in recalled.programs for name, version in _installed(program.name, program.version)}
    installed = {name for program in now.all for name, _ in _installed(program.name, program.version)}
    absent = [f"{name}=={was[name]}" for name in sorted(names & was.keys() - installed - INSTALLERS)]
    return (f"Python packages that runs used are not installed: pip install {' '.join(absent)}",) if absent else ()


def _installed(name: str, listed: str | None) -> Iterator[tuple[str, str]]:
    """Yield the distributions that a program's record lists, with their versions."""
    if name.endswith(INSTALLED):
        yield from versions(listed).items()


def reason(error: SierraError) -> str:
    """Return an error as one line."""
    return one_line(" ".join(str(error).split()))
