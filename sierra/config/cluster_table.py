"""The table of a cluster in `sierra.toml`, and the check of its directives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Literal

from pydantic import Field, PositiveInt

from sierra.config.field_types import OF_PYTHON, Line, Positive, Size, Table, valid_path
from sierra.errors import ConfigError

SETTINGS: Mapping[int | str, str] = {
    **dict.fromkeys(("queue", "partitions"), "partition"),
    **dict.fromkeys(("time", "walltime", "time_limit"), "wall"),
    **dict.fromkeys(("ncpus", "ppn", "ntasks", "cpus_per_task", "cores", "procs"), "cpus"),
    **dict.fromkeys(("nodes", "array", "jobs", "elements"), "array_tasks"),
    **dict.fromkeys(("gres", "ngpus", "gpu"), "gpus"),
    **dict.fromkeys(("features", "select"), "constraint"),
    "project": "account",
    "mem": "memory",
}
"""Schedulers' names for settings of clusters, with the name in `sierra.toml`."""
OnNode = Annotated[
    str, valid_path(lambda path: path.startswith(("/", "$")), "an absolute path on the node, such as /scratch or $TMPDIR/x")
]


class ClusterTable(Table):
    """A cluster: the resources of each array task, and the division of a batch into array tasks."""

    scheduler: str | None = Field(None, description="`slurm`, `pbs`, or an installed plug-in; default: the name of the table")
    array_tasks: PositiveInt | None = Field(
        None, description="number of array tasks; each executes a share of the batch; default: enough for 5 to 10 minutes each"
    )
    cpus: PositiveInt = Field(1, description="cores of an array task; it executes as many runs at a time")
    memory: Size | None = Field(None, description="memory of an array task, in bytes or as in `4 GiB`")
    wall: Positive | None = Field(
        None, description="time limit of an array task, in seconds; default: estimated, or the site's default"
    )
    partition: Line | None = Field(None, description="partition (PBS: queue)")
    account: Line | None = Field(None, description="account that is charged (SLURM and PBS)")
    qos: Line | None = Field(None, description="quality of service (SLURM)")
    constraint: Line | None = Field(
        None, description="features that nodes must have (SLURM), or text that is added to `select` (PBS)"
    )
    gpus: PositiveInt | None = Field(None, description="GPUs of an array task")
    modules: tuple[Line, ...] = Field((), description="environment modules that are loaded first")
    directives: tuple[Line, ...] = Field(
        (), description="further directives for which there is no setting: the text after `#SBATCH` or `#PBS`"
    )
    python: Annotated[str, OF_PYTHON, Field(min_length=1)] = "python3"
    scratch: OnNode | None = Field(
        None,
        description="folder on the node in which runs execute, such as `$TMPDIR/x`; its parent folder must exist; default: "
        "$SLURM_TMPDIR, $TMPDIR or /tmp",
    )
    cancelled: Literal["stop", "resubmit"] = Field(
        "stop", description="if somebody else cancels an array task: `stop` the session, or `resubmit` the task"
    )
    attempts: PositiveInt = Field(
        3,
        description="number of attempts at a run (the last one alone), or at an array task that starts no run, before it fails",
    )


def check_directives(table: ClusterTable, complaint: Callable[[str], str | None], where: str, name: str) -> None:
    """Raise ConfigError if a line of a cluster contradicts lines that SIERRA writes itself; `complaint` returns the reason."""
    for line in table.directives:
        if why := complaint(line):
            raise ConfigError(f"{where}: directive {line!r} of {name!r} cannot be added: {why}")
