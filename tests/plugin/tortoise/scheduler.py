"""The scheduler `spool`: array tasks are processes of this machine, and their states are files in a folder.

It is as small as a scheduler can be. A real one calls the commands of a batch system. The files of a job are in
`SPOOL/NAME/JOB`: `script`, `elements`, and for each array task `N.pid` (it has begun), `N.ended` (its exit status) and
`N.cancelled`.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shlex
import signal
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from sierra.plugin import Bounds, ClusterTable, Missing, Request, State, Task

LAUNCH = """
wait_for() { while kill -0 "$(cat "$1.pid")" 2>/dev/null && ! test -e "$1.ended"; do sleep 0.1; done; }
echo $$ > "$1/$2.pid.new" && mv "$1/$2.pid.new" "$1/$2.pid"
for before in $(cat "$4/elements" 2>/dev/null); do
    while ! test -e "$4/$before.pid"; do sleep 0.1; done
    wait_for "$4/$before"
    test "$(cat "$4/$before.ended" 2>/dev/null)" = 0 || exit 1
done
test -e "$1/$2.cancelled" && exit 1
sh "$1/script" "$2" >> "$3" 2>&1
echo $? > "$1/$2.ended.new" && mv "$1/$2.ended.new" "$1/$2.ended"
"""
"""Executes one array task: folder of the job, index, log, folder of the job that must end before it (or nothing)."""


class SpoolTable(ClusterTable):
    """A cluster that consists of this machine."""

    spool: str = Field(pattern="^/", description="folder for the states of jobs; it must exist")
    niceness: int = Field(0, ge=0, le=19, description="how far elements give way to other programs")


class Spool:
    """The scheduler `spool`."""

    name = "spool"
    contract = 1
    Options: ClassVar[type[ClusterTable]] = SpoolTable
    requeue: tuple[str, ...] = ()
    forgets = False

    def __init__(self, table: SpoolTable) -> None:
        self._table = table

    @staticmethod
    def refuses(line: str) -> str | None:
        name = line.split("=")[0].strip()
        if name == "--array":
            return "use array_tasks = N"
        return None if name.startswith("--note") else "spool knows only --note=TEXT"

    def version(self) -> str:
        return "spool 1"

    def bounds(self) -> Bounds:
        return Bounds()

    def script(self, request: Request) -> str:
        command = " ".join(map(shlex.quote, ("nice", "-n", str(self._table.niceness), *request.command)))
        notes = [f"#SPOOL {line}" for line in self._table.directives]
        return "\n".join(["#!/bin/sh", *notes, f"cd {shlex.quote(str(request.folder))} || exit 3", f'exec {command} "$1"', ""])

    def submit(self, request: Request) -> str:
        job = secrets.token_hex(6)
        folder = self._named(request.name) / job
        try:
            folder.mkdir(parents=True)
            (folder / "script").write_text(self.script(request))
            (folder / "elements").write_text("\n".join(map(str, request.elements)))
        except OSError as error:
            raise Missing(f"{folder}: {error.strerror}; spool = must name a folder where you can write") from error
        before = self._named_job(request.after)
        for index in request.elements:
            log = request.logs / f"{job}_{index}.out"
            words = ("setsid", "--fork", "sh", "-c", LAUNCH, "sh", str(folder), str(index), str(log), before)
            subprocess.run(words, stdin=subprocess.DEVNULL, env={"PATH": os.defpath}, check=True)
        return job

    def look(self, name: str) -> tuple[Task, ...] | None:
        return tuple(self._tasks(name)) if self._table_is_there() else None

    def explain(self, words: str) -> str:
        return f"{words}: see [runners.…] spool"

    def cancel(self, name: str, elements: Sequence[int] | None = None) -> None:
        for task in self._tasks(name):
            if task.state is not State.ENDED and (elements is None or task.element in elements):
                element = self._named(name) / task.job / str(task.element)
                element.with_suffix(".cancelled").touch()
                if (pid := _pid(element)) is not None:
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(pid, signal.SIGTERM)

    def _tasks(self, name: str) -> Iterator[Task]:
        for listed in sorted(self._named(name).glob("*/elements")):
            for index in listed.read_text().split():
                element = listed.with_name(index)
                state = _state(element)
                cancelled = element.with_suffix(".cancelled").exists() if state is State.ENDED else None
                yield Task(listed.parent.name, int(index), state, node="here", cancelled=cancelled)

    def _named(self, name: str) -> Path:
        return Path(self._table.spool, name)

    def _named_job(self, job: str) -> str:
        """Return the folder of a job; an empty text if no job is meant."""
        return next((str(path) for path in Path(self._table.spool).glob(f"*/{job}")), "") if job else ""

    def _table_is_there(self) -> bool:
        return Path(self._table.spool).is_dir()


def _state(element: Path) -> State:
    if element.with_suffix(".ended").exists():
        return State.ENDED
    pid = _pid(element)
    if pid is None:
        return State.ENDED if element.with_suffix(".cancelled").exists() else State.QUEUED
    return State.RUNNING if _is_alive(pid) else State.ENDED


def _pid(element: Path) -> int | None:
    with contextlib.suppress(OSError, ValueError):
        return int(element.with_suffix(".pid").read_text())
    return None


def _is_alive(group: int) -> bool:
    """Return True if a process of this group still runs. Its first process may have ended before the others."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, found = stat.read_text().rpartition(")")[2].split()[:3]
            if int(found) == group and state not in "ZX":
                return True
    return False
