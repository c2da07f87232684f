"""A pretended fleet: a runner that executes the members of jobs as local processes, and a project whose runs take robots."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

import pytest
from pydantic import Field

from sierra.config.field_types import Table
from sierra.config.plugin_registry import RUNNERS
from sierra.errors import ConfigError
from sierra.model import Job, Member, OutputFile, Result
from sierra.runners.base import Look, Work
from sierra.store.layout import RUN_HOME, RUN_OUTPUT, RUN_STDERR, RUN_STDOUT, RUN_TMP, SessionPaths
from sierra.store.row_types import RobotRow, TrialRow
from sierra.util.processors import here
from sierra.worker.outputs import describe
from tests.waiting import PATIENCE_S

NAMES = ("tb3-00", "tb3-01", "tb3-02", "tb3-03", "tb3-04")
"""The names of the robots; the place decides which one it is."""
START_NS, SECOND = 1_700_000_000_000_000_000, 1_000_000_000

ROBOT = """\
import os, sys
text = open(sys.argv[1]).read()
seed = int(text.split('seed="')[1].split('"')[0])
place = int(sys.argv[2])
x = float(text.split('x="')[1].split('"')[0])
if os.environ["SIERRA_ROBOT"] != str(place) or place > int(os.environ["SIERRA_ROBOTS"]):
    sys.exit("wrong place")
if "silent" in sys.argv and place == 2:
    sys.exit()
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    for tick in range(4):
        print(tick, tick * place + x + seed % 10, sep=",", file=file)
"""
SIMULATOR = """\
import sys
text = open(sys.argv[1]).read()
seed = int(text.split('seed="')[1].split('"')[0])
count = int(text.split('count="')[1].split('"')[0])
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    for tick in range(4):
        print(tick, tick * (count + 1) / 2 + seed % 10, sep=",", file=file)
"""
TRACKER = 'open("tracking.csv", "w").write("tick,seen\\n0,1\\n")\n'
TEMPLATE = '<arena seed="0" count="1" x="0"/>\n'
CONFIG = """\
template = "arena.xml"
seed = "//@seed"
runs = 2
command = "python3 sim.py {input}"
target = "sim"
[variables]
population_size = "//@count"
[outputs.swarm]
file = "swarm.csv"
time = "tick"
[targets.sim]
[targets.robots]
runner = "pretend"
[targets.robots.robots]
count = "population_size"
command = "{python} robot.py {input} {robot}"
"""


def project(folder: Path, more: str = "", config: str = CONFIG) -> Path:
    """Make a project with a simulator and robots as targets; return its folder."""
    folder.mkdir()
    files = {"sim.py": SIMULATOR, "robot.py": ROBOT, "tracker.py": TRACKER, "arena.xml": TEMPLATE, "sierra.toml": config + more}
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


def register(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the runner `pretend` for one test."""
    monkeypatch.setitem(RUNNERS.shipped, "pretend", "tests.robots:Pretend")  # type: ignore[arg-type]


class PretendOptions(Table):
    """Options of the pretended fleet."""

    robots: int = Field(len(NAMES) - 1, description="number of robots")
    invalid: tuple[int, ...] = Field((), description="the trials, by their order from 0, that their operator calls invalid")


class Pretend:
    """The runner `pretend`: one run after the other, all its members at once, each in a folder of its own."""

    name = "pretend"
    stays = False
    remote = False
    Options: ClassVar[type[Table]] = PretendOptions

    def __init__(self, slots: int, options: PretendOptions) -> None:
        self._options = options
        self._jobs: Iterator[Job] = iter(())
        self._done = 0

    def check_robots(self, runs: Collection[Sequence[tuple[int, str]]], groups: Collection[str]) -> None:
        most = max(place for run in runs for place, _ in run)
        if most > self._options.robots:
            raise ConfigError(f"runs take {most} robots, but the fleet has {self._options.robots}")

    def robot_names(self, places: Sequence[tuple[int, str]]) -> Mapping[int, str]:
        return {place: NAMES[place] for place, _ in places}

    def submit(self, work: Work, session: SessionPaths) -> None:
        self._session, self._code = session, work.code
        self._jobs = iter(work.jobs)

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        raise NotImplementedError

    def look(self) -> Look:
        job = next(self._jobs, None)
        if job is None:
            return Look((), 0, alive=False)
        folder = self._session.runs / str(self._done)
        result, rows = _execute(job, folder, str(self._code))
        if self._done in self._options.invalid:
            mark = TrialRow(job.execution, datetime.now(UTC), valid=False, reason="fell over", operator="Ada")
            rows.append(("trials", mark._asdict()))
        self._done += 1
        return Look((result,), 0, alive=True, rows=tuple(rows))

    def leave(self) -> None:
        raise NotImplementedError

    def stop(self) -> None:
        self._jobs = iter(())

    def close(self) -> None:
        pass


def _execute(job: Job, folder: Path, code: str) -> tuple[Result, list[tuple[str, Mapping[str, Any]]]]:
    assert job.members
    assert job.argv == ()
    started = time.time()
    processes = [
        _start(one.at(str(folder / f"robot{one.place}"), code, here()), folder / f"robot{one.place}") for one in job.members
    ]
    codes = [process.wait(PATIENCE_S) for process in processes]
    (folder / RUN_OUTPUT).mkdir()
    for one in job.members:
        (folder / f"robot{one.place}" / RUN_OUTPUT).rename(folder / RUN_OUTPUT / str(one.place))
    for log in (RUN_STDOUT, RUN_STDERR):
        (folder / log).write_bytes(b"".join((folder / f"robot{one.place}" / log).read_bytes() for one in job.members))
    names = {one.place: NAMES[one.place] for one in job.members}
    rows = [("robots", _row(job, one, code)._asdict()) for one, code in zip(job.members, codes, strict=True)]
    result = Result(
        job.run, job.execution, str(folder), started, time.time(), max(codes), None, None, 0.0, 0.0, 0, "lab-host-7", 0,
        tuple(_outputs(folder / RUN_OUTPUT)), robots=names,
    )  # fmt: skip
    return result, rows


def _start(member: Member, folder: Path) -> subprocess.Popen[bytes]:
    for name in (RUN_OUTPUT, RUN_HOME, RUN_TMP):
        (folder / name).mkdir(parents=True)
    for name, content in member.files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    environment = {"PATH": os.environ["PATH"], **member.environment}
    with (folder / RUN_STDOUT).open("wb") as out, (folder / RUN_STDERR).open("wb") as err:
        return subprocess.Popen(member.argv, cwd=folder / RUN_OUTPUT, env=environment, stdout=out, stderr=err)


def _row(job: Job, one: Member, code: int) -> RobotRow:
    """Return the record of a robot whose clock is `place` seconds ahead, and runs fast by as many parts in a million."""
    return RobotRow(
        execution=job.execution,
        place=one.place,
        robot_group=one.group,
        robot=NAMES[one.place],
        status="ok" if code == 0 else "failed",
        host=f"{NAMES[one.place]}.lan",
        boot_id=f"boot-of-{NAMES[one.place]}",
        battery_start=90.0,
        battery_end=88.5,
        offset_start_ns=one.place * SECOND,
        offset_end_ns=one.place * SECOND + one.place * 10_000,
        clock_start_ns=START_NS,
        clock_end_ns=START_NS + 10 * SECOND,
        rtt_ns=2_000_000,
        exit_code=code,
        uneven_ns=one.place * 1_000,
    )


def _outputs(folder: Path) -> Iterator[OutputFile]:
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            yield OutputFile(**describe(str(path), str(path.relative_to(folder))))
