"""The engine `podman`: one container per process, from OCI images, with or without root.

podman's containers outlive their client, because `conmon` holds them. Each container therefore has its id in a file in the
run's folder and its session as a label, and is removed by these. Its first process is podman's own init, which forwards signals
and waits for orphans. A run sees neither the container's name nor podman's own output.
"""

from __future__ import annotations

import math
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from pathlib import Path

from sierra.config.field_types import Table
from sierra.containers import images
from sierra.containers.engines import capabilities, hosts, podman_ways_to_start
from sierra.containers.engines.base import HOSTNAME, Capabilities, ContainerSpec, Process, Supplied, WithoutOptions
from sierra.containers.engines.client_errors import killed, last_line, mounted, signalled
from sierra.containers.engines.hosts import HERE, SLOWEST, SPARE_S, Host, Notice, OtherHost, handed_on
from sierra.containers.images import podman_images
from sierra.containers.images.image import Image, Kind, short
from sierra.errors import Missing
from sierra.model import Client, Result
from sierra.store.layout import StorePaths
from sierra.util.lazy_definitions import regex

LABEL = "org.sierra.session"
CID = "\0/.cid"
STOP = ("podman", "rm", "--force", "--time=0", "--ignore", f"--cidfile={CID}")
HANDED_ON = regex(
    r"PATH|HOME|USER|LOGNAME|LANG|LC_\w+|TMPDIR|XDG_\w+|DBUS_SESSION_BUS_ADDRESS|CONTAINERS_\w+|STORAGE_\w+|BUILDAH_\w+|SSL_CERT_\w+"
)
"""The variables of the caller's environment that podman itself needs."""
MAX_FILES = 16384
"""The greatest number of open files, and of processes, in a container. Some hosts do not allow podman's own, higher default."""
MOST: Mapping[str, int | None] = {"NOFILE": None, "NPROC": None}
FAILED, NOT_EXECUTABLE, NOT_FOUND = 125, 126, 127
INIT = regex(r"ERROR \(catatonit:\d+\): failed to exec pid1: (.*)")
ERROR = regex(r"Error: (.*)")


class Podman(WithoutOptions):
    """The engine `podman`."""

    name = "podman"

    def __init__(self, options: Table | None = None, host: Host = HERE) -> None:
        self._host = host

    def on(self, host: OtherHost) -> Podman:
        return Podman(host=host)

    def probe(self) -> Capabilities:
        return podman_ways_to_start.podman() if self._host is HERE else podman_ways_to_start.podman(self._host)

    def prepare(self, image: Image, root: Path, store: StorePaths) -> str:
        _check_kind(image)
        if not podman_images.present(image.id):
            if not image.file:
                raise Missing(
                    f"the image {image.name} ({short(image.id)}) is not in podman's storage; import it with sierra image import"
                )
            podman_images.load(root / image.file, image.id)
        return image.id

    def portable(self, image: Image, root: Path, store: StorePaths) -> Path:
        from sierra.containers.images import import_export

        _check_kind(image)
        if image.file and (root / image.file).is_file():
            images.unchanged(root, image)
            return root / image.file
        archive = store.image(image.folder).archive
        if not archive.is_file():
            archive.parent.mkdir(parents=True, exist_ok=True)
            import_export.export(root, image.name, archive)
        return archive

    def supply(self, image: Image, file: Path, sha256: str, notice: Notice) -> Supplied:
        assert isinstance(self._host, OtherHost)  # noqa: S101 - by contract
        if not self._has(image):
            placed = self._host.place(file, sha256, "images", notice)
            done = self._podman("load", "--quiet", f"--input={placed.path}", timeout=SPARE_S + file.stat().st_size / SLOWEST)
            self._host.call("remove", str(Path(placed.path).parent))  # podman has a copy
            if not self._has(image):
                why = capabilities.advice(done.stderr) or podman_images.complaint(done.stderr)
                said = why if done.returncode else f"it has not the id {short(image.id)}"
                raise Missing(f"{self._host.name}: podman cannot load the image {image.name}: {said}")
        return Supplied(image.id)

    def _has(self, image: Image) -> bool:
        return self._podman("image", "exists", image.id).returncode == 0

    def client(self, box: ContainerSpec, process: Process) -> Client:
        here = podman_ways_to_start.here(self._host)
        enforced, most = here.abilities.enforced, self._host.facts.most
        return Client(words(box, process, here.options, enforced, most, self._host), environment(box.session, self._host), STOP)

    def sweep(self, sessions: Sequence[str]) -> None:
        for session in sessions:
            listed = self._podman(
                "ps", "--all", "--quiet", "--no-trunc", f"--filter=label={LABEL}={session}", session=session
            ).stdout
            if found := listed.split():
                self._podman("rm", "--force", "--time=0", "--ignore", *found, session=session)

    def _podman(self, *words: str, session: str = "", timeout: float | None = None) -> subprocess.CompletedProcess[str]:
        """Return the end of a podman command; its status is 1 if podman cannot be started."""
        return hosts.run(self._host, ("podman", *words), environment(session, self._host), timeout)

    def classify(self, result: Result, stderr: str, enforced: AbstractSet[str]) -> Result:
        last = last_line(stderr)
        if match := INIT.search(last):
            return replace(result, exit_code=None, error=f"the command cannot be started in the container: {match[1]}")
        if result.exit_code in (FAILED, NOT_EXECUTABLE, NOT_FOUND) and (match := ERROR.match(last)):
            return replace(result, exit_code=None, error=f"podman: {match[1]}")
        if result.signal is not None and result.stopped is None:
            return killed("podman", result)
        return signalled(result, enforced)


def environment(session: str, host: Host = HERE) -> dict[str, str]:
    """Return the environment in which podman is started."""
    return {**handed_on(host, HANDED_ON), "SIERRA_SESSION": session}


def _check_kind(image: Image) -> None:
    if image.kind != Kind.OCI:
        raise Missing(f"podman cannot run {image.name}, which is only a file system; use --engine apptainer")


def words(
    box: ContainerSpec,
    process: Process,
    way: Sequence[str] = (),
    enforced: AbstractSet[str] = frozenset(),
    most: Mapping[str, int | None] = MOST,
    host: Host = HERE,
) -> tuple[str, ...]:
    """Return the command of a client.

    `way` are the options with which podman starts here, `enforced` the limits that it enforces, and `most` the greatest limits
    that the user may set.
    """
    return ("podman", *way, "run", *_options(host, box, process, enforced, most), box.reference, *process.argv)


def _options(
    host: Host, box: ContainerSpec, process: Process, enforced: AbstractSet[str], most: Mapping[str, int | None]
) -> Iterator[str]:
    yield from ("--rm", "--init", "--pull=never", "--log-driver=none", f"--cidfile={CID}", f"--label={LABEL}={box.session}")
    yield from ("--read-only", "--read-only-tmpfs=false", "--tmpfs=/run:rw,nosuid,nodev,mode=755", "--no-hosts")
    yield from ("--image-volume=ignore", "--no-healthcheck")  # else an image adds writable folders and programs beside the run
    yield from ("--cap-drop=all", "--security-opt=no-new-privileges", "--user=0:0", f"--hostname={HOSTNAME}", "--tz=UTC")
    yield from ("--pid=private", "--ipc=private", "--umask=0022")  # independent of containers.conf
    yield from (f"--ulimit={name}={_allowed(most[kind])}" for name, kind in (("nofile", "NOFILE"), ("nproc", "NPROC")))
    yield "--network=host" if box.network else "--network=none"
    if process.interactive:
        yield "--interactive"
    if not any(mount.target == "/tmp" for mount in process.mounts):  # noqa: S108 - the container's own
        yield "--tmpfs=/tmp:rw,nosuid,nodev,mode=1777"
    yield from map(mounted, (*box.mounts, *process.mounts))
    yield from (f"--device={device}" for device in box.devices)
    if box.gpu:
        yield f"--device=nvidia.com/gpu={box.gpus}"
    if box.memory is not None and "memory" in enforced:
        yield from podman_ways_to_start.memory_options(box.memory, host)
    if box.cpus is not None and "cpus" in enforced:
        yield f"--cpus={box.cpus}"
    if box.pids is not None and "pids" in enforced:
        yield f"--pids-limit={box.pids}"
    if box.wall is not None:
        yield f"--timeout={math.ceil(box.wall)}"
    yield "--unsetenv-all"
    yield from (f"--env={name}={value}" for name, value in process.environment.items())
    yield from ("--entrypoint=", f"--workdir={process.folder}", "--")


def _allowed(hard: int | None) -> str:
    most = MAX_FILES if hard is None else min(hard, MAX_FILES)
    return f"{most}:{most}"
