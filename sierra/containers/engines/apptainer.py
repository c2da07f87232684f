"""The engine `apptainer` (also for singularity-ce): one container per process, from the squashfs of an image.

Its client becomes the parent of the container's first process, which ends with the client, and the kernel ends all processes of
a container with its first process. A container therefore never outlives its client, and `stop` has nothing to do. The client
forwards signals that ask it to end. Each of its own errors ends it with status 255, which programs may also return; the last
line on standard error then tells the two apart.

Also: the files of an image in a folder, for apptainer where it cannot mount a squashfs.

The owner of a folder can change it. Therefore the state of each file just after unpacking is recorded (no program can set it:
`sierra.provenance.hash_cache`). A folder whose state has changed, or has no recorded state, is unpacked again. Each user has a
folder of their own beside the squashfs, because nobody can vouch for another user's folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import signal
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import cache
from pathlib import Path

from sierra.config.field_types import Table
from sierra.containers import images
from sierra.containers.engines import apptainer_ways_to_start
from sierra.containers.engines.apptainer_ways_to_start import Launcher
from sierra.containers.engines.base import Capabilities, ContainerSpec, Mount, Process, Supplied, WithoutOptions
from sierra.containers.engines.client_errors import killed, last_line, mounted, signalled
from sierra.containers.engines.hosts import HERE, SLOWEST, Host, Notice, OtherHost
from sierra.containers.images.image import Image
from sierra.containers.images.sif_format import is_sif
from sierra.containers.images.sif_format import read as read_sif
from sierra.errors import Missing
from sierra.model import Client, Result
from sierra.store.layout import StorePaths, user_engines
from sierra.util.cache import Cache
from sierra.util.lazy_definitions import regex

MAX_ENTRIES = 64


def prepare(squashfs: Path, identity: str, folder: Path) -> Path:
    """Return `folder` with the files of a squashfs (or of the one in a SIF), unpacked if necessary. Raises Missing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _locked(folder):
        unpack(HERE, squashfs, str(squashfs), identity, str(folder.resolve()))
    return folder


def unpack(host: Host, squashfs: Path, there: str, identity: str, folder: str) -> None:
    """Unpack a squashfs on a host, unless the folder has its unchanged files. It has the path `there`. Raises Missing."""
    cache = Cache(user_engines(), MAX_ENTRIES)
    key = " ".join(("sandbox", *([f"on {host.name}"] if host.name else []), folder, identity))
    limit = squashfs.stat().st_size / SLOWEST
    if cache.get(key) == (host.call("tree_state", folder, timeout=limit) or "gone"):
        return
    offset = read_sif(squashfs).offset if is_sif(squashfs) else 0
    if trouble := host.call("unpack", there, offset, folder, timeout=limit):
        raise Missing(f"{host.name}: {trouble}" if host.name else trouble)
    cache.put(key, host.call("tree_state", folder, timeout=limit))
    cache.save()


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a lock, so that only one process of this user at a time works on the folder."""
    descriptor = os.open(folder.with_name(f".{folder.name}.lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


SCRIPT = Path(__file__).with_name("environment.sh")
SOURCED = "/.singularity.d/env/99-zz-sierra.sh"
"""The path in a container of the script that sets its environment.

Apptainer sources the scripts there in the order of their names.
"""
NAME = regex(r"[A-Za-z_][A-Za-z0-9_]*")
PREFIX = "SIERRA__"
MARK = "SIERRA_CONTAINERS_OF"
"""The variable by which a client's session is found.

It is first in the client's environment, then in the configuration (JSON) of the process that becomes the container's parent.
"""
FAILED = 255
FATAL = regex(r"FATAL: +(.*)")
COMMAND = regex(
    r'".*": executable file not found|stat .*: (no such file|not a directory|permission denied)'
    r"|^(permission denied|is a directory)$|exec .* failed|fork/exec|exec format error"
)
IMAGE = regex(r"could not open image|image format not recognized|failed to retrieve path|mount.*(rootfs|squashfs)")


class Apptainer(WithoutOptions):
    """The engine `apptainer`."""

    name = "apptainer"

    def __init__(self, options: Table | None = None, host: Host = HERE) -> None:
        self._host = host

    def on(self, host: OtherHost) -> Apptainer:
        return Apptainer(host=host)

    def probe(self) -> Capabilities:
        return apptainer_ways_to_start.apptainer(self._host)

    def prepare(self, image: Image, root: Path, store: StorePaths) -> str:
        images.verify(root, image)
        squashfs = images.rootfs(root, store, image)
        if apptainer_ways_to_start.launcher().squashfs:
            return str(squashfs)
        return str(prepare(squashfs, image.id, store.image(image.folder).sandbox(os.geteuid())))

    def portable(self, image: Image, root: Path, store: StorePaths) -> Path:
        images.unchanged(root, image)
        return images.rootfs(root, store, image)

    def supply(self, image: Image, file: Path, sha256: str, notice: Notice) -> Supplied:
        assert isinstance(self._host, OtherHost)  # noqa: S101 - by contract
        placed = self._host.place(file, sha256, "images", notice)
        if apptainer_ways_to_start.launcher(self._host).squashfs:
            return Supplied(placed.path, {placed.path: placed.state})
        folder = f"{Path(placed.path).parent}.files"
        unpack(self._host, file, placed.path, image.id, folder)
        return Supplied(folder)

    def client(self, box: ContainerSpec, process: Process) -> Client:
        launcher = apptainer_ways_to_start.launcher(self._host)
        given = apptainer_ways_to_start.environment(self._host) | dict(variables(launcher, box, process))
        return Client(words(launcher, box, process), given)

    def sweep(self, sessions: Sequence[str]) -> None:
        if self._host is not HERE:
            return  # the agent there ends all processes of a run, and no container outlives its client
        mark = re.compile(f'{MARK}(=|":")({"|".join(map(re.escape, sessions))})(\0|")'.encode())
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if sessions and mark.search((folder / "environ").read_bytes()):
                    os.kill(int(folder.name), signal.SIGKILL)

    def classify(self, result: Result, stderr: str, enforced: AbstractSet[str]) -> Result:
        last = last_line(stderr)
        if result.exit_code == FAILED and (match := FATAL.fullmatch(last)):
            return replace(result, exit_code=None, error=_explained(match[1]))
        if result.signal is not None and result.stopped is None:
            if result.signal == signal.SIGKILL and "memory" in enforced:
                return replace(result, stopped="memory")
            return killed("apptainer", result)
        return signalled(result, enforced)


def _explained(complaint: str) -> str:
    if COMMAND.search(complaint):
        return f"the command cannot be started in the container: {complaint}"
    if IMAGE.search(complaint):
        return f"apptainer: the image cannot be opened: {complaint}"
    return f"apptainer: {complaint}"


@cache
def _script(host: Host, files: str) -> str:
    """Return the path of the script on a host."""
    if host is HERE and not files:
        return str(SCRIPT)
    return str(host.call("keep", files or host.folder, SCRIPT.read_text(), "sh"))


def words(launcher: Launcher, box: ContainerSpec, process: Process) -> tuple[str, ...]:
    """Return the command of a client."""
    started = launcher.words(network=box.network, files=box.files)
    return (*started, *_options(launcher, box, process), box.reference, *process.argv)


def _options(launcher: Launcher, box: ContainerSpec, process: Process) -> Iterator[str]:
    yield from map(mounted, (Mount(_script(launcher.host, box.files), SOURCED), *box.mounts, *process.mounts))
    yield from (mounted(Mount(device, device, writable=True)) for device in box.devices)
    if box.gpu:
        yield "--nv"
    if box.cpus is not None and "cpus" in launcher.enforced:
        yield f"--cpus={box.cpus}"
    if box.pids is not None and "pids" in launcher.enforced:
        yield f"--pids-limit={box.pids}"
    yield f"--pwd={process.folder}"


def variables(launcher: Launcher, box: ContainerSpec, process: Process) -> Iterator[tuple[str, str]]:
    """Yield the environment of a process, under names that have no meaning for any other program.

    Raises Missing for a name that apptainer does not accept.
    """
    yield f"{launcher.prefix}{MARK}", box.session
    for name, value in process.environment.items():
        if not NAME.fullmatch(name):
            raise Missing(f"{name!r} is not a valid variable name in apptainer; use letters, digits and _")
        if box.gpu and name == "LD_LIBRARY_PATH":
            value += ":/.singularity.d/libs"
        yield f"{launcher.prefix}{PREFIX}{name}", value
    if box.gpu and "LD_LIBRARY_PATH" not in process.environment:
        yield f"{launcher.prefix}{PREFIX}LD_LIBRARY_PATH", "/.singularity.d/libs"
