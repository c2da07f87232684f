"""Conformance suite for runners that execute runs on robots, in addition to `sierra.testing.runners`.

    from sierra.testing import robots as conformance

    def test_it_is_a_runner_for_robots(tmp_path):
        conformance.check(lambda: MyRunner(1, MyOptions()), tmp_path)

The runner needs a fleet with at least one robot. A broken claim raises AssertionError with one line.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable
from pathlib import Path

from sierra.containers.engines.apptainer import Apptainer
from sierra.containers.engines.base import ContainerSpec
from sierra.containers.engines.hosts import OtherHost
from sierra.containers.images.image import Image, Kind
from sierra.containers.on_hosts import HostContainer, HostContainers, Prepared
from sierra.errors import Missing, SierraError
from sierra.model import Job, Limits, Member
from sierra.provenance import environment
from sierra.runners.base import ContainsMembers, NamesRobots, Runner, RunsMembers, Work
from sierra.store.layout import SessionPaths
from sierra.testing.assertions import holds

PATIENCE_S = 60.0
POLL_S = 0.05
REASON = "this suite has no containers"


def check(make: Callable[[], Runner], folder: Path) -> None:
    """Check all claims. `make` makes a new runner for each claim; `folder` is empty, and on this machine."""
    for number, claim in enumerate((executes_runs_on_robots, names_its_robots, executes_nothing_beside_containers)):
        own = folder / str(number)
        own.mkdir()
        claim(make(), own)


def executes_runs_on_robots(runner: Runner, folder: Path) -> None:
    """Check that a runner says that it executes the members of runs."""
    holds(isinstance(runner, RunsMembers), f"{runner.name} has no check_robots: it is not a runner for robots")


def names_its_robots(runner: Runner, folder: Path) -> None:
    """Check that a runner that can name its robots names one for each place."""
    if isinstance(runner, NamesRobots):
        names = runner.robot_names([(1, "robot")])
        holds(set(names) == {1} and bool(names[1]), f"robot_names() of place 1 returns {names!r}")


def executes_nothing_beside_containers(runner: Runner, folder: Path) -> None:
    """Check that a runner for containers executes nothing on a robot where these cannot be had.

    A runner that does not claim `contains_members` gets no such runs.
    """
    if not (isinstance(runner, ContainsMembers) and runner.contains_members):
        return
    session = SessionPaths(folder / secrets.token_hex(8))
    session.root.mkdir()
    containers = _NoContainers()
    began = folder / "began"
    try:
        runner.submit(Work(iter([_job(began)]), 1, "0" * 64, around=environment.capture("0"), containers=containers), session)
        results, wrong = _followed(runner)
    except SierraError as error:
        results, wrong = 0, error
    finally:
        runner.close()
    holds(containers.requested, "it has not requested the containers of Work.containers")
    holds(not began.exists() and results == 0, "the program was executed on the robot itself, without its container")
    holds(wrong is not None and REASON in str(wrong), f"the reason ({REASON}) is not reported, but {wrong}")


def _job(began: Path) -> Job:
    """Return a run of one robot, whose program makes a file; a robot on another machine makes it there."""
    argv = ("sh", "-c", 'mkdir -p "$(dirname "$0")"; : > "$0"', str(began))
    member = Member(1, "robot", argv, {"PATH": os.defpath, "SIERRA_ROBOT": "1", "SIERRA_ROBOTS": "1"}, ())
    return Job("1" * 64, "2" * 64, (), {}, (), Limits(wall_s=PATIENCE_S), members=(member,))


def _followed(runner: Runner) -> tuple[int, SierraError | None]:
    """Return the number of results of a session, and the error that ended it."""
    results, give_up = 0, time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up:
        seen = runner.look()
        results += len(seen.results)
        if not seen.alive:
            return results, seen.wrong
        time.sleep(POLL_S)
    raise AssertionError("a run that cannot execute in its container has no end")


class _NoContainers(HostContainers):
    """Containers that no host can have."""

    def __init__(self) -> None:
        image = Image("suite", f"squashfs:{'0' * 64}", Kind.SQUASHFS, "", (), {})
        super().__init__(Apptainer(), ContainerSpec(image, "", ""), image, lambda one: Prepared(one, Path(one.name), "", ""))
        self.requested = False

    def on(self, host: OtherHost) -> HostContainer:
        self.requested = True
        raise Missing(REASON)
