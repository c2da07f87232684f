"""Faults of clusters that could stay unnoticed, mostly with a scheduler that misbehaves on request."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import itertools
import os
import pty
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest

import sierra
from sierra.api import Project
from sierra.config.cluster_table import ClusterTable
from sierra.config.plugin_registry import SCHEDULERS
from sierra.errors import ConfigError, Full, Missing, SierraError
from sierra.execution.observer import Progress
from sierra.execution.sessions import Session
from sierra.execution.summary import Summary
from sierra.runners.cluster import collect, runner
from sierra.runners.cluster.result_log_reader import Pack
from sierra.runners.schedulers.base import Bounds, Request, State, Task
from sierra.store.layout import user_apptainer
from sierra.store.store import Store
from sierra.worker.program import HERE
from sierra.worker.result_log import Attempt
from tests import containers, projects
from tests.clusters import Slurm
from tests.conftest import Simulated
from tests.observers import Observing
from tests.support.worker_zip import change
from tests.users import a_user, called_as
from tests.waiting import PATIENCE_S, until

QUERY = ("size=1,2,3",)
CLUSTER = "\n[runners.here]\narray_tasks = 1\n"
PRINTS = r"printf 't,v\n1,1\n2,4\n' > swarm.csv"


class Here:
    """A scheduler whose only node is this host, and that misbehaves on request."""

    name = "here"
    Options: ClassVar[type[ClusterTable]] = ClusterTable
    tasks: ClassVar[list[tuple[str, str, int, subprocess.Popen[bytes]]]] = []
    requests: ClassVar[list[Request]] = []
    numbers: ClassVar[Iterator[int]] = itertools.count(1)
    full: ClassVar[int] = 0
    """The number of further submissions that it refuses as full, except for the first array task."""
    walls: ClassVar[list[float | None]] = []
    """The time limits of array tasks in seconds, by job."""
    word: ClassVar[str] = "ENDED"
    """The word with which it reports the end of array tasks."""
    tells: ClassVar[dict[str, bool]] = {"CANCELLED": True}
    """A map from the word for an end to whether the array task was cancelled; unknown for other words."""
    cancelled: ClassVar[Callable[[], None] | None] = None
    """The action instead of ending cancelled array tasks."""

    held: ClassVar[int] = 0
    """The number of further jobs, except probes, that it cannot begin."""
    stuck: ClassVar[set[str]] = set()

    def __init__(self, table: ClusterTable) -> None:
        self._table = table

    @staticmethod
    def refuses(line: str) -> str | None:
        return None

    forgets: ClassVar[bool] = False
    requeue: ClassVar[tuple[str, ...]] = ()

    def version(self) -> str:
        return "here 1"

    def bounds(self) -> Bounds:
        return Bounds()

    def script(self, request: Request) -> str:
        return ""

    def submit(self, request: Request) -> str:
        if Here.full and request.elements[-1] > 0:
            Here.full -= 1
            raise Full("there is no room")
        Here.walls.append(self._table.wall)
        return self.start(request)

    @staticmethod
    def start(request: Request) -> str:
        job = str(next(Here.numbers))
        Here.requests.append(request)
        begins = not Here.held or request.name.startswith("probe-")
        if not begins:
            Here.held -= 1
            Here.stuck.add(job)
        for element in request.elements:
            environment = {"PATH": os.environ["PATH"], "TMPDIR": str(request.folder)}
            with (request.logs / f"{job}_{element}.out").open("wb") as log:
                argv = (*request.command, str(element)) if begins else ("sleep", "60")
                process = subprocess.Popen(argv, stdout=log, stderr=log, env=environment, start_new_session=True)
            Here.tasks.append((request.name, job, element, process))
        return job

    def look(self, name: str) -> tuple[Task, ...] | None:
        found = [(job, element, *Here.state(job, process)) for called, job, element, process in Here.tasks if called == name]
        return tuple(Task(*one, cancelled=Here.tells.get(one[-1])) for one in found)

    @staticmethod
    def state(job: str, process: subprocess.Popen[bytes]) -> tuple[State, str]:
        if process.poll() is not None:
            return State.ENDED, "CANCELLED" if job in Here.stuck else Here.word
        return (State.STUCK, "launch failed requeued held") if job in Here.stuck else (State.RUNNING, "")

    def explain(self, words: str) -> str:
        return words

    def cancel(self, name: str, elements: Sequence[int] | None = None) -> None:
        if Here.cancelled is not None:
            Here.cancelled()
            return
        for called, _, element, process in Here.tasks:
            if called == name and (elements is None or element in elements):
                process.terminate()


def cut_off(process: subprocess.Popen[bytes]) -> None:
    """Cut off an array task from its node, unless it has ended, which may happen at any time."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


@dataclass
class Clustered:
    """A project with this cluster."""

    simulated: Simulated
    gate: Path

    @property
    def project(self) -> Project:
        return sierra.open(self.simulated.folder)

    def session(self) -> Path:
        [found] = self.simulated.work()
        return found

    def rows(self, text: str) -> list[dict[str, Any]]:
        return self.simulated.sql(text)


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Here]]:
    monkeypatch.setitem(SCHEDULERS.shipped, "here", f"{__name__}:Here")
    monkeypatch.setattr(Here, "full", 0)
    monkeypatch.setattr(Here, "word", "ENDED")
    monkeypatch.setattr(Here, "cancelled", None)
    monkeypatch.setattr(Here, "held", 0)
    for name, seconds in (("FIRST_POLL_S", 0.1), ("LAST_POLL_S", 1.0), ("QUIET_S", 0.1)):  # it answers immediately
        monkeypatch.setattr(runner, name, seconds)
    yield Here
    for _, _, _, process in Here.tasks:
        cut_off(process)
        process.wait()
    Here.tasks.clear()
    Here.requests.clear()
    Here.walls.clear()


@pytest.fixture
def clustered(simulate: Callable[..., Simulated], here: type[Here], tmp_path: Path) -> Callable[..., Clustered]:
    def make(script: str = PRINTS, *, elements: int = 1) -> Clustered:
        made = simulate(script.replace("{gate}", str(tmp_path / "gate")))
        config = made.folder / "sierra.toml"
        config.write_text(config.read_text() + CLUSTER.replace("1", str(elements)))
        return Clustered(made, tmp_path / "gate")

    return make


WAITS = 'while [ ! -e "{gate}" ] && [ ! -e "{gate}.$SIERRA_RUN_ID" ]; do sleep 0.02; done; ' + PRINTS


# detaching


@pytest.mark.nightly
def test_the_option_detach_asks_no_question_on_a_terminal(simulate: Callable[..., Simulated], slurm: Slurm) -> None:
    project = simulate()
    terminal, theirs = pty.openpty()
    process = project.start(
        "run", *QUERY, "--runs", "1", "--on", "slurm", "--detach", stdin=theirs, stdout=theirs, stderr=theirs
    )
    os.close(theirs)
    said = ""
    while "[D/c]" not in said and select.select([terminal], [], [], PATIENCE_S)[0]:
        try:
            said += os.read(terminal, 65536).decode()
        except OSError:  # it has ended
            break
    os.close(terminal)
    assert "detach or cancel?" not in said
    assert process.wait(PATIENCE_S) == 0


# no results are deleted


@pytest.mark.nightly
def test_a_session_whose_scheduler_is_not_installed_is_kept(
    clustered: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = clustered(WAITS)
    made.project.run(*QUERY, runs=1, runner="here", detach=True, figures=False)
    session = made.session()
    with monkeypatch.context() as patch:
        patch.delitem(SCHEDULERS.shipped, "here")
        with pytest.raises(ConfigError, match="scheduler"):
            made.project.jobs.attach(session.name, figures=False)
        made.project.jobs.status()
    assert (session / "submission.json").exists()
    made.gate.touch()
    assert made.project.jobs.attach(session.name, figures=False).missing == 0


def test_runs_that_end_during_cancellation_are_kept(
    clustered: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = clustered(WAITS)
    submit, look = Here.submit, Here.look

    def slowed(text: str) -> str:
        changed, found = re.subn(r"(?m)^SYNC_S = .*$", "SYNC_S = 600.0", text)
        assert found == 1
        return changed

    def late_to_heed(self: Here, request: Request) -> str:
        change(request.folder / "worker.pyz", "result_log.py", slowed)
        return submit(self, request)

    monkeypatch.setattr(Here, "submit", late_to_heed)
    made.project.run(*QUERY, runs=1, runner="here", detach=True, figures=False)
    made.simulated.until_executed(1)
    monkeypatch.setattr(collect, "READ_S", 60.0)
    monkeypatch.setattr(Here, "cancelled", made.gate.touch)

    def late(self: Here, name: str) -> tuple[Task, ...] | None:
        until(lambda: all(process.poll() is not None for *_, process in Here.tasks))
        return look(self, name)

    monkeypatch.setattr(Here, "look", late)
    [done] = made.project.jobs.cancel(made.session().name)
    assert (done.kept, done.missing) == (3, 0)


@pytest.mark.nightly
def test_sessions_of_another_user_are_not_taken_over(require: Callable[..., str]) -> None:
    require("root, to be another user", there=os.geteuid() == 0)
    require("useradd")
    with a_user(f"sierra-test-{os.getpid()}", ids=False) as user:
        store = Store.create(user.home / "store").paths
        session = Session(store)
        session.paths.submission.write_text("{}")
        session.leave()
        session.close()
        store.work_lock.chmod(0o666)

        def check() -> None:
            assert Session.adopted(store, session.paths) is None

        called_as(user, check)


@pytest.mark.nightly
def test_a_partially_removed_session_is_not_a_submission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(Store.create(tmp_path / "store").paths, logged=False)
    for number in range(8):
        (session.paths.root / f"folder{number}").mkdir()
    session.paths.submission.write_text("{}")

    def killed(folder: str) -> None:
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr("sierra.execution.sessions.remove", killed)
        with pytest.raises(SystemExit):
            session.close()
    assert session.paths.root.exists()
    assert not session.paths.submission.exists()


@pytest.mark.nightly
def test_a_session_with_unreadable_results_is_cancelled(clustered: Callable[..., Clustered]) -> None:
    from sierra.worker import result_log

    made = clustered(WAITS)
    made.project.run(*QUERY, runs=1, runner="here", detach=True, figures=False)
    made.simulated.until_executed(1)
    session = made.session()
    (session / "results" / "0.other.pack").write_bytes(result_log.line_of({"event": "end", "told": "otherwise"}))
    with pytest.raises(SierraError, match="another version"):
        made.project.jobs.cancel(session.name)
    until(lambda: all(process.poll() is not None for *_, process in Here.tasks))
    assert session.exists()


# executed runs, and how often


def test_a_full_queue_does_not_make_runs_fail(clustered: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch) -> None:
    which = 'if [ "$SIERRA_RUN_ID" = "$(cat "{gate}.which")" ] && [ ! -e "{gate}" ]; then touch "{gate}"; sleep 60; fi; '
    made = clustered(which + PRINTS, elements=2)
    made.gate.with_name("gate.which").write_text(made.project.plan(*QUERY, runs=1).batch.runs[1].id)
    monkeypatch.setattr(runner, "FULL_S", 0.1)
    monkeypatch.setattr(Here, "full", 5)
    cut: list[subprocess.Popen[bytes]] = []

    def watch(progress: Progress) -> None:
        if made.gate.exists() and not cut:
            cut.append(Here.tasks[-1][-1])
            cut_off(cut[0])

    summary = made.project.run(*QUERY, runs=1, runner="here", observer=Observing(watch), figures=False)
    assert cut
    assert (summary.failed, summary.executed) == (0, 3), summary.failures


def test_array_tasks_get_more_time_if_the_estimate_was_too_short(
    clustered: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = clustered(WAITS)
    first = made.project.plan("size=1", runs=1).batch.runs[0].id
    made.gate.with_name(f"gate.{first}").touch()
    made.project.run("size=1", runs=1, figures=False)
    monkeypatch.setattr(Here, "word", "TIMEOUT")

    def watch(progress: Progress) -> None:
        begun = [process for name, *_, process in Here.tasks if name.startswith("sierra-")]
        if not progress.running or begun[-1].poll() is not None:
            return
        if len(begun) < 3:
            cut_off(begun[-1])
        else:
            made.gate.touch()

    summary = made.project.run("size=2", runs=1, runner="here", observer=Observing(watch), figures=False)
    assert (summary.executed, summary.failed) == (1, 0), summary.failures
    least, *longer = [
        wall for wall, request in zip(Here.walls, Here.requests, strict=True) if request.name.startswith("sierra-")
    ]
    assert least is not None
    assert longer == [2 * least, 4 * least]


@pytest.mark.nightly
def test_resubmitted_jobs_with_more_time_are_found_by_the_scheduler(
    clustered: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = clustered(WAITS, elements=2)
    made.gate.touch()
    made.project.run("size=1", runs=1, figures=False)
    made.gate.unlink()
    monkeypatch.setattr(Here, "word", "TIMEOUT")
    submit, look = Here.submit, Here.look
    looks: Counter[int] = Counter()
    """The number of queries for array tasks, by their count."""

    def forgets(self: Here, request: Request) -> str:
        self.__dict__.pop(request.name, None)
        return submit(self, request)

    def remembers(self: Here, name: str) -> tuple[Task, ...]:
        alive = self.__dict__.get(name)
        tasks = [task for task in look(self, name) or () if not alive or task.job in alive]
        self.__dict__[name] = {task.job for task in tasks if task.state is not State.ENDED}
        looks[len(Here.tasks)] += name.startswith("sierra-")
        return tuple(tasks)

    monkeypatch.setattr(Here, "submit", forgets)
    monkeypatch.setattr(Here, "look", remembers)

    def watch(progress: Progress) -> None:
        sent = [process for name, *_, process in Here.tasks if name.startswith("sierra-")]
        if progress.running == 2 and len(sent) == 2:
            cut_off(sent[0])
        elif len(sent) > 2 and looks[len(Here.tasks)] > 10:
            made.gate.touch()

    summary = made.project.run("size=2", runs=2, runner="here", observer=Observing(watch), figures=False)
    assert (summary.executed, summary.failed) == (2, 0), summary.failures
    assert [request.elements for request in Here.requests if request.name.startswith("sierra-")] == [(0, 1), (0,)]


@pytest.mark.nightly
def test_array_tasks_that_could_not_begin_are_submitted_again_with_a_notice(
    clustered: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Here, "held", 1)
    said: list[str] = []
    made = clustered()
    summary = made.project.execute(
        made.project.plan(*QUERY, runs=1), runner="here", observer=Observing(notice=said.append), figures=False
    )
    assert (summary.executed, summary.failed) == (3, 0)
    assert "1 array task is submitted again: launch failed requeued held (CANCELLED)" in said


def gives_back(project: Project) -> Callable[[Progress], None]:
    """Let another session claim a run of the query, and release it when it is waited for."""
    other = Session(Store.create(project.paths.store).paths, logged=False)
    other.claim({project.plan(*QUERY, runs=1).batch.runs[0].id})

    def watch(progress: Progress) -> None:
        if progress.elsewhere:
            other.close()

    return watch


@pytest.mark.nightly
def test_runs_that_another_session_releases_are_executed(clustered: Callable[..., Clustered]) -> None:
    made = clustered()
    project = made.project
    summary = project.run(*QUERY, runs=1, runner="here", observer=Observing(gives_back(project)), figures=False)
    assert (summary.executed, summary.failed, summary.missing) == (3, 0, 0)
    assert made.simulated.work() == []


@pytest.mark.nightly
def test_a_failed_earlier_job_does_not_affect_released_runs(
    clustered: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Here, "word", "FAILED")
    made = clustered("sleep 3; " + PRINTS, elements=2)
    project = made.project
    summary = project.run(*QUERY, runs=1, runner="here", observer=Observing(gives_back(project)), figures=False)
    handed_over = [request.elements for request in Here.requests if request.name.startswith("sierra-")]
    assert handed_over == [(0, 1), (0,)]
    assert (summary.executed, summary.failed, summary.missing) == (3, 0, 0)


def test_a_duplicate_run_is_recorded_once(clustered: Callable[..., Clustered]) -> None:
    made = clustered(WAITS)
    project = made.project
    project.run(*QUERY, runs=1, runner="here", detach=True, figures=False)
    Here.start(Here.requests[-1])
    made.simulated.until_executed(2)
    [first] = set(made.simulated.executed())
    made.gate.with_name(f"gate.{first}").touch()
    made.simulated.until_executed(4)
    until(lambda: project.jobs.status() and made.rows("SELECT * FROM duplicates"), "the copy is recorded")
    for _ in range(3):
        project.jobs.status()
    assert made.rows("SELECT count(*) AS n FROM duplicates") == [{"n": 1}]
    made.gate.touch()
    project.jobs.attach(made.session().name, figures=False)
    assert made.rows(f"SELECT count(*) AS n FROM duplicates WHERE run = '{first}'") == [{"n": 1}]
    assert made.rows("SELECT 1 FROM duplicates c JOIN executions e USING (execution) WHERE c.attempt = e.attempt") == []


@pytest.mark.nightly
def test_a_program_that_changes_during_the_batch_gives_no_result(clustered: Callable[..., Clustered]) -> None:
    made = clustered()
    tool = made.simulated.folder.with_name("tool.sh")
    tool.write_text(WAITS.replace("{gate}", str(made.gate)))
    config = made.simulated.folder / "sierra.toml"
    config.write_text(config.read_text().replace('"sim.sh"', '"../tool.sh"'))

    def watch(progress: Progress) -> None:
        if progress.running and not made.gate.exists():
            tool.with_name("new").write_text(PRINTS.replace("4", "5"))
            tool.with_name("new").replace(tool)
            made.gate.touch()

    with pytest.raises(SierraError, match="differs from the one on the submitting host"):
        made.project.run(*QUERY, runs=1, runner="here", observer=Observing(watch), figures=False)
    assert made.rows("SELECT * FROM executions") == []


# replays


@pytest.mark.nightly
@pytest.mark.parametrize(("tells", "ended"), [({"FAILED": False}, False), ({}, True)])
def test_failed_array_tasks_that_nobody_cancelled_are_submitted_again(
    clustered: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch, tells: dict[str, bool], ended: bool
) -> None:
    """SLURM reports FAILED for an array task that ends late after a requeue."""
    monkeypatch.setattr(Here, "word", "FAILED")
    monkeypatch.setattr(Here, "tells", tells)
    made = clustered(WAITS)
    made.project.run(*QUERY, runs=1, runner="here", detach=True, figures=False)
    made.simulated.until_executed(1)
    [process] = [process for name, _, _, process in Here.tasks if not name.startswith("probe-")]
    process.terminate()
    process.wait()
    made.gate.touch()
    summary = made.project.jobs.attach(made.session().name, figures=False)
    assert (summary.interrupted, summary.missing > 0) == (ended, ended)


@pytest.mark.nightly
def test_a_replay_cancelled_by_another_process_gives_no_verdict(clustered: Callable[..., Clustered]) -> None:
    made = clustered(WAITS)
    made.gate.touch()
    batch = made.project.run(*QUERY, runs=1, figures=False).batch
    made.gate.unlink()

    def watch(progress: Progress) -> None:
        if progress.running and (made.session() / "submission.json").exists():
            (made.session() / "cancelled").touch()

    answer = made.project.replay(batch, runner="here", observer=Observing(watch))
    assert answer.interrupted
    assert made.rows("SELECT * FROM replays") == []


@pytest.mark.nightly
def test_files_of_a_replay_are_kept_across_file_systems(
    clustered: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = clustered()
    batch = made.project.run(*QUERY, runs=1, figures=False).batch
    if Path("/dev/shm").stat().st_dev == made.simulated.folder.stat().st_dev:
        pytest.skip("needs two file systems")
    monkeypatch.setattr(tempfile, "tempdir", "/dev/shm")
    answer = made.project.replay(batch, runner="here", keep=True)
    assert answer.kept is not None
    assert len(list(answer.kept.glob("*/output/swarm.csv"))) == 3


# code


@pytest.mark.nightly
def test_a_note_reports_ignored_files_that_nodes_do_not_get(clustered: Callable[..., Clustered]) -> None:
    made = clustered('cat "$1/built" > /dev/null && ' + PRINTS)
    folder = made.simulated.folder
    config = folder / "sierra.toml"
    config.write_text(config.read_text().replace('"{input}"]', '"{project}/built"]').replace('sim.sh"', 'sim.sh", "{project}"'))
    for name in ("built", "big.npy", "maps/a", "__pycache__/b.pyc", "environment/pyvenv.cfg"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("")
    (folder / ".gitignore").write_text("built\n*.npy\nmaps/\n__pycache__/\nenvironment/\n")
    projects.commit(folder)
    said: list[str] = []
    summary = made.project.execute(
        made.project.plan(*QUERY, runs=1), runner="here", observer=Observing(notice=said.append), figures=False
    )
    assert (summary.executed, summary.failed) == (3, 0)
    [note] = [text for text in said if "ignores" in text]
    assert note.startswith("git ignores big.npy, maps/ in the project: nodes get only those that the command")


@pytest.mark.nightly
def test_nodes_execute_what_was_recorded_although_a_file_changes(clustered: Callable[..., Clustered]) -> None:
    made = clustered('cat "${0%/*}/asked.log"; [ -s "${0%/*}/asked.log" ] && exit 1; ' + PRINTS)
    log = made.simulated.folder / "asked.log"
    log.write_text("")
    projects.commit(made.simulated.folder)
    plan = made.project.plan(*QUERY, runs=1)
    log.write_text("note: …\n")
    summary = made.project.execute(plan, runner="here", figures=False)
    assert (summary.executed, summary.failed) == (3, 0)
    log.write_text("")
    assert made.project.run(*QUERY, runs=1, runner="here", figures=False).reused == 3


def test_nodes_execute_the_program_that_was_checked(clustered: Callable[..., Clustered]) -> None:
    made = clustered('tr "\\0" "\\n" < /proc/$$/cmdline | head -n 1 > called; ' + PRINTS)
    assert '["sh", "sim.sh"' in (made.simulated.folder / "sierra.toml").read_text()
    summary = made.project.run(*QUERY, runs=1, runner="here", figures=False)
    assert (summary.executed, summary.failed) == (3, 0)
    digest = hashlib.sha256(f"{shutil.which('sh')}\n".encode()).hexdigest()
    assert made.rows("SELECT DISTINCT sha256 FROM artifacts WHERE path = 'called'") == [{"sha256": digest}]


# containers


@pytest.fixture
def contained(here: type[Here], tmp_path: Path, require: Callable[..., str]) -> Callable[..., Project]:
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    require("mksquashfs")
    require("apptainer")

    def make(image: Callable[[Path], Path], *more: str) -> Project:
        folder = containers.make(tmp_path / "project", image(tmp_path), 'engine = "apptainer"', *more)
        with (folder / "sierra.toml").open("a") as file:
            file.write(CLUSTER + "attempts = 1\n")
        return sierra.open(folder)

    return make


@pytest.mark.nightly
def test_mounts_are_available_on_nodes(contained: Callable[..., Project], tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "map").write_text("5\n")
    project = contained(containers.busybox, f'mounts = {{ "/data" = "{tmp_path}/maps" }}')
    summary = project.run("population_size=1", runner="here", figures=False)
    assert (summary.executed, summary.failed) == (2, 0)


@pytest.mark.nightly
def test_links_in_mounts_are_accepted_on_nodes(contained: Callable[..., Project], tmp_path: Path) -> None:
    (tmp_path / "maps" / "old").mkdir(parents=True)
    (tmp_path / "maps" / "latest").symlink_to("old")
    (tmp_path / "maps" / "gone").symlink_to("nowhere")
    project = contained(containers.busybox, f'mounts = {{ "/data" = "{tmp_path}/maps" }}')
    summary = project.run("population_size=1", runner="here", figures=False)
    assert (summary.executed, summary.failed) == (2, 0)


@pytest.mark.parametrize("isolation", ["run", "worker"])
def test_containers_on_nodes_need_no_files_of_sierra(contained: Callable[..., Project], isolation: str) -> None:
    project = contained(containers.python, f'isolation = "{isolation}"')
    project.run("population_size=1", runner="here", detach=True, figures=False)
    [jobs] = project.paths.store.glob("work/*/elements/0.jobs")
    told = gzip.decompress(jobs.read_bytes()).decode()
    for only_here in (Path(HERE), user_apptainer()):
        assert f"{only_here}/" not in told
    assert project.jobs.attach(jobs.parent.parent.name, figures=False).failed == 0


@pytest.mark.nightly
def test_nodes_report_a_missing_device(contained: Callable[..., Project]) -> None:
    if Path("/proc/driver/nvidia").exists():
        pytest.skip("there is a driver of NVIDIA's here")
    project = contained(containers.busybox, "gpu = true")
    with pytest.raises(Missing, match=r"\[container\] gpu: /proc/driver/nvidia: No such file"):
        project.run("population_size=1", runner="here", figures=False)
    assert project.store.rows("SELECT * FROM executions") == []


# runs that are held back until the first runs are timed


DIES = """
import os, sierra
from sierra.config.plugin_registry import SCHEDULERS
from tests.integration.clusters.test_silent_failures import Here

SCHEDULERS.shipped["here"] = "tests.integration.clusters.test_silent_failures:Here"
Here.submit = lambda self, request: os._exit(9)
sierra.open(".").run("size=1,2,3", runs=8, runner="here", figures=False)
"""
"""A submitter that dies just before it submits the first runs."""
PACKS = '"${gate%/*}"/*/.sierra/work/*/results/*.pack'
TOLD = f'gate="{{gate}}"; until grep -aqs "start.*$SIERRA_EXECUTION" {PACKS}; do sleep 0.02; done; '
"""A script that waits until the array task has reported the start of the run."""
KILLS = 'case "$(cat "{gate}.which")" in *$SIERRA_RUN_ID*) ' + TOLD + "kill -9 $(ps -o ppid= $PPID);; esac; " + PRINTS


@pytest.fixture
def untold(clustered: Callable[..., Clustered]) -> Callable[..., Clustered]:
    """Return a function that makes a project whose first runs are timed, because their duration is unknown."""

    def make(script: str, settings: str = "") -> Clustered:
        made = clustered(script)
        config = made.simulated.folder / "sierra.toml"
        config.write_text(config.read_text().replace("array_tasks = 1\n", settings))
        return made

    return make


def ask(made: Clustered, **how: Any) -> Summary:
    project = made.project
    return project.execute(project.plan(*QUERY, runs=8), runner="here", figures=False, **how)


def refuse(monkeypatch: pytest.MonkeyPatch) -> None:
    submit = Here.submit

    def refused(self: Here, request: Request) -> str:
        if request.elements[-1] > 0:
            raise ConfigError("no such array")
        return submit(self, request)

    monkeypatch.setattr(Here, "submit", refused)


@pytest.mark.nightly
def test_a_refused_submission_while_detaching_is_reported_and_cancels_no_runs(
    untold: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = untold(WAITS)
    said: list[str] = []

    def watch(progress: Progress) -> None:
        if progress.running and made.simulated.executed():
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        refuse(patch)
        ask(made, observer=Observing(watch, said.append))
    assert any("no such array" in text for text in said)
    made.gate.touch()
    assert made.project.jobs.attach(made.session().name, figures=False).missing == 0
    assert sorted(made.simulated.executed().values()) == [1] * 24


@pytest.mark.nightly
def test_runs_of_a_dead_submitter_are_released_if_their_submission_is_refused(
    untold: Callable[..., Clustered], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = untold(PRINTS)
    died = subprocess.run([sys.executable, "-c", DIES], cwd=made.simulated.folder, check=False, timeout=100)
    assert died.returncode == 9
    assert made.session().exists()

    def refused(self: Here, request: Request) -> str:
        raise ConfigError("no such account")

    with monkeypatch.context() as patch:
        patch.setattr(Here, "submit", refused)
        with pytest.raises(ConfigError, match="no such account"):
            ask(made)
    assert made.simulated.work() == []
    assert ask(made).missing == 0
    assert sorted(made.simulated.executed().values()) == [1] * 24


@pytest.mark.nightly
def test_first_runs_that_crash_their_node_do_not_block_the_batch(untold: Callable[..., Clustered]) -> None:
    made = untold(KILLS, "attempts = 1\n")
    runs = made.project.plan(*QUERY, runs=8).batch.runs
    made.gate.with_name("gate.which").write_text(f"{runs[0].id} {runs[-1].id}")
    summary = ask(made)
    assert (summary.failed, summary.executed, summary.missing) == (2, 24, 0)


def track(path: Path, node: str, started: float, ahead: float) -> collect.Track:
    """Return the state of an attempt at array task 0, on a node whose clock is ahead."""
    attempt = Attempt(node, "s", 0, "1_0", node, started, 1, 1, None, None, {}, {}, {}, "3.11", ahead)
    return collect.Track(Pack(path), 0, attempt, ahead=ahead)


@pytest.mark.nightly
def test_the_last_attempt_is_found_although_an_earlier_node_had_a_fast_clock(tmp_path: Path) -> None:
    before, after = track(tmp_path / "a", "n1", 5000.0, 3600.0), track(tmp_path / "b", "n2", 2000.0, 0.0)
    assert collect.last_of([before, after], 0) is after
    assert collect.last_of([after, before], 0) is after
    assert collect.last_of([before, after], 1) is None
    assert before.since == 1400.0
