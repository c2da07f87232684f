"""Batches on a real SLURM: they give the same results as on this machine, despite faults of the cluster."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import sierra
from sierra.api import Project
from sierra.errors import ConfigError
from sierra.execution import expected_durations
from sierra.runners.cluster.result_log_reader import Ended
from sierra.worker.processes import marked
from tests import projects
from tests.batches import CLUSTER, Gated, at_rest, ended, is_whole, packed, rows
from tests.clusters import Slurm
from tests.conftest import Simulated
from tests.tiers import at_night
from tests.waiting import until


@pytest.fixture
def gated(tmp_path: Path, slurm: Slurm) -> Iterator[Gated]:
    made = Gated.make(tmp_path / "project", slurm)
    yield made
    made.close()


def test_a_batch_on_slurm_has_the_same_results_as_a_local_one(tmp_path: Path, slurm: Slurm) -> None:
    here = projects.make(tmp_path / "here")
    there = projects.make(tmp_path / "there", projects.CONFIG + CLUSTER)
    done = projects.sierra(there, "run", "population_size.Log8", "--on", "slurm")
    assert done.returncode == 0, done.stderr
    assert projects.quick(here, "run", "population_size.Log8").returncode == 0
    results = "SELECT run, result FROM executions ORDER BY run"
    assert rows(sierra.open(there), results) == rows(sierra.open(here), results)
    is_whole(sierra.open(there))
    at_rest(slurm, sierra.open(there))
    completed(slurm, sierra.open(there))
    [session] = rows(sierra.open(there), "SELECT runner, executed, failed, missing FROM sessions")
    assert session == {"runner": "slurm", "executed": 8, "failed": 0, "missing": 0}


def test_array_tasks_execute_the_longest_runs_first(
    simulate: Callable[..., Simulated], slurm: Slurm, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated = simulate("printf 't,v\\n1,1\\n' > swarm.csv")
    config = simulated.folder / "sierra.toml"
    config.write_text(config.read_text() + "[runners.slurm]\narray_tasks = 2\n")
    seconds = {1: 2.0, 2: 2.0, 8: 12.0, 4: 3.0}
    known = [expected_durations.Timed({"size": size}, took) for size, took in seconds.items()]
    monkeypatch.setattr(expected_durations, "_timed", lambda plan, store, runner: iter(known))
    sierra.open(simulated.folder).run("size=1,2,4,8", runs=2, runner="slurm", figures=False)
    order = simulated.sql(
        "SELECT a.array_task AS task, list(x.size ORDER BY e.started) AS sizes FROM executions e "
        "JOIN (SELECT attempt, array_task FROM attempts) a USING (attempt) JOIN batch_runs USING (batch, run) "
        "JOIN experiments x USING (batch, ordinal) GROUP BY 1 ORDER BY 1"
    )
    assert order == [{"task": 0, "sizes": [8, 4, 1, 2]}, {"task": 1, "sizes": [8, 4, 1, 2]}]


HABITS = """
import subprocess, time
if count == 1:
    subprocess.Popen(["sleep", "71"])
    print("RuntimeError: no GPU", file=sys.stderr)
print("finished", flush=True)
if count == 2:
    time.sleep(72)
"""
MARKED = '[success]\nmarker = "stdout"\ncontains = "finished"\n[limits]\nafter_marker = 0.5\n'


def test_what_nodes_see_of_the_ends_of_runs_is_told(tmp_path: Path, slurm: Slurm) -> None:
    root = projects.make(tmp_path / "p", projects.CONFIG + MARKED + CLUSTER, simulator=projects.SIMULATOR + HABITS)
    done = projects.sierra(root, "run", "population_size=1,2", "--runs", "2", "--on", "slurm", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "in 2 of 4 runs processes were still running when the command ended, and were ended: sleep 71" in done.stderr
    assert "2 of 4 runs were successful, but what they printed ends with an error: RuntimeError: no GPU" in done.stderr
    found = rows(sierra.open(root), "SELECT kind, count(*) AS n FROM endings GROUP BY kind ORDER BY kind")
    assert found == [{"kind": kind, "n": 2} for kind in ("after marker", "error", "left running")]


def test_what_runs_print_on_nodes_becomes_a_table(tmp_path: Path, slurm: Slurm) -> None:
    printed = "[outputs.printed]\nfile = 'stdout'\nlines = 'count=(?P<n>\\d+)'\n"
    simulator = projects.SIMULATOR + "print('begin', f'count={count}', sep='\\n')\n"
    root = projects.make(tmp_path / "p", projects.CONFIG + printed + CLUSTER, simulator=simulator)
    done = projects.sierra(root, "run", "population_size=1,2", "--runs", "2", "--on", "slurm", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "note: 4 lines of stdout in 4 runs are in no table" in done.stderr
    found = rows(sierra.open(root), "SELECT n, count(*) AS runs FROM printed GROUP BY n ORDER BY n")
    assert found == [{"n": 1, "runs": 2}, {"n": 2, "runs": 2}]


@pytest.mark.nightly
def test_a_study_waits_for_the_batch_of_each_look(tmp_path: Path, slurm: Slurm) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + CLUSTER)
    rule = ("--until", "ci(coverage) < 3", "--runs", "3", "--max-runs", "8")
    words = ("run", "population_size=1", *rule, "--on", "slurm", "--json")
    done = projects.sierra(root, *words, "--no-figures")
    assert done.returncode == 0, done.stderr
    study = json.loads(done.stdout)["study"]
    sizes = rows(sierra.open(root), "SELECT runner, executed FROM sessions ORDER BY lamport")
    assert [row["runner"] for row in sizes] == ["slurm"] * len(study["looks"])
    assert sum(row["executed"] for row in sizes) == study["looks"][-1]["runs"]
    assert (study["decision"], len(study["looks"]) > 1) == ("reached", True)
    at_rest(slurm, sierra.open(root))


def completed(slurm: Slurm, project: Project) -> None:
    """Check that SLURM and the recorded attempts report success for every task of a project."""
    attempts = rows(project, "SELECT job, state, error FROM attempts")
    jobs = {row["job"].partition("_")[0] for row in attempts}
    assert {(row["state"], row["error"]) for row in attempts} == {("finished", None)}
    assert {state for job in jobs for state in slurm.states(job).values()} == {"COMPLETED"}


@pytest.mark.nightly
def test_finished_array_tasks_are_never_cancelled(simulate: Callable[..., Simulated], slurm: Slurm) -> None:
    """The last run of an array task is recorded before the task has ended."""
    made = simulate()
    config = made.folder / "sierra.toml"
    config.write_text(config.read_text() + "[runners.slurm]\narray_tasks = 4\n")
    for value in range(6):
        done = made.quick("run", f"size={value}", "--runs", "8", "--on", "slurm", "--no-figures")
        assert done.returncode == 0, done.stderr
    at_rest(slurm, sierra.open(made.folder))
    completed(slurm, sierra.open(made.folder))


def test_attempts_record_node_resources_and_state(tmp_path: Path, slurm: Slurm) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + CLUSTER + "cpus = 2\nmemory = '100 MB'\n")
    assert projects.quick(root, "run", "population_size.Log8", "--on", "slurm").returncode == 0
    found = rows(sierra.open(root), "SELECT * FROM attempts ORDER BY array_task")
    assert [row["array_task"] for row in found] == [0, 1, 2]
    assert [row["runs"] for row in found] == [3, 3, 2]
    for row in found:
        assert row["scheduler"].startswith("slurm ")
        assert row["node"] in slurm.names
        assert (row["cpus"], row["state"], row["interrupted_runs"], row["error"]) == (2, "finished", 0, None)
    joined = "executions e JOIN attempts a USING (attempt) JOIN environments v ON v.environment = e.environment"
    same = f"SELECT count(*) AS n FROM {joined} WHERE v.host = a.node AND e.host = a.node"
    assert rows(sierra.open(root), same) == [{"n": 8}]


@pytest.mark.nightly
def test_runs_see_the_devices_of_their_slot(simulate: Callable[..., Simulated], slurm: Slurm) -> None:
    made = simulate('printf "t,v,w\\n1,$CUDA_VISIBLE_DEVICES,$ROCR_VISIBLE_DEVICES\\n" > swarm.csv; sleep 1')
    config = made.folder / "sierra.toml"
    text = config.read_text() + '[environment.set]\nROCR_VISIBLE_DEVICES = "7"\n'
    config.write_text(text + "[runners.slurm]\narray_tasks = 1\ncpus = 2\ngpus = 2\n")
    project = sierra.open(made.folder)
    before = project.plan("size=1,2,3,4", runs=1).batch.id
    summary = project.run("size=1,2,3,4", runs=1, runner="slurm", figures=False)
    assert (summary.failed, summary.executed, summary.batch) == (0, 4, before)
    [attempt] = rows(project, "SELECT gpus, allocation FROM attempts")
    assert attempt["gpus"] == json.loads(attempt["allocation"])["CUDA_VISIBLE_DEVICES"] == "0,1"
    found = rows(project, "SELECT slot, v, w FROM swarm JOIN executions USING (run)")
    alone = len(os.sched_getaffinity(0)) == 1
    assert {row["w"] for row in found} == {7}
    assert {(row["slot"], str(row["v"])) for row in found} == {(0, "0"), (1, "1")} or alone


@pytest.mark.nightly
@pytest.mark.usefixtures("slurm")
def test_runs_hold_gpus_of_their_array_task(simulate: Callable[..., Simulated]) -> None:
    made = simulate('printf "t,v,w\\n1,$CUDA_VISIBLE_DEVICES,$XLA_PYTHON_CLIENT_MEM_FRACTION\\n" > swarm.csv; sleep 1')
    config = made.folder / "sierra.toml"
    table = "[runners.slurm]\narray_tasks = 1\ncpus = 2\n"
    config.write_text(config.read_text().replace("[limits]\n", "[limits]\ngpus = 0.5\n") + table)
    project = sierra.open(made.folder)
    with pytest.raises(ConfigError, match=r"request 0.5 GPU each .* but an array task has none; set gpus = 1 or more"):
        project.run("size=1,2,3,4", runs=1, runner="slurm", figures=False)
    config.write_text(f"{config.read_text()}gpus = 2\n")
    project = sierra.open(made.folder)
    summary = project.run("size=1,2,3,4", runs=1, runner="slurm", figures=False)
    assert (summary.failed, summary.executed) == (0, 4)
    found = rows(project, "SELECT v, w, gpus, gpu_limit FROM swarm JOIN executions USING (run)")
    assert {str(row["v"]) for row in found} <= {"0", "1"}
    assert [(row["w"], row["gpus"], row["gpu_limit"]) for row in found] == [(0.45, [str(row["v"])], 0.5) for row in found]


@pytest.mark.nightly
@pytest.mark.usefixtures("slurm")
def test_runs_hold_cores_of_their_array_task(simulate: Callable[..., Simulated]) -> None:
    made = simulate('t=$(date +%s.%N); sleep 1; printf "t,v,w\\n1,$t,$(date +%s.%N)\\n" > swarm.csv')
    config = made.folder / "sierra.toml"
    table = "[runners.slurm]\narray_tasks = 1\ncpus = 2\n"
    config.write_text(config.read_text().replace("[limits]\n", '[limits]\ncores = "{size}"\n') + table)
    project = sierra.open(made.folder)
    with pytest.raises(ConfigError, match=r"request 3 cores each .* but an array task has 2; set cpus = 3 or more"):
        project.run("size=1,3", runs=1, runner="slurm", figures=False)
    summary = project.run("size=1,2", runs=2, runner="slurm", figures=False)
    assert (summary.failed, summary.executed) == (0, 4)
    joined = "swarm JOIN batch_runs USING (run) JOIN experiments USING (batch, ordinal)"
    times = rows(project, f"SELECT experiments.size, v AS began, w AS ended FROM {joined}")
    wide = [row for row in times if row["size"] == 2]
    assert all(
        row["ended"] <= other["began"] or other["ended"] <= row["began"] for row in wide for other in times if row != other
    )


@pytest.mark.nightly
@pytest.mark.usefixtures("slurm")
def test_a_run_may_be_an_mpi_program_with_several_processes_on_its_node(
    simulate: Callable[..., Simulated], require: Callable[..., str]
) -> None:
    mpirun = require("mpirun")
    made = simulate(
        f'n=$({mpirun} --allow-run-as-root -n 2 sh -c "echo rank" | grep -c rank); printf "t,v\\n1,$n\\n" > swarm.csv'
    )
    config = made.folder / "sierra.toml"
    table = "[runners.slurm]\narray_tasks = 1\ncpus = 2\n"
    config.write_text(config.read_text().replace("[limits]\n", "[limits]\ncores = 2\n") + table)
    project = sierra.open(made.folder)
    assert project.run("size=1", runs=2, runner="slurm", figures=False).executed == 2
    assert rows(project, "SELECT DISTINCT v FROM swarm") == [{"v": 2}]


@pytest.mark.nightly
def test_code_may_change_while_runs_are_queued(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_begun(3)
    (gated.root / "sim.py").write_text("raise SystemExit(1)\n")
    gated.open()
    ended(asking)
    is_whole(gated.project)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.nightly)])
def test_submitted_jobs_continue_without_their_submitter(gated: Gated, number: signal.Signals) -> None:
    asking = gated.ask()
    gated.until_begun(3)
    asking.send_signal(number)
    ended(asking, -9 if number == signal.SIGKILL else 130)
    gated.open()
    ended(gated.ask())
    is_whole(gated.project)
    assert len(gated.begun()) == 8
    at_rest(gated.slurm, gated.project)


def test_a_job_whose_id_was_not_recorded_is_found_by_its_name(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_begun(3)
    asking.kill()
    asking.communicate()
    [sent] = gated.root.glob(".sierra/work/*/sent/0.json")
    sent.write_text(sent.read_text().replace(f'"job": "{gated.job()}"', '"job": null'))
    gated.open()
    ended(gated.ask())
    is_whole(gated.project)
    assert len(gated.begun()) == 8


@pytest.mark.nightly
def test_a_batch_of_a_submitter_that_died_before_submission_is_completed(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_begun(3)
    asking.kill()
    asking.communicate()
    gated.slurm.command("scancel", gated.job())
    at_rest(gated.slurm, gated.project)
    for file in [*gated.root.glob(".sierra/work/*/sent/*"), *gated.root.glob(".sierra/work/*/results/*")]:
        file.unlink()
    gated.open()
    ended(gated.ask())
    is_whole(gated.project)


@pytest.mark.nightly
def test_two_sessions_with_the_same_query_execute_it_once(gated: Gated) -> None:
    first = gated.ask()
    gated.until_begun(3)
    second = gated.ask()
    time.sleep(2)
    gated.open()
    ended(first)
    ended(second)
    is_whole(gated.project)
    assert len(gated.begun()) == 8


@pytest.mark.nightly
@pytest.mark.parametrize("which", ["one element", "all"])
def test_jobs_cancelled_by_somebody_else_end_the_session(gated: Gated, which: str) -> None:
    asking = gated.ask()
    gated.until_begun(3)
    job = gated.job()
    gated.slurm.command("scancel", f"{job}_1" if which == "one element" else job)
    told = ended(asking, 130)
    assert f"slurm job {job} was cancelled, but not by SIERRA" in told
    assert "submitted again" not in told
    assert len(gated.begun()) == 3
    at_rest(gated.slurm, gated.project)
    gated.open()
    ended(gated.ask())
    is_whole(gated.project)


@pytest.mark.nightly
def test_jobs_cancelled_while_detached_are_not_submitted_again(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_told(3)
    gated.until_begun(3)
    asking.kill()
    asking.communicate()
    job = gated.job()
    gated.slurm.command("scancel", job)
    at_rest(gated.slurm, gated.project)
    assert "was cancelled, but not by SIERRA" in ended(gated.ask(), 130)
    assert len(gated.begun()) == 3
    gated.open()
    ended(gated.ask())
    is_whole(gated.project)


@pytest.mark.nightly
def test_a_probe_cancelled_by_somebody_else_ends_the_session(
    gated: Gated, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # force a probe
    gated.slurm.command("scontrol", "update", f"nodename={','.join(gated.slurm.names)}", "state=drain", "reason=test")
    asking = gated.ask()
    listed = ("squeue", "-h", "-t", "PENDING", "-o", "%F %j")
    until(lambda: " probe-" in gated.slurm.command(*listed), "the probe waits")
    [probe] = [line.split()[0] for line in gated.slurm.command(*listed).splitlines() if " probe-" in line]
    gated.slurm.command("scancel", probe)
    told = ended(asking, 130)
    gated.slurm.command("scontrol", "update", f"nodename={','.join(gated.slurm.names)}", "state=resume")
    assert f"slurm job {probe} was cancelled, but not by SIERRA" in told
    assert gated.begun() == []
    at_rest(gated.slurm, gated.project)


@pytest.mark.nightly
@pytest.mark.parametrize("which", ["one element", "all"])
def test_cancelled_jobs_are_submitted_again_if_the_project_configures_it(gated: Gated, which: str) -> None:
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text() + 'cancelled = "resubmit"\n')
    asking = gated.ask()
    gated.until_begun(3)
    job = gated.job()
    gated.slurm.command("scancel", f"{job}_1" if which == "one element" else job)
    gated.slurm.until(job, "CANCELLED", element=1)
    gated.open()
    told = ended(asking)
    assert "submitted again" in told or which == "one element"
    is_whole(gated.project)
    at_rest(gated.slurm, gated.project)


def test_runs_on_a_node_that_loses_power_are_executed_again(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_begun(3)
    node = gated.node()
    gated.slurm.power_cut(node)
    gated.slurm.declare_down(node)
    gated.open()
    gated.slurm.release_requeued()
    ended(asking)
    is_whole(gated.project)
    gated.slurm.start_node(node)
    at_rest(gated.slurm, gated.project)


@pytest.mark.nightly
def test_two_copies_of_an_array_task_give_one_result_and_a_comparison(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_begun(3)
    node = gated.node()
    gated.slurm.kill_slurmd(node)
    gated.slurm.declare_down(node)
    gated.slurm.release_requeued()
    gated.until_begun(4)
    twice = min(run for run in gated.begun() if gated.begun().count(run) > 1)
    gated.open(twice)
    until(lambda: [end.result.run for end in packed(gated.root, Ended)].count(twice) == 2, "both copies have ended")
    gated.open()
    told = ended(asking)
    is_whole(gated.project)
    [copies] = rows(gated.project, "SELECT count(*) AS n, bool_and(same) AS same FROM duplicates")
    assert copies["n"] > 0
    assert copies["same"]
    assert "executed twice" in told


@pytest.mark.nightly
@pytest.mark.parametrize("requeued", [3, *at_night([0])])
def test_a_batch_completes_after_a_crash_of_the_controller(gated: Gated, requeued: int) -> None:
    """A busy SLURM may requeue the running array tasks when its controller is back.

    A requeued task executes the run again that it was executing. Therefore SIERRA may start as many runs twice as SLURM
    counts restarts of tasks, and no more. The second case requeues all running tasks, so that this happens for sure.
    """
    asking = gated.ask()
    gated.until_begun(3)
    job = gated.job()
    gated.slurm.kill_controller(saved=True)
    time.sleep(12)
    gated.slurm.start_controller(SlurmdTimeout="300")  # however long the nodes take, they count as alive
    for task in range(requeued):
        gated.slurm.requeue(f"{job}_{task}")
    if requeued:
        gated.slurm.release_requeued(requeued)
        gated.until_begun(3 + requeued)
    gated.open()
    ended(asking)
    is_whole(gated.project)
    starts, restarts = Counter(gated.begun()), gated.slurm.restarts(job)
    assert len(restarts) == 3
    assert all(restarts.values()) or not requeued
    assert len(starts) == 8
    assert starts.total() <= 8 + sum(restarts.values())
    assert max(starts.values()) <= 1 + max(restarts.values())


@pytest.mark.nightly
@pytest.mark.parametrize("again", ["status", "cancel", "run"])
def test_the_next_command_cancels_jobs_that_could_not_be_cancelled(gated: Gated, again: str) -> None:
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text().replace("array_tasks = 3", 'array_tasks = 8\ndirectives = ["--exclusive"]'))
    ended(gated.ask("population_size.Log8", "--detach"))
    gated.until_begun(3)
    gated.slurm.kill_controller(saved=True)
    begun = len(gated.begun())
    assert begun == 3, "others wait for a node"
    done = projects.quick(gated.root, "cancel", gated.project.jobs.status()[0].session)
    assert done.returncode == 3
    assert done.stderr.splitlines()[-1].startswith("sierra: slurm cannot be reached, so jobs of session ")
    [session] = [path for path in (gated.root / ".sierra" / "work").iterdir() if path.is_dir()]
    until(lambda: not marked({f"SIERRA_SESSION={session.name}".encode()}), "what runs ends by itself")
    gated.slurm.start_controller()
    if again == "run":
        gated.open()
        ended(gated.ask())
        is_whole(gated.project)
    else:
        done = projects.quick(gated.root, again, session.name)
        assert done.returncode == 0, done.stderr
        assert not session.exists()
    until(lambda: not {"PENDING", "RUNNING"} & set(gated.slurm.states().values()), "no job is left")
    assert len(gated.begun()) == begun + (8 if again == "run" else 0)


@pytest.mark.nightly
def test_a_failed_cancellation_is_reported_and_the_next_command_completes_it(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_begun(3)
    gated.slurm.kill_controller(saved=True)
    [session] = [path for path in (gated.root / ".sierra" / "work").iterdir() if path.is_dir()]
    (session / "cancelled").touch()  # as a cancelling process leaves it
    told = ended(asking, 3)
    assert "are not cancelled yet" in told.splitlines()[-1]
    gated.slurm.start_controller()
    assert projects.quick(gated.root, "status").returncode == 0
    assert not session.exists()
    gated.open()
    ended(gated.ask())
    is_whole(gated.project)
    at_rest(gated.slurm, gated.project)


@pytest.mark.nightly
def test_a_requeued_array_task_continues_with_its_remaining_runs(gated: Gated) -> None:
    asking = gated.ask()
    gated.until_told(3)
    job = gated.job()
    gated.slurm.command("scontrol", "requeue", f"{job}_0")
    gated.slurm.release_requeued()
    gated.open()
    ended(asking)
    is_whole(gated.project)
    assert rows(gated.project, "SELECT array_task, interrupted_runs FROM attempts WHERE state = 'cut off'") == [
        {"array_task": 0, "interrupted_runs": 1}
    ]


KEEPING = """\
import os, pathlib, sys, time

state = pathlib.Path(sys.argv[2], "state")
with state.open("a") as file:
    print(os.environ["SIERRA_EXECUTION"], file=file)
begun = len(state.read_text().splitlines())
if begun == 1:
    time.sleep(600)
with open("swarm.csv", "w") as file:
    print("tick,coverage", f"0,{begun}", sep="\\n", file=file)
"""


@pytest.mark.nightly
def test_a_run_continues_from_its_checkpoint_in_a_requeued_array_task(tmp_path: Path, slurm: Slurm) -> None:
    config = projects.CONFIG.replace("{input}", "{input} {checkpoint}") + CLUSTER
    root = projects.make(tmp_path / "project", config, simulator=KEEPING)
    asking = projects.start(root, "run", "population_size=1", "--runs", "1", "--no-figures", "--on", "slurm")
    until(lambda: any(root.glob(".sierra/checkpoints/*/files/state")))
    [task] = [task for task, state in slurm.states().items() if state == "RUNNING"]
    slurm.requeue(task)
    slurm.release_requeued()
    ended(asking)
    assert rows(sierra.open(root), "SELECT coverage FROM swarm") == [{"coverage": 2}]
    assert rows(sierra.open(root), "SELECT kind FROM endings") == [{"kind": "resumed"}]
    assert list((root / ".sierra/checkpoints").iterdir()) == []


@pytest.mark.nightly
def test_sierra_in_an_allocation_uses_its_cores(slurm: Slurm) -> None:
    code = "from sierra.worker.machine import granted_cores; print(granted_cores())"
    argv = ("salloc", "--quiet", "--ntasks=1", "--cpus-per-task=1", sys.executable, "-c", code)
    assert slurm.command(*argv) == "1"


@pytest.mark.nightly
def test_a_run_whose_array_task_is_cut_off_at_every_attempt_fails(gated: Gated) -> None:
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text() + 'attempts = 2\ncancelled = "resubmit"\n')
    asking = gated.ask("population_size=1", "--runs", "2")
    for count in (2, 4):
        gated.until_told(count)
        gated.slurm.command("scancel", "--me")
        until(lambda: not {"RUNNING", "PENDING"} & set(gated.slurm.states().values()), "it is cancelled")
    told = ended(asking, 1)
    assert "cut off 2 times" in told
    reasons = rows(gated.project, "SELECT status, reason FROM executions")
    assert [row["status"] for row in reasons] == ["failed", "failed"]
    assert all("cut off 2 times while the run executed" in row["reason"] for row in reasons)
    gated.open()
    ended(gated.ask("population_size=1", "--runs", "2"))
    is_whole(gated.project, 2, executions=4)


@pytest.mark.nightly
def test_jobs_that_succeed_without_executing_runs_are_an_error(gated: Gated) -> None:
    lazy = gated.root.with_name("lazy")
    lazy.write_text('#!/bin/sh\ncase "$*" in *--probe*) exec python3 "$@" ;; esac\n')
    lazy.chmod(0o755)
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text() + f'python = "{lazy}"\nattempts = 2\n')
    told = ended(gated.ask(), 3)
    assert "was executed 2 times and ended before any of its runs ended: COMPLETED" in told
    config.write_text(config.read_text().replace(f'python = "{lazy}"\n', ""))
    gated.open()
    ended(gated.ask())
    is_whole(gated.project)


@pytest.mark.nightly
def test_a_probe_without_output_ends_the_session_before_any_run(gated: Gated) -> None:
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text() + 'python = "true"\n')
    told = ended(gated.ask(), 3)
    assert "the preflight job ended on the nodes without any output (COMPLETED)" in told
    assert gated.begun() == []
    at_rest(gated.slurm, gated.project)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('partition = "nowhere"', "partition"),
        ('python = "/no/python3"', "/no/python3"),
        ("wall = 1e9", "more than the site allows"),
        ("cpus = 4000", "cpus = 4000"),
        ('scratch = "/nowhere/runs"', "scratch = /nowhere/runs: its parent folder does not exist"),
    ],
)
def test_settings_that_the_site_cannot_satisfy_are_refused_in_one_line(gated: Gated, line: str, words: str) -> None:
    config = gated.root / "sierra.toml"
    config.write_text(config.read_text() + f"{line}\nattempts = 1\n")
    asking = gated.ask()
    _, err = asking.communicate(timeout=200)
    assert asking.returncode in (2, 3)
    assert words in err
    assert len([text for text in err.splitlines() if text.startswith("sierra:")]) == 1, err
    assert rows(gated.project, "SELECT * FROM executions") == []
    assert [path for path in gated.root.glob(".sierra/work/*") if path.is_dir()] == []
    assert gated.begun() == []
    until(lambda: set(gated.slurm.states().values()) <= {"CANCELLED", "FAILED", "COMPLETED"}, "nothing is left")


@pytest.mark.nightly
def test_results_of_jobs_that_slurm_forgot_are_recorded(
    tmp_path: Path, require: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from tests import clusters

    clusters.needed(require)
    root = projects.make(tmp_path / "project", projects.CONFIG + CLUSTER)
    with clusters.folder() as folder, Slurm(folder, settings={"MinJobAge": "2"}) as cluster:
        monkeypatch.setenv("SLURM_CONF", cluster.environment["SLURM_CONF"])
        done = projects.quick(root, "run", "population_size.Log8", "--on", "slurm", "--detach")
        assert done.returncode == 0, done.stderr
        until(lambda: not cluster.states(), "the controller has forgotten the jobs", 90)
        done = projects.quick(root, "run", "population_size.Log8", "--on", "slurm")
        assert done.returncode == 0, done.stderr
    is_whole(sierra.open(root))
    assert rows(sierra.open(root), "SELECT count(*) AS n FROM attempts") == [{"n": 3}]


def test_secrets_of_the_submitters_shell_do_not_reach_runs(
    tmp_path: Path, slurm: Slurm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MY_SECRET_THING", "leak")
    look = "[open(f'/proc/{p}/environ').read() for p in ('self', os.getppid())]"
    simulator = f"import os, pathlib\npathlib.Path('env.txt').write_text(repr({look}))\n"
    root = projects.make(tmp_path / "project", projects.CONFIG + CLUSTER, simulator=simulator)
    assert projects.quick(root, "run", "population_size=1", "--on", "slurm").returncode == 0
    project = sierra.open(root)
    texts = [
        project.store.object(row["sha256"]) for row in rows(project, "SELECT sha256 FROM artifacts WHERE path = 'env.txt'")
    ]
    assert texts
    assert not any(b"leak" in text for text in texts)


def test_local_runs_replay_identically_on_slurm_and_vice_versa(tmp_path: Path, slurm: Slurm) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + CLUSTER)
    projects.commit(root)
    here = projects.quick(root, "run", "population_size=1,2")
    assert here.returncode == 0, here.stderr
    there = projects.quick(root, "run", "population_size=4,8", "--on", "slurm")
    assert there.returncode == 0, there.stderr
    project = sierra.open(root)
    first, second = (one.batch for one in project.batches)
    assert str(project.replay(first, runner="slurm").verdict) == "identical"
    assert str(project.replay(second, runner="local").verdict) == "identical"
    at_rest(slurm, project)


@pytest.mark.nightly
def test_a_cluster_job_can_attach_and_record_a_batch(gated: Gated) -> None:
    left = projects.quick(gated.root, "run", "population_size.Log8", "--on", "slurm", "--detach")
    assert left.returncode == 0, left.stderr
    [batch] = gated.project.batches
    gated.open()
    log = gated.root.with_name("attach.log")
    wrapped = f"cd {gated.root} && SLURM_CONF={os.environ['SLURM_CONF']} {projects.SIERRA} attach {batch.batch}"
    gated.slurm.command("sbatch", "--wait", "-o", str(log), "--wrap", wrapped)
    assert "8 executed" in log.read_text()
    is_whole(gated.project)
