"""First runs on a real SLURM, which are timed if the duration of runs is unknown."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from sierra.execution.summary import Summary
from sierra.runners.cluster import sizing
from sierra.worker.result_log import Started
from tests.batches import packed
from tests.clusters import Slurm
from tests.conftest import Simulated
from tests.observers import Observing
from tests.waiting import until

PRINTS = r"printf 't,v\n1,1\n2,4\n' > swarm.csv"
ASKED = ("run", "size=1,2", "--runs", "12", "--on", "slurm", "--no-figures")
RUNS = 24
SECOND = """
import os, sys, sierra
from sierra.runners.schedulers.slurm import Slurm

submit = Slurm.submit

def once(self, request):
    if 0 not in request.elements:
        os._exit(9)
    return submit(self, request)

Slurm.submit = once
sierra.open(".").run("size=1,2", runs=12, runner="slurm", figures=False)
"""
"""A submitter that dies just before it submits the runs after the first ones."""


@pytest.fixture
def waiting(simulate: Callable[..., Simulated], slurm: Slurm, tmp_path: Path) -> Simulated:
    """Return a project whose runs wait until a gate file exists."""
    return simulate(f'while [ ! -e "{tmp_path}/gate" ]; do sleep 0.02; done; {PRINTS}')


def opened(project: Simulated) -> None:
    project.folder.with_name("gate").touch()


def sent(project: Simulated) -> list[list[int]]:
    """Return the array tasks of each submitted job, while the session exists."""
    [session] = project.work()
    files = sorted((session / "sent").glob("*.json"), key=lambda file: int(file.stem))
    return [json.loads(file.read_text())["elements"] for file in files]


def elements(project: Simulated) -> dict[int, int]:
    """Return the number of executed runs of each array task."""
    rows = project.sql("SELECT array_task, sum(runs) AS runs FROM attempts GROUP BY array_task ORDER BY array_task")
    return {row["array_task"]: int(row["runs"]) for row in rows}


def is_whole(project: Simulated) -> None:
    """Check that every run was executed once, with success."""
    assert project.sql("SELECT count(*) AS n FROM executions WHERE status = 'ok'") == [{"n": RUNS}]
    assert sorted(project.executed().values()) == [1] * RUNS
    assert project.work() == []


def asked(project: Simulated, say: Callable[[str], None] = lambda text: None) -> Summary:
    """Execute the batch in this process."""
    here = sierra.open(project.folder)
    return here.execute(here.plan("size=1,2", runs=12), runner="slurm", figures=False, observer=Observing(notice=say))


@pytest.mark.parametrize("runner", ["slurm", pytest.param("pbs", marks=pytest.mark.nightly)])
def test_the_first_and_last_run_are_timed_to_distribute_the_others(
    simulate: Callable[..., Simulated], slurm: Slurm, require: Callable[..., str], runner: str
) -> None:
    if runner == "pbs":
        require("qsub")
    project = simulate()
    first = project.quick("run", "size=1,2", "--runs", "12", "--on", runner, "--no-figures")
    assert first.returncode == 0, first.stderr
    assert "the duration of runs is not known yet: 2 runs of 24 are executed first" in first.stderr
    assert re.search(r"the first runs took [\d.]+ s: the other 22 runs are split into 1 array task \(", first.stderr)
    assert elements(project) == {0: 2, 1: 22}
    is_whole(project)
    joined = "attempts a JOIN executions USING (attempt) JOIN runs r USING (run)"
    pair = project.sql(f"SELECT r.size, r.number FROM {joined} WHERE a.array_task = 0 ORDER BY 1")
    assert [tuple(row.values()) for row in pair] == [(1, 0), (2, 11)]
    again = project.quick("run", "size=1,2", "--runs", "24", "--on", runner, "--no-figures")
    assert "are executed first" not in again.stderr


@pytest.mark.nightly
def test_runs_with_values_that_were_never_timed_go_first(simulate: Callable[..., Simulated], slurm: Slurm) -> None:
    project = simulate()
    project.quick("run", "size=1,2", "--runs", "2", "--no-figures")
    done = project.quick("run", "size=1,2,30,60", "--runs", "8", "--on", "slurm", "--no-figures")
    assert done.returncode == 0, done.stderr
    assert "runs with these values were never timed: 2 runs of 28 are executed first" in done.stderr
    joined = "attempts a JOIN executions USING (attempt) JOIN runs r USING (run)"
    pair = project.sql(f"SELECT r.size FROM {joined} WHERE a.array_task = 0 ORDER BY 1")
    assert [row["size"] for row in pair] == [30, 60]


@pytest.mark.nightly
def test_long_runs_are_distributed_to_many_array_tasks(
    simulate: Callable[..., Simulated], slurm: Slurm, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = simulate(f"sleep 0.4; {PRINTS}")
    monkeypatch.setattr(sizing, "ELEMENT_S", 1.0)
    assert asked(project).missing == 0
    took = (
        "SELECT avg(epoch(e.ended) - epoch(e.started)) AS s FROM executions e JOIN attempts USING (attempt) "
        "WHERE array_task = 0"
    )
    [first] = project.sql(took)
    assert first["s"] > 0.4
    assert len(elements(project)) - 1 == min(math.ceil((RUNS - 2) * first["s"]), RUNS - 2)
    is_whole(project)


@pytest.mark.nightly
def test_a_first_run_that_takes_as_long_as_an_array_task_is_not_waited_for(
    waiting: Simulated, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sizing, "ELEMENT_S", 1.0)
    said: list[str] = []

    def say(text: str) -> None:
        said.append(text)
        if "are split into 22 array tasks" in text:
            opened(waiting)

    asked(waiting, say)
    assert any("one of the first runs has not ended within 1 s" in text for text in said)
    assert elements(waiting) == {0: 2, **dict.fromkeys(range(1, 23), 1)}
    is_whole(waiting)


@pytest.mark.nightly
def test_first_runs_without_a_free_node_are_not_waited_for(
    waiting: Simulated, slurm: Slurm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sizing, "TIMEOUT_S", 1.0)
    slurm.command("scontrol", "update", f"nodename={','.join(slurm.names)}", "state=drain", "reason=test")
    said: list[str] = []

    def say(text: str) -> None:
        said.append(text)
        if "within 1 s: the other 22 runs are split into 16 array tasks" in text:
            slurm.command("scontrol", "update", f"nodename={','.join(slurm.names)}", "state=resume")
            opened(waiting)

    asked(waiting, say)
    assert any("no node was available for the first runs within 1 s" in text for text in said)
    assert len(elements(waiting)) == 17
    is_whole(waiting)


@pytest.mark.nightly
def test_the_other_runs_are_submitted_when_the_user_detaches(waiting: Simulated, slurm: Slurm) -> None:
    process = waiting.start(*ASKED)
    waiting.until_executed(1, process)
    process.send_signal(signal.SIGINT)
    told = waiting.end_of(process)
    assert told.returncode == 130
    assert "no process waits for the first runs: the other 22 runs are split into 16 array tasks" in told.stderr
    assert sent(waiting) == [[0], list(range(1, 17))]
    opened(waiting)
    assert waiting.quick(*ASKED).returncode == 0
    is_whole(waiting)


@pytest.mark.nightly
def test_no_runs_go_first_with_the_option_detach(waiting: Simulated, slurm: Slurm) -> None:
    told = waiting.quick(*ASKED, "--detach")
    assert "are executed first" not in told.stderr
    assert sent(waiting) == [list(range(16))]
    opened(waiting)
    assert waiting.quick(*ASKED).returncode == 0
    is_whole(waiting)


@pytest.mark.nightly
@pytest.mark.parametrize("between", ["ask", "status"])
def test_the_next_command_submits_the_runs_that_a_killed_submitter_held_back(
    waiting: Simulated, slurm: Slurm, between: str
) -> None:
    process = waiting.start(*ASKED)
    waiting.until_executed(1, process)
    process.kill()
    waiting.end_of(process)
    assert sent(waiting) == [[0]]
    if between == "status":
        told = json.loads(waiting.quick("status", "--json").stdout)
        assert sent(waiting) == [[0], list(range(1, 17))], told
    opened(waiting)
    done = waiting.quick(*ASKED)
    assert done.returncode == 0, done.stderr
    assert len(elements(waiting)) == {"ask": 2, "status": 17}[between]
    is_whole(waiting)


@pytest.mark.nightly
def test_a_submitter_may_die_between_distribution_and_submission(waiting: Simulated, slurm: Slurm) -> None:
    opened(waiting)
    died = subprocess.run([sys.executable, "-c", SECOND], cwd=waiting.folder, check=False, timeout=100)
    assert died.returncode == 9
    [session] = waiting.work()
    assert json.loads((session / "submission.json").read_text())["counts"] == [2, 22]
    (session / "sent" / "1.json").unlink()  # as if it had died before it wrote this file
    done = waiting.quick(*ASKED)
    assert done.returncode == 0, done.stderr
    is_whole(waiting)


@pytest.mark.nightly
def test_cancelling_during_the_first_runs_submits_no_more(waiting: Simulated, slurm: Slurm) -> None:
    process = waiting.start(*ASKED)
    waiting.until_executed(1, process)
    [batch] = {row["batch"] for row in json.loads(waiting.quick("status", "--json").stdout)}
    assert waiting.quick("cancel", batch[:10]).returncode == 0
    assert waiting.end_of(process).returncode == 130
    assert waiting.executed().total() == 1
    assert waiting.work() == []
    opened(waiting)
    until(lambda: set(slurm.states().values()) <= {"CANCELLED", "COMPLETED", "FAILED"}, "nothing runs")
    assert waiting.quick(*ASKED).returncode == 0
    assert waiting.sql("SELECT count(DISTINCT run) AS n FROM executions WHERE status = 'ok'") == [{"n": RUNS}]


@pytest.mark.nightly
def test_failed_first_runs_give_no_time_estimate(simulate: Callable[..., Simulated], slurm: Slurm) -> None:
    project = simulate("exit 7")
    done = project.quick(*ASKED)
    assert done.returncode == 1
    assert "the first runs have failed: the other 22 runs are split into 16 array tasks" in done.stderr
    assert sorted(project.executed().values()) == [1] * RUNS
    fast = simulate("exit 7", name="fast")
    assert fast.quick(*ASKED, "--fail-fast").returncode == 1
    assert fast.executed().total() - RUNS <= 2  # both projects log to one file


@pytest.mark.nightly
def test_a_controller_that_is_down_during_first_runs_loses_no_runs(waiting: Simulated, slurm: Slurm) -> None:
    process = waiting.start(*ASKED)
    waiting.until_executed(1, process)
    slurm.kill_controller(saved=True)
    opened(waiting)
    until(lambda: len(sent(waiting)) == 2, "the others are dealt out")
    time.sleep(1)  # no controller accepts them
    slurm.start_controller()
    done = waiting.end_of(process, 100)
    assert done.returncode == 0, done.stderr
    is_whole(waiting)


@pytest.mark.nightly
def test_first_runs_that_lose_their_node_are_executed_again(waiting: Simulated, slurm: Slurm) -> None:
    process = waiting.start(*ASKED)
    until(lambda: packed(waiting.folder, Started), "the element tells that a run has begun")
    [node] = slurm.command("squeue", "-h", "-r", "-t", "RUNNING", "-o", "%N").split()
    slurm.power_cut(node)
    slurm.declare_down(node)
    opened(waiting)
    slurm.release_requeued()
    assert waiting.end_of(process, 100).returncode == 0
    assert waiting.sql("SELECT count(*) AS n FROM executions WHERE status = 'ok'") == [{"n": RUNS}]
    assert waiting.executed().total() == RUNS + 1


@pytest.mark.nightly
def test_a_dry_run_reports_first_runs(simulate: Callable[..., Simulated], slurm: Slurm) -> None:
    project = simulate()
    told = project.quick(*ASKED, "-n", "--explain")
    assert re.search(
        r"^first runs +2 +the duration of runs is not known yet: measured by these runs$", told.stdout, re.MULTILINE
    )
    assert "#SBATCH --array=1-16" in told.stdout
    few = project.quick("run", "size=1,2", "--runs", "8", "--on", "slurm", "-n", "--explain")
    assert "first runs" not in few.stdout
