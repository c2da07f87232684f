"""What contains a run where it is executed: the Engine contract, and the door to find one by name.

Shipped: `none`, `podman` and `apptainer`. Others come as entry points of the group `sierra.engines`, each naming a class
that fulfils `Engine`; `sierra.testing.engines` holds them to it.

Engine and runner are independent: an engine turns a process that is to be contained into the client that starts it so, and
nothing else in the program knows which engine it is. All engines give a process the same: a root that it can't write to,
no network, no capabilities, the host name `run`, and below `INSIDE` the code, its inputs and its own folders. What else a
process can write to (`WRITABLE`) is the container's own and none of the host's: the worker removes from there what runs leave
that share a container.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from sierra.containers.images import Image
from sierra.model import Client, Result
from sierra.store.layout import StorePaths
from sierra.util import entry_points

SHIPPED = {
    "none": "sierra.containers.engines.base:NoEngine",
    "podman": "sierra.containers.engines.podman:Podman",
    "apptainer": "sierra.containers.engines.apptainer:Apptainer",
}
INSIDE = "/run/sierra"
"""Where a container has what SIERRA gives it: `run`, `project` and, for runs that share it, `runs` and `worker.py`."""
PROJECT = f"{INSIDE}/project"
PYTHON = "python3"
"""What `{python}` stands for in a container."""
HOSTNAME = "run"
WRITABLE = ("/tmp", "/var/tmp", "/run", "/dev", "/dev/shm", "/dev/mqueue")  # noqa: S108 - the container's own
"""Where runs may write in a container, beside folders of their own, with one engine or another."""


@dataclass(frozen=True, slots=True)
class Mount:
    """A file or folder of the host (NUL in it stands for the run's folder) that a container has, at a path of its own."""

    source: str
    target: str
    writable: bool = False


@dataclass(frozen=True, slots=True)
class ContainerSpec:
    """What the containers of one session have in common."""

    image: Image
    reference: str
    """What the engine calls the image, ready to be started: as `Engine.prepare` gave it."""
    session: str
    mounts: tuple[Mount, ...] = ()
    network: bool = False
    devices: tuple[str, ...] = ()
    gpu: bool = False
    memory: int | None = None
    """Bytes, where the engine is to enforce it; likewise cores, and processes with their threads."""
    cpus: float | None = None
    pids: int | None = None
    wall: float | None = None
    """Seconds after which a container is to end in any case, where that can be had: should nobody be left to end it."""
    shared: bool = False
    """Whether one container has many runs, one after the other, rather than one."""
    files: str = ""
    """A folder for what the engine itself needs wherever containers are started; empty where that is on this host alone."""

    @property
    def limits(self) -> dict[str, float]:
        """The limits that are asked for."""
        asked = {"memory": self.memory, "cpus": self.cpus, "pids": self.pids}
        return {name: limit for name, limit in asked.items() if limit is not None}


@dataclass(frozen=True, slots=True)
class Process:
    """What is to run in a container of its own: paths are those of the container."""

    argv: tuple[str, ...]
    environment: Mapping[str, str]
    """All of it: nothing of the host's or the image's is added, but what an engine can't leave out."""
    mounts: tuple[Mount, ...]
    """The first is the run's folder, NUL, or in it."""
    folder: str
    """Where it begins."""
    interactive: bool = False
    """Whether it reads the standard input of its client."""


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What an engine can do on this host, for this user: found out by starting something with it."""

    version: str
    """The engine, and what it uses to start containers, each with its version."""
    rootless: bool = False
    enforced: frozenset[str] = frozenset()
    """Of `memory`, `cpus` and `pids`: the limits that hold; others are not given to it.

    Of memory: a container that has more ends as a whole. (Where the kernel kills one process of it, as control groups of
    version 1 do, a script may take no notice. The worker's own watch ends all then.)
    """
    isolated: bool = True
    """Whether a container without network has none."""
    user: str = ""
    """Who a process of a container is outside of it."""
    trouble: str = ""
    """Why nothing can be started, and what to do about it; empty where all is well."""


class Engine(Protocol):
    """One way to contain processes. It has no state: an object of it may be made at any time, and used by many threads."""

    name: str

    def probe(self) -> Capabilities:
        """Start something, and say what works; remembered for as long as nothing changes (boot, user, version).

        Never raises.
        """
        ...

    def prepare(self, image: Image, root: Path, store: StorePaths) -> str:
        """Have the image ready; what `client` calls it. Idempotent, quick once it is there, and safe beside others that do the
        same. What is ready is the image by its content, whatever is called by its name now.

        Raises Missing: not to be had, for another architecture, damaged, no room.
        """
        ...

    def client(self, box: ContainerSpec, process: Process) -> Client:
        """What starts a process in a container of its own, waits for its end, and ends with its exit status.

        Its standard output and error are the process's. SIGTERM ends the process likewise. `stop` of it is a command that ends
        the container if it is still there, also where the client is gone (it may be empty where that can't be).
        """
        ...

    def sweep(self, sessions: Sequence[str]) -> None:
        """End and remove all containers of these sessions, whoever started them; there may be none."""
        ...

    def classify(self, result: Result, said: str, enforced: AbstractSet[str]) -> Result:
        """What became of the process, from how its client ended and the end of what was `said` on standard error.

        A signal that ended the process is the result's `signal`; a limit among `enforced` its `stopped`; what the engine
        itself failed at (no image, no such command, no rights) its `error`. All else stays as it is.
        """
        ...


class NoEngine:
    """The engine `none`: the program runs as it is."""

    name = "none"

    def probe(self) -> Capabilities:
        return Capabilities("none")

    def prepare(self, image: Image, root: Path, store: StorePaths) -> str:
        return ""

    def client(self, box: ContainerSpec, process: Process) -> Client:
        return Client(process.argv, process.environment)

    def sweep(self, sessions: Sequence[str]) -> None:
        return None

    def classify(self, result: Result, said: str, enforced: AbstractSet[str]) -> Result:
        return result


def find(name: str) -> Engine:
    """The engine of that name. Raises ConfigError where there is none."""
    made: Engine = entry_points.find("engine", SHIPPED, name)()
    return made


def names() -> tuple[str, ...]:
    """The engines that are known here."""
    return entry_points.names("engine", SHIPPED)
