"""The shipped runners pass the conformance suite, also over a real SLURM, and the suite detects violations."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sierra import runners
from sierra.config.cluster_table import ClusterTable
from sierra.model import Job, Limits, Result
from sierra.runners.base import Look, Runner, Work
from sierra.runners.cluster.runner import Cluster
from sierra.runners.local import Local
from sierra.store.layout import SessionPaths
from sierra.testing import runners as conformance
from sierra.testing.runners import Ordeal
from tests import clusters, pbs
from tests.waiting import until

TABLE: dict[str, Any] = {"array_tasks": 2, "cpus": 2}


def local(slots: int) -> Runner:
    return Local(slots)


def cluster(name: str) -> Callable[[int], Runner]:
    return runners.find(name, {name: TABLE})


@pytest.mark.integration
def test_the_runner_local_conforms(tmp_path: Path) -> None:
    conformance.check_runner(local, tmp_path)


@pytest.mark.real
@pytest.mark.integration
@pytest.mark.parametrize("name", ["slurm", "pbs"])
def test_cluster_runners_over_slurm_conform(
    name: str, slurm: clusters.Slurm, tmp_path: Path, require: Callable[..., str]
) -> None:
    if name == "pbs":
        require("qsub")
    conformance.check_runner(cluster(name), tmp_path)


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[pbs.Server]:
    """Yield a PBS server that commands on the PATH use; the home folder is separate."""
    (tmp_path / "home").mkdir()
    made = pbs.Server(tmp_path / "server")
    monkeypatch.setenv("PATH", f"{made.bin}:{os.environ['PATH']}")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    yield made
    made.end()


@pytest.mark.nightly
def test_the_runner_pbs_conforms(server: pbs.Server, tmp_path: Path) -> None:
    (tmp_path / "trials").mkdir()
    conformance.check_runner(cluster("pbs"), tmp_path / "trials")


class Changed(Local):
    """A runner that changes the jobs that it executes."""

    def submit(self, work: Work, session: SessionPaths) -> None:
        super().submit(replace(work, jobs=map(self.changed, work.jobs)), session)

    def changed(self, job: Job) -> Job:
        return job


class Leaking(Changed):
    """Passes on the caller's environment."""

    def changed(self, job: Job) -> Job:
        return replace(job, environment={**os.environ, **job.environment})


class Splitting(Changed):
    """Interprets a command as a line of a shell."""

    def changed(self, job: Job) -> Job:
        return replace(job, argv=("sh", "-c", " ".join(job.argv).replace("\0", "$SIERRA_RUN_DIR")))


class Lenient(Changed):
    """Enforces no limits."""

    def changed(self, job: Job) -> Job:
        return replace(job, limits=Limits())


class Retold(Local):
    """A runner that reports runs incorrectly."""

    def look(self) -> Look:
        look = super().look()
        return replace(look, results=tuple(self.told(list(look.results))))

    def told(self, results: list[Result]) -> list[Result]:
        return results


class Repeating(Retold):
    """Reports each run twice."""

    def told(self, results: list[Result]) -> list[Result]:
        return results * 2


class Hopeful(Retold):
    """Reports no failure."""

    def told(self, results: list[Result]) -> list[Result]:
        return [replace(result, exit_code=0) for result in results]


class Careless(Retold):
    """Does not hash outputs."""

    def told(self, results: list[Result]) -> list[Result]:
        outputs = [tuple(replace(file, sha256="0" * 64) for file in result.outputs) for result in results]
        return [replace(result, outputs=files) for result, files in zip(results, outputs, strict=True)]


class Slow(Local):
    """Waits during a query."""

    def look(self) -> Look:
        time.sleep(0.5)
        return super().look()


class Deaf(Local):
    """Cannot be stopped."""

    def stop(self) -> None: ...


class Hasty(Deaf):
    """Reports its end as soon as it is stopped."""

    stopped = False

    def stop(self) -> None:
        self.stopped = True

    def look(self) -> Look:
        return replace(super().look(), alive=not self.stopped)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("runner", "claim", "complaint"),
    [
        (Leaking, conformance.gives_exactly_the_jobs_environment, "the variables differ from the job's"),
        (Splitting, conformance.gives_what_the_job_has, "became|other|unpack|differs from the job's"),
        (Lenient, conformance.keeps_the_time_limit, "the session does not end"),
        (Repeating, conformance.executes_each_job_once, "14 results of 7 executions"),
        (Hopeful, conformance.tells_how_each_ended, "exit status 3 became"),
        (Careless, conformance.keeps_what_runs_leave, "differs from its reported size or hash"),
        (Slow, conformance.looks_at_once, r"look\(\) took"),
        (Deaf, conformance.ends_when_stopped, "the session does not end"),
        (Hasty, conformance.ends_when_stopped, "are still running"),
    ],
)
def test_the_suite_detects_violations_of_its_claims(
    runner: type[Local], claim: Callable[[Ordeal], None], complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if runner in (Lenient, Deaf, Hasty):  # the suite waits for an event that never happens
        monkeypatch.setattr(conformance, "PATIENCE_S", 8.0)
    monkeypatch.setattr(conformance, "AT_ONCE_S", 0.4)
    ordeal = Ordeal(lambda slots: runner(slots, ClusterTable()), tmp_path)
    with pytest.raises(AssertionError, match=complaint):
        claim(ordeal)
    (ordeal.begun[-1].shared / "go").touch()
    left = ordeal.begun[-1].runner
    assert isinstance(left, Local)
    Local.stop(left)
    until(lambda: not Local.look(left).alive, "what was to end has ended")


class Forgetful(Cluster):
    """A runner that ignores its record."""

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        super().resume(session, {})


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("runner", "claim", "complaint"),
    [
        (Forgetful, conformance.goes_on_for_another, "expected the results of 2 other runs, but got"),
        (Cluster, conformance.ends_with_its_process, "are still running"),
    ],
)
def test_the_suite_detects_violations_of_runners_that_detach(
    runner: type[Cluster],
    claim: Callable[[Ordeal], None],
    complaint: str,
    server: pbs.Server,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if runner is Cluster:  # the suite waits for an event that never happens
        monkeypatch.setattr(conformance, "PATIENCE_S", 20.0)
    (tmp_path / "trials").mkdir()
    ordeal = Ordeal(lambda slots: runner(slots, ClusterTable(**TABLE), name="pbs", scheduler="pbs"), tmp_path / "trials")
    with pytest.raises(AssertionError, match=complaint):
        claim(ordeal)
    ordeal.close()
