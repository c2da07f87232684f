"""The shipped schedulers pass the conformance suite over a real SLURM, and the suite detects violations."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from sierra.config.cluster_table import ClusterTable
from sierra.runners import schedulers
from sierra.runners.schedulers.base import Request, State, Task
from sierra.runners.schedulers.slurm import Slurm
from sierra.testing import runners
from sierra.testing.runners import Trial
from tests import clusters
from tests.users import a_user, called_as

pytestmark = pytest.mark.real


@pytest.mark.each_case
@pytest.mark.parametrize("name", ["slurm", "pbs"])
def test_shipped_schedulers_conform_over_slurm(
    name: str, slurm: clusters.Slurm, tmp_path: Path, require: Callable[..., str]
) -> None:
    if name == "pbs":
        require("qsub")
    runners.check(schedulers.find(name)(ClusterTable()), tmp_path)


@pytest.mark.nightly
def test_slurm_conforms_for_a_user_without_privileges(slurm: clusters.Slurm, require: Callable[..., str]) -> None:
    require("useradd")
    with a_user(f"sierra-test-{os.getpid()}", ids=False) as user:

        def check() -> None:
            os.environ.update(slurm.environment)
            (user.home / "trials").mkdir()
            runners.check(Slurm(ClusterTable()), user.home / "trials")

        called_as(user, check)


class Splitting(Slurm):
    """A scheduler that interprets a command as a line of a shell."""

    def submit(self, request: Request) -> str:
        return super().submit(replace(request, command=("sh", "-c", " ".join(request.command))))


class Counting(Slurm):
    """A scheduler that counts array tasks from 0, for any indices."""

    def submit(self, request: Request) -> str:
        return super().submit(replace(request, elements=tuple(range(len(request.elements)))))


class Leaking(Slurm):
    """A scheduler whose scripts contain a secret."""

    def script(self, request: Request) -> str:
        return super().script(request) + f"# {os.environ.get(runners.CANARY)}\n"


class Forgetting(Slurm):
    """A scheduler that does not find its submitted jobs."""

    def look(self, name: str) -> tuple[Task, ...] | None:
        return ()


class Remembering(Slurm):
    """A scheduler that reports ended tasks as queued."""

    def look(self, name: str) -> tuple[Task, ...] | None:
        return tuple(replace(task, state=State.QUEUED) for task in super().look(name) or ())


class Ruthless(Slurm):
    """A scheduler that cancels all array tasks instead of some."""

    def cancel(self, name: str, elements: Sequence[int] | None = None) -> None:
        super().cancel(name)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("scheduler", "claim", "complaint"),
    [
        (Splitting, runners.passes_words_as_they_are, "became|No such file"),
        (Counting, runners.executes_each_element_once, "executed: "),
        (Leaking, runners.says_what_it_hands_over, "environment"),
        (Forgetting, runners.finds_jobs_by_name, "not found immediately"),
        (Remembering, runners.may_be_looked_at_after_the_end, "does not end"),
        (Ruthless, runners.cancels_some, "after array task 1 was cancelled"),
    ],
)
def test_the_suite_detects_violations_of_its_claims(
    scheduler: type[Slurm],
    claim: Callable[[Trial], None],
    complaint: str,
    slurm: clusters.Slurm,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if scheduler is Remembering:
        monkeypatch.setattr(runners, "PATIENCE_S", 4.0)
    with pytest.raises((AssertionError, FileNotFoundError), match=complaint):
        claim(Trial(scheduler(ClusterTable()), tmp_path))
