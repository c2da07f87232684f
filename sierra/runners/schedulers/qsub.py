"""Scripts for `qsub`. Their `#PBS` lines contain all options, so that the command line needs none.

OpenPBS and the `qsub` that Debian provides for SLURM differ in these lines:

              resources                        array          index
    OpenPBS   -l select=1:ncpus=4:mem=8mb      -J 0-5         $PBS_ARRAY_INDEX
    SLURM's   -l nodes=1:ppn=4, -l mem=8mb     -J 0-3,5       $SLURM_ARRAY_TASK_ID

OpenPBS has only ranges, and refuses a range of a single index. So there, one element is a plain job, and elements with gaps are
an array of places: the script turns the place into the element, and the job's variable SIERRA_ELEMENTS tells the same to
programs that list the job.

PBS keeps the output of a job on the node until the end, and copies it by rules of each site. So scripts write to their log
themselves, from their first line on. PBS's own output goes to `/dev/null`. OpenPBS takes that for a file on the host of `qsub`,
and copies an empty file there by scp. If scp does not work, it tries so often that the job takes a minute and a half to end.
Nothing is copied to the node's own file, `localhost:/dev/null`.

Jobs may be executed again when their node is lost (`-r y`), for three reasons: OpenPBS accepts arrays only with this option,
such jobs come back even if no process follows them, and a second copy does no harm.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator
from enum import StrEnum

from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError
from sierra.runners.schedulers.base import Request
from sierra.runners.schedulers.qstat import ELEMENTS
from sierra.util.text import ranges

MIB = 1 << 20


class Dialect(StrEnum):
    """Variants of `qsub`."""

    OPENPBS = "openpbs"
    SLURM = "slurm"
    """The wrapper over SLURM. Here sbatch reads the script: its `#SBATCH` lines and most of its `#PBS` lines."""


OUTPUT = {Dialect.OPENPBS: "localhost:/dev/null", Dialect.SLURM: "/dev/null"}
INDEX = {Dialect.OPENPBS: "$PBS_ARRAY_INDEX", Dialect.SLURM: "$SLURM_ARRAY_TASK_ID"}
NUMBER = {Dialect.OPENPBS: "${PBS_JOBID%%[!0-9]*}", Dialect.SLURM: "${SLURM_ARRAY_JOB_ID:-$SLURM_JOB_ID}"}


def script(request: Request, table: ClusterTable, dialect: Dialect) -> str:
    """Return the whole script. Raises ConfigError for a setting that this scheduler does not have."""
    if table.qos and dialect is not Dialect.SLURM:
        raise ConfigError(f"qos = {table.qos!r} is an option of SLURM; use directives for its equivalent in this PBS")
    shell = "/bin/bash" if table.modules else "/bin/sh"
    lines = [
        f"#!{shell} -l" if table.modules else f"#!{shell}",
        f"# {' '.join(request.comment.split())}",
        f"#PBS -N {request.name}",
        f"#PBS -S {shell}",
        "#PBS -j oe",
        f"#PBS -o {OUTPUT[dialect]}",
        "#PBS -m n",
        "#PBS -r y",
        *(f"#PBS -l {words}" for words in _resources(table, dialect)),
        *_places(table, dialect),
        *_after(request, dialect),
        *_array(request, dialect),
        *(f"#PBS {line}" for line in table.directives),
        *_index(request, dialect),
        f'exec >>{shlex.quote(str(request.logs))}/"{NUMBER[dialect]}_$index.out" 2>&1',
        f"cd {shlex.quote(str(request.folder))} || exit 3",
        *(f"module load {shlex.join(module.split())} || exit 3" for module in table.modules),
        f'exec {shlex.join(request.command)} "$index"',
    ]
    return "\n".join(lines) + "\n"


def _resources(table: ClusterTable, dialect: Dialect) -> Iterator[str]:
    memory = f"mem={math.ceil(table.memory / MIB)}mb" if table.memory else ""
    if dialect is Dialect.OPENPBS:
        gpus = f"ngpus={table.gpus}" if table.gpus else ""
        yield "select=" + ":".join(filter(None, ("1", f"ncpus={table.cpus}", memory, gpus, table.constraint)))
    else:
        yield f"nodes=1:ppn={table.cpus}"  # SLURM's own lines say what its sbatch does not understand in PBS lines
        if memory:
            yield memory
    if table.wall:
        minutes, seconds = divmod(math.ceil(table.wall), 60)
        yield f"walltime={minutes // 60:02}:{minutes % 60:02}:{seconds:02}"


def _places(table: ClusterTable, dialect: Dialect) -> Iterator[str]:
    if table.partition:
        yield f"#PBS -q {table.partition}"
    if table.account:
        yield f"#PBS -A {table.account}"
    if dialect is Dialect.SLURM:
        if table.qos:
            yield f"#SBATCH --qos={table.qos}"
        if table.constraint:
            yield f"#SBATCH --constraint={table.constraint}"
        if table.gpus:
            yield f"#SBATCH --gres=gpu:{table.gpus}"


def _after(request: Request, dialect: Dialect) -> Iterator[str]:
    if not request.after:
        return
    if dialect is Dialect.SLURM:
        yield f"#SBATCH --dependency=afterok:{request.after}"
        yield "#SBATCH --kill-on-invalid-dep=yes"
    else:
        yield f"#PBS -W depend=afterok:{request.after}"


def _array(request: Request, dialect: Dialect) -> Iterator[str]:
    elements = request.elements
    if dialect is Dialect.SLURM:
        yield f"#PBS -J {ranges(elements)}"
    elif len(elements) == 1:
        yield f"#PBS -v {ELEMENTS}={elements[0]}"
    elif _gaps(request):
        yield f"#PBS -J 0-{len(elements) - 1}"
        yield f"#PBS -v {ELEMENTS}={ranges(elements, '+')}"
    else:
        yield f"#PBS -J {elements[0]}-{elements[-1]}"


def _index(request: Request, dialect: Dialect) -> Iterator[str]:
    if len(request.elements) == 1:
        yield f"index={request.elements[0]}"
    elif dialect is Dialect.OPENPBS and _gaps(request):
        yield f"set -- {' '.join(map(str, request.elements))}"
        yield f'shift "{INDEX[dialect]}"'
        yield "index=$1"
    else:
        yield f"index={INDEX[dialect]}"


def _gaps(request: Request) -> bool:
    return request.elements[-1] - request.elements[0] != len(request.elements) - 1
