"""Runs of a small program on robots, through the runner `robots`, without the rest of SIERRA."""

from __future__ import annotations

import hashlib
import itertools
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sierra.extensions.robots.fleet_table import FleetTable
from sierra.extensions.robots.runner import MakeLink, Robots
from sierra.model import ON_ROBOT, Job, Limits, Member, Result
from sierra.provenance import environment
from sierra.runners.base import Look, Work
from sierra.store.layout import SessionPaths
from tests.waiting import PATIENCE_S, until

CODE = f"{ON_ROBOT}/go.py"
RECORD = environment.capture("1.0")
GO = """
import os, signal, sys, time
place = os.environ["SIERRA_ROBOT"]
mine = sys.argv[1:]
action, _, gate = (mine[mine.index(place) + 1] if place in mine else "0").partition("@")
print("robot", place, flush=True)
if action == "deaf":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
if action in ("deaf", "loud"):
    print("x" * (10 << 20), flush=True)
if action == "writes":
    open("much.bin", "wb").write(os.urandom(8 << 20))
if action == "forks" and os.fork() == 0:
    while os.fork() == 0:
        os.setsid()
        time.sleep(0.001)
    os._exit(0)
with open("here.part", "w") as file:
    file.write(f"time,robot\\n0,{place}\\n")
os.rename("here.part", "here.csv")  # all of the above is done
time.sleep({"nap": 5, "1s": 1}.get(action, 0.4 if action.isdigit() or action == "writes" else 3600))
while gate and not os.path.exists(gate):
    time.sleep(0.02)
sys.exit(int(action) if action.isdigit() else 0)
"""
"""A program that is ready when here.csv is there. It ends with the status `7`, or with `7@PATH` when the path is there."""


_numbers = itertools.count()


class Runs:
    """Runs on robots, and what their runner reports. `homes` are the robots' home folders, as seen from here."""

    def __init__(self, folder: Path, homes: Mapping[str, Path], make_link: MakeLink, **options: Any) -> None:
        self.homes = homes
        self.make_link = make_link
        fleet = {name: {"host": name} for name in homes}
        own = {"fleet": fleet, "stop": ["touch", "stopped"], "grace": 0.3, "disk_min": 1, "clock_error": 1.0}
        self.table = FleetTable(**{**own, **options})
        self.session = SessionPaths(folder / f"session{next(_numbers) % 10}")
        self.code = folder / "code"
        self.code.mkdir(exist_ok=True)
        (self.code / "go.py").write_text(GO)
        self.rows: list[tuple[str, Mapping[str, Any]]] = []
        self.notes: list[str] = []
        self.session.root.mkdir(exist_ok=True)

    def submit(self, *jobs: Job) -> Robots:
        runner = Robots(1, self.table, self.make_link)
        self.start(runner, *jobs)
        return runner

    def start(self, runner: Robots, *jobs: Job) -> None:
        runner.submit(Work(jobs, len(jobs), "b" * 64, around=RECORD, record=("GREETING*",), code=self.code), self.session)

    def run(self, *jobs: Job) -> list[Result]:
        return self.follow(self.submit(*jobs))

    def follow(self, runner: Robots, seconds: float = PATIENCE_S) -> list[Result]:
        """Return the results of a runner that was started. Raises its error."""
        results: list[Result] = []
        give_up = time.monotonic() + seconds
        while True:
            look = self.take(runner)
            results += look.results
            if look.wrong:
                runner.close()
                raise look.wrong
            if not look.alive:
                runner.close()
                return results
            assert time.monotonic() < give_up
            time.sleep(0.01)

    def take(self, runner: Robots) -> Look:
        look = runner.look()
        self.rows += look.rows
        self.notes += look.notes
        return look

    def begun(self) -> list[str]:
        """Return the robots on which the program has begun."""
        return [name for name, home in self.homes.items() if list(home.rglob("here.csv"))]

    def all_begun(self) -> None:
        """Wait until the program has begun on all robots, in the only run of which files are there."""
        until(lambda: len(self.begun()) == len(self.homes), "all have begun")

    @property
    def rows_by_place(self) -> dict[int, Mapping[str, Any]]:
        return {row["place"]: row for table, row in self.rows if table == "robots"}


def execution_of(number: int) -> str:
    """Return the id of the execution of a run of this test. Agents end all processes that have the id of a leftover run."""
    test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" (")[0]
    return hashlib.sha256(f"{os.getpid()} {test} {number}".encode()).hexdigest()


def job(number: int, *words: str, robots: int = 3, base: bool = False, python: str = "python3") -> Job:
    """Return a run of GO. `words` are pairs of a place and its action: an exit status, a word that GO knows."""
    execution = execution_of(number)
    places = range(0 if base else 1, robots + 1)
    own = {"SIERRA_EXECUTION": execution, "SIERRA_ROBOTS": str(robots), "HOME": "\0/home"}
    members = tuple(
        Member(
            place,
            "robot" if place else "base",
            (python, CODE, *words),
            {**own, "SIERRA_ROBOT": str(place)},
            (("input.txt", b"1"),),
        )
        for place in places
    )
    return Job(f"{number:064d}", execution, (), {}, (), Limits(wall_s=3600), members=members)
