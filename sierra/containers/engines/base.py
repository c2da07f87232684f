"""The Engine contract: a way to run processes in containers; and the function that finds an engine by name.

Shipped engines: `none`, `podman` and `apptainer`. Other packages add engines by entry points of the group `sierra.engines` (see
`sierra.plugin`), and `sierra.testing.engines` tests them.

Engine and runner are independent: an engine turns a process into the client that starts it in a container, and no other part of
the program knows which engine it is. All engines give a process the same environment: a read-only root, no network, no
capabilities, the host name `run`, and below `INSIDE` the code, its inputs and its own folders. The other places where a process
can write (`WRITABLE`) belong to the container and not to the host. If runs share a container, the worker removes what a run
leaves there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from sierra.config.field_types import Table
from sierra.config.plugin_registry import ENGINES, NoOptions, Tables
from sierra.containers.engines.hosts import Notice, OtherHost
from sierra.containers.images.image import Image
from sierra.model import Client, Result
from sierra.store.layout import RUN_HOME, RUN_OUTPUT, RUN_TMP, StorePaths
from sierra.util.lazy_definitions import dataclass, field

INSIDE = "/run/sierra"
"""The folder in a container with SIERRA's files: `run`, `project` and, if it needs them, `runs` and `worker.pyz`."""
RUN = f"{INSIDE}/run"
PROJECT = f"{INSIDE}/project"
PYTHON = "python3"
"""The value of `{python}` in a container."""
HOSTNAME = "run"
HERE = "\0"
"""The mark that stands for the run's folder on the host, which only the worker knows."""
WRITABLE = ("/tmp", "/var/tmp", "/run", "/dev", "/dev/shm", "/dev/mqueue")  # noqa: S108 - the container's own
"""The folders in a container where runs may write with at least one engine, in addition to their own folders."""


@dataclass(frozen=True, slots=True)
class Mount:
    """A file or folder of the host that is in a container at the path `target`. NUL in `source` stands for the run's folder."""

    source: str
    target: str
    writable: bool = False


@dataclass(frozen=True, slots=True)
class ContainerSpec:
    """The settings that all containers of one session share."""

    image: Image
    reference: str
    """The engine's name for the prepared image, as returned by `Engine.prepare`."""
    session: str
    mounts: tuple[Mount, ...] = ()
    network: bool = False
    devices: tuple[str, ...] = ()
    gpu: bool = False
    memory: int | None = None
    """The limit in bytes, if the engine must enforce it. `cpus` limits cores, `pids` processes including their threads."""
    cpus: float | None = None
    pids: int | None = None
    wall: float | None = None
    """The seconds after which a container ends even if nothing else ends it, if the engine supports that."""
    shared: bool = False
    """True if one container executes many runs, one after the other; false if each run has its own."""
    files: str = ""
    """A folder for the engine's own files that all hosts can read; empty if containers start only on this host."""
    gpus: str = "all"
    """The name of NVIDIA's GPUs in CDI; the worker puts those of a run in the place of `CDI_MARK`."""

    @property
    def limits(self) -> dict[str, float]:
        """Return the requested limits by name."""
        requested = {"memory": self.memory, "cpus": self.cpus, "pids": self.pids}
        return {name: limit for name, limit in requested.items() if limit is not None}


@dataclass(frozen=True, slots=True)
class Process:
    """A process to start in a container of its own. All paths except the mounts' sources are paths in the container."""

    argv: tuple[str, ...]
    environment: Mapping[str, str]
    """The complete environment. Nothing of the host's or the image's is added, except what an engine cannot leave out."""
    mounts: tuple[Mount, ...]
    """The mounts. The source of the first one is the run's folder, NUL, or a path in it."""
    folder: str
    """The working directory."""
    interactive: bool = False
    """True if it reads the standard input of its client."""


@dataclass(frozen=True, slots=True)
class Capabilities:
    """The abilities of an engine on this host for this user, found by starting a container."""

    version: str
    """The versions of the engine and of the programs that it uses to start containers."""
    rootless: bool = False
    enforced: frozenset[str] = frozenset()
    """The limits among `memory`, `cpus` and `pids` that work. Other limits are not passed to the engine.

    `memory` means that a container which exceeds it ends as a whole. (If the kernel kills only one process of the container, as
    control groups of version 1 do, a script may not notice. The worker's own check then ends all processes.)
    """
    isolated: bool = True
    """True if a container without network really has no network."""
    user: str = ""
    """The host's user to whom a container's processes belong."""
    groups: bool = True
    """True if a container's processes also belong to the other groups of this user, who may use devices by them."""
    trouble: str = ""
    """The reason why no container can be started, and the remedy; empty if containers work."""


def run_process(argv: tuple[str, ...], variables: Mapping[str, str], *more: Mount) -> Process:
    """Return the process of a run in a container of its own, with its folders. NUL stands for the run's folder on the host."""
    own = (
        Mount(HERE, RUN),
        *(Mount(f"{HERE}/{name}", f"{RUN}/{name}", writable=True) for name in (RUN_OUTPUT, RUN_HOME)),
        Mount(f"{HERE}/{RUN_TMP}", "/tmp", writable=True),  # noqa: S108 - the container's own
        *more,
    )
    return Process(argv, variables, own, f"{RUN}/{RUN_OUTPUT}")


class Engine(Protocol):
    """The contract of an engine. An engine has no state: it may be created at any time and used by many threads."""

    name: str
    Options: ClassVar[type[Table]]
    """The model of `[engines.NAME]`. Options must not change the results of runs, because they are not part of identities."""

    def __init__(self, options: Table) -> None:
        """Make the engine; `options` is an object of `Options`."""

    def probe(self) -> Capabilities:
        """Start a container to find out what works, and cache the result until boot, user or version change. Never raises."""

    def prepare(self, image: Image, root: Path, store: StorePaths) -> str:
        """Prepare the image, and return the reference to it that `client` uses.

        Idempotent, fast if the image is prepared already, and safe if other processes do the same. The prepared image is
        identified by its content, whatever its name stands for now.

        Raises Missing if the image is unavailable, damaged or for another architecture, or if there is no space.
        """

    def client(self, box: ContainerSpec, process: Process) -> Client:
        """Return the client that starts a process in a container of its own, waits for its end, and ends with its exit status.

        Its standard output and error are those of the process. SIGTERM to the client ends the process too. Its `stop` is a
        command that ends the container if it still exists, even if the client is gone (it may be empty if that cannot happen).
        """

    def sweep(self, sessions: Sequence[str]) -> None:
        """End and remove all containers of these sessions, no matter which process started them; there may be none."""

    def classify(self, result: Result, stderr: str, enforced: AbstractSet[str]) -> Result:
        """Return the result of the process, derived from the client's result and the end of its standard error in `stderr`.

        A signal that ended the process becomes `signal`. An exceeded limit among `enforced` becomes `stopped`. An error of the
        engine itself (no image, no such command, no permission) becomes `error`. All other fields stay as they are.
        """


@dataclass(frozen=True, slots=True)
class Supplied:
    """An image that another host has now."""

    reference: str
    """The engine's name for it there, as returned by `Engine.prepare`."""
    files: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """The files there that must not change, with the kernel's data about them when they were verified."""


@runtime_checkable
class OnOtherHosts(Protocol):
    """An engine that also starts containers on other hosts, such as robots, where nothing of SIERRA is installed."""

    def on(self, host: OtherHost) -> Engine:
        """Return this engine on another host: its `probe`, `client` and `sweep` are about that host."""

    def portable(self, image: Image, root: Path, store: StorePaths) -> Path:
        """Return a file on this host with the image, in the form that other hosts need. Raises Missing as `prepare`."""

    def supply(self, image: Image, file: Path, sha256: str, notice: Notice) -> Supplied:
        """Copy the `portable` file of an image to the host of this engine, unless that has it, and verify it there.

        `sha256` is that of the file. Called on an engine that `on` has returned. `notice` gets messages for the user. Raises
        Missing, Unreachable.
        """


class WithoutOptions:
    """An engine that has no options."""

    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, options: Table | None = None) -> None:
        """Make the engine."""


class NoEngine(WithoutOptions):
    """The engine `none`: programs run without a container."""

    name = "none"

    def probe(self) -> Capabilities:
        return Capabilities("none")

    def prepare(self, image: Image, root: Path, store: StorePaths) -> str:
        return ""

    def client(self, box: ContainerSpec, process: Process) -> Client:
        return Client(process.argv, process.environment)

    def sweep(self, sessions: Sequence[str]) -> None:
        return None

    def classify(self, result: Result, stderr: str, enforced: AbstractSet[str]) -> Result:
        return result


def find(name: str, tables: Tables | None = None) -> Engine:
    """Return the engine with this name; `tables` are `[engines.…]` of the project. Raises ConfigError if there is none."""
    made: Engine = ENGINES.make(name, tables or {})
    return made


def names() -> tuple[str, ...]:
    """Return the names of all engines that are known here."""
    return ENGINES.names()
