"""More faults on a real SLURM: memory, disks, clocks, time limits, preemption, locks, and submitters."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sierra.worker.processes import marked
from sierra.worker.result_log import Finished, Requeued
from tests import clusters, projects
from tests.batches import WAITING, Gated, at_rest, ended, is_whole, packed, rows
from tests.clusters import Slurm
from tests.waiting import until

pytestmark = pytest.mark.nightly

ASK = ("population_size.Log8", "--on", "slurm", "--no-figures")
HUNGRY = """\
import sys, time
import xml.etree.ElementTree as ET

count = int(ET.parse(sys.argv[1]).getroot().find("swarm").get("count"))
with open({log!r}, "a") as log:
    print(count, file=log, flush=True)
if count == 4:
    eaten = b"1" * 400_000_000
    time.sleep(6)
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    print(0, count, sep=",", file=file)
"""
"""A simulator that takes far more memory than others for some of its inputs."""

LARGE = """\
import os

with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    print(0, 1, sep=",", file=file)
with open("noise", "wb") as file:
    file.write(os.urandom(1_000_000))
with open({log!r}, "a") as log:
    print(os.environ["SIERRA_RUN_ID"], file=log, flush=True)
"""
"""A simulator with large outputs."""


def why(gated: Gated) -> str:
    """Return the output of `sierra why` for the last batch."""
    done = projects.sierra(gated.root, "why", gated.project.batches[-1].batch)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def gate(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Callable[..., Gated]]:
    """Yield a function that makes a project whose runs wait for a gate; `table` extends its settings of the cluster."""
    made: list[Gated] = []

    def gate(table: str = "", *, on: Slurm | None = None, root: Path = tmp_path / "project", simulator: str = WAITING) -> Gated:
        made.append(Gated.make(root, on or request.getfixturevalue("slurm"), table, simulator=simulator))
        return made[-1]

    yield gate
    for one in made:
        one.close()


@pytest.fixture
def start(require: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Slurm]]:
    """Yield a function that starts a separate cluster."""
    clusters.needed(require)
    with contextlib.ExitStack() as stack:

        def start(**more: Any) -> Slurm:
            cluster = stack.enter_context(Slurm(stack.enter_context(clusters.folder()), **more))
            for name, value in cluster.environment.items():
                monkeypatch.setenv(name, value)
            return cluster

        yield start


@pytest.fixture
def instead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Return a function that replaces a program by a script for one of its calls; `"$real"` is the program."""

    def instead(name: str, script: str, call: int = 1) -> Path:
        folder = tmp_path / "programs"
        folder.mkdir()
        count = f'call=1; until mkdir "{folder}/call $call" 2>/dev/null; do call=$((call + 1)); done'
        passed = f'[ "$1" != --version ] || exec "$real" "$@"; {count}; [ "$call" -eq {call} ] || exec "$real" "$@"'
        (folder / name).write_text(f"#!/bin/sh\nreal={shutil.which(name)}\n{passed}\n{script}\n")
        (folder / name).chmod(0o755)
        monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # force a probe
        return folder / f"call {call}"

    return instead


WATCHED = {
    "JobAcctGatherType": "jobacct_gather/linux",
    "JobAcctGatherFrequency": "1",
    "JobAcctGatherParams": "OverMemoryKill",
    "SelectTypeParameters": "CR_CPU_Memory",
}
"""Settings of a SLURM that kills tasks over their requested memory."""


def test_only_runs_over_their_memory_limit_fail_on_a_node(gate: Callable[..., Gated]) -> None:
    gated = gate('[limits]\nmemory = "200 MB"\n', simulator=HUNGRY)
    told = ended(gated.ask(), 1)
    assert "Traceback" not in told
    found = rows(gated.project, "SELECT status, reason, count(*) AS n FROM executions GROUP BY ALL ORDER BY status")
    assert [(row["status"], row["n"]) for row in found] == [("memory", 2), ("ok", 6)]
    assert rows(gated.project, "SELECT count(*) AS n FROM attempts") == [{"n": 3}]
    at_rest(gated.slurm, gated.project)


def test_runs_that_slurm_kills_for_their_memory_fail_and_others_complete(
    gate: Callable[..., Gated], start: Callable[..., Slurm]
) -> None:
    gated = gate('memory = "200 MB"\nattempts = 2\n', on=start(settings=WATCHED), simulator=HUNGRY)
    told = ended(gated.ask(), 1)
    assert "cut off 2 times" in told
    found = rows(
        gated.project, "SELECT status, min(reason) AS reason, count(*) AS n FROM executions GROUP BY status ORDER BY status"
    )
    assert [row["status"] for row in found] == ["failed", "ok"]
    assert [row["n"] for row in found] == [2, 6]
    said = ("Exceeded job memory limit", "exceeded memory limit (")  # slurmd writes both, in any order
    assert any(words in found[0]["reason"] for words in said)
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text().replace('memory = "200 MB"', 'memory = "2 GB"'))
    ended(gated.ask())
    is_whole(gated.project, executions=10)
    at_rest(gated.slurm, gated.project)


def test_a_run_that_ends_its_array_task_is_identified_and_the_others_complete(
    gate: Callable[..., Gated], start: Callable[..., Slurm]
) -> None:
    slow = HUNGRY.replace("if count == 4:", "time.sleep(1 + count)\nif count == 4:")
    gated = gate('memory = "300 MB"\nattempts = 2\ncpus = 4\n', on=start(settings=WATCHED), simulator=slow)
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text().replace("array_tasks = 3", "array_tasks = 1"))
    told = ended(gated.ask("population_size.Log8", "--runs", "1"), 1)
    assert "may have caused its end: executed one by one now" in told
    found = rows(gated.project, "SELECT e.status, reason FROM executions e JOIN runs USING (run) ORDER BY population_size")
    assert [row["status"] for row in found] == ["ok", "ok", "failed", "ok"], found
    assert "cut off 2 times" in found[2]["reason"]
    begun = [int(one) for one in gated.begun()]
    assert begun.count(4) == 2
    assert begun.index(8) != len(begun) - 1
    at_rest(gated.slurm, gated.project)


def test_a_full_disk_of_a_node_is_reported_and_free_space_completes_the_batch(
    gate: Callable[..., Gated], start: Callable[..., Slurm], disk: Callable[[Path, str], Path], tmp_path: Path
) -> None:
    scratch = disk(tmp_path / "node's own", "500k")
    gated = gate(f'scratch = "{scratch}"\nattempts = 2\n', on=start(), simulator=LARGE)
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text().replace("array_tasks = 3", "array_tasks = 1"))
    told = ended(gated.ask(), 3)
    assert "ended before any of its runs ended: n1: " in told
    assert "No space left on device" in told
    assert len([line for line in told.splitlines() if line.startswith("sierra:")]) == 1
    assert rows(gated.project, "SELECT * FROM executions") == []
    disk(scratch, "100m")
    ended(gated.ask())
    is_whole(gated.project)
    at_rest(gated.slurm, gated.project)
    assert list(scratch.iterdir()) == []


def test_a_full_shared_disk_is_reported_and_free_space_completes_the_batch(
    gate: Callable[..., Gated], start: Callable[..., Slurm], disk: Callable[[Path, str], Path], tmp_path: Path
) -> None:
    shared = disk(tmp_path / "shared", "5m")
    gated = gate("attempts = 2\n", on=start(), root=shared / "project", simulator=LARGE)
    told = ended(gated.ask(), 3)
    assert len([line for line in told.splitlines() if line.startswith("sierra:")]) == 1
    disk(shared, "100m")
    ended(gated.ask())
    is_whole(gated.project)
    at_rest(gated.slurm, gated.project)


def test_a_disk_that_is_full_during_recording_loses_no_results(
    gate: Callable[..., Gated], start: Callable[..., Slurm], disk: Callable[[Path, str], Path], tmp_path: Path
) -> None:
    shared = disk(tmp_path / "shared", "20m")
    gated = gate(on=start(), root=shared / "project")
    ended(gated.ask(*ASK[:1], "--detach"))
    gated.until_begun(3)
    gated.open()
    until(lambda: set(gated.slurm.states().values()) == {"COMPLETED"}, "all is executed")
    with contextlib.suppress(OSError):
        (shared / "filler").write_bytes(bytes(21_000_000))
    told = ended(gated.ask(), 3)
    assert len([line for line in told.splitlines() if line.startswith("sierra:")]) == 1
    (shared / "filler").unlink()
    ended(gated.ask())
    is_whole(gated.project)
    assert len(gated.begun()) == 8


AHEAD = """\
#define _GNU_SOURCE
#include <dlfcn.h>
#include <time.h>

int clock_gettime(clockid_t clock, struct timespec *told)
{
    int (*real)(clockid_t, struct timespec *) = dlsym(RTLD_NEXT, "clock_gettime");
    int done = real(clock, told);
    if (clock == CLOCK_REALTIME)
        told->tv_sec += 3600;
    return done;
}
"""
"""A clock that is an hour ahead."""


def test_times_from_a_node_with_a_wrong_clock_are_corrected(
    gate: Callable[..., Gated], tmp_path: Path, require: Callable[..., str]
) -> None:
    source, library, python = tmp_path / "ahead.c", tmp_path / "ahead.so", tmp_path / "python"
    source.write_text(AHEAD)
    subprocess.run([require("gcc"), "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    python.write_text(f'#!/bin/sh\nexec env LD_PRELOAD={library} python3 "$@"\n')
    python.chmod(0o755)
    gated = gate(f"python = '{python}'\n")
    gated.open()
    before = time.time()
    ended(gated.ask())
    after = time.time()
    is_whole(gated.project)
    [found] = rows(gated.project, "SELECT epoch(min(started)) AS first, epoch(max(ended)) AS last FROM executions")
    assert before - 1 < found["first"] <= found["last"] < after + 1
    for row in rows(gated.project, "SELECT clock_offset_s, epoch(started) AS started, epoch(ended) AS ended FROM attempts"):
        assert row["clock_offset_s"] == pytest.approx(3600, abs=2)
        assert before - 1 < row["started"] <= row["ended"] < after + 1


def test_runs_of_an_array_task_at_its_time_limit_continue_in_another(gate: Callable[..., Gated]) -> None:
    gated = gate()
    asking = gated.ask()
    gated.until_begun(3)
    job = gated.job()
    for element in range(3):
        gated.slurm.command("scontrol", "update", f"jobid={job}_{element}", "EndTime=now+2")
    until(lambda: "TIMEOUT" in gated.slurm.states().values(), "the limit is hit", 200)
    gated.open()
    told = ended(asking)
    assert "TIMEOUT" in told
    assert "TIMEOUT" in why(gated)
    is_whole(gated.project)
    at_rest(gated.slurm, gated.project)


QUICK_FIRST = WAITING.replace("while not", "while count > 1 and not")
"""A simulator whose runs end immediately with the first value, and wait for the gate with others."""


def test_a_detached_array_task_requeues_itself_before_its_time_limit(gate: Callable[..., Gated]) -> None:
    gated = gate("wall = 60\n", simulator=QUICK_FIRST)
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text().replace("array_tasks = 3", "array_tasks = 1"))
    told = ended(gated.ask(*ASK[:1], "--detach"))
    assert "continues by itself only if the site lets tasks requeue themselves" in told
    until(lambda: packed(gated.root, Requeued), "the element asks to be begun anew", 200)
    gated.open()
    gated.slurm.release_requeued()
    until(lambda: packed(gated.root, Finished), "the element has finished")
    until(lambda: "COMPLETED" in gated.slurm.states().values(), "SLURM knows that")
    assert projects.quick(gated.root, "status").returncode == 0
    is_whole(gated.project)
    assert rows(gated.project, "SELECT state, error FROM attempts ORDER BY started") == [
        {"state": "cut off", "error": "its time was nearly over: it requested to be started again"},
        {"state": "finished", "error": None},
    ]


def test_preempted_array_tasks_continue_with_their_remaining_runs(
    gate: Callable[..., Gated], start: Callable[..., Slurm]
) -> None:
    partitions = (
        "PartitionName=low Nodes=ALL Default=YES MaxTime=60 State=UP PriorityTier=1 PreemptMode=REQUEUE",
        "PartitionName=high Nodes=ALL MaxTime=60 State=UP PriorityTier=9 PreemptMode=OFF",
    )
    preempting = {"PreemptType": "preempt/partition_prio", "PreemptMode": "REQUEUE"}
    gated = gate(on=start(settings=preempting, partitions=partitions))
    asking = gated.ask()
    gated.until_told(3)
    high = gated.slurm.command("sbatch", "--parsable", "-p", "high", "-N3", "--exclusive", "-o/dev/null", "--wrap=sleep 1")
    gated.slurm.until(high, "COMPLETED")
    gated.slurm.release_requeued(3)
    gated.until_begun(6)
    gated.open()
    ended(asking)
    is_whole(gated.project)
    assert len(gated.begun()) == 8 + 3
    assert rows(gated.project, "SELECT count(*) AS n FROM attempts WHERE state = 'cut off' AND interrupted_runs = 1") == [
        {"n": 3}
    ]
    assert "array tasks were interrupted 3 times while 3 runs executed; these runs were started again" in why(gated)
    at_rest(gated.slurm, gated.project)


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("call", [1, 2], ids=["the probe", "the batch"])
def test_a_submitter_killed_around_sbatch_leaves_no_lost_or_duplicate_runs(
    gate: Callable[..., Gated], instead: Callable[..., Path], when: str, call: int
) -> None:
    gated = gate()
    real = '"$real" "$@" > /dev/null' if when == "after" else ":"
    called = instead("sbatch", f"{real}; kill -9 $PPID", call)
    ended(gated.ask(), -signal.SIGKILL)
    assert called.exists()
    gated.open()
    ended(gated.ask())
    is_whole(gated.project)
    assert len(gated.begun()) == 8
    at_rest(gated.slurm, gated.project)


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_controller_that_crashes_during_submission_loses_no_jobs(
    gate: Callable[..., Gated], start: Callable[..., Slurm], instead: Callable[..., Path], when: str
) -> None:
    gated = gate(on=start())
    killed = gated.root.with_name("killed")
    wait = f'until [ -e "{killed}" ]; do sleep 0.05; done'
    called = instead(
        "sbatch", f'{wait}; exec "$real" "$@"' if when == "before" else f'"$real" "$@" > /dev/null; {wait}; exit 1', 2
    )
    asking = gated.ask()
    until(called.exists, "sbatch is called")
    if when == "after":
        until(lambda: len(gated.slurm.states()) > 3, "all is submitted")
    gated.slurm.kill_controller()
    killed.touch()
    time.sleep(10)
    gated.slurm.start_controller()
    gated.open()
    ended(asking)
    is_whole(gated.project)
    at_rest(gated.slurm, gated.project)
    assert len(gated.begun()) == 8


def test_two_concurrent_sessions_with_the_same_query_submit_once(gate: Callable[..., Gated]) -> None:
    gated = gate()
    askings = [gated.ask(), gated.ask()]
    gated.until_begun(3)
    gated.open()
    for asking in askings:
        ended(asking)
    is_whole(gated.project)
    assert len(gated.begun()) == 8
    at_rest(gated.slurm, gated.project)


def test_a_session_that_waits_for_a_killed_one_continues_its_batch(gate: Callable[..., Gated]) -> None:
    gated = gate()
    first = gated.ask()
    gated.until_begun(3)
    second = gated.ask()
    time.sleep(3)
    first.kill()
    ended(first, -signal.SIGKILL)
    gated.open()
    ended(second)
    is_whole(gated.project)
    assert len(gated.begun()) == 8
    at_rest(gated.slurm, gated.project)


def test_removing_a_session_folder_by_hand_ends_its_processes_and_jobs(gate: Callable[..., Gated]) -> None:
    gated = gate()
    asking = gated.ask()
    gated.until_begun(3)
    [folder] = (path for path in gated.root.glob(".sierra/work/*") if path.is_dir())
    shutil.rmtree(folder)
    until(lambda: not marked({f"SIERRA_SESSION={folder.name}".encode()}), "no process is left")
    told = ended(asking, 3)
    assert len([line for line in told.splitlines() if line.startswith("sierra:")]) == 1
    until(lambda: not set(gated.slurm.states().values()) & {"PENDING", "RUNNING", "COMPLETING"}, "no job is left")
    gated.open()
    ended(gated.ask())
    is_whole(gated.project)


WITHOUT_LOCKS = """
import errno, fcntl
def flock(descriptor, how):
    raise OSError(errno.ENOLCK, "No locks available")
fcntl.flock = flock
from sierra.cli.main import main
main()
"""


def test_a_detached_batch_is_joined_on_a_file_system_without_locks(gate: Callable[..., Gated], tmp_path: Path) -> None:
    gated = gate()
    program = tmp_path / "without_locks.py"
    program.write_text(WITHOUT_LOCKS)

    def ask(*words: str) -> str:
        command = [sys.executable, str(program), "run", *ASK, *words]
        pipe = subprocess.PIPE
        return ended(subprocess.Popen(command, cwd=gated.root, stdout=pipe, stderr=pipe, text=True))

    ask("--detach")
    gated.until_begun(3)
    ask("--detach")
    gated.open()
    ask()
    is_whole(gated.project)
    assert len(gated.begun()) == 8
    at_rest(gated.slurm, gated.project)


def test_why_reports_duplicate_executions_of_concurrent_sessions_without_locks(
    gate: Callable[..., Gated], tmp_path: Path
) -> None:
    gated = gate()
    program = tmp_path / "without_locks.py"
    program.write_text(WITHOUT_LOCKS)
    command = [sys.executable, str(program), "run", *ASK]
    pipe = subprocess.PIPE
    askings = [subprocess.Popen(command, cwd=gated.root, stdout=pipe, stderr=pipe, text=True) for _ in range(2)]
    until(lambda: len(list(gated.root.glob(".sierra/work/*/claims.json"))) == 2, "both have claimed what nobody executes")
    gated.until_begun(3)
    gated.open()
    for asking in askings:
        ended(asking)
    twice = len(gated.begun()) == 16
    is_whole(gated.project, executions=16 if twice else 8)
    at_rest(gated.slurm, gated.project)
    if twice:
        said = why(gated)  # at the same time, or just before: both are true of runs that short
        assert re.search("another session (had just )?executed it.* without this session's knowledge", said), said
