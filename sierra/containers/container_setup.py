"""The containers of one session: they are prepared before anything executes, and their isolation is recorded."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from sierra.config.execution_tables import Container
from sierra.containers import images
from sierra.containers.engines.base import PROJECT, PYTHON, Capabilities, ContainerSpec, Engine, Mount, Process
from sierra.containers.images.image import Image
from sierra.errors import ConfigError, Missing
from sierra.model import IN_PROJECT, Limits, Requirement, RunSpec
from sierra.provenance.change_guard import ChangeGuard, guard_file
from sierra.provenance.dependency_model import Kind, Program, Programs
from sierra.provenance.hash_cache import HashCache, cached_sha256
from sierra.store.layout import StorePaths
from sierra.store.row_types import IsolationRow
from sierra.util.hashing import digest, sha256
from sierra.util.json_types import RecordValue
from sierra.util.lazy_definitions import dataclass, regex, replace
from sierra.worker.devices import CDI_MARK

if TYPE_CHECKING:
    from sierra.containers.images.image_contents import Contents

NETWORK, GPU, DEVICE, MOUNT = "network", "gpu", "device ", "mount "
MOUNTS = "{mount}"
"""The prefix of the name of a mounted file."""
WATCHED = frozenset(("memory",))
"""The limits that the worker checks if the engine does not enforce them."""
NVIDIA = Path("/proc/driver/nvidia")
MOUNTED = Path("/proc/self/mountinfo")
ESCAPED = regex(rb"\\([0-7]{3})")
SPARE_S = 60.0
"""The seconds after a run's time limit until its container ends by itself, in case that nothing else ends it."""


def host_access(container: Container | None) -> tuple[str, ...]:
    """Return the host access of runs beyond their image and their own folder, in the form that is part of their identity."""
    if container is None:
        return ()
    flags = [name for name, given in ((NETWORK, container.network), (GPU, container.gpu)) if given]
    listed = [f"{DEVICE}{path}" for path in container.devices] + [f"{MOUNT}{path}" for path in container.mounts]
    return tuple(sorted({*flags, *listed}))


def other_host_access(was: Sequence[str], now: Sequence[str]) -> list[str]:
    """Return the differences between two lists of host access, in words."""
    return [*(f"{one} is new" for one in now if one not in was), *(f"{one} is gone" for one in was if one not in now)]


def limits(row: Mapping[str, RecordValue]) -> dict[str, dict[str, float]]:
    """Return the limits in a row of `isolations`: all requested ones, divided into enforced, watched and ignored ones."""
    requested, enforced = (json.loads(str(row[name])) for name in ("limits_asked", "limits_enforced"))
    left = {name: limit for name, limit in requested.items() if name not in enforced}
    return {
        "limits_asked": requested,
        "limits_enforced": enforced,
        "limits_watched": {name: limit for name, limit in left.items() if name in WATCHED},
        "limits_ignored": {name: limit for name, limit in left.items() if name not in WATCHED},
    }


def data(named: Programs, container: Container, project: Path) -> Programs:
    """Return the data files that are part of the identity: project files that a template names, and all mounted files.

    Other files that a template names belong to the image. A mounted file is named by its whole path (`{mount}/data/map`),
    because two files may have the same name. A link is hashed by its target path, which is another place in a container.
    """
    digests = HashCache()
    mounted = []
    for target, source in container.mounts.items():
        root = _mount_source(project, target, source)
        for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
            if path.is_symlink() and path != root:
                hashed, kind = sha256(os.fsencode(path.readlink())), Kind.LINK
            elif path.is_file():
                hashed, kind = digests.of(str(path)), Kind.FILE
            else:
                continue
            mounted.append(Program(f"{MOUNTS}{Path(target, path.relative_to(root))}", str(path), hashed, kind))
    digests.save()
    own = (used for used in named.all if used.name.startswith(IN_PROJECT))
    return Programs((*own, *mounted), named.notes)


class Recorded(TypedDict, total=False):
    """The facts about an isolation that are needed to record executions."""

    engine: str
    isolation: IsolationRow | None
    shared: bool
    enforced: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Isolation:
    """The isolation of a session's runs: none, or containers with the same settings."""

    engine: Engine
    abilities: Capabilities
    box: ContainerSpec | None = None
    notes: tuple[str, ...] = ()
    guard: ChangeGuard | None = None
    """A guard for the image, if it is a file that its user may replace: its state when it was found to be the pinned one."""

    @property
    def row(self) -> IsolationRow | None:
        """Return the row of `isolations`, whose id is the hash of its other fields; None without containers."""
        box, able = self.box, self.abilities
        if box is None:
            return None
        # the code of a replay is in a folder of its own
        placed = tuple(replace(bound, source="{project}") if bound.target == PROJECT else bound for bound in box.mounts)
        client = self.engine.client(replace(box, session="", mounts=placed, files=""), Process((), {}, (), "/"))
        row = IsolationRow(
            isolation="",
            engine=self.engine.name,
            version=able.version,
            rootless=able.rootless,
            mode="worker" if box.shared else "run",
            image=box.image.id,
            user=able.user,
            network="host" if box.network else "none" if able.isolated else "not isolated",
            devices=[*box.devices, *(["gpu"] if box.gpu else [])],
            mounts=json.dumps({mount.target: mount.source for mount in placed}, sort_keys=True),
            limits_asked=json.dumps(box.limits, sort_keys=True),
            limits_enforced=json.dumps({name: box.limits[name] for name in sorted(self.enforced)}),
            argv=[word.replace("\0", "{run}").replace(CDI_MARK, "{gpus}") for word in client.argv],
        )
        fields = row._asdict()
        del fields["isolation"]
        return row._replace(isolation=digest("isolation", fields))

    @property
    def context(self) -> Recorded:
        if self.box is None:
            return {"engine": self.engine.name}
        enforced = tuple(sorted(self.enforced))
        return {"engine": self.engine.name, "isolation": self.row, "shared": self.box.shared, "enforced": enforced}

    @property
    def files(self) -> tuple[Path, ...]:
        """Return the files and folders that the commands of containers name: the image, if it is a file, and mounts."""
        if self.box is None:
            return ()
        paths = (self.box.reference, *(mount.source for mount in self.box.mounts if mount.target != PROJECT))
        return tuple(Path(path) for path in paths if Path(path).is_absolute())

    @property
    def needed(self) -> tuple[Requirement, ...]:
        """Return what every executing host must have: the devices, and the image if it is a file."""
        if self.box is None:
            return ()
        devices = tuple(Requirement("[container] devices", path) for path in self.box.devices)
        driver = (Requirement("[container] gpu", str(NVIDIA)),) if self.box.gpu else ()
        reference = self.box.reference
        if not Path(reference).is_absolute() or not Path(reference).is_file():
            return (*devices, *driver)
        digest = self.box.image.sha256 if self.guard else cached_sha256(reference)  # whatever the file contains by now
        return (*devices, *driver, Requirement("the image", reference, digest))

    def doubt(self) -> str | None:
        """Return why executions since then cannot be attributed to the image, or None. Its file was replaced or changed."""
        if self.box is None or self.guard is None or self.guard.doubt() is None:
            return None
        return f"the image {self.box.image.name} has changed since the runs began: {self.box.reference} was replaced"

    def close(self) -> None:
        """Remove all remaining containers of the session."""
        if self.box is not None:
            self.engine.sweep([self.box.session])

    @property
    def enforced(self) -> frozenset[str]:
        """Return the limits that the engine enforces."""
        return frozenset(self.box.limits) & self.abilities.enforced if self.box else frozenset()


def contain(
    engine: Engine,
    image: Image | None,
    spec: RunSpec,
    container: Container | None,
    bounds: Limits,
    *,
    code: Path,
    project: Path,
    store: StorePaths,
    session: str,
    elsewhere: bool = False,
) -> Isolation:
    """Prepare everything that the containers of runs need.

    `code` is the folder of the code, `container` is the project's current configuration. Runs that execute `elsewhere` use the
    devices of those hosts, which check for them (`Isolation.needed`). Raises Missing if the image or the engine is unavailable,
    or a mount does not exist.
    """
    if image is None or engine.name == "none":
        return Isolation(engine, Capabilities(""))
    able = engine.probe()
    if able.trouble:
        raise Missing(able.trouble)
    inside = examined(spec, image, project, store)
    reference = engine.prepare(image, project, store)
    theirs = image.file and reference == str(project / image.file)
    given = container or Container(image=image.name)
    shared, notes = given.isolation == "worker", []
    if shared and not inside.program(PYTHON):
        shared = False
        notes.append(f'isolation = "worker" needs {PYTHON} in the image, which lacks it: each run gets its own container')
    if inside.user:
        notes.append(f"the image's USER {inside.user!r} is ignored: outside the container, processes belong to {able.user}")
    if not elsewhere:
        _check_devices(spec)
    box = replace(
        settings(spec, image, given, bounds, session, shared=shared),
        reference=reference,
        mounts=tuple(_with_below((Mount(str(code), PROJECT), *mounts(spec, given, project)))),
        files=str(store.session(session).engine) if elsewhere else "",
        gpus="all" if elsewhere or bounds.gpus is None else CDI_MARK,  # a scheduler's indices may be those within a job
    )
    return Isolation(engine, able, box, (*notes, *ignored(engine, able, box)), guard_file(Path(reference)) if theirs else None)


def examined(spec: RunSpec, image: Image, project: Path, store: StorePaths) -> Contents:
    """Return the contents of an image after a check that it has the programs of runs. Raises Missing."""
    inside = images.examine(project, store, image)
    _check_variables(image, inside)
    for command in (spec.command, *(spec.robots or {}).values(), *spec.around.commands):
        program(command, spec.environment.get("PATH"), inside)
    if spec.around and not inside.program(PYTHON):
        raise Missing(
            f"services, before and after need {PYTHON} in the image {image.name}, which lacks it; add it to the image"
        )
    return inside


def settings(
    spec: RunSpec, image: Image, given: Container, bounds: Limits, session: str, *, shared: bool = False
) -> ContainerSpec:
    """Return the settings of containers that do not depend on a host: without the reference to the image, and mounts."""
    return ContainerSpec(
        image=image,
        reference="",
        session=session,
        network=NETWORK in spec.host_access,
        devices=tuple(access.removeprefix(DEVICE) for access in spec.host_access if access.startswith(DEVICE)),
        gpu=GPU in spec.host_access,
        # in a shared container, the limit would also hit the worker: it checks memory itself
        memory=None if shared else bounds.memory_bytes,
        cpus=given.cpus,
        pids=given.pids,
        wall=None if shared or bounds.wall_s is None else bounds.wall_s + bounds.grace_s + SPARE_S,
        shared=shared,
    )


def mounts(spec: RunSpec, given: Container, project: Path) -> Iterator[Mount]:
    """Yield the additional mounts of a run specification, with the project's sources. Raises ConfigError, Missing."""
    for target in (one.removeprefix(MOUNT) for one in spec.host_access if one.startswith(MOUNT)):
        if target not in given.mounts:
            raise ConfigError(f"runs need a mount at {target}; add its source to [container] mounts")
        yield Mount(str(_mount_source(project, target, given.mounts[target])), target)


def _with_below(mounts: Iterable[Mount]) -> Iterator[Mount]:
    """Yield the mounts, each followed by the host's own mounts below its source, because its options do not apply to these."""
    try:
        lines = MOUNTED.read_bytes().splitlines()
    except OSError:
        lines = []
    points = sorted({os.fsdecode(ESCAPED.sub(lambda match: bytes([int(match[1], 8)]), line.split()[4])) for line in lines})
    for mount in mounts:
        yield mount
        top = os.path.realpath(mount.source)
        for point in points:
            if point.startswith(f"{top}/") and os.access(point, os.F_OK):
                yield replace(mount, source=point, target=mount.target + point.removeprefix(top))


def _mount_source(project: Path, target: str, source: str) -> Path:
    """Return the path of a mount's source. Raises Missing if it does not exist."""
    path = project / source
    if not path.exists():
        raise Missing(f"[container] mounts: {path} does not exist, but runs need it at {target}")
    return path


def _check_devices(spec: RunSpec) -> None:
    """Check that this machine has the devices that runs use. Raises Missing."""
    for path in (one.removeprefix(DEVICE) for one in spec.host_access if one.startswith(DEVICE)):
        if not Path(path).exists():
            raise Missing(f"[container] devices: {path} does not exist on this machine")
    if GPU in spec.host_access and not NVIDIA.exists():
        raise Missing("[container] gpu: this machine has no NVIDIA driver")


def _check_variables(image: Image, inside: Contents) -> None:
    """Check that the pinned variables are the image's, because only its id is in the identity. Raises Missing."""
    from sierra.containers.images import oci

    if inside.config and dict(image.variables) != oci.variables(inside.config):
        differs = f"the variables of {image.name} in sierra.lock differ from the image's"
        raise Missing(f"{differs}; run: sierra image pin {image.name}")


def program(command: Sequence[str], path: str | None, inside: Contents) -> str:
    """Return the path of a run's program in the image, or the word if it is a file of the project. Raises Missing."""
    word = PYTHON if command[0] == "{python}" else command[0]
    found = word if "{" in word else inside.program(word, path)
    if found is None:
        raise Missing(f"the program {word!r} is not in the image {inside.image.name}; sierra image show lists its contents")
    return found


def ignored(engine: Engine, able: Capabilities, box: ContainerSpec) -> Iterator[str]:
    """Yield a note for each limit that is neither enforced nor watched, and for a network that is not isolated."""
    for name in sorted(box.limits.keys() - able.enforced - WATCHED):
        yield f"LIMIT IGNORED: {engine.name} does not enforce {name} here ({able.version})"
    if not box.network and not able.isolated:
        yield f"NOT ISOLATED: containers of {engine.name} have network access here ({able.version})"
