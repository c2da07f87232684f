"""Batches on a real SLURM: a project whose runs wait for a gate, and checks at the end of a batch."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import sierra
from sierra.api import Project
from sierra.runners.cluster.result_log_reader import Pack
from sierra.worker.processes import marked
from sierra.worker.result_log import Started
from tests import projects
from tests.clusters import Slurm
from tests.waiting import until

CLUSTER = """
[runners.slurm]
array_tasks = 3
"""
WAITING = """\
import os, sys, time

count = int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    print(0, count, sep=",", file=file)
with open({log!r}, "a") as log:
    print(os.environ["SIERRA_RUN_ID"], file=log, flush=True)
while not os.path.exists({gate!r}) and not os.path.exists({gate!r} + "." + os.environ["SIERRA_RUN_ID"]):
    time.sleep(0.02)
"""
"""A simulator that reports its start, and continues after a gate is open."""


@dataclass
class Gated:
    """A project whose runs wait until a gate is open."""

    root: Path
    slurm: Slurm
    asked: list[subprocess.Popen[str]] = field(default_factory=list)

    @classmethod
    def make(cls, root: Path, slurm: Slurm, table: str = "", *, simulator: str = WAITING) -> Gated:
        """Make such a project in a new folder; `table` is added to its settings of the cluster."""
        text = simulator.format(log=str(root.with_name("log")), gate=str(root.with_name("gate")))
        return cls(projects.make(root, projects.CONFIG + CLUSTER + table, simulator=text), slurm)

    @property
    def gate(self) -> Path:
        return self.root.with_name("gate")

    def open(self, run: str = "") -> None:
        """Let all runs end, or the given one."""
        (self.gate.with_name(f"gate.{run}") if run else self.gate).touch()

    def begun(self) -> list[str]:
        """Return the runs that were begun, each as often as it was begun."""
        log = self.root.with_name("log")
        return log.read_text().split() if log.exists() else []

    def ask(self, *words: str) -> subprocess.Popen[str]:
        command = ["run", *(words or ("population_size.Log8",)), "--on", "slurm", "--no-figures"]
        self.asked.append(projects.start(self.root, *command, stdin=subprocess.DEVNULL))
        return self.asked[-1]

    def until_begun(self, count: int) -> None:
        until(lambda: len(self.begun()) >= count, f"{count} runs begin")

    def until_told(self, count: int) -> None:
        """Wait until this number of runs has begun, and array tasks have recorded it."""
        until(lambda: len(packed(self.root, Started)) >= count, f"the start of {count} runs is recorded")

    def job(self) -> str:
        """Return the id of the only job."""
        listed = self.slurm.command("squeue", "-h", "-t", "PENDING,RUNNING", "-o", "%F %j").splitlines()
        [job] = {line.split()[0] for line in listed if " sierra-" in line}
        return job

    def node(self) -> str:
        """Return a node that executes an array task."""
        return self.slurm.command("squeue", "-h", "-r", "-t", "RUNNING", "-j", self.job(), "-o", "%N").split()[0]

    @property
    def project(self) -> Project:
        return sierra.open(self.root)

    def close(self) -> None:
        """Let the runs end, and end the sessions."""
        self.open()
        for asking in self.asked:
            asking.kill()
            asking.communicate()


def ended(process: subprocess.Popen[str], code: int = 0) -> str:
    """Wait for a command, check its exit code, and return its standard error."""
    out, err = process.communicate(timeout=200)
    assert "Traceback" not in err, err
    assert "fault in SIERRA" not in err, err
    assert process.returncode == code, out + err
    return err


def packed(root: Path, kind: type[Any]) -> list[Any]:
    """Return the events of one kind that array tasks have packed so far, in the sessions of a project."""
    packs = map(Pack, sorted(root.glob(".sierra/work/*/results/[0-9]*.pack")))
    return [event for pack in packs for event in pack.read() if isinstance(event, kind)]


def rows(project: Project, text: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = project.sql(text).to_pylist()
    return found


def is_whole(project: Project, runs: int = 8, executions: int | None = None) -> None:
    """Check that every run has one effective execution, no run was executed more often, and no session is left."""
    [found] = rows(project, "SELECT count(*) AS runs, count(*) FILTER (status = 'ok') AS good FROM runs")
    assert found == {"runs": runs, "good": runs}
    [found] = rows(project, "SELECT count(*) AS n, count(DISTINCT execution) AS d FROM executions WHERE purpose = 'run'")
    assert found == {"n": executions or runs, "d": executions or runs}
    assert [path for path in (project.root / ".sierra" / "work").iterdir() if path.is_dir()] == []


def at_rest(slurm: Slurm, project: Project) -> None:
    """Wait until no jobs and no processes are running."""
    until(lambda: set(slurm.states().values()) & {"PENDING", "RUNNING", "COMPLETING"} == set(), "no job is left")
    sessions = {row["session"] for row in rows(project, "SELECT DISTINCT session FROM executions")}
    until(lambda: not marked({f"SIERRA_SESSION={one}".encode() for one in sessions}), "no process is left")
