"""The engine `podman`: one container per process, from OCI images, with or without root.

podman's containers outlive their client, because `conmon` holds them. Each container therefore has its id in a file in the
run's folder and its session as a label, and is removed by these. Its first process is podman's own init, which forwards signals
and waits for orphans. A run sees neither the container's name nor podman's own output.
"""

from __future__ import annotations

import math
import os
import re
import resource
import subprocess
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from pathlib import Path

from sierra.containers.engines import podman_ways_to_start
from sierra.containers.engines.base import HOSTNAME, Capabilities, ContainerSpec, Process, WithoutOptions
from sierra.containers.engines.client_errors import killed, last_line, mounted, signalled
from sierra.containers.images import podman_images
from sierra.containers.images.image import Image, Kind, short
from sierra.errors import Missing
from sierra.model import Client, Result
from sierra.store.layout import StorePaths
from sierra.util.lazy_logger import Log

log = Log(__name__)

LABEL = "org.sierra.session"
CID = "\0/.cid"
HANDED_ON = re.compile(
    r"PATH|HOME|USER|LOGNAME|LANG|LC_\w+|TMPDIR|XDG_\w+|DBUS_SESSION_BUS_ADDRESS|CONTAINERS_\w+|STORAGE_\w+|BUILDAH_\w+|SSL_CERT_\w+"
)
"""The variables of the caller's environment that podman itself needs."""
MAX_FILES = 16384
"""The greatest number of open files, and of processes, in a container. Some hosts do not allow podman's own, higher default."""
FAILED, NOT_EXECUTABLE, NOT_FOUND = 125, 126, 127
INIT = re.compile(r"ERROR \(catatonit:\d+\): failed to exec pid1: (.*)")
ERROR = re.compile(r"Error: (.*)")


class Podman(WithoutOptions):
    """The engine `podman`."""

    name = "podman"

    def probe(self) -> Capabilities:
        return podman_ways_to_start.podman()

    def prepare(self, image: Image, root: Path, store: StorePaths) -> str:
        if image.kind != Kind.OCI:
            raise Missing(f"podman cannot run {image.name}, which is only a file system; use --engine apptainer")
        if not podman_images.present(image.id):
            if not image.file:
                raise Missing(
                    f"the image {image.name} ({short(image.id)}) is not in podman's storage; import it with sierra image import"
                )
            podman_images.load(root / image.file, image.id)
        return image.id

    def client(self, box: ContainerSpec, process: Process) -> Client:
        here = podman_ways_to_start.here()
        options = _options(box, process, here.abilities.enforced)
        argv = ("podman", *here.options, "run", *options, box.reference, *process.argv)
        return Client(argv, environment(box.session), ("podman", "rm", "--force", "--time=0", "--ignore", f"--cidfile={CID}"))

    def sweep(self, sessions: Sequence[str]) -> None:
        for session in sessions:
            listed = _podman("ps", "--all", "--quiet", "--no-trunc", f"--filter=label={LABEL}={session}", session=session)
            if found := listed.split():
                _podman("rm", "--force", "--time=0", "--ignore", *found, session=session)

    def classify(self, result: Result, stderr: str, enforced: AbstractSet[str]) -> Result:
        last = last_line(stderr)
        if match := INIT.search(last):
            return replace(result, exit_code=None, error=f"the command cannot be started in the container: {match[1]}")
        if result.exit_code in (FAILED, NOT_EXECUTABLE, NOT_FOUND) and (match := ERROR.match(last)):
            return replace(result, exit_code=None, error=f"podman: {match[1]}")
        if result.signal is not None and result.stopped is None:
            return killed("podman", result)
        return signalled(result, enforced)


def environment(session: str) -> dict[str, str]:
    """Return the environment in which podman is started."""
    return {**{name: value for name, value in os.environ.items() if HANDED_ON.fullmatch(name)}, "SIERRA_SESSION": session}


def _options(box: ContainerSpec, process: Process, enforced: AbstractSet[str]) -> Iterator[str]:
    yield from ("--rm", "--init", "--pull=never", "--log-driver=none", f"--cidfile={CID}", f"--label={LABEL}={box.session}")
    yield from ("--read-only", "--read-only-tmpfs=false", "--tmpfs=/run:rw,nosuid,nodev,mode=755", "--no-hosts")
    yield from ("--image-volume=ignore", "--no-healthcheck")  # else an image adds writable folders and programs beside the run
    yield from ("--cap-drop=all", "--security-opt=no-new-privileges", "--user=0:0", f"--hostname={HOSTNAME}", "--tz=UTC")
    yield from ("--pid=private", "--ipc=private", "--umask=0022")  # independent of containers.conf
    yield from (f"--ulimit={name}={_allowed(kind)}" for name, kind in (("nofile", "NOFILE"), ("nproc", "NPROC")))
    yield "--network=host" if box.network else "--network=none"
    if process.interactive:
        yield "--interactive"
    if not any(mount.target == "/tmp" for mount in process.mounts):  # noqa: S108 - the container's own
        yield "--tmpfs=/tmp:rw,nosuid,nodev,mode=1777"
    yield from map(mounted, (*box.mounts, *process.mounts))
    yield from (f"--device={device}" for device in box.devices)
    if box.gpu:
        yield "--device=nvidia.com/gpu=all"
    if box.memory is not None and "memory" in enforced:
        yield from podman_ways_to_start.memory_options(box.memory)
    if box.cpus is not None and "cpus" in enforced:
        yield f"--cpus={box.cpus}"
    if box.pids is not None and "pids" in enforced:
        yield f"--pids-limit={box.pids}"
    if box.wall is not None:
        yield f"--timeout={math.ceil(box.wall)}"
    yield "--unsetenv-all"
    yield from (f"--env={name}={value}" for name, value in process.environment.items())
    yield from ("--entrypoint=", f"--workdir={process.folder}", "--")


def _allowed(kind: str) -> str:
    _, hard = resource.getrlimit(getattr(resource, f"RLIMIT_{kind}"))
    most = MAX_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_FILES)
    return f"{most}:{most}"


def _podman(*words: str, session: str) -> str:
    """Return podman's standard output; empty if podman cannot be started."""
    try:
        done = subprocess.run(("podman", *words), capture_output=True, text=True, env=environment(session), check=False)
    except OSError:
        return ""
    log.command(("podman", *words), done.returncode, done.stderr)
    return done.stdout
