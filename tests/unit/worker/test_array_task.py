"""Array tasks without a cluster: real processes that execute runs, pack results, and are killed at any moment."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sierra.errors import Damaged
from sierra.model import Client, Job, Limits
from sierra.runners import local
from sierra.runners.cluster.result_log_reader import Ended, Pack
from sierra.runners.cluster.shard import deal
from sierra.runners.schedulers.base import NodeVariables
from sierra.runners.schedulers.pbs import Pbs
from sierra.store.layout import SessionPaths
from sierra.util import worker_zip
from sierra.worker import allocation, checkpoints, element_jobs, machine, result_log
from sierra.worker.processes import cpu_of
from sierra.worker.result_log import Attempt, Finished, Requeued, Started, Trouble
from tests.pythons import python_of
from tests.support.worker_zip import change
from tests.waiting import PATIENCE_S, until


def job(
    name: str,
    code: str,
    *,
    limits: Limits | None = None,
    files: tuple[tuple[str, bytes], ...] = (),
    observe: Mapping[str, str] | None = None,
) -> Job:
    """A run that executes a shell script."""
    variables = {"PATH": os.defpath, "HOME": "\0/home", "SIERRA_RUN_DIR": "\0", "SIERRA_EXECUTION": name, "NAME": name}
    return Job(name, name, ("/bin/sh", "-c", code), variables, files, limits or Limits(grace_s=1), observe=observe)


def many(count: int, code: str) -> list[Job]:
    return [job(f"run{number}", code) for number in range(count)]


class Folder:
    """The folder of a session, as a submitter makes it, and the array tasks that were started on it."""

    def __init__(self, root: Path, scratch: Path) -> None:
        self.root = root
        self.scratch = scratch
        self.paths = SessionPaths(root)
        self.started: list[subprocess.Popen[str]] = []
        root.mkdir()
        scratch.mkdir()
        self.paths.results.mkdir()
        self.paths.worker.write_bytes(worker_zip.packed())
        self.set()

    def set(self, **settings: Any) -> None:
        node = asdict(Pbs.node)
        given = {"session": "5e55", "slots": 2, "scratch": str(self.scratch), "needs": [], "record": [], "node": node}
        self.paths.element_settings.write_text(json.dumps(given | settings))

    def deal(self, jobs: Sequence[Job], elements: int = 1) -> tuple[int, ...]:
        return deal(jobs, elements, self.paths)

    def start(self, *words: str, python: str = sys.executable, **variables: str) -> subprocess.Popen[str]:
        """Start `worker.pyz array_task FOLDER WORDS`."""
        command = [python, "-I", "-S", str(self.paths.worker), "array_task", str(self.root), *(words or ("0",))]
        environment = {"PATH": os.defpath, "MARK": str(self.root), **variables}
        self.started.append(
            subprocess.Popen(
                command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
            )
        )
        return self.started[-1]

    def run(self, *words: str, **more: str) -> tuple[int, str]:
        """Execute an array task to its end; return its exit status and its output."""
        process = self.start(*words, **more)
        out, err = process.communicate(timeout=PATIENCE_S)
        assert (out, "Traceback" in err) == ("", False)
        return process.returncode, err

    def packs(self) -> list[Pack]:
        return [Pack(path) for path in sorted(self.paths.results.iterdir())]

    def events(self, kind: type[Any]) -> list[Any]:
        return [event for pack in self.packs() for event in pack.read() if isinstance(event, kind)]

    def ended(self) -> dict[str, Ended]:
        return {event.result.execution: event for event in self.events(Ended)}

    def until_started(self, count: int = 1) -> None:
        until(lambda: len(self.events(Started)) >= count)

    def left_running(self) -> list[int]:
        """Return the processes of this session: array tasks, workers and runs."""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if os.fsencode(self.root.parent) in (process / "environ").read_bytes() + (process / "cmdline").read_bytes():
                    found.append(int(process.name))
        return found

    def close(self) -> None:
        for process in self.started:
            if process.poll() is None:
                process.kill()
            process.communicate()


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Folder]:
    made = Folder(tmp_path / "a'; echo session", tmp_path / "node's own")
    yield made
    made.close()
    until(lambda: made.left_running() == [])


def test_an_array_task_executes_its_runs_and_packs_their_results(folder: Folder, tmp_path: Path) -> None:
    code = 'echo "$NAME"; echo oops >&2; mkdir -p "a b"; cat ../in.xml > "a b/out.csv"'
    shares = folder.deal([job(f"run{n}", code, files=(("in.xml", b"<a n='%d'/>\n" % n),)) for n in range(7)], elements=3)
    assert shares == (3, 2, 2)
    assert folder.run("1") == (0, "")
    assert sorted(folder.ended()) == ["run1", "run4"]
    (pack,) = folder.packs()
    events = list(pack.read())
    assert isinstance(events[0], Attempt)
    assert isinstance(events[-1], Finished)
    assert events[0].element == pack.element == 1
    assert events[0].attempt == pack.attempt
    result = pack.extract(folder.ended()["run4"], tmp_path / "taken")
    assert result.directory == str(tmp_path / "taken")
    assert (result.exit_code, result.error, result.attempt) == (0, None, pack.attempt)
    assert (tmp_path / "taken/output/a b/out.csv").read_bytes() == b"<a n='4'/>\n"
    assert (tmp_path / "taken/stdout").read_text() == "run4\n"
    assert (tmp_path / "taken/stderr").read_text() == "oops\n"
    assert list(folder.scratch.iterdir()) == []


def test_jobs_are_read_as_they_were_distributed(folder: Folder) -> None:
    jobs = [
        job("empty", "true", files=(("in.xml", b""), ("b", b"\0\xff"))),
        job("same", "true", files=(("in.xml", b"abc" * 400), ("b", b"\0\xff"))),
        job("other", "false", limits=Limits(wall_s=3.5), files=(("in.xml", b"abc" * 399 + b"abd"), ("b", b"\xff"))),
        job("less", "true", files=(("in.xml", b"abcabc"), ("c", b"new"))),
    ]
    jobs = [replace(jobs[0], observe={"home": "/home"}), *jobs[1:3], replace(jobs[3], observe={"home": "/other"})]
    assert folder.deal(jobs) == (4,)
    arrived = list(element_jobs.jobs(str(folder.paths.jobs(0))))
    assert arrived == [json.loads(local.line(one)) for one in jobs]


@given(contents=st.lists(st.binary(max_size=12), min_size=2, max_size=6))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_contents_of_inputs_are_read_as_they_were_distributed(tmp_path: Path, contents: list[bytes]) -> None:
    jobs = [job("x", "true", files=(("in", content),)) for content in contents]
    deal(jobs, 1, SessionPaths(tmp_path))
    assert list(element_jobs.jobs(str(SessionPaths(tmp_path).jobs(0)))) == [json.loads(local.line(one)) for one in jobs]


def test_a_truncated_list_of_jobs_is_reported(folder: Folder) -> None:
    folder.deal(many(50, "true"))
    path = folder.paths.jobs(0)
    path.write_bytes(path.read_bytes()[:-30])
    code, said = folder.run()
    assert (code, said.count("\n")) == (3, 1)
    assert f"{path} cannot be read: Compressed file ended" in said
    assert [type(event) for event in folder.events(Trouble)] == [Trouble]
    assert folder.events(Finished) == []


def test_recorded_runs_are_not_executed_again(folder: Folder) -> None:
    folder.deal(many(6, "true"))
    assert folder.run()[0] == 0
    assert folder.run()[0] == 0
    assert Counter(event.result.execution for event in folder.events(Ended)) == Counter(f"run{n}" for n in range(6))
    assert len(folder.events(Finished)) == 2


@pytest.mark.integration
def test_runs_with_damaged_results_are_executed_again(folder: Folder, tmp_path: Path) -> None:
    folder.deal(many(3, 'echo "$NAME" > out'))
    folder.run()
    (pack,) = folder.packs()
    whole = pack.path.read_bytes()
    ended = folder.ended()["run1"]
    pack.path.write_bytes(whole[: ended.at] + b"\0" + whole[ended.at + 1 :])
    with pytest.raises(Damaged, match="does not match its record"):
        pack.extract(ended, tmp_path / "taken")
    assert not (tmp_path / "taken").exists()
    assert folder.run()[0] == 0
    assert Counter(event.result.execution for event in folder.events(Ended)) == Counter(run0=1, run1=2, run2=1)


@pytest.mark.integration
def test_a_killed_array_task_leaves_no_process_and_loses_only_unfinished_runs(folder: Folder, tmp_path: Path) -> None:
    log = tmp_path / "executed"
    folder.deal(many(40, f"sleep 0.0$((${{#NAME}} * 7)); echo $NAME >> '{log}'; echo 1 > out"))
    chance = random.Random(5)
    for _ in range(6):
        process = folder.start()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(chance.uniform(0.1, 1.2))
        os.killpg(process.pid, signal.SIGKILL) if process.poll() is None else None
        process.wait()
        until(lambda: folder.left_running() == [])
    assert folder.run()[0] == 0
    assert set(folder.ended()) == {f"run{n}" for n in range(40)}
    for number, (pack, ended) in enumerate((p, e) for p in folder.packs() for e in p.read() if isinstance(e, Ended)):
        pack.extract(ended, tmp_path / f"taken{number}")
    assert len(log.read_text().split()) < 40 + 6 * 60
    assert list(folder.scratch.iterdir()) == []


@pytest.mark.integration
def test_two_copies_of_an_array_task_do_not_disturb_each_other(folder: Folder, tmp_path: Path) -> None:
    folder.deal(many(10, "sleep 0.05; echo $NAME > out"))
    copies = [folder.start(), folder.start()]
    assert [copy.wait(PATIENCE_S) for copy in copies] == [0, 0]
    assert len(folder.packs()) == 2
    assert set(folder.ended()) == {f"run{n}" for n in range(10)}


@pytest.mark.nightly
@pytest.mark.integration
def test_suspicious_runs_are_executed_alone_before_all_others(folder: Folder, tmp_path: Path) -> None:
    log = tmp_path / "log"
    folder.deal(many(5, f"echo begin $NAME >> '{log}'; sleep 0.1; echo end $NAME >> '{log}'"))
    folder.set(slots=4)
    folder.paths.alone(0).write_text("run3\nrun1\n")
    assert folder.run()[0] == 0
    assert log.read_text().splitlines()[:4] == ["begin run3", "end run3", "begin run1", "end run1"]
    assert Counter(event.execution for event in folder.events(Started)) == Counter(f"run{n}" for n in range(5))
    assert set(folder.ended()) == {f"run{n}" for n in range(5)}
    assert list(folder.scratch.iterdir()) == []


def test_the_start_of_a_run_that_kills_its_array_task_is_recorded_if_it_runs_alone(folder: Folder) -> None:
    kills = "read -r _ _ _ element _ < /proc/$PPID/stat; kill -9 $element $PPID"
    folder.deal([*many(2, "true"), job("killer", kills)])
    folder.paths.alone(0).write_text("killer\n")
    assert folder.run()[0] == -signal.SIGKILL
    assert [event.execution for event in folder.events(Started)] == ["killer"]
    assert folder.ended() == {}


@pytest.mark.integration
def test_a_stopped_worker_is_continued_once(folder: Folder) -> None:
    folder.set(slots=1)
    folder.deal(many(3, 'kill -STOP $PPID; [ "$NAME" = run0 ] || exec sleep 60; sleep 0.3; echo 1 > out.csv'))
    code, _ = folder.run()
    assert code != 0
    assert sorted(folder.ended()) == ["run0"]
    [trouble] = folder.events(Trouble)
    assert trouble.reason.endswith("a run stopped the worker (SIGSTOP) although it had been continued before")


@pytest.mark.integration
def test_sigterm_stops_the_runs_of_an_array_task_without_results(folder: Folder) -> None:
    folder.deal([job("quick", "true"), job("long", "trap 'exit 0' TERM; sleep 60 & wait"), job("never", "true")])
    folder.set(slots=1)
    process = folder.start()
    folder.until_started(2)
    until(folder.ended)
    process.terminate()
    assert process.wait(PATIENCE_S) == 1
    assert sorted(folder.ended()) == ["quick"]
    assert folder.events(Finished) == []
    assert list(folder.scratch.iterdir()) == []


@pytest.mark.nightly
@pytest.mark.integration
@pytest.mark.parametrize("observed", [False, True])
def test_a_signal_to_all_processes_of_an_array_task_gives_no_result(
    folder: Folder, require: Callable[..., str], *, observed: bool
) -> None:
    if observed:
        require("strace")
    runs = many(8, "trap 'echo partial > out; exit 0' TERM; sleep 60 & wait")
    folder.deal([replace(one, observe={}) for one in runs] if observed else runs)
    process = folder.start()
    folder.until_started(2)
    for pid in sorted(folder.left_running(), reverse=True):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)
    assert process.wait(PATIENCE_S) == 1
    assert folder.ended() == {}


def test_an_observed_run_is_packed_with_the_files_that_it_used(
    folder: Folder, tmp_path: Path, require: Callable[..., str]
) -> None:
    require("strace")
    code = tmp_path / "store" / "code"
    code.mkdir(parents=True)
    (code / "data").write_text("x")
    roots = {"store": str(code.parent), "project": str(code)}
    folder.deal(
        [job("one", f"cat '{code}/data'; cat \"$(realpath /proc/self/cwd)/../../none\"", observe=roots), job("two", "true")]
    )
    assert folder.run() == (0, "")
    ended = folder.ended()
    assert (ended["one"].result.observed, ended["two"].result.observed) == (True, False)
    found = json.loads(Path(folder.packs()[0].extract(ended["one"], tmp_path / "taken").directory, "observed.json").read_text())
    assert (found["method"], found["reason"], found["written"]) == ("strace", None, [])
    assert ["{project}/data", "read", hashlib.sha256(b"x").hexdigest(), 1] in found["files"]
    assert [name for name, *_ in found["files"] if str(tmp_path) in name] == [], "the folders of runs are left out"
    assert not (folder.root / "__pycache__").exists()


@pytest.mark.nightly
@pytest.mark.integration
def test_a_node_without_strace_observes_the_files_that_are_mapped_and_says_why(folder: Folder, tmp_path: Path) -> None:
    folder.deal([job("one", "sleep 2", observe={})])
    assert folder.run(PATH=str(tmp_path)) == (0, "")
    ended = folder.ended()["one"]
    found = json.loads(Path(folder.packs()[0].extract(ended, tmp_path / "taken").directory, "observed.json").read_text())
    assert found["method"] == "maps"
    assert found["reason"] == "only files that were mapped into memory were seen; strace: strace is not installed"
    assert any(use == "executed" for _, use, *_ in found["files"])


@pytest.mark.integration
@pytest.mark.parametrize("plant", ["ln -s '{}' {}", "mkfifo {1}", "mkdir {1}"], ids=["link", "pipe", "folder"])
def test_a_run_cannot_lead_its_observation_elsewhere(
    folder: Folder, tmp_path: Path, require: Callable[..., str], plant: str
) -> None:
    require("strace")
    (tmp_path / "other").write_text("mine")
    folder.deal([job("one", plant.format(tmp_path / "other", "../observed.json") + "; echo 1 > out", observe={})])
    assert folder.run() == (0, "")
    result = folder.ended()["one"].result
    assert (result.observed, len(result.outputs)) == (not plant.startswith("mkdir"), 1)
    assert (tmp_path / "other").read_text() == "mine"


@pytest.mark.integration
def test_a_file_that_may_have_changed_meanwhile_by_another_clock_is_reported(
    folder: Folder, tmp_path: Path, require: Callable[..., str]
) -> None:
    require("strace")
    (tmp_path / "data").write_text("x")
    time.sleep(0.1)
    one = local.record(job("one", f"cat '{tmp_path}/data'", observe={}))
    for number, ahead in enumerate((0.0, 3600.0)):
        runs = folder.scratch / str(number)
        runs.mkdir()
        jobs = tmp_path / "jobs"
        jobs.write_text("".join(json.dumps(line) + "\n" for line in ({**one, "ahead": ahead}, {"end": True})))
        command = [sys.executable, "-I", "-S", str(folder.paths.worker), str(runs), "1"]
        with jobs.open() as file:
            subprocess.run(command, stdin=file, check=True)
        reason = json.loads((runs / "1" / "observed.json").read_text())["reason"]
        assert (f"{tmp_path}/data: it was changed after the run had opened it" in (reason or "")) is (ahead > 0)


KILLS = "kill -9 $(sed -n 's/TracerPid:[^0-9]*\\([1-9]\\)/\\1/p' /proc/$$/status)"
"""A shell command that kills the tracer, if there is one."""


@pytest.mark.integration
def test_a_run_whose_tracer_is_killed_begins_once_and_is_executed_unobserved(
    folder: Folder, tmp_path: Path, require: Callable[..., str]
) -> None:
    require("strace")
    folder.deal([job("one", f"echo x >> '{tmp_path}/log'; {KILLS}; echo 1 > out", observe={})])
    assert folder.run() == (0, "")
    assert (tmp_path / "log").read_text() == "x\nx\n"
    assert len(folder.events(Started)) == 1
    result = folder.ended()["one"].result
    assert (result.observed, result.exit_code, [file.path for file in result.outputs]) == (True, 0, ["out"])


@pytest.mark.nightly
@pytest.mark.integration
def test_a_run_whose_tracer_is_killed_at_the_end_of_its_array_task_has_no_result(
    folder: Folder, tmp_path: Path, require: Callable[..., str]
) -> None:
    require("strace")
    code = f"until [ -s '{tmp_path}/task' ]; do :; done; read task < '{tmp_path}/task'; {KILLS}; kill -TERM $task; exit 0"
    folder.deal([job("one", code, observe={})])
    process = folder.start()
    (tmp_path / "task").write_text(f"{process.pid}\n")
    assert process.wait(PATIENCE_S) == 1
    assert folder.ended() == {}


def test_a_second_sigterm_ends_an_array_task_without_grace_time(folder: Folder, tmp_path: Path) -> None:
    asked = tmp_path / "asked"
    deaf = f"trap 'touch \"{asked}\"' TERM; touch '{tmp_path}/deaf'; while :; do sleep 0.1; done"
    folder.deal([job("deaf", deaf, limits=Limits(grace_s=PATIENCE_S))])
    process = folder.start()
    until((tmp_path / "deaf").exists)
    process.terminate()
    until(asked.exists)
    assert process.poll() is None
    process.terminate()
    assert process.wait(PATIENCE_S / 2) == 1


def requeues(folder: Folder, script: str) -> Path:
    """Set the script that array tasks call to be requeued, with the task's id; return the file where it logs its calls."""
    called = folder.root.with_name("called")
    program = folder.root.with_name("requeue")
    program.write_text(f'#!/bin/sh\necho "$@" >> "{called}"\n{script}\n')
    program.chmod(0o755)
    folder.set(requeue=[str(program), "again"], slots=1)
    return called


@pytest.mark.integration
def test_an_array_task_requeues_itself_before_its_time_limit(folder: Folder) -> None:
    called = requeues(folder, "kill -TERM $PPID")
    folder.deal([job("quick", "true"), job("long", f"[ -e '{called}' ] || exec sleep 60")])
    process = folder.start("--wall=2", "0", SLURM_ARRAY_JOB_ID="12", SLURM_ARRAY_TASK_ID="3", SLURM_JOB_ID="15")
    assert process.wait(PATIENCE_S) == 1
    assert called.read_text() == "again 12_3\n"
    [event] = folder.events(Requeued)
    assert event.refused is None
    assert sorted(folder.ended()) == ["quick"]
    assert folder.run("--wall=1000", "0")[0] == 0
    assert sorted(folder.ended()) == ["long", "quick"]
    assert len(called.read_text().splitlines()) == 1


@pytest.mark.nightly
def test_an_array_task_continues_if_the_scheduler_refuses_to_requeue_it(folder: Folder) -> None:
    called = requeues(folder, "echo not allowed here >&2; exit 1")
    folder.deal([job("quick", "true"), job("long", f"until [ -e '{called}' ]; do sleep 0.1; done; sleep 1")])
    assert folder.run("--wall=2", "0")[0] == 0
    assert [event.refused for event in folder.events(Requeued)] == [None, "not allowed here"]
    assert sorted(folder.ended()) == ["long", "quick"]


@pytest.mark.integration
def test_a_run_continues_from_its_checkpoint_in_the_next_attempt(folder: Folder) -> None:
    code = 'echo x >> "$0/n"; test $(wc -l < "$0/n") -ge 2 && exit 0; sleep 60'
    kept = folder.root.with_name("kept") / "run.programs"
    given = replace(job("run", code), argv=("/bin/sh", "-c", code, checkpoints.TEXT), checkpoint=str(kept))
    folder.deal([given])
    cut_off = folder.start()
    until(lambda: (kept / "files/n").exists())
    cut_off.send_signal(signal.SIGTERM)
    cut_off.communicate(timeout=PATIENCE_S)
    assert not checkpoints.changed_since(str(kept), time.time() + 1)
    assert checkpoints.changed_since(str(kept), folder.events(Attempt)[0].started - 10)
    assert folder.run() == (0, "")
    assert [event.result.resumed for event in folder.events(Ended)] == [True]
    assert (kept / "files/n").read_text() == "x\n" * 2
    assert checkpoints.discard(str(kept))
    assert not kept.exists()


@pytest.mark.integration
def test_an_array_task_whose_run_has_a_new_checkpoint_requeues_itself(folder: Folder) -> None:
    called = requeues(folder, "kill -TERM $PPID")
    kept = folder.root.with_name("kept") / "run.programs"
    code = 'date > "$0/n"; sleep 60'
    folder.deal([replace(job("run", code), argv=("/bin/sh", "-c", code, checkpoints.TEXT), checkpoint=str(kept))])
    assert folder.run("--wall=3", "0", PBS_JOBID="7")[0] == 1
    assert called.read_text().split() == ["again", "7"]


@pytest.mark.nightly
@pytest.mark.parametrize("why", ["nothing got on", "it is cancelled"])
def test_an_array_task_without_progress_or_a_cancelled_one_is_not_requeued(folder: Folder, why: str) -> None:
    called = requeues(folder, "exit 0")
    jobs = [job("long", "sleep 3")] if why == "nothing got on" else [job("quick", "true"), job("long", "sleep 60")]
    folder.deal(jobs)
    process = folder.start("--wall=2", "0")
    if why == "it is cancelled":
        until(folder.ended)
        folder.paths.cancelled.touch()
    assert process.wait(PATIENCE_S) == (0 if why == "nothing got on" else 1)
    assert not called.exists()


@pytest.mark.nightly
@pytest.mark.integration
def test_an_array_task_of_a_cancelled_session_starts_no_more_runs(folder: Folder) -> None:
    folder.deal(many(3, "sleep 60"))
    process = folder.start()
    folder.until_started()
    folder.paths.cancelled.touch()
    assert process.wait(PATIENCE_S) == 1
    assert folder.run()[0] == 1
    assert len(folder.packs()) == 1
    assert folder.ended() == {}


@pytest.mark.nightly
@pytest.mark.integration
def test_packing_stops_when_the_session_is_cancelled(folder: Folder) -> None:
    slow = "def _write(self, data, at):\n        time.sleep(len(data) / 1e7)\n        return self._written(data, at)\n\n"
    change(folder.paths.worker, "result_log.py", lambda text: text.replace("def _write(self", f"{slow}    def _written(self"))
    folder.deal([job("large", "truncate -s 300M x")])
    process = folder.start()
    folder.until_started()
    until(lambda: folder.packs()[0].path.stat().st_size > 10_000_000)
    folder.paths.cancelled.touch()
    assert process.wait(PATIENCE_S / 2) == 1
    assert folder.ended() == {}
    assert folder.packs()[0].path.stat().st_size < 100_000


@pytest.mark.nightly
@pytest.mark.integration
@pytest.mark.parametrize("what", ["the folder", "the pack"])
def test_runs_are_stopped_if_the_session_folder_or_the_pack_is_removed(folder: Folder, what: str) -> None:
    folder.deal(many(3, "sleep 60"))
    process = folder.start()
    folder.until_started()
    if what == "the folder":
        shutil.rmtree(folder.root)
    else:
        folder.packs()[0].path.unlink()
    assert process.wait(PATIENCE_S) == 1


def test_a_changed_required_file_is_reported_before_any_run_executes(folder: Folder, tmp_path: Path) -> None:
    program = tmp_path / "simulator"
    program.write_bytes(b"as it was")
    need = {"name": "simulator", "path": str(program), "sha256": hashlib.sha256(b"as it was").hexdigest()}
    folder.set(needs=[need])
    folder.deal(many(2, "true"))
    assert folder.run("--probe", "0") == (0, "")
    assert folder.packs()[0].element is None
    assert (len(folder.events(Finished)), folder.ended()) == (1, {})
    program.write_bytes(b"another")
    for words in (("0",), ("--probe", "0")):
        code, said = folder.run(*words)
        assert (code, said.count("\n")) == (3, 1)
        assert f"simulator: {program} differs from the one on the submitting host" in said
    program.unlink()
    assert "No such file" in folder.run()[1]
    assert len(folder.events(Trouble)) == 3
    assert folder.events(Started) == []


def test_a_program_called_by_name_is_checked_as_the_node_finds_it(folder: Folder, tmp_path: Path) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    program = tmp_path / "second" / "simulator"
    program.write_bytes(b"as it was")
    program.chmod(0o755)
    sha256 = hashlib.sha256(b"as it was").hexdigest()
    search = f"{tmp_path}/first:{tmp_path}/second"
    folder.set(needs=[{"name": "simulator", "path": str(program), "sha256": sha256, "search": search}])
    folder.deal(many(2, "true"))
    assert folder.run("--probe", "0") == (0, "")
    shutil.copy(program, tmp_path / "first")
    assert folder.run("--probe", "0") == (0, "")
    (tmp_path / "first" / "simulator").write_bytes(b"another")
    code, said = folder.run("--probe", "0")
    assert (code, f"simulator: {tmp_path}/first/simulator differs from the one on the submitting host" in said) == (3, True)


def test_a_required_link_is_compared_by_its_target(folder: Folder, tmp_path: Path) -> None:
    link = tmp_path / "latest"
    link.symlink_to("nowhere")
    sha256 = hashlib.sha256(b"nowhere").hexdigest()
    folder.set(needs=[{"name": "{mount}/data/latest", "path": str(link), "sha256": sha256, "link": True}])
    folder.deal(many(2, "true"))
    assert folder.run("--probe", "0") == (0, "")
    link.unlink()
    link.symlink_to("elsewhere")
    code, said = folder.run("--probe", "0")
    assert (code, f"{link} differs from the one on the submitting host" in said) == (3, True)


def test_a_python_with_other_distributions_is_reported(folder: Folder, tmp_path: Path) -> None:
    for name in ("numpy-1.26.4.dist-info", "old.egg-info", "numpy", "~umpy"):
        (tmp_path / "site-packages" / name).mkdir(parents=True)
    where = f"{tmp_path}/site-packages:{tmp_path}/none"
    held = allocation.installed(where)
    assert [Path(path).name for path in held] == ["numpy-1.26.4.dist-info", "old.egg-info"]
    folder.set(needs=[{"name": "python3: installed distributions", "path": where, "sha256": "", "search": "", "holds": held}])
    folder.deal(many(2, "true"))
    assert folder.run("--probe", "0") == (0, "")
    (tmp_path / "site-packages" / "numpy-1.26.4.dist-info").rename(tmp_path / "site-packages" / "numpy-2.0.dist-info")
    code, said = folder.run()
    assert (code, said.count("\n")) == (3, 1)
    assert "python3: installed distributions differ from those on the submitting host: " in said
    assert "/numpy-1.26.4.dist-info is missing here, " in said
    assert "/numpy-2.0.dist-info is only here" in said
    assert folder.events(Started) == []


def test_the_facts_and_allocation_of_a_node_are_recorded_without_secrets(folder: Folder) -> None:
    folder.set(record=["OMP_*", "MY_*"], slots=64)
    folder.deal(many(1, "true"))
    given = {"SLURM_ARRAY_JOB_ID": "12", "SLURM_ARRAY_TASK_ID": "3", "SLURM_JOB_ID": "15", "SLURM_MEM_PER_NODE": "2000"}
    variables = {
        "OMP_NUM_THREADS": "1",
        "MY_TOKEN": "secret",
        "OTHER": "secret",
        "SLURM_CPUS_PER_TASK": "4",
        "SLURM_RESTART_COUNT": "2",
    }
    assert folder.run(**given, **variables)[0] == 0
    (attempt,) = folder.events(Attempt)
    assert (attempt.job, attempt.cpus, attempt.memory) == ("12_3", 4, 2000 << 20)
    assert attempt.attempt.startswith("15.2.")
    assert attempt.variables == {"OMP_NUM_THREADS": "1"}
    assert attempt.allocation == {**given, "SLURM_CPUS_PER_TASK": "4", "SLURM_RESTART_COUNT": "2"}
    assert attempt.slots == machine.usable_cores()
    assert attempt.facts == json.loads(json.dumps(machine.facts()))
    assert b"secret" not in folder.packs()[0].path.read_bytes()


def test_an_array_task_of_pbs_is_identified_by_its_job_id(folder: Folder) -> None:
    folder.deal(many(1, "true"))
    assert folder.run(PBS_JOBID="5[3].pbs1", NCPUS="2")[0] == 0
    (attempt,) = folder.events(Attempt)
    assert attempt.job == "5[3].pbs1"
    assert attempt.attempt.startswith("5_3__pbs1.0.")
    assert attempt.attempt.count(".") == 3


def test_a_scheduler_names_the_variables_of_its_nodes(folder: Folder, tmp_path: Path) -> None:
    names = NodeVariables(
        task=("{LSB_JOBID}[{LSB_JOBINDEX}]",), cores=("{LSB_DJOB_NUMPROC}",), memory_mib=("{LSF_MEM}*{LSB_DJOB_NUMPROC}",)
    )
    more = {"gpus": ["{LSF_GPUS}"], "scratch": ["{LSF_TMPDIR}"], "end": ["{LSF_END}"], "host": ["{LSF_HOST}"]}
    folder.set(node={**asdict(names), **more}, scratch=None)
    folder.deal(many(1, 'echo "$SIERRA_RUN_DIR"'))
    (tmp_path / "disk").mkdir()
    given = {"LSB_JOBID": "7", "LSB_JOBINDEX": "2", "LSB_DJOB_NUMPROC": "4", "LSF_MEM": "100", "LSF_GPUS": "3", "LSF_END": "99"}
    assert folder.run(**given, LSF_TMPDIR=str(tmp_path / "disk"), LSF_HOST="n1", SLURM_JOB_ID="5")[0] == 0
    (attempt,) = folder.events(Attempt)
    assert (attempt.job, attempt.cpus, attempt.memory, attempt.gpus) == ("7[2]", 4, 400 << 20, "3")
    assert (attempt.node, attempt.end, attempt.attempt.split(".")[0]) == ("n1", 99, "7_2_")
    assert attempt.allocation == {**given, "LSF_TMPDIR": str(tmp_path / "disk"), "LSF_HOST": "n1"}
    folder.packs()[0].extract(folder.ended()["run0"], tmp_path / "taken")
    assert (tmp_path / "taken/stdout").read_text().startswith(f"{tmp_path}/disk/sierra-5e55-")


def test_the_scratch_folder_may_use_variables_of_the_node(folder: Folder, tmp_path: Path) -> None:
    folder.deal(many(1, 'echo "$SIERRA_RUN_DIR"'))
    folder.set(scratch="$WHERE/${DEEP}/runs")
    code, said = folder.run(WHERE=str(tmp_path))
    assert (code, "the variable $DEEP is not set" in said) == (3, True)
    (tmp_path / "down").mkdir()
    assert folder.run(WHERE=str(tmp_path), DEEP="down")[0] == 0
    (pack,) = [pack for pack in folder.packs() if any(isinstance(event, Ended) for event in pack.read())]
    pack.extract(folder.ended()["run0"], tmp_path / "taken")
    assert (tmp_path / "taken/stdout").read_text().startswith(f"{tmp_path}/down/runs/sierra-5e55-")


def test_temporary_files_of_runs_are_in_the_scratch_folder_with_a_short_path(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="t-", dir="/tmp") as node:
        folder = Folder(tmp_path / "session", Path(node, "scratch"))
        one = job("one", 'touch "$TMPDIR/x"; printf %s "$TMPDIR"')
        folder.deal([replace(one, environment={**one.environment, "TMPDIR": "\0/tmp"})])
        assert folder.run() == (0, "")
        folder.packs()[0].extract(folder.ended()["one"], tmp_path / "taken")
        where = (tmp_path / "taken/stdout").read_text()
        assert re.fullmatch(re.escape(f"{node}/scratch") + r"/sierra-[0-9a-f]{8}/1/tmp", where)
        assert list(folder.scratch.iterdir()) == []


@pytest.mark.parametrize("scratch", ["{}/scrach/runs", "/scrach"])
def test_only_the_last_folder_of_a_missing_scratch_path_is_created(folder: Folder, tmp_path: Path, scratch: str) -> None:
    folder.deal(many(1, "true"))
    folder.set(scratch=scratch.format(tmp_path))
    for words in (("0",), ("--probe", "0")):
        code, said = folder.run(*words)
        assert code == 3
        assert f"scratch = {scratch.format(tmp_path)}: its parent folder does not exist" in said
    assert not (tmp_path / "scrach").exists()
    assert not Path("/scrach").exists()
    folder.set(scratch=f"{tmp_path}/scrach")
    assert folder.run()[0] == 0


def test_links_instead_of_files_of_a_run_are_not_followed(folder: Folder, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "stdout").write_text("a secret")
    (foreign / "out").write_text("a secret")
    folder.deal(
        [
            job(
                "log",
                f"rm ../stdout; ln -s '{foreign}/stdout' ../stdout; ln -s '{foreign}/out' out; mkfifo pipe; echo 1 > good",
            ),
            job("folder", f'cd /; mv "$SIERRA_RUN_DIR" "$SIERRA_RUN_DIR.moved"; ln -s \'{foreign}\' "$SIERRA_RUN_DIR"'),
        ]
    )
    assert folder.run()[0] == 0
    assert [path for path, *_ in folder.ended()["log"].files] == ["output/good"]
    assert folder.ended()["log"].result.left_out == ("out", "pipe")
    assert folder.ended()["folder"].files == ()
    assert b"a secret" not in folder.packs()[0].path.read_bytes()
    assert sorted(path.name for path in foreign.iterdir()) == ["out", "stdout"]
    assert list(folder.scratch.iterdir()) == []


@pytest.mark.nightly
def test_large_outputs_and_odd_names_are_packed_completely(folder: Folder, tmp_path: Path) -> None:
    named = "printf x > \"$(printf 'a\\nb\\377')\""
    code = f"head -c 50000000 /dev/urandom > big; sha256sum big; {named}; head -c 2000000 /dev/zero >&2"
    folder.deal([job("big", code)])
    assert folder.run()[0] == 0
    (pack,) = folder.packs()
    pack.extract(folder.ended()["big"], tmp_path / "taken")
    big = (tmp_path / "taken/output/big").read_bytes()
    assert len(big) == 50_000_000
    assert hashlib.sha256(big).hexdigest() in (tmp_path / "taken/stdout").read_text()
    assert sorted(os.fsencode(path.name) for path in (tmp_path / "taken/output").iterdir()) == [b"a\nb\xff", b"big"]
    assert (tmp_path / "taken/stderr").stat().st_size == 2_000_000


def test_results_of_runs_that_share_a_container_are_packed(folder: Folder, tmp_path: Path) -> None:
    inside = (sys.executable, "-I", "-S", str(folder.paths.worker), "\0/runs", "1", "-")
    client = Client(inside, {"PATH": os.defpath, "MARK": str(folder.root)})
    folder.deal([replace(one, client=client, shared=True) for one in many(5, 'echo "$NAME" > out')])
    assert folder.run() == (0, "")
    (pack,) = folder.packs()
    for name, ended in folder.ended().items():
        pack.extract(ended, tmp_path / name)
        assert (tmp_path / name / "output" / "out").read_text() == f"{name}\n"
    assert len(folder.ended()) == 5
    assert list(folder.scratch.iterdir()) == []


def test_a_container_that_cannot_be_started_is_recorded_as_a_result(folder: Folder) -> None:
    client = Client(("/no/such/engine",), {})
    folder.deal([replace(one, client=client, shared=True) for one in many(3, "true")])
    assert folder.run() == (0, "")
    assert {"could not be started" in (one.result.error or "") for one in folder.ended().values()} == {True}
    assert len(folder.ended()) == 3


def test_a_missing_program_is_recorded_as_a_result(folder: Folder) -> None:
    missing = job("missing", "true")
    folder.deal([Job("missing", "missing", ("/no/such/program",), missing.environment, (), Limits())])
    assert folder.run()[0] == 0
    assert "could not be started" in (folder.ended()["missing"].result.error or "")


@pytest.mark.integration
def test_a_full_shared_disk_is_reported_and_packed_results_stay_intact(
    folder: Folder, tmp_path: Path, disk: Callable[[Path, str], Path]
) -> None:
    folder.deal(many(20, "head -c 400000 /dev/urandom > out"))
    disk(folder.paths.results, "3m")
    code, said = folder.run()
    assert (code, "No space left on device" in said, said.count("\n")) == (3, True, 1)
    (pack,) = folder.packs()
    ended = [event for event in pack.read() if isinstance(event, Ended)]
    assert 0 < len(ended) < 20
    for number, one in enumerate(ended):
        pack.extract(one, tmp_path / f"taken{number}")
    assert list(folder.scratch.iterdir()) == []
    disk(folder.paths.results, "60m")
    assert folder.run()[0] == 0
    assert Counter(one.result.execution for one in folder.events(Ended)) == Counter(f"run{n}" for n in range(20))


@pytest.mark.integration
def test_a_full_disk_of_a_node_is_reported(folder: Folder, disk: Callable[[Path, str], Path]) -> None:
    folder.deal([job(f"run{n}", "true", files=(("in", os.urandom(2_000_000)),)) for n in range(4)])
    disk(folder.scratch, "3m")
    (folder.scratch / "other_inputs").write_bytes(bytes(2_000_000))
    code, said = folder.run()
    assert (code, "No space left on device" in said, said.count("\n")) == (3, True, 1)
    assert "No space left" in folder.events(Trouble)[0].reason
    assert [path.name for path in folder.scratch.iterdir()] == ["other_inputs"]


@pytest.mark.integration
def test_a_killed_worker_is_reported_and_leaves_no_process(folder: Folder) -> None:
    folder.deal(many(2, "sleep 60"))
    process = folder.start()
    folder.until_started(2)
    (found,) = [pid for pid in folder.left_running() if b"worker.pyz\0/" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    os.kill(found, signal.SIGKILL)
    assert process.wait(PATIENCE_S) == 3
    assert folder.left_running() == []
    assert "the worker ended with signal 9" in folder.events(Trouble)[0].reason


@pytest.mark.integration
def test_scratch_files_of_a_dead_attempt_are_removed_and_those_of_others_are_kept(folder: Folder) -> None:
    folder.deal(many(2, "sleep 60"))
    alive = folder.start()
    folder.until_started(2)
    one = len(folder.left_running())
    dead = folder.start()
    folder.until_started(4)
    dead.kill()
    dead.wait()
    (folder.scratch / "sierra-5e55-somebody").mkdir()
    until(lambda: len(folder.left_running()) <= one)
    before = {path.name for path in folder.scratch.iterdir()}
    third = folder.start()
    folder.until_started(6)
    now = {path.name for path in folder.scratch.iterdir()}
    assert (len(before), len(now), len(before & now)) == (3, 3, 2)
    assert "sierra-5e55-somebody" in now
    assert (alive.poll(), third.poll()) == (None, None)


def test_a_python_that_is_too_old_is_reported(folder: Folder, require: Any) -> None:
    old = python_of("3.6") or python_of("3.7")
    require("a Python before 3.8", there=old is not None)
    folder.deal(many(1, "true"))
    code, said = folder.run(python=str(old))
    assert (code, said.count("\n")) == (3, 1)
    assert "3.8 or newer is needed" in said


@pytest.mark.integration
def test_the_oldest_supported_python_executes_an_array_task(folder: Folder, require: Any) -> None:
    oldest = python_of("3.8")
    require("Python 3.8", there=oldest is not None)
    folder.deal([*many(3, "echo 1 > out"), job("observed", "true", observe={})])
    assert folder.run(python=str(oldest)) == (0, "")
    assert {name for name, one in folder.ended().items() if one.result.observed} == {"observed"}
    assert len(folder.ended()) == 4
    assert folder.events(Attempt)[0].python.startswith("3.8.")
    assert not (folder.root / "__pycache__").exists()


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    folder = Folder(tmp_path_factory.mktemp("packed") / "session", tmp_path_factory.mktemp("node") / "scratch")
    folder.deal(many(4, 'echo "$NAME" > out; echo log'))
    assert folder.run()[0] == 0
    folder.close()
    return folder.packs()[0]


@pytest.mark.nightly
@pytest.mark.integration
@given(data=st.data())
@settings(max_examples=200)
def test_a_damaged_pack_gives_only_events_that_were_written(
    packed: Pack, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    whole, events = packed.path.read_bytes(), list(Pack(packed.path).read())
    at = data.draw(st.integers(0, len(whole)))
    length = data.draw(st.integers(0, 40))
    damage = data.draw(st.one_of(st.binary(max_size=40), st.just(b"\0" * 20), st.just(b'{"event":"end"}\n')))
    text = whole[:at] + damage + whole[at + length :] if data.draw(st.booleans()) else whole[:at]
    folder = tmp_path_factory.mktemp("damaged")
    pack = Pack(folder / packed.path.name)
    pack.path.write_bytes(text)
    for number, event in enumerate(pack.read()):
        assert event in events or (
            isinstance(event, Ended) and event.result in [e.result for e in events if isinstance(e, Ended)]
        )
        if isinstance(event, Ended):
            with contextlib.suppress(Damaged):
                pack.extract(event, folder / f"taken{number}")
                name = event.result.run
                assert (folder / f"taken{number}/output/out").read_text() == f"{name}\n"
    shutil.rmtree(folder)


def test_a_pack_can_be_read_while_it_grows(packed: Pack, tmp_path: Path) -> None:
    whole, growing = packed.path.read_bytes(), Pack(tmp_path / packed.path.name)
    found = []
    for size in range(0, len(whole) + 1, 7):
        growing.path.write_bytes(whole[:size])
        found += list(growing.read())
    growing.path.write_bytes(whole)
    assert found + list(growing.read()) == list(Pack(packed.path).read())


def test_a_record_of_another_version_is_reported(tmp_path: Path) -> None:
    pack = Pack(tmp_path / "0.a.b.c.d.pack")
    pack.path.write_bytes(result_log.line_of({"event": "start", "execution": "x", "time": 1.0, "weather": "fine"}))
    with pytest.raises(Damaged, match="another version"):
        list(pack.read())


@pytest.mark.parametrize(
    "path", ["../x", "/etc/x", "output/../../x", "output//x", "output/./x", "output", "else", "output/a\0b", ""]
)
def test_paths_out_of_a_runs_folder_are_refused(packed: Pack, tmp_path: Path, path: str) -> None:
    ended = next(event for event in Pack(packed.path).read() if isinstance(event, Ended))
    hostile = Ended(ended.result, ((path, *ended.files[0][1:]),), ended.at)
    with pytest.raises(Damaged, match="is not in a run's folder"):
        packed.extract(hostile, tmp_path / "in" if (tmp_path / "in").mkdir() else tmp_path / "in" / "taken")
    assert [entry.name for entry in tmp_path.rglob("*")] == ["in"]


def test_outputs_that_are_not_in_the_pack_are_refused(packed: Pack, tmp_path: Path) -> None:
    with packed.path.open("rb") as file:
        ends = [(record, at, after) for record, at, after in result_log.records(file, 0) if record["event"] == "end"]
        record, at, after = next(one for one in ends if one[0]["outputs"])
        file.seek(at)
        payload = file.read(after - at)
    record.pop("check", None)
    hostile = Pack(tmp_path / packed.path.name)
    hostile.path.write_bytes(result_log.line_of(record) + payload)
    assert [type(event) for event in hostile.read()] == [Ended]
    record["outputs"][0]["path"] = "../../x"
    hostile = Pack(tmp_path / packed.path.name)
    hostile.path.write_bytes(result_log.line_of(record) + payload)
    with pytest.raises(Damaged):
        list(hostile.read())


def cpu_of_children() -> float:
    """Return the CPU seconds of all processes that this one, or its children, waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.nightly
@pytest.mark.integration
def test_the_cpu_time_of_an_array_task_is_limited_relative_to_its_worker(folder: Folder, tmp_path: Path) -> None:
    folder.deal(many(300, "true"))
    began = cpu_of_children()
    assert folder.run()[0] == 0
    whole = cpu_of_children() - began
    alone = tmp_path / "alone"
    alone.mkdir()
    lines = [json.dumps(one).encode() + b"\n" for one in element_jobs.jobs(str(folder.paths.jobs(0)))]
    began = cpu_of_children()
    command = [sys.executable, "-I", "-S", str(folder.paths.worker), str(alone), "2"]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        process.stdin.write(b"".join((*lines, b'{"end": true}\n')))
        process.stdin.flush()
        assert process.wait(PATIENCE_S) == 0
    assert whole < 2.5 * (cpu_of_children() - began) + 2


@pytest.mark.nightly
@pytest.mark.integration
def test_an_array_task_with_long_runs_is_idle(folder: Folder) -> None:
    folder.deal(many(2, "sleep 5"))
    process = folder.start()
    folder.until_started(2)
    before = sum(cpu_of([process.pid]))
    time.sleep(4)
    assert sum(cpu_of([process.pid])) - before <= 0.06
    assert process.wait(PATIENCE_S) == 0
