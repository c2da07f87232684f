"""The scheduler `slurm`, with a real SLURM: see `tests.clusters`."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError, Full, Missing, SierraError
from sierra.runners.schedulers.base import Request, State, Task
from sierra.runners.schedulers.slurm import PATH, Slurm, refusal, seconds, tasks
from sierra.util.text import ranges
from tests import clusters
from tests.waiting import PATIENCE_S

ODD = "a'; echo foo"


def scheduler(**table: Any) -> Slurm:
    return Slurm(ClusterTable(**table))


@pytest.fixture
def request_of(tmp_path: Path) -> Callable[..., Request]:
    """Return a function that makes a request to execute a shell script, in a folder with an odd name; `$1` is the index."""
    folder = tmp_path / ODD
    (folder / "logs").mkdir(parents=True)

    def made(script: str = "true", *elements: int, name: str = f"sierra-{secrets.token_hex(4)}", after: str = "") -> Request:
        (folder / f"{name}.sh").write_text(script)
        command = ("sh", str(folder / f"{name}.sh"))
        return Request(name, "sierra: a 'comment' | \"so\"", elements or (0,), folder, folder / "logs", command, after)

    return made


def until(slurm: Slurm, name: str, condition: Callable[[list[Task]], bool], seconds: float = PATIENCE_S) -> list[Task]:
    """Query until the tasks meet a condition; return the last tasks."""
    give_up = time.monotonic() + seconds
    while True:
        found = slurm.look(name)
        assert found is not None
        if condition(seen := sorted(found, key=lambda task: (task.job, task.element or 0))):
            return seen
        assert time.monotonic() < give_up, seen
        time.sleep(0.05)


def ended(seen: list[Task]) -> bool:
    return bool(seen) and all(task.state == State.ENDED for task in seen)


def running(seen: list[Task]) -> bool:
    return bool(seen) and all(task.state == State.RUNNING for task in seen)


# scripts and answers, without a cluster


def test_a_script_contains_all_configured_settings() -> None:
    table = {
        "cpus": 4,
        "memory": "4 GB",
        "wall": 61.0,
        "partition": "long",
        "account": "physics",
        "qos": "low",
        "constraint": "[rack1|rack2]&fast",
        "gpus": 2,
        "modules": ("python/3.11", "it's"),
        "directives": ("--exclude=n1", "--no-requeue"),
    }
    folder = Path("/shared/a'; echo foo 100%")
    request = Request("sierra-1", "batch 12", (0, 1, 2, 5, 7, 8), folder, folder / "logs", ("python3", "-I", "it's"), "77")
    assert Slurm(ClusterTable.model_validate(table, strict=True)).script(request) == (
        """\
#!/bin/bash
#SBATCH --requeue
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=4
#SBATCH --partition="long"
#SBATCH --account="physics"
#SBATCH --qos="low"
#SBATCH --constraint="[rack1|rack2]&fast"
#SBATCH --gres=gpu:2
#SBATCH --mem=3815M
#SBATCH --time=2
#SBATCH --exclude=n1
#SBATCH --no-requeue
#SBATCH --job-name=sierra-1
#SBATCH --comment="batch 12"
#SBATCH --array=0-2,5,7-8
#SBATCH --chdir="/shared/a'; echo foo 100%"
#SBATCH --output="/shared/a'; echo foo 100%%/logs/%A_%a.out"
#SBATCH --open-mode=append
#SBATCH --dependency=afterok:77
#SBATCH --kill-on-invalid-dep=yes
. /etc/profile
module load python/3.11 || exit 3
module load 'it'"'"'s' || exit 3
cd '/shared/a'"'"'; echo foo 100%' || exit 3
exec python3 -I 'it'"'"'s' "$SLURM_ARRAY_TASK_ID"
"""
    )


def test_a_script_requests_nothing_that_is_not_configured(request_of: Callable[..., Request]) -> None:
    script = scheduler().script(request_of())
    assert script.startswith("#!/bin/sh\n")
    assert not [word for word in ("--mem", "--time", "--partition", "--gres", "--dependency", "module") if word in script]


def test_a_path_that_a_script_cannot_contain_is_refused(request_of: Callable[..., Request]) -> None:
    with pytest.raises(ConfigError, match="without a line feed"):
        scheduler().script(replace(request_of(), folder=Path("/a\nb")))
    with pytest.raises(ConfigError, match="without a backslash"):
        scheduler().script(replace(request_of(), logs=Path("/a\\b")))


@pytest.mark.parametrize(
    ("elements", "text"), [((0,), "0"), ((3, 4), "3-4"), ((0, 1, 2, 3, 4, 5, 7), "0-5,7"), ((1, 3, 5), "1,3,5")]
)
def test_array_tasks_are_written_as_ranges(elements: tuple[int, ...], text: str) -> None:
    assert ranges(elements) == text


@pytest.mark.parametrize(
    ("text", "limit"), [("01:00:00", 3600), ("00:01:30", 90), ("2-12:00:00", 216000), ("UNLIMITED", None), ("", None)]
)
def test_limits_of_time_are_parsed(text: str, limit: float | None) -> None:
    assert seconds(text) == limit


@pytest.mark.parametrize(
    ("line", "state", "reason"),
    [
        ("7|3|RUNNING|n1|None", State.RUNNING, ""),
        ("7|3|COMPLETING|n1|None", State.RUNNING, ""),
        ("7|3|SUSPENDED|n1|None", State.RUNNING, ""),
        ("7|3|A_STATE_OF_TOMORROW|n1|None", State.RUNNING, ""),
        ("7|3|COMPLETED|n1|None", State.ENDED, "COMPLETED"),
        ("7|3|FAILED|n1|NonZeroExitCode", State.ENDED, "FAILED"),
        ("7|3|NODE_FAIL|n1|NodeDown", State.ENDED, "NODE_FAIL"),
        ("7|3|OUT_OF_MEMORY|n1|OutOfMemory", State.ENDED, "OUT_OF_MEMORY"),
        ("7|3|TIMEOUT|n1|TimeLimit", State.ENDED, "TIMEOUT"),
        *(
            (f"7|3|PENDING||{reason}", State.QUEUED, reason)
            for reason in (
                "Priority",
                "Resources",
                "BeginTime",
                "Dependency",
                "JobArrayTaskLimit",
                "JobHeldUser",
                "PartitionDown",
                "AssocMaxJobsLimit",
                "AssocGrpCPUMinutesLimit",
                "QOSMaxCpuPerUserLimit",
                "QOSMaxJobsPerUserLimit",
                "ReqNodeNotAvail, UnavailableNodes:n[1-3]",
                "Nodes required for job are DOWN, DRAINED or reserved for jobs in higher priority partitions",
            )
        ),
        *(
            (f"7|3|PENDING||{reason}", State.STUCK, reason)
            for reason in (
                "PartitionConfig",
                "PartitionNodeLimit",
                "PartitionTimeLimit",
                "BadConstraints",
                "DependencyNeverSatisfied",
                "InvalidAccount",
                "InvalidQOS",
                "JobHeldAdmin",
                "MaxMemPerLimit",
                "AssocMaxWallDurationPerJobLimit",
                "QOSMaxMemoryPerNode",
                "QOSMinGRES",
                "launch failed requeued held",
                "user env retrieval failed requeued held",
                "job requeued in held state",
                "Job's account not permitted to use this partition (a|b allow it not)",
                "Job's account not known, so it can't use this partition (closed allows rich)",
            )
        ),
        ("7|3|SPECIAL_EXIT||None", State.STUCK, ""),
    ],
)
def test_lines_of_squeue_give_the_state_and_reason_of_a_task(line: str, state: State, reason: str) -> None:
    [task] = tasks(line)
    assert (task.job, task.element, task.state, task.reason) == ("7", 3, state, reason)


@pytest.mark.parametrize(("word", "cancelled"), [("CANCELLED", True), ("FAILED", False), ("TIMEOUT", False), ("RUNNING", None)])
def test_the_state_in_squeue_tells_if_a_task_was_cancelled(word: str, cancelled: bool | None) -> None:
    [task] = tasks(f"7|3|{word}|n1|None\n")
    assert task.cancelled is cancelled


def test_tasks_without_an_index_are_not_array_tasks() -> None:
    assert [task.element for task in tasks("7|N/A|PENDING||None\n8|0-5,7|PENDING||None\n9|3|RUNNING|n1|None\n")] == [
        None,
        None,
        3,
    ]


def test_lines_that_are_not_tasks_are_ignored() -> None:
    assert tasks("") == ()
    assert tasks("welcome to the cluster\n7|1|RUNNING|n1|a\nb|c\n") == (Task("7", 1, State.RUNNING, "a", "n1"),)


POLICY = (
    "sbatch: error: Batch job submission failed: "
    "Job violates accounting/QOS policy (job submit limit, user's size and/or time limits)"
)


@pytest.mark.parametrize(
    ("said", "error", "words"),
    [
        (f"sbatch: error: QOSMaxSubmitJobPerUserLimit\n{POLICY}", Full, "QOSMaxSubmitJobPerUserLimit; Batch job submission"),
        (f"sbatch: error: AssocMaxSubmitJobLimit\n{POLICY}", Full, "AssocMaxSubmitJobLimit"),
        (f"sbatch: error: MaxSubmitJobsPerAccount\n{POLICY}", Full, "MaxSubmitJobsPerAccount"),
        (f"sbatch: error: QOSMaxWallDurationPerJobLimit\n{POLICY}", ConfigError, "QOSMaxWallDurationPerJobLimit"),
        (POLICY, ConfigError, "Job violates accounting/QOS policy"),
        (
            "sbatch: error: Batch job submission failed: Invalid account or account/partition combination specified",
            ConfigError,
            "SLURM: Batch job submission failed: Invalid account or account/partition combination specified",
        ),
        ("sbatch: unrecognized option '--x'\nTry \"sbatch --help\" for more information", ConfigError, "option '--x'$"),
        (
            "sbatch: error: Batch job submission failed: Unable to contact slurm controller (connect failure)",
            Missing,
            "Unable to contact",
        ),
        ("sbatch: error: Batch job submission failed: Socket timed out on send/recv operation", Missing, "Socket timed out"),
        ("sbatch: error: Munge encode failed: Failed to connect\nsbatch: error: x", Missing, "Munge"),
        ("sbatch: fatal: Could not establish a configuration source", Missing, "SLURM: Could not establish"),
    ],
)
def test_refusals_full_queues_and_missing_answers_are_distinguished(said: str, error: type[SierraError], words: str) -> None:
    refused = refusal(said)
    assert type(refused) is error
    assert re.search(words, str(refused))
    assert "\n" not in str(refused)


@pytest.fixture
def sbatch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Return a function that puts a shell script on the PATH as `sbatch`, as many sites do."""

    def put(script: str) -> None:
        (tmp_path / "bin").mkdir()
        (tmp_path / "bin" / "sbatch").write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "bin" / "sbatch").chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")

    return put


@pytest.mark.parametrize("said", ["12", "12;tux", "You have 3 jobs.\\n12;tux", "12\\nThank you", "7\\n12", "7;old\\n\\n12;tux"])
def test_the_answer_of_sbatch_names_the_job(
    said: str, sbatch: Callable[[str], None], request_of: Callable[..., Request]
) -> None:
    sbatch(f"cat > /dev/null; printf '{said}\\n'; echo welcome >&2")
    assert scheduler().submit(request_of()) == "12"


def test_an_answer_without_a_job_is_reported_as_unknown(
    sbatch: Callable[[str], None], request_of: Callable[..., Request]
) -> None:
    sbatch("cat > /dev/null; echo Job 12 would start at noon")
    with pytest.raises(Missing, match="'Job 12 would start at noon'; it is unknown whether the job exists"):
        scheduler().submit(request_of())


@pytest.mark.nightly
def test_waiting_for_an_answer_of_sbatch_ends_after_a_time_limit(
    sbatch: Callable[[str], None], request_of: Callable[..., Request], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sierra.runners.schedulers.slurm.TIMEOUT_S", 1.0)
    sbatch("exec sleep 30")
    with pytest.raises(Missing, match="does not answer sbatch within 1 s"):
        scheduler().submit(request_of())


def test_a_host_without_slurm_is_reported(monkeypatch: pytest.MonkeyPatch, request_of: Callable[..., Request]) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    for asked in (scheduler().version, scheduler().bounds, lambda: scheduler().submit(request_of())):
        with pytest.raises(Missing, match=r"(sbatch|scontrol) is not installed here"):
            asked()
    assert scheduler().look("sierra-1234567") is None


# with a cluster


@pytest.mark.nightly
@pytest.mark.real
def test_the_version_of_slurm_is_returned(slurm: clusters.Slurm) -> None:
    word, number = scheduler().version().split()
    assert (word, number.count(".")) == ("slurm", 2)


@pytest.mark.integration
@pytest.mark.real
def test_limits_of_the_site_are_returned(slurm: clusters.Slurm) -> None:
    bounds = scheduler().bounds()
    assert (bounds.array, bounds.jobs, bounds.wall_s, bounds.running) == (1001, 10000, 3600, None)
    assert bounds.whose == {"array": "MaxArraySize", "jobs": "MaxJobCount", "wall_s": "MaxTime of partition debug"}
    assert scheduler(partition="short").bounds().wall_s == 60
    assert scheduler(partition="debug,short").bounds().wall_s == 60
    with pytest.raises(ConfigError, match="no partition 'nope'; it has debug, short"):
        scheduler(partition="nope").bounds()


@pytest.mark.integration
@pytest.mark.real
def test_array_tasks_execute_with_their_index(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    request = request_of('echo "$PWD" "$@"; echo trouble >&2', 0, 1, 2, 5)
    job = scheduler().submit(request)
    seen = until(scheduler(), request.name, ended)
    assert [(task.job, task.element, task.reason) for task in seen] == [(job, each, "COMPLETED") for each in (0, 1, 2, 5)]
    for task in seen:
        assert task.node in slurm.names
        log = request.logs / f"{job}_{task.element}.out"
        assert log.read_text() == f"{request.folder} {task.element}\ntrouble\n"


@pytest.mark.nightly
@pytest.mark.real
def test_one_array_task_is_submitted_as_an_array(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    request = request_of('echo "$@"', 3)
    job = scheduler().submit(request)
    [task] = until(scheduler(), request.name, ended)
    assert (task.job, task.element) == (job, 3)


@pytest.mark.integration
@pytest.mark.real
def test_jobs_get_the_requested_resources(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    table = {"cpus": 3, "memory": 100 << 20, "wall": 90.0, "partition": "debug", "constraint": "fast", "gpus": 1}
    job = scheduler(**table).submit(request_of("sleep 60"))
    told = slurm.command("scontrol", "show", "job", job)
    for said in ("CPUs/Task=3", "MinMemoryNode=100M", "TimeLimit=00:02:00", "Partition=debug", "Features=fast", "gpu:1"):
        assert said in told
    assert "Requeue=1" in told


@pytest.mark.nightly
@pytest.mark.real
def test_directives_add_options_but_never_change_name_or_output(
    slurm: clusters.Slurm, request_of: Callable[..., Request]
) -> None:
    request = request_of("sleep 60")
    job = scheduler(directives=("--no-requeue", "--nice=7 --job-name=other", "-o nowhere")).submit(request)
    told = slurm.command("scontrol", "show", "job", job)
    assert "Requeue=0" in told
    assert "Nice=7" in told
    assert f"JobName={request.name}" in told
    assert "nowhere" not in told


@pytest.mark.nightly
@pytest.mark.real
def test_modules_are_loaded_before_the_command_executes(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    request = request_of("echo began")
    job = scheduler(modules=("nope/1.0",)).submit(request)
    [task] = until(scheduler(), request.name, ended)
    log = (request.logs / f"{job}_0.out").read_text()
    assert task.reason == "FAILED"
    assert "module" in log
    assert "began" not in log


@pytest.mark.integration
@pytest.mark.real
def test_the_callers_environment_is_not_exported(
    slurm: clusters.Slurm, request_of: Callable[..., Request], monkeypatch: pytest.MonkeyPatch
) -> None:
    canaries = {
        "API_TOKEN": "canary",
        "SLURM_JWT": "canary",
        "SPANK_TOKEN": "canary",
        "SLURM_CANARY": "canary",
        "NIL": "canary",
        "PATH": os.environ["PATH"] + ":/canary",
    }
    for name, value in canaries.items():
        monkeypatch.setenv(name, value)
    request = request_of("cat /proc/self/environ")
    job = scheduler().submit(request)
    until(scheduler(), request.name, ended)
    text = (request.logs / f"{job}_0.out").read_text()
    assert "canary" not in text
    seen = dict(entry.split("=", 1) for entry in text.split("\0") if "=" in entry)
    assert seen["PATH"] == PATH
    assert seen["HOME"] == str(Path("~").expanduser())
    known = {"PATH", "HOME", "USER", "LOGNAME", "PWD", "TMPDIR", "HOSTNAME", "SHLVL", "OLDPWD", "ENVIRONMENT", "_"}
    slurms = ("SLURM", "PBS_", "CUDA_", "ROCR_", "GPU_", "ZE_")
    assert not [name for name in seen.keys() - known if not name.startswith(slurms)]


@pytest.mark.nightly
@pytest.mark.real
def test_the_callers_variables_for_slurm_do_not_affect_jobs(
    slurm: clusters.Slurm, request_of: Callable[..., Request], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {
        "SBATCH_PARTITION": "short",
        "SBATCH_TIMELIMIT": "1",
        "SBATCH_JOB_NAME": "other",
        "SBATCH_ARRAY_INX": "0-9",
        "SQUEUE_FORMAT": "%i",
        "SQUEUE_STATES": "PD",
        "SQUEUE_USERS": "nobody",
        "SLURM_CLUSTERS": "other",
        "SCANCEL_STATE": "PENDING",
        "SCANCEL_INTERACTIVE": "1",
    }.items():
        monkeypatch.setenv(name, value)
    request = request_of("sleep 60", 0, 1)
    job = scheduler().submit(request)
    assert [(task.job, task.element) for task in until(scheduler(), request.name, running)] == [(job, 0), (job, 1)]
    assert "Partition=debug" in slurm.command("scontrol", "show", "job", job)
    scheduler().cancel(request.name)
    until(scheduler(), request.name, ended)


@pytest.mark.integration
@pytest.mark.real
def test_jobs_of_other_names_are_neither_found_nor_cancelled(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    first, second = request_of("sleep 60", 0, name="sierra-a"), request_of("sleep 60", 0, name="sierra-b")
    scheduler().submit(first)
    job = scheduler().submit(second)
    scheduler().cancel(first.name)
    until(scheduler(), first.name, ended)
    assert [task.job for task in until(scheduler(), second.name, running)] == [job]
    assert scheduler().look("sierra-c") == ()


@pytest.mark.integration
@pytest.mark.real
def test_some_or_all_array_tasks_are_cancelled(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    request = request_of("sleep 60", *range(16))
    scheduler().submit(request)
    until(scheduler(), request.name, lambda seen: sum(task.state == State.RUNNING for task in seen) == 12)
    scheduler().cancel(request.name, [1, 2, 3, 15, 77])
    left = [0, *range(4, 15)]
    until(scheduler(), request.name, lambda seen: left == [task.element for task in seen if task.state != State.ENDED])
    scheduler().cancel(request.name)
    assert {task.reason for task in until(scheduler(), request.name, ended)} == {"CANCELLED"}
    scheduler().cancel(request.name)
    scheduler().cancel(request.name, [0])
    scheduler().cancel("sierra-never")
    scheduler().cancel("sierra-never", [0])


@pytest.mark.integration
@pytest.mark.real
def test_a_cancelled_array_task_gets_sigterm_and_may_finish(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    request = request_of("trap 'echo asked; exit' TERM; echo began; while :; do sleep 0.05; done")
    job = scheduler().submit(request)
    log = request.logs / f"{job}_0.out"
    until(scheduler(), request.name, lambda seen: log.exists() and "began" in log.read_text())
    scheduler().cancel(request.name)
    until(scheduler(), request.name, ended)
    assert {"began", "asked"} < {*log.read_text().splitlines()}


@pytest.mark.integration
@pytest.mark.real
@pytest.mark.parametrize(
    ("table", "elements", "words"),
    [
        ({"partition": "nope"}, (0,), "nvalid partition"),
        ({"partition": "drained"}, (0,), "not available"),
        ({"constraint": "nope"}, (0,), "Invalid feature specification"),
        ({"gpus": 9}, (0,), "Requested node configuration is not available"),
        ({"memory": 1 << 50}, (0,), "Memory specification can not be satisfied"),
        ({"directives": ("--nonsense",)}, (0,), "unrecognized option '--nonsense'"),
        ({"directives": ("--reservation=nope",)}, (0,), "reservation is invalid"),
        ({"directives": ("--licenses=nope:1",)}, (0,), "Invalid license"),
        ({}, (0, 1001), "Invalid job array specification"),
    ],
)
def test_refusals_are_reported_with_slurms_message(
    table: dict[str, Any], elements: tuple[int, ...], words: str, slurm: clusters.Slurm, request_of: Callable[..., Request]
) -> None:
    request = request_of("true", *elements)
    with pytest.raises(ConfigError, match=words) as refused:
        scheduler(**table).submit(request)
    assert str(refused.value).startswith("SLURM: ")
    assert "\n" not in str(refused.value)
    assert ended([*(scheduler().look(request.name) or ()), Task("", None, State.ENDED)])


@pytest.mark.integration
@pytest.mark.real
@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ({"cpus": 99}, "PartitionConfig"),
        ({"wall": 7200.0}, "PartitionTimeLimit"),
        ({"directives": ("--nodes=9 --ntasks=9",)}, "PartitionNodeLimit"),
        ({"partition": "closed"}, "Job's account not known, so it can't use this partition"),
    ],
)
def test_jobs_that_can_never_begin_are_stuck(
    table: dict[str, Any], reason: str, slurm: clusters.Slurm, request_of: Callable[..., Request]
) -> None:
    request = request_of("true", 0, 1)
    scheduler(**table).submit(request)
    seen = until(scheduler(), request.name, lambda seen: any(task.state == State.STUCK for task in seen))
    assert [task.reason.startswith(reason) for task in seen if task.state == State.STUCK]


@pytest.mark.nightly
@pytest.mark.real
def test_jobs_held_by_an_administrator_are_stuck_and_jobs_held_by_the_user_wait(
    slurm: clusters.Slurm, request_of: Callable[..., Request]
) -> None:
    request = request_of()
    held = scheduler(directives=("--hold",)).submit(request)
    [task] = until(scheduler(), request.name, lambda seen: seen[0].reason != "")
    assert (task.state, task.reason) == (State.QUEUED, "JobHeldUser")
    slurm.command("scontrol", "release", held)
    until(scheduler(), request.name, ended)
    job = scheduler().submit(request_of("sleep 60", name="sierra-held"))
    until(scheduler(), "sierra-held", running)
    slurm.command("scontrol", "requeuehold", job)
    [task] = until(scheduler(), "sierra-held", lambda seen: seen[0].state == State.STUCK)
    assert "held" in task.reason.lower()


@pytest.mark.nightly
@pytest.mark.real
def test_a_dependent_job_waits_for_the_other(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    first = scheduler().submit(request_of("sleep 1", name="sierra-first"))
    scheduler().submit(request_of("sleep 1", name="sierra-second", after=first))
    seen = until(scheduler(), "sierra-second", ended)
    assert {task.reason for task in seen} == {"COMPLETED"}


@pytest.mark.nightly
@pytest.mark.real
def test_a_job_that_depends_on_a_failed_job_never_begins(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    folder = request_of().folder
    first = scheduler().submit(request_of("exit 7", name="sierra-first"))
    until(scheduler(), "sierra-first", ended)
    second = replace(request_of(name="sierra-second", after=first), command=("touch", str(folder / "begun")))
    scheduler().submit(second)
    until(scheduler(), "sierra-second", lambda seen: bool(seen) and seen[0].state in (State.ENDED, State.STUCK))
    assert not [*folder.glob("begun*")]


@pytest.mark.integration
@pytest.mark.real
def test_a_task_that_lost_its_node_is_requeued(slurm: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    request = request_of('echo "began $SLURM_RESTART_COUNT"; test -n "$SLURM_RESTART_COUNT" || sleep 60')
    job = scheduler().submit(request)
    log = request.logs / f"{job}_0.out"
    [task] = until(scheduler(), request.name, lambda seen: running(seen) and log.exists() and log.read_text() == "began \n")
    slurm.power_cut(task.node)
    slurm.declare_down(task.node)
    [again] = until(scheduler(), request.name, lambda seen: seen[0].reason == "BeginTime")
    assert again.state == State.QUEUED
    slurm.release_requeued()
    [done] = until(scheduler(), request.name, ended)
    assert (done.reason, done.node == task.node) == ("COMPLETED", False)
    assert log.read_text() == "began \nbegan 1\n"


@pytest.fixture
def small(require: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> Iterator[clusters.Slurm]:
    """Yield a separate cluster that forgets jobs early and accepts few jobs."""
    clusters.needed(require)
    settings = {"MinJobAge": "2", "MaxJobCount": "5", "MessageTimeout": "2"}
    settings["SchedulerParameters"] = clusters.SETTINGS["SchedulerParameters"] + ",max_array_tasks=4"
    with clusters.folder() as folder, clusters.Slurm(folder, nodes=1, settings=settings) as cluster:
        for name, value in cluster.environment.items():
            monkeypatch.setenv(name, value)
        yield cluster


@pytest.mark.real
@pytest.mark.nightly
def test_the_state_is_unknown_while_the_controller_is_down(small: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    request = request_of("sleep 60")
    job = scheduler().submit(request)
    until(scheduler(), request.name, running)
    small.kill_controller()
    assert scheduler().look(request.name) is None
    with pytest.raises(Missing, match="Unable to contact slurm controller"):
        scheduler().submit(request)
    with pytest.raises(Missing, match="Unable to contact slurm controller"):
        scheduler().bounds()
    with pytest.raises(Missing):
        scheduler().cancel(request.name)
    with pytest.raises(Missing):
        scheduler().cancel(request.name, [0])
    small.start_controller()
    assert {task.job for task in scheduler().look(request.name) or ()} <= {job}


@pytest.mark.real
@pytest.mark.nightly
def test_slurm_forgets_jobs_that_ended_long_ago(small: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    request = request_of()
    scheduler().submit(request)
    until(scheduler(), request.name, ended)
    until(scheduler(), request.name, lambda seen: not seen, seconds=200)


@pytest.mark.nightly
@pytest.mark.real
def test_jobs_held_after_a_failed_launch_are_stuck(small: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    shutil.rmtree(small.root / "spool.n1")
    request = request_of("true", 0, 1)
    scheduler().submit(request)
    seen = until(scheduler(), request.name, lambda seen: all(task.state == State.STUCK for task in seen))
    assert [(task.element, task.reason) for task in seen] == [(each, "launch failed requeued held") for each in (0, 1)]
    scheduler().cancel(request.name)
    until(scheduler(), request.name, ended)


@pytest.mark.integration
@pytest.mark.real
def test_a_full_queue_is_reported_immediately(small: clusters.Slurm, request_of: Callable[..., Request]) -> None:
    assert scheduler().bounds().array == 4
    scheduler().submit(request_of("sleep 60", 0, 1, 2))
    began = time.monotonic()
    with pytest.raises(Full, match="temporarily unable to accept job"):
        scheduler().submit(request_of("sleep 60", 0, 1, 2, name="sierra-second"))
    assert time.monotonic() - began < 30, "sbatch itself would have tried for two minutes"
    assert scheduler().look("sierra-second") == ()
