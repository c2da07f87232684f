"""One build: its command is executed on this machine, in the run's image if there is one, and recorded with its products."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import socket
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from sierra.config.project_file import LoadedProject
from sierra.containers.container_setup import Isolation, contain
from sierra.containers.engines.base import INSIDE, PROJECT, PYTHON, Engine, Mount, Process
from sierra.containers.images.image import Image
from sierra.errors import Missing, SierraError
from sierra.execution import build_products, commands
from sierra.execution.build.recipe import Recipe
from sierra.execution.build_products import Product
from sierra.execution.sessions import Session
from sierra.model import Client, Limits, Purpose
from sierra.provenance import reported_versions
from sierra.provenance.dependency_model import Programs
from sierra.runners import local
from sierra.store.lamport_clock import stamp
from sierra.store.layout import RUN_HOME, RUN_TMP
from sierra.store.objects import Objects
from sierra.store.row_types import BuildProductRow, BuildRow
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.util import bounded_program
from sierra.util.kept_log import kept_of
from sierra.util.lazy_definitions import dataclass, regex, replace
from sierra.util.lazy_logger import Log
from sierra.util.text import one_line
from sierra.worker.containers import end_container
from sierra.worker.files import check_room
from sierra.worker.job import with_folder
from sierra.worker.temporary_folders import Temporary

log = Log(__name__)

EPOCH = "315532800"
"""The time that compilers put into products (1980-01-01): the same for each build; earlier times do not fit into archives."""
LOG = "log"
ERROR = regex(r"\b(error|undefined reference)\b", re.IGNORECASE)
"""Pattern of the line of a log that probably says why a build failed."""
SHOWN = 200
"""The largest number of characters of that line that are shown."""
_IN_RUN = f"{INSIDE}/run"


@dataclass(frozen=True, slots=True)
class Place:
    """The location where a build is executed."""

    root: Path
    """The folder of the code."""
    project: LoadedProject
    engine: Engine
    image: Image | None


@dataclass(frozen=True, slots=True)
class Ended:
    """The end of a build: its products, or why it failed in one line."""

    started: datetime
    ended: datetime
    exit_code: int | None
    reason: str | None
    products: tuple[Product, ...] = ()


def perform(recipe: Recipe, location: Place, store: Store, session: Session) -> Ended:
    """Execute the command of a build until its end. Raises Missing if the disk is full, or if the image is unavailable.

    If this process is interrupted, all processes of the build are ended.
    """
    folder = session.paths.building
    with disk_errors(folder):
        for name in (RUN_HOME, RUN_TMP):
            (folder / name).mkdir(parents=True)
    isolation = _isolated(recipe, location, store, session)
    log.info("build %s begins", recipe.id)
    started = datetime.now(UTC)
    temporary = Temporary(str(folder))
    try:
        exit_code, reason = _execute_all(recipe, location, session, isolation, temporary.make(str(folder)))
    finally:
        temporary.close()
        isolation.close()
    ended = datetime.now(UTC)
    log.info("build %s ended: %s", recipe.id, reason or "well")
    if reason is not None:
        _check_disk(location.root, folder, folder / LOG)
        return Ended(started, ended, exit_code, reason)
    if lacking := build_products.unmatched(location.root, recipe.patterns):
        return Ended(started, ended, exit_code, f"it made no file that matches {lacking[0]!r} of produces")
    return Ended(started, ended, exit_code, None, build_products.hashed(location.root, recipe.patterns))


def record(
    recipe: Recipe, ended: Ended, location: Place, store: Store, session: Session, *, batch: str, purpose: Purpose
) -> BuildRow:
    """Record a build with its products, its programs and its log; return its row."""
    programs, compiler = _versions(recipe, location)
    writer = store.writer(session.paths.segment, batch)
    objects = Objects(writer.path("objects"))
    content, _ = kept_of(str(session.paths.building / LOG))
    spec = recipe.spec
    row = BuildRow(
        build=recipe.id,
        session=session.id,
        batch=batch,
        purpose=purpose,
        source=spec.source,
        command=list(spec.command),
        folder=recipe.folder,
        produces=list(recipe.produces),
        variables=json.dumps(dict(spec.environment), sort_keys=True),
        image=spec.image,
        host_access=list(spec.host_access),
        programs=recipe.programs.id,
        host=socket.gethostname(),
        engine=location.engine.name,
        started=ended.started,
        ended=ended.ended,
        exit_code=ended.exit_code,
        reason=ended.reason,
        compiler=compiler,
        flags=json.dumps(recipe.flags) if recipe.flags else None,
        result=build_products.result(ended.products) if ended.reason is None else None,
        log=objects.add(content),
        lamport=stamp(session.number, session.id),
        processors=list(recipe.processors) or None,
    )
    objects.close()
    writer.records([row])
    writer.records(
        BuildProductRow(row.build, row.session, product.name, product.size, product.sha256)
        for product in ended.products
        if row.result
    )
    writer.records(programs.rows())
    store.publish(writer)
    return row


def failure(ended: Ended, store: Store, session: Session) -> SierraError:
    """Return the error for a failed build: one line with its likely cause, and the file to which its log is copied."""
    content, _ = kept_of(str(session.paths.building / LOG))
    file = store.paths.log(session.id)
    with contextlib.suppress(OSError):
        file.parent.mkdir(exist_ok=True)
        with file.open("ab") as copy:
            copy.write(content)
    lines = [line.strip() for line in content.decode("utf-8", "replace").splitlines() if line.strip()]
    said = next((line for line in lines if ERROR.search(line)), lines[-1] if lines else "")
    cause = f": {one_line(said[:SHOWN])}" if said else ""
    return SierraError(f"the build failed, so nothing was executed: {ended.reason}{cause}; log: {file}")


def _versions(recipe: Recipe, location: Place) -> tuple[Programs, str | None]:
    """Return the programs of a build with the versions that they report, and those of the compilers in one line."""
    if recipe.spec.image is not None:
        return recipe.programs, None
    variables = commands.declared(recipe.spec.environment, location.root, location.project.root)
    found = reported_versions.with_versions(recipe.programs, location.project.config.programs, variables, location.root)
    named = [one.version for one in found.all if one.path in recipe.compilers and one.version]
    first = [one.version for one in found.all[:1] if one.version]
    return found, "; ".join(dict.fromkeys(named or first)) or None


def _isolated(recipe: Recipe, location: Place, store: Store, session: Session) -> Isolation:
    """Return the isolation of a build: that of the runs, except that it may write to the project."""
    isolation = contain(
        location.engine,
        location.image,
        recipe.placed(location.root),
        location.project.config.container,
        Limits(recipe.wall),
        code=location.root,
        project=location.project.root,
        store=store.paths,
        session=session.id,
    )
    box = isolation.box
    if box is None:
        return isolation
    mounts = tuple(replace(mount, writable=True) if mount.target == PROJECT else mount for mount in box.mounts)
    return replace(isolation, box=replace(box, mounts=mounts, shared=False))


def _client(recipe: Recipe, location: Place, session: Session, isolation: Isolation, temporary: str | None) -> Client:
    """Return the program to start: the command itself, or the client that starts it in a container.

    `temporary` is the command's folder for temporary files, if it has a short one.
    """
    folder = str(session.paths.building)
    box = isolation.box
    code = Path(PROJECT) if box else location.root
    argv = _argv(recipe, code, location)
    here = _IN_RUN if box else folder
    variables = {
        **commands.within(location.image, _filled(recipe.spec.environment, code, location)),
        "HOME": f"{here}/{RUN_HOME}",
        "TMPDIR": "/tmp" if box else temporary or f"{here}/{RUN_TMP}",  # noqa: S108 - the container's own
        "SIERRA_SESSION": session.id,
    }
    variables.setdefault("SOURCE_DATE_EPOCH", EPOCH)
    if box is None:
        return Client(argv, variables | {"PATH": commands.search_path(variables)})
    own = (
        Mount(folder, _IN_RUN),
        Mount(f"{folder}/{RUN_HOME}", f"{_IN_RUN}/{RUN_HOME}", writable=True),
        Mount(f"{folder}/{RUN_TMP}", "/tmp", writable=True),  # noqa: S108
    )
    process = Process(argv, variables, own, os.path.normpath(f"{PROJECT}/{recipe.folder}"))
    client = location.engine.client(box, process)
    filled = with_folder(
        {"argv": list(client.argv), "environment": dict(client.environment), "stop": list(client.stop)}, folder
    )
    return Client(tuple(filled["argv"]), filled["environment"], tuple(filled.get("stop", ())))


def _argv(recipe: Recipe, code: Path, location: Place) -> tuple[str, ...]:
    """Return the command as it is started. Only its program gets a whole path: compilers put paths of files into products."""
    first = recipe.placed(location.root).command[0]
    words = (first if "/" in recipe.spec.command[0] else recipe.spec.command[0], *recipe.spec.command[1:])
    return _fill(words, code, location)


def _fill(words: tuple[str, ...], code: Path, location: Place) -> tuple[str, ...]:
    contained = {"python": PYTHON} if location.image else {}
    return commands.fill(words, code, contained, project=None if contained else location.project.root)


def _filled(variables: Mapping[str, str], code: Path, location: Place) -> dict[str, str]:
    return {name: _fill((value,), code, location)[0] for name, value in variables.items()}


def _execute_all(
    recipe: Recipe, location: Place, session: Session, isolation: Isolation, temporary: str | None
) -> tuple[int | None, str | None]:
    """Execute a build's command for each processor until one fails; return the last exit status, and why it failed."""
    exit_code, reason, output = None, None, session.paths.building / LOG
    for part in recipe.executions:
        client = _client(part, location, session, isolation, temporary)
        try:
            exit_code, reason = _execute(client, location.root / recipe.folder, output, recipe.wall)
        finally:
            if client.stop:
                end_container({"argv": [], "environment": dict(client.environment), "stop": list(client.stop)})
            local.end_orphans([session.paths])
        if reason is not None:
            break
    return exit_code, reason


def _execute(client: Client, folder: Path, output: Path, wall: float | None) -> tuple[int | None, str | None]:
    """Execute a program until it ends, or until its time limit; return its exit status, and why it failed."""
    with disk_errors(output.parent), output.open("ab") as file:
        try:
            status = bounded_program.execute(
                client.argv, cwd=folder, env=client.environment, wall=wall, stdout=file, stderr=subprocess.STDOUT
            ).status
        except (FileNotFoundError, NotADirectoryError, PermissionError) as error:
            return None, f"{client.argv[0]!r} cannot be started in {folder}: {error.strerror}"
    if status is None:
        return None, f"it was ended after {wall:g} s, the time limit in [build] wall"
    if status < 0:
        return None, f"{Path(client.argv[0]).name} was ended by signal {-status}"
    return status, f"exit status {status} of {Path(client.argv[0]).name}" if status else None


def _check_disk(root: Path, folder: Path, output: Path) -> None:
    """Raise Missing if a full disk is why a build failed: it is full now, or the build said so and then removed files."""
    for checked in (root, folder):
        try:
            check_room(str(checked))
        except OSError as error:
            raise Missing(f"cannot write to {checked}: {error.strerror}") from error
    content, _ = kept_of(str(output))
    for number in (errno.ENOSPC, errno.EDQUOT):
        if os.strerror(number).encode() in content:
            raise Missing(f"the build in {root} cannot write: {os.strerror(number)}")
