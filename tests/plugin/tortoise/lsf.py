"""The scheduler `lsf`: job arrays by bsub, bjobs and bkill. It was tried with programs that stand for these commands only."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from typing import ClassVar

from sierra.plugin import Bounds, ClusterTable, Missing, NodeVariables, Request, State, Task

STATES = {"PEND": State.QUEUED, "RUN": State.RUNNING, "DONE": State.ENDED, "EXIT": State.ENDED, "PSUSP": State.STUCK}
FORMAT = "jobid jobindex stat exec_host delimiter='|'"
SUBMITTED = re.compile(r"Job <(\d+)> is submitted")
TIMEOUT_S = 20.0


class Lsf:
    """The scheduler `lsf`. Elements of its arrays are numbered from 1, those of SIERRA from 0."""

    name = "lsf"
    contract = 1
    Options: ClassVar[type[ClusterTable]] = ClusterTable
    node = NodeVariables(
        task=("{LSB_JOBID}[{LSB_JOBINDEX}]", "{LSB_JOBID}"),
        cores=("{LSB_DJOB_NUMPROC}",),
        memory_mib=("{LSF_LIM_MEM_MB}",),
        gpus=("{LSF_GPUS}",),
        scratch=("{LSF_TMPDIR}",),
        others=("{LSB_QUEUE}", "{LSB_HOSTS}"),
    )
    requeue: tuple[str, ...] = ()
    forgets = True

    def __init__(self, table: ClusterTable) -> None:
        self._table = table

    @staticmethod
    def refuses(line: str) -> str | None:
        return "use array_tasks = N" if line.startswith("-J") else None

    def version(self) -> str:
        return f"lsf {_said('bsub', '-V').split()[0]}"

    def bounds(self) -> Bounds:
        return Bounds()

    def script(self, request: Request) -> str:
        indices = ",".join(str(index + 1) for index in request.elements)
        words = [
            f"-J {request.name}[{indices}]",
            f"-cwd {request.folder}",
            f"-oo {request.logs}/%J_%I.out",
            f"-n {self._table.cpus}",
        ]
        words += [f"-w done({request.after})"] if request.after else []
        lines = [f"#BSUB {line}" for line in (*words, *self._table.directives)]
        return "\n".join(["#!/bin/sh", *lines, f'exec {shlex.join(request.command)} "$((LSB_JOBINDEX - 1))"', ""])

    def submit(self, request: Request) -> str:
        said = _said("bsub", text=self.script(request))
        number = SUBMITTED.search(said)
        if number is None:
            raise Missing(f"bsub: {said.strip()}")
        return number[1]

    def look(self, name: str) -> tuple[Task, ...] | None:
        try:
            return tuple(self._tasks(name))
        except Missing:
            return None

    def explain(self, words: str) -> str:
        return words

    def cancel(self, name: str, elements: Sequence[int] | None = None) -> None:
        for task in self._tasks(name):
            if task.state is not State.ENDED and (elements is None or task.element in elements):
                _said("bkill", f"{task.job}[{(task.element or 0) + 1}]")

    def _tasks(self, name: str) -> Iterator[Task]:
        for line in _said("bjobs", "-a", "-noheader", "-o", FORMAT, "-J", name).splitlines():
            if line.count("|") == 3:
                job, index, state, node = line.split("|")
                yield Task(job, int(index) - 1, STATES.get(state, State.QUEUED), node=node)


def _said(*argv: str, text: str = "") -> str:
    """Return the output of a command of LSF. Raises Missing if it is not there or fails."""
    if shutil.which(argv[0]) is None:
        raise Missing(f"{argv[0]} is not installed")
    done = subprocess.run(
        argv, input=text, capture_output=True, text=True, timeout=TIMEOUT_S, check=False, env={"PATH": os.environ["PATH"]}
    )
    if done.returncode:
        raise Missing(f"{argv[0]}: {' '.join(done.stderr.split())}")
    return done.stdout
