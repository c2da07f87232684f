"""Jobs: the lines of JSON, one for each run, by which a worker is told what to execute."""

from __future__ import annotations

from typing import TYPE_CHECKING, Mapping, Sequence, TypedDict

if TYPE_CHECKING:
    from typing import NotRequired

CONDUCTED = "\2"  # the first word of a job that the conductor executes; the second is its plan
GRACE_S = 5.0  # between SIGTERM and SIGKILL, if the job does not say


class Limits(TypedDict, total=False):
    """The limits of a run that are set: see `sierra.model.Limits`."""

    wall_s: float
    cpu_s: float
    memory_bytes: int
    output_bytes: int
    grace_s: float
    after_marker_s: float
    marker: str
    contains: str
    gpus: float
    cores: int


class Program(TypedDict):
    """A program; `stop` is the command that ends the container of one that starts a container."""

    argv: Sequence[str]
    environment: Mapping[str, str]
    stop: NotRequired[Sequence[str]]
    start_pipe: NotRequired[str]
    """The named pipe from which a line lets the program in the container begin."""


class Helps(TypedDict):
    """Knowledge of this machine from before: a tracer that works, and a file with the SHA-256 of files."""

    tracer: str | None
    digests: str


class Claim(TypedDict):
    """The checkpoint of a run, as long as this process has locked it."""

    path: str
    """The folder with its files."""
    lock: int
    """The descriptor of the locked file."""


class Job(Program):
    """A run to execute: one line of the input."""

    run: str
    execution: str
    files: dict[str, str]
    """The content of each input file, in base64."""
    limits: Limits
    client: NotRequired[Program]
    shared: NotRequired[bool]
    used: NotRequired[int | None]
    seal: NotRequired[str]
    observe: NotRequired[Mapping[str, str]]
    """The folders by which observed files are named, if this run is observed: see `file_names.Names`."""
    beside: NotRequired[str]
    """A folder whose files lie beside the input files; the runs of a session share it."""
    folders: NotRequired[Mapping[str, str]]
    """The texts that take the place of marks in the input files; NUL stands for the run's folder."""
    ahead: NotRequired[float]
    """Seconds that this host's clock may be ahead of that of a file system with files that the run uses."""
    budget: NotRequired[float]
    """The run is in a sample: the part of the runs' time that observations of the sample may take."""
    affordable: NotRequired[float]
    """The run is observed if this takes at most so many times the mean time of a run, and while no run has ended."""
    experiment: NotRequired[int]
    """The number of its experiment. If the observed run fails, another one is observed: see `Worker.request_another`."""
    helps: NotRequired[Helps]
    compares: NotRequired[bool]
    """The worker observes this run to compare it with one that was doubtful: see `Worker.with_observation`."""
    checkpoint: NotRequired[str]
    """The folder of the run's checkpoint, which its executions share: see `sierra.worker.checkpoints`."""
    claim: NotRequired[Claim]
    unkept: NotRequired[str]
    """The reason why the run does not get its checkpoint, so that what it saves is lost. `claimed` sets it."""
    resumed: NotRequired[bool]
    """True if the run begins with files in its checkpoint. The worker sets it, and `claim`."""
    waits: NotRequired[bool]
    """True: the run is prepared (event `ready`), and starts at the moment that the input gives later: see `Worker.read`.

    It is one of several that start together on robots, and so cannot be executed once more. Therefore no tracer observes it.
    """
    own_ports: NotRequired[Sequence[int]]
    """The ports that the worker has chosen for it."""
    gpus: NotRequired[Sequence[str]]
    """The devices that the worker has given to it."""
    again: NotRequired[bool]
    """In a request: one more run is to be observed after the next."""
    unobserved: NotRequired[str]
    """Why this run was executed before and could not be observed: it is executed once more without observation."""


def is_conducted(job: Job) -> bool:
    """Return whether the conductor executes a job."""
    return list(job["argv"][:1]) == [CONDUCTED]


def with_folder(client: Program, folder: str) -> Program:
    """Return the program's words and environment with the path of the given folder."""
    return {
        "argv": [word.replace("\0", folder) for word in client["argv"]],
        "environment": {name: value.replace("\0", folder) for name, value in client["environment"].items()},
        "stop": [word.replace("\0", folder) for word in client.get("stop", ())],
        "start_pipe": client.get("start_pipe", "").replace("\0", folder),
    }
