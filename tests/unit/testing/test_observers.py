"""The shipped ways to observe pass the conformance suite, and the suite detects violations."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.testing import observers as conformance
from sierra.worker.file_trace import LISTS, Observation, Trace, Way
from sierra.worker.observers import Maps, Strace
from tests.users import a_user, called_as

CLAIMS = [pytest.param(claim, id=claim.__name__) for claim in conformance.CLAIMS]


@pytest.mark.integration
@pytest.mark.parametrize("claim", CLAIMS)
@pytest.mark.parametrize("way", [Strace(), Maps()], ids=lambda way: way.name)
def test_it_observes(way: Way, claim: Callable[[conformance.Trial], None], tmp_path: Path, require: Callable[..., str]) -> None:
    if way.name == "strace":
        require("strace")
    claim(conformance.Trial(way, tmp_path))


@pytest.mark.integration
def test_it_observes_for_an_ordinary_user(require: Callable[..., str]) -> None:
    require("strace")
    require("root, to make a user", there=os.geteuid() == 0)
    require("useradd")
    require("/usr/bin/python3")
    with a_user(f"sierra-test-{os.getpid()}", ids=False) as user:
        for way in (Strace(), Maps()):
            called_as(user, lambda way=way: conformance.check(way, user.home / way.name, "/usr/bin/python3"))


class Boastful(Maps):
    """Claims to see what it does not see."""

    sees = LISTS


class Confident(Maps):
    """Says that its traces are complete."""

    def begin(self, log: str, cwd: str) -> Observation:
        observation = super().begin(log, cwd)
        observation.trace = lambda *_: Trace("maps")  # type: ignore[method-assign]
        return observation


class Interfering(Maps):
    """Starts the program by another one, which becomes its parent."""

    def begin(self, log: str, cwd: str) -> Observation:
        observation = super().begin(log, cwd)
        observation.prefixed = lambda argv, *_: ["/bin/sh", "-c", '"$@"; exit 0', "sh", *argv]  # type: ignore[method-assign]
        return observation


class Grasping(Maps):
    """Takes all processes for its tracer."""

    def begin(self, log: str, cwd: str) -> Observation:
        observation = super().begin(log, cwd)
        observation.is_tracer = lambda pid: True  # type: ignore[method-assign]
        return observation


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("way", "claim"),
    [
        (Boastful(), conformance.sees_each_kind_of_use),
        (Boastful(), conformance.is_complete_only_if_it_sees_all),
        (Confident(), conformance.is_complete_only_if_it_sees_all),
        (Confident(), conformance.sees_mapped_files),
        (Confident(), conformance.sees_descendants),
        (Confident(), conformance.leaves_errors_to_the_caller),
        (Interfering(), conformance.keeps_the_exit_status),
        (Interfering(), conformance.keeps_the_surroundings),
        (Interfering(), conformance.leaves_errors_to_the_caller),
        (Grasping(), conformance.knows_its_tracer),
    ],
)
def test_the_suite_detects_violations(way: Way, claim: Callable[[conformance.Trial], None], tmp_path: Path) -> None:
    with pytest.raises(AssertionError):
        claim(conformance.Trial(way, tmp_path))
