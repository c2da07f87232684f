"""The scheduler `pbs` in its dialects: a small emulation (`tests/pbs.py`), SLURM's real wrapper, recorded answers."""

from __future__ import annotations

import json
import os
import pwd
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sierra
from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError, Full, Missing
from sierra.runners.schedulers import qstat, qsub
from sierra.runners.schedulers.base import Request, State
from sierra.runners.schedulers.pbs import Pbs
from sierra.runners.schedulers.qsub import Dialect
from sierra.testing import runners
from sierra.util.text import ranges
from tests import clusters, pbs, projects
from tests.conftest import Simulated
from tests.waiting import until

DATA = Path(__file__).parents[3] / "data" / "pbs"
HOSTILE = "a'; echo foo"
SHAPES = [(0, 1, 2), (4,), (3, 7, 9, 10)]
NAME = "sierra-0123abcd"


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[pbs.Server]:
    """Yield a PBS server that commands on the PATH use; the home folder is separate."""
    home = tmp_path / "home"
    home.mkdir()
    made = pbs.Server(tmp_path / "server")
    monkeypatch.setenv("PATH", f"{made.bin}:{os.environ['PATH']}")
    monkeypatch.setenv("HOME", str(home))
    yield made
    made.end()


@pytest.fixture
def wrapper(slurm: clusters.Slurm, require: Callable[..., str]) -> clusters.Slurm:
    """Return a real SLURM with `qsub`, `qstat` and `qdel` of Debian's slurm-wlm-torque on the PATH."""
    for command in ("qsub", "qstat", "qdel"):
        require(command)
    return slurm


@pytest.fixture
def imitate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Return a function that puts a `qsub` on the PATH that executes a line of shell."""

    def imitate(line: str) -> None:
        (tmp_path / "qsub").write_text(f"#!/bin/sh\n{line}\n")
        (tmp_path / "qsub").chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    return imitate


@pytest.fixture
def ask(tmp_path: Path) -> Callable[..., Request]:
    """Return a function that makes a request whose array tasks execute a line of shell; $1 is the index."""

    def ask(line: str = "echo $1", elements: tuple[int, ...] = (0, 1, 2), *, name: str = NAME, after: str = "") -> Request:
        folder = tmp_path / HOSTILE
        (folder / "logs").mkdir(parents=True, exist_ok=True)
        return Request(name, "a batch,\nof runs", elements, folder, folder / "logs", ("sh", "-c", line, "sh"), after)

    return ask


def alive(scheduler: Pbs, name: str = NAME) -> set[int | None]:
    tasks = scheduler.look(name)
    assert tasks is not None
    return {task.element for task in tasks if task.state is not State.ENDED}


def ended(scheduler: Pbs, name: str = NAME) -> Callable[[], bool]:
    return lambda: not alive(scheduler, name)


def logs(request: Request) -> dict[str, str]:
    return {path.name: path.read_text() for path in request.logs.glob("*.out")}


# detection of the dialect


def test_openpbs_is_detected_by_the_version_of_qsub(server: pbs.Server) -> None:
    assert Pbs(ClusterTable()).version() == "openpbs 23.06.06"


def test_missing_commands_of_pbs_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ask: Callable[..., Request]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    scheduler = Pbs(ClusterTable())
    for called in (scheduler.version, scheduler.bounds, lambda: scheduler.submit(ask())):
        with pytest.raises(Missing, match="qsub is not installed here"):
            called()
    assert scheduler.look(NAME) is None


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("echo this is Grid Engine; exit 7", "this is Grid Engine"),
        ("printf 'Version: 6.1.2\\nCommit: 66cfc0\\n' >&2", "Version: 6.1.2; Commit: 66cfc0"),
    ],
    ids=["Grid Engine", "Torque"],
)
def test_a_qsub_of_another_scheduler_is_reported(imitate: Callable[[str], None], line: str, words: str) -> None:
    imitate(line)
    with pytest.raises(Missing, match=f"^qsub --version names no OpenPBS: {words}$"):
        Pbs(ClusterTable()).version()


def test_a_wrapper_that_cannot_reach_its_cluster_is_reported(imitate: Callable[[str], None]) -> None:
    imitate("echo perl: fatal: Could not establish a configuration source >&2; exit 1")
    with pytest.raises(Missing, match=r"qsub cannot reach its cluster: .*establish a configuration source$"):
        Pbs(ClusterTable()).version()


# submitting


@pytest.mark.parametrize("elements", SHAPES, ids=str)
def test_array_tasks_get_their_index_and_write_their_logs(
    server: pbs.Server, ask: Callable[..., Request], elements: tuple[int, ...]
) -> None:
    server.waiting()
    scheduler, request = Pbs(ClusterTable()), ask("pwd; echo element $1; echo wrong >&2", elements)
    job = scheduler.submit(request)
    tasks = scheduler.look(NAME)
    assert tasks is not None
    assert [(task.job, task.element, task.state) for task in tasks] == [(job, index, State.QUEUED) for index in elements]

    server.begin()
    until(ended(scheduler))
    number = re.split(r"[\[.]", job)[0]
    assert logs(request) == {f"{number}_{i}.out": f"{request.folder}\nelement {i}\nwrong\n" for i in elements}


@pytest.mark.parametrize("elements", SHAPES, ids=str)
def test_running_array_tasks_are_reported_with_their_node(
    server: pbs.Server, ask: Callable[..., Request], elements: tuple[int, ...]
) -> None:
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask("sleep 60", elements))
    tasks = scheduler.look(NAME)
    assert tasks is not None
    assert [(task.element, task.state, task.node) for task in tasks] == [(i, State.RUNNING, "pbs1") for i in elements]


def test_only_the_script_stays_in_the_folder(server: pbs.Server, ask: Callable[..., Request]) -> None:
    scheduler, request = Pbs(ClusterTable()), ask()
    scheduler.submit(request)
    until(ended(scheduler))
    assert sorted(path.name for path in request.folder.iterdir()) == ["logs", f"{NAME}.pbs"]
    assert (request.folder / f"{NAME}.pbs").read_text() == scheduler.script(request)
    assert list((request.folder.parent / "home").iterdir()) == []
    assert not list((request.folder.parent / "server").glob("undelivered"))


def test_the_end_of_a_job_does_not_wait_for_copies_of_its_output(server: pbs.Server, ask: Callable[..., Request]) -> None:
    server.set(copying=90)
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask())
    until(ended(scheduler))


def test_the_callers_environment_is_not_exported_even_if_the_site_exports_all(
    server: pbs.Server, ask: Callable[..., Request], monkeypatch: pytest.MonkeyPatch
) -> None:
    server.set(always_V=True)
    monkeypatch.setenv("SECRET_THING", "leak")
    scheduler, request = Pbs(ClusterTable()), ask("env", (0,))
    scheduler.submit(request)
    until(ended(scheduler))
    (said,) = logs(request).values()
    assert "PBS_JOBID=" in said
    assert "SECRET_THING" not in said
    assert "leak" not in said


def test_variables_of_the_callers_shell_do_not_affect_jobs(
    server: pbs.Server, ask: Callable[..., Request], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("PBS_DPREFIX", "PBS_JOBID", "PBS_ARRAY_INDEX", "SIERRA_ELEMENTS", "QSTATRCHOME", "SBATCH_ACCOUNT"):
        monkeypatch.setenv(name, "99")
    scheduler, request = Pbs(ClusterTable()), ask(elements=(1, 2))
    scheduler.submit(request)
    until(ended(scheduler))
    assert sorted(logs(request).values()) == ["1\n", "2\n"]


def test_an_unknown_queue_is_refused_with_the_schedulers_message(server: pbs.Server, ask: Callable[..., Request]) -> None:
    with pytest.raises(ConfigError, match=r"qsub refuses: Unknown queue.*; requested: partition = 'nope'"):
        Pbs(ClusterTable(partition="nope")).submit(ask())


def test_an_array_that_is_too_large_is_refused(server: pbs.Server, ask: Callable[..., Request]) -> None:
    server.set(max_array_size=2)
    with pytest.raises(ConfigError, match="Array job exceeds server or queue size limit"):
        Pbs(ClusterTable()).submit(ask())


def test_a_full_queue_is_reported_and_accepts_jobs_later(server: pbs.Server, ask: Callable[..., Request]) -> None:
    server.set(max_queued=4)
    server.waiting()
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask())
    with pytest.raises(Full, match="would exceed complex's per-user limit"):
        scheduler.submit(ask(elements=(3, 4)))
    assert alive(scheduler) == {0, 1, 2}
    server.begin()
    until(ended(scheduler))
    scheduler.submit(ask(elements=(3, 4)))


def test_a_qos_is_refused_because_only_slurm_has_it(server: pbs.Server, ask: Callable[..., Request]) -> None:
    with pytest.raises(ConfigError, match="qos = 'high' is an option of SLURM; use directives"):
        Pbs(ClusterTable(qos="high")).submit(ask())


def test_a_job_that_waits_for_another_is_queued_and_not_stuck(server: pbs.Server, ask: Callable[..., Request]) -> None:
    scheduler = Pbs(ClusterTable())
    first = scheduler.submit(ask("sleep 60", (0,), name="first"))
    request = ask("echo done", (0, 1), after=first)
    scheduler.submit(request)
    tasks = scheduler.look(NAME)
    assert tasks is not None
    assert {task.state for task in tasks} == {State.QUEUED}
    assert "done\n" not in logs(request).values()


@pytest.mark.parametrize(("command", "done"), [("true", 2), ("exit 3", 0)])
def test_a_dependent_job_executes_only_after_success_of_the_other(
    server: pbs.Server, ask: Callable[..., Request], command: str, done: int
) -> None:
    server.waiting()
    scheduler = Pbs(ClusterTable())
    request = ask("echo done", (0, 1), after=scheduler.submit(ask(command, (0,), name="first")))
    scheduler.submit(request)
    server.begin()
    until(ended(scheduler, "first"))
    until(ended(scheduler))
    assert list(logs(request).values()).count("done\n") == done


def test_a_job_that_depends_on_a_forgotten_job_ends_without_executing(server: pbs.Server, ask: Callable[..., Request]) -> None:
    scheduler = Pbs(ClusterTable())
    first = scheduler.submit(ask("true", (0,), name="first"))
    until(ended(scheduler, "first"))
    request = ask("echo done", after=first)
    scheduler.submit(request)
    assert alive(scheduler) == set()
    assert "done\n" not in logs(request).values()


def test_a_refused_dependency_is_not_an_error_of_the_project(
    ask: Callable[..., Request], imitate: Callable[[str], None]
) -> None:
    imitate("test $1 = --version && echo pbs_version = 23.06.06 && exit; echo qsub: Invalid Job Dependency >&2; exit 1")
    with pytest.raises(Missing, match="no longer known"):
        Pbs(ClusterTable()).submit(ask(after="99.pbs1"))


def test_a_server_that_crashes_during_submission_may_have_accepted_the_job(
    server: pbs.Server, ask: Callable[..., Request]
) -> None:
    server.waiting()
    server.set(dies=True)
    scheduler = Pbs(ClusterTable())
    with pytest.raises(Missing, match="Premature end of message"):
        scheduler.submit(ask())
    server.set(down=False)
    assert alive(scheduler) == {0, 1, 2}


# querying


def test_jobs_are_found_by_name_in_another_process(server: pbs.Server, ask: Callable[..., Request]) -> None:
    server.waiting()
    Pbs(ClusterTable()).submit(ask(elements=(1, 2)))
    Pbs(ClusterTable()).submit(ask(elements=(5,)))
    Pbs(ClusterTable()).submit(ask(name=f"{NAME[:-1]}x"))
    assert alive(Pbs(ClusterTable())) == {1, 2, 5}


def test_jobs_of_other_users_are_ignored(server: pbs.Server, ask: Callable[..., Request]) -> None:
    server.waiting()
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask())
    server.change(1, owner="somebody")
    assert scheduler.look(NAME) == ()
    scheduler.cancel(NAME)
    server.change(1, owner=pwd.getpwuid(os.geteuid()).pw_name)
    assert alive(scheduler) == {0, 1, 2}


def test_an_unknown_name_has_no_jobs(server: pbs.Server) -> None:
    assert Pbs(ClusterTable()).look(NAME) == ()


@pytest.mark.integration
@pytest.mark.parametrize("history", [False, True])
def test_ended_jobs_are_not_alive(server: pbs.Server, ask: Callable[..., Request], history: bool) -> None:
    server.set(history=history)
    scheduler = Pbs(ClusterTable())
    for elements in SHAPES:
        scheduler.submit(ask("exit 7", elements))
    until(ended(scheduler))
    assert alive(Pbs(ClusterTable())) == set()


def test_an_ended_array_task_of_a_running_array_is_reported_as_ended(server: pbs.Server, ask: Callable[..., Request]) -> None:
    server.set(history=True)
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask("test $1 = 7 || sleep 60; exit 7", (3, 7, 9)))
    until(lambda: alive(scheduler) == {3, 9})
    tasks = scheduler.look(NAME)
    assert tasks is not None
    assert [(task.element, task.reason) for task in tasks if task.state is State.ENDED] == [(7, "Exit_status 7")]


def test_the_exit_status_of_an_array_is_not_used_for_its_array_tasks(server: pbs.Server, ask: Callable[..., Request]) -> None:
    server.set(array_status=1)
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask("test $1 = 7 || sleep 60; exit 7", (3, 7, 9)))
    until(lambda: alive(scheduler) == {3, 9})
    tasks = scheduler.look(NAME)
    assert tasks is not None
    assert [(task.element, task.reason) for task in tasks if task.state is State.ENDED] == [(7, "")]


def test_each_query_is_one_call_that_names_the_known_jobs(server: pbs.Server, ask: Callable[..., Request]) -> None:
    server.waiting()
    scheduler = Pbs(ClusterTable())
    jobs = [scheduler.submit(ask()), scheduler.submit(ask(elements=(7,)))]
    scheduler.version()
    server.calls()
    for _ in range(4):
        assert alive(scheduler) == {0, 1, 2, 7}
    first, *others = server.calls()
    assert first[-1] == "json"
    assert len(others) == 3
    assert all(call[0] == "qstat" and call[-2:] == jobs for call in others)


def test_a_job_submitted_during_a_query_of_another_thread_is_found(
    server: pbs.Server, ask: Callable[..., Request], tmp_path: Path
) -> None:
    server.waiting()
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask())
    answer = tmp_path / "answer"
    server.set(slow=str(answer))
    server.calls()
    looking = threading.Thread(target=scheduler.look, args=(NAME,))
    looking.start()
    until(lambda: bool(server.calls()))
    scheduler.submit(ask(elements=(7,)))
    assert looking.is_alive()
    answer.touch()
    looking.join()
    for _ in range(2):
        assert alive(scheduler) == {0, 1, 2, 7}


def test_the_remaining_job_is_found_after_one_of_two_ends(server: pbs.Server, ask: Callable[..., Request]) -> None:
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask("sleep 60"))
    scheduler.submit(ask("sleep 60", (7,)))
    assert alive(scheduler) == {0, 1, 2, 7}
    subprocess.run(["qdel", "2.pbs1"], check=True)
    until(lambda: alive(scheduler) == {0, 1, 2})


def test_the_state_is_unknown_while_the_server_is_unreachable(server: pbs.Server, ask: Callable[..., Request]) -> None:
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask("sleep 60"))
    assert alive(scheduler) == {0, 1, 2}
    server.set(down=True)
    assert scheduler.look(NAME) is None
    for called in (scheduler.bounds, lambda: scheduler.submit(ask()), lambda: scheduler.cancel(NAME)):
        with pytest.raises(Missing, match=r"cannot connect to server pbs1|does not answer"):
            called()
    server.set(down=False)
    assert alive(scheduler) == {0, 1, 2}


def test_invalid_json_falls_back_to_the_text_format(server: pbs.Server, ask: Callable[..., Request]) -> None:
    server.set(broken_json=True)
    server.waiting()
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask(elements=(3, *range(7, 40, 2))))
    assert alive(scheduler) == {3, *range(7, 40, 2)}


def test_jobs_that_no_node_can_execute_are_stuck_with_the_schedulers_reason(
    server: pbs.Server, ask: Callable[..., Request]
) -> None:
    scheduler = Pbs(ClusterTable(cpus=100))
    for elements in ((0, 1), (2,)):
        scheduler.submit(ask(elements=elements))
    tasks = scheduler.look(NAME)
    assert tasks is not None
    assert [task.state for task in tasks] == [State.STUCK] * 3
    assert {task.reason for task in tasks} == {"Can Never Run: Insufficient amount of resource: ncpus (R: 100 A: 4 T: 4)"}


@pytest.mark.parametrize(("hold", "state"), [("s", State.STUCK), ("o", State.STUCK), ("u", State.QUEUED)])
def test_jobs_held_by_the_system_are_stuck_and_jobs_held_by_the_user_are_not(
    server: pbs.Server, ask: Callable[..., Request], hold: str, state: State
) -> None:
    server.waiting()
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask())
    server.change(1, hold=hold)
    tasks = scheduler.look(NAME)
    assert tasks is not None
    assert {(task.state, task.reason) for task in tasks} == {(state, f"held: {hold}")}


# cancelling


@pytest.mark.integration
@pytest.mark.parametrize("elements", [(4,), (3, 7, 9)], ids=str)
@pytest.mark.parametrize("waits", [True, False])
def test_all_jobs_of_one_name_are_cancelled(
    server: pbs.Server, ask: Callable[..., Request], elements: tuple[int, ...], waits: bool
) -> None:
    if waits:
        server.waiting()
    scheduler = Pbs(ClusterTable())
    scheduler.submit(ask("sleep 60", elements))
    scheduler.submit(ask("sleep 60", elements))
    scheduler.submit(ask("sleep 60", name="other"))
    Pbs(ClusterTable()).cancel(NAME)
    until(ended(scheduler))
    assert alive(scheduler, "other") == {0, 1, 2}
    scheduler.cancel(NAME)


def test_single_array_tasks_are_cancelled(server: pbs.Server, ask: Callable[..., Request]) -> None:
    scheduler = Pbs(ClusterTable())
    for elements in ((0, 1, 2), (4,), (5, 7, 9)):
        scheduler.submit(ask("sleep 60", elements))
    scheduler.cancel(NAME, [1, 4, 7, 99])
    until(lambda: alive(scheduler) == {0, 2, 5, 9})


def test_cancelling_without_jobs_succeeds(server: pbs.Server) -> None:
    Pbs(ClusterTable()).cancel(NAME)
    Pbs(ClusterTable()).cancel(NAME, [1])


# limits


def test_limits_come_from_the_server_and_the_queue(server: pbs.Server) -> None:
    server.set(max_array_size=500, max_queued=70)
    bounds = Pbs(ClusterTable()).bounds()
    assert (bounds.array, bounds.wall_s) == (500, 86400)


def test_openpbs_reports_the_limits_of_jobs_per_user(server: pbs.Server) -> None:
    server.set(max_queued=70, max_run=7)
    bounds = Pbs(ClusterTable(partition="workq")).bounds()
    assert (bounds.jobs, bounds.running) == (70, 7)
    assert bounds.whose["jobs"] == f"max_queued of {pbs.HOST}"
    assert bounds.whose["wall_s"] == "resources_max.walltime of workq"


def test_an_unknown_queue_has_no_limit_of_time(server: pbs.Server) -> None:
    assert Pbs(ClusterTable(partition="nope")).bounds().wall_s is None


# scripts

FULL_TABLE = ClusterTable(
    cpus=4,
    memory=1_000_000_000,
    wall=3725.5,
    partition="long",
    account="physics",
    constraint="bigmem",
    gpus=2,
    modules=("gcc/12 openmpi", "python"),
    directives=("-l place=excl",),
)


@pytest.mark.parametrize("dialect", list(Dialect))
def test_scripts_equal_the_recorded_ones(dialect: Dialect) -> None:
    folder = Path("/shared") / HOSTILE
    words = ("python3", "-I", "-S", str(folder / "array_task.py"), str(folder))
    request = Request(NAME, "batch 12ab of swarm", (0, 1, 2, 3), folder, folder / "logs", words)
    scripts = [
        qsub.script(request, ClusterTable(), dialect),
        qsub.script(Request(NAME, "x", (3, 7, 8, 9), folder, folder / "logs", words, "12[].pbs1"), FULL_TABLE, dialect),
        qsub.script(Request(NAME, "x", (5,), folder, folder / "logs", words, "12.pbs1"), ClusterTable(), dialect),
    ]
    assert "\n".join(scripts) == (DATA / f"scripts.{dialect}").read_text()


# recorded answers


def test_a_recorded_array_of_openpbs_is_parsed() -> None:
    records = qstat.own(qstat.json_records((DATA / "arrt.json").read_text()), "arr", "pbsu")
    tasks = list(qstat.tasks(records))
    assert [(task.job, task.element, task.state) for task in tasks] == [("5[].pbs1", i, State.ENDED) for i in range(6)]
    assert {task.node for task in tasks} == {"pbs1"}
    assert [task.reason for task in tasks] == ["", "", "", "Exit_status 7", "", ""]


def test_a_recorded_array_without_array_tasks_is_reported_as_a_whole() -> None:
    (task,) = qstat.tasks(qstat.own(qstat.json_records((DATA / "arr.json").read_text()), "arr", "pbsu"))
    assert (task.job, task.element, task.state) == ("5[].pbs1", None, State.ENDED)


@pytest.mark.parametrize(("answer", "reason"), [("ended-forgotten", ""), ("ended-remembered", "Exit_status 7")])
def test_a_recorded_running_array_is_parsed(answer: str, reason: str) -> None:
    """Array task 1 ended with 7 and array task 2 with 0; without a history, and with one."""
    tasks = list(qstat.tasks(list(qstat.json_records((DATA / f"{answer}.json").read_text()))))
    states = [State.RUNNING, State.ENDED, State.ENDED, State.RUNNING]
    assert [(task.element, task.state) for task in tasks] == list(enumerate(states))
    assert [task.reason for task in tasks[1:3]] == [reason, ""]


@pytest.mark.parametrize("text", ["", "{}", '{"timestamp": 1, "pbs_version": "23.06.06"}'])
def test_an_answer_without_jobs_has_no_records(text: str) -> None:
    assert list(qstat.json_records(text)) == []


@pytest.mark.parametrize("text", ["[", "[]", '{"Jobs": 3}', '{"Jobs": {"1.pbs1": 3}}', '{"Jobs": {"1": {"a": "b"c"}}}'])
def test_an_invalid_answer_is_an_error(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        list(qstat.json_records(text))


@given(st.sets(st.integers(0, 300), min_size=1))
def test_positions_in_an_array_map_to_the_submitted_indices(elements: set[int]) -> None:
    said = ranges(sorted(elements), "+")
    record = {"Variable_List": f"PBS_O_HOME=/x,{qstat.ELEMENTS}={said}"}
    found = [qstat.element({"id": f"1[{place}].pbs1", **record}) for place in range(len(elements))]
    assert found == sorted(elements)


@pytest.mark.parametrize("said", ["", "1-", "+", "1--2", "1-2-3", "5-3", "x"])
def test_damaged_lists_of_array_tasks_are_not_guessed(said: str) -> None:
    record = {"Variable_List": f"PBS_O_HOME=/x,{qstat.ELEMENTS}={said},PBS_O_PATH=/y"}
    assert qstat.element({"id": "1[0].pbs1", **record}) is None


@pytest.mark.integration
@given(st.text())
def test_any_text_of_qstat_is_parsed_without_an_error(text: str) -> None:
    list(qstat.tasks(list(qstat.text_records(f"Job Id: 1.pbs1\n{text}\nJob Id: 2[1].pbs1\n    job_state = {text}"))))


# conformance of every scheduler


@pytest.mark.nightly
def test_pbs_passes_the_conformance_checks_for_schedulers(server: pbs.Server, tmp_path: Path) -> None:
    runners.check(Pbs(ClusterTable()), tmp_path / "shared")


@pytest.mark.nightly
@pytest.mark.real
def test_pbs_over_slurm_passes_the_conformance_checks_for_schedulers(wrapper: clusters.Slurm) -> None:
    with clusters.folder() as folder:
        runners.check(Pbs(ClusterTable()), folder)


# batches

CLUSTER = f"""
[runners.pbs]
array_tasks = 3
python = "{sys.executable}"
"""
WAITS = """
import os, time
while not os.path.exists({gate!r}):
    time.sleep(0.02)
"""


def begun(server: pbs.Server, root: Path) -> int:
    """Let jobs begin after the array tasks of a batch were submitted; return the number of their job.

    Not earlier: they depend on a probe, which could end and be forgotten before their submission.
    """
    until(lambda: [job for job in sent(root) if job])
    server.begin()
    return int(sent(root)[0].partition("[")[0])


def sent(root: Path) -> list[str]:
    return [json.loads(file.read_text())["job"] or "" for file in root.glob(".sierra/work/*/sent/0.json")]


@pytest.mark.nightly
@pytest.mark.parametrize("which", ["one element", "all", "all while they wait"])
def test_deleted_jobs_end_the_session(server: pbs.Server, tmp_path: Path, which: str) -> None:
    gate = tmp_path / "gate"
    simulator = projects.SIMULATOR + WAITS.format(gate=str(gate))
    root = projects.make(tmp_path / "swarm", projects.CONFIG + CLUSTER, simulator=simulator)
    words = (projects.SIERRA, "run", "population_size.Log8", "--on", "pbs", "--no-figures")
    gate.touch()
    assert projects.quick(root, "run", "population_size=16", *words[3:]).returncode == 0  # nodes are probed
    gate.unlink()
    server.waiting()
    asked = subprocess.Popen(words, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until(lambda: [job for job in sent(root) if job])
    [job] = sent(root)
    if which == "all while they wait":
        server.calls()
        until(lambda: [call for call in server.calls() if call[0] == "qstat"])
    else:
        begun(server, root)
        until(lambda: len(list(root.glob(".sierra/work/*/results/[0-9]*.pack"))) == 3)
    subprocess.run(["qdel", job.replace("[]", "[1]") if which == "one element" else job], check=True)
    out, err = asked.communicate(timeout=200)
    assert asked.returncode == 130, out + err
    assert f"pbs job {job} was cancelled, but not by SIERRA" in err
    assert "submitted again" not in err
    gate.touch()
    server.begin()
    done = projects.quick(root, *words[1:])
    assert done.returncode == 0, done.stderr
    assert sierra.open(root).sql("SELECT count(*) AS n FROM runs WHERE status = 'ok'").to_pylist() == [{"n": 10}]


@pytest.mark.nightly
def test_a_batch_completes_although_an_array_task_is_deleted(server: pbs.Server, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    simulator = projects.SIMULATOR + WAITS.format(gate=str(gate))
    table = CLUSTER + 'cancelled = "resubmit"\n'
    root = projects.make(tmp_path / HOSTILE, projects.CONFIG + table, simulator=simulator)
    words = (projects.SIERRA, "run", "population_size.Log8", "--on", "pbs", "--no-figures")
    server.waiting()
    asked = subprocess.Popen(words, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    number = begun(server, root)
    until(lambda: len(list(root.glob(".sierra/work/*/results/[0-9]*.pack"))) == 3)
    subprocess.run(["qdel", f"{number}[1].pbs1"], check=True)
    again = tmp_path / "server" / f"{number + 1}.SC"
    until(again.exists)
    gate.touch()
    out, err = asked.communicate(timeout=200)
    assert asked.returncode == 0, err
    assert "8 runs: 8 executed, 0 reused" in out
    jobs = (
        sierra.open(root).sql("SELECT array_task, job FROM attempts WHERE state = 'finished' ORDER BY array_task").to_pylist()
    )
    assert jobs == [
        {"array_task": 0, "job": f"{number}[0].pbs1"},
        {"array_task": 1, "job": f"{number + 1}.pbs1"},
        {"array_task": 2, "job": f"{number}[2].pbs1"},
    ]
    text = again.read_text()
    assert "SIERRA_ELEMENTS=1" in text
    until(ended(Pbs(ClusterTable()), re.findall("-N (.*)", text)[0]), "no task is left")


@pytest.mark.nightly
def test_an_array_task_reports_its_expired_time_limit_if_pbs_does_not(server: pbs.Server, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    simulator = projects.SIMULATOR + WAITS.format(gate=str(gate))
    root = projects.make(tmp_path / "swarm", projects.CONFIG + CLUSTER + "wall = 3\n", simulator=simulator)
    words = (projects.SIERRA, "run", "population_size=1,2", "--on", "pbs", "--no-figures")
    server.waiting()
    asked = subprocess.Popen(words, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    begun(server, root)
    until(lambda: len(list(root.glob(".sierra/work/*/sent/*.json"))) > 1)
    gate.touch()
    _, err = asked.communicate(timeout=60)
    assert asked.returncode == 1, err
    expired = r"array task: asked to end after \d s \(walltime of 3 s exceeded\)"
    assert re.search(rf"failed, cut off once: {expired}; it had all of that time: set a longer wall in \[runners.pbs\]", err)
    assert re.search(f"submitted again: {expired}", err)


@pytest.mark.nightly
def test_runs_see_the_devices_that_a_hook_of_pbs_set(
    server: pbs.Server, simulate: Callable[..., Simulated], tmp_path: Path
) -> None:
    hooked = tmp_path / "hooked"
    hooked.write_text(f'#!/bin/sh\nCUDA_VISIBLE_DEVICES=GPU-1f exec "{sys.executable}" "$@"\n')
    hooked.chmod(0o755)
    made = simulate('printf "t,v\\n1,$CUDA_VISIBLE_DEVICES\\n" > swarm.csv')
    config = made.folder / "sierra.toml"
    config.write_text(config.read_text() + f'[runners.pbs]\narray_tasks = 1\npython = "{hooked}"\n')
    project = sierra.open(made.folder)
    assert project.run("size=1", runs=1, runner="pbs", figures=False).failed == 0
    assert project.sql("SELECT v FROM swarm").to_pylist() == [{"v": "GPU-1f"}]
    [told] = project.sql("SELECT allocation FROM attempts").to_pylist()
    assert json.loads(told["allocation"])["CUDA_VISIBLE_DEVICES"] == "GPU-1f"


# SLURM's wrapper


@pytest.mark.integration
@pytest.mark.real
def test_slurms_wrapper_executes_jobs_with_the_requested_resources(
    wrapper: clusters.Slurm, ask: Callable[..., Request], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET_THING", "leak")
    scheduler = Pbs(ClusterTable(cpus=2, memory=100 << 20, wall=60, constraint="fast", gpus=1, directives=("-p 5",)))
    request = ask("pwd; echo $1 of $PBS_JOBNAME with $SLURM_CPUS_ON_NODE, $SLURM_GPUS_ON_NODE; env >&2", (1, 4, 5))
    job = scheduler.submit(request)
    for index in request.elements:
        wrapper.until(job, "COMPLETED", element=index)
    found = logs(request)
    assert set(found) == {f"{job}_{index}.out" for index in request.elements}
    for index in request.elements:
        assert found[f"{job}_{index}.out"].startswith(f"{request.folder}\n{index} of {NAME} with 2, 1\n")
        assert "SECRET_THING" not in found[f"{job}_{index}.out"]
        assert "SLURM_GET_USER_ENV" not in found[f"{job}_{index}.out"], "a login shell was started for it"
    assert sorted(path.name for path in request.folder.iterdir()) == ["logs", f"{NAME}.pbs"]


@pytest.mark.integration
@pytest.mark.real
def test_array_tasks_over_slurm_are_reported_and_cancelled(wrapper: clusters.Slurm, ask: Callable[..., Request]) -> None:
    scheduler = Pbs(ClusterTable())
    assert re.fullmatch(r"slurm \S+ \(its qsub\)", scheduler.version())
    assert scheduler.bounds().array == 1001
    job = scheduler.submit(ask("sleep 60", (1, 4, 5)))
    tasks = Pbs(ClusterTable()).look(NAME)
    assert tasks is not None
    living = [task for task in tasks if task.state is not State.ENDED]
    assert sorted((task.job, task.element) for task in living) == [(job, 1), (job, 4), (job, 5)]
    scheduler.cancel(NAME, [4])
    until(lambda: alive(scheduler) == {1, 5})
    scheduler.cancel(NAME)
    until(ended(scheduler))


@pytest.mark.nightly
@pytest.mark.real
def test_the_wrappers_qstat_is_parsed_and_its_qdel_cancels_the_job(
    wrapper: clusters.Slurm, ask: Callable[..., Request]
) -> None:
    job = Pbs(ClusterTable()).submit(ask("sleep 60", (3,)))
    wrapper.until(job, "RUNNING")
    records = qstat.own(qstat.text_records(wrapper.command("qstat", "-f")), NAME, pwd.getpwuid(os.geteuid()).pw_name)
    (task,) = [task for task in qstat.tasks(records) if task.job == job]
    assert task.state is State.RUNNING
    assert task.node in wrapper.names
    wrapper.command("qdel", job)
    wrapper.until(job, "CANCELLED")


@pytest.mark.integration
@pytest.mark.real
@pytest.mark.parametrize(
    ("table", "words"),
    [
        (ClusterTable(partition="nope"), "Invalid partition name specified"),
        (ClusterTable(constraint="nope"), "Invalid feature specification"),
        (ClusterTable(gpus=9), "Requested node configuration is not available"),
        (ClusterTable(directives=("-l walltime=x",)), "Invalid"),
    ],
)
def test_refusals_of_slurms_wrapper_are_reported_with_its_message(
    wrapper: clusters.Slurm, ask: Callable[..., Request], table: ClusterTable, words: str
) -> None:
    with pytest.raises(ConfigError, match=f"qsub refuses: .*{words}"):
        Pbs(table).submit(ask())
