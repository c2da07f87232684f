"""After any end of SIERRA, its worker or its runs, the same command completes the batch without loss or duplicates."""

from __future__ import annotations

import contextlib
import os
import pty
import random
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests import projects
from tests.conftest import PRINTS, held
from tests.waiting import PATIENCE_S, until

ASKED = ("run", "size.Log8", "--runs", "6", "-j", "2", "--no-figures")
RUNS = 24
Simulate = Callable[..., Any]
Disk = Callable[[Path, str], Path]


def assert_complete(project: Any, runs: int = RUNS) -> None:
    """Check that every run has one successful execution and one table, and that no session is left."""
    assert project.sql("SELECT count(*) AS n, count(DISTINCT run) AS runs FROM executions WHERE status = 'ok'") == [
        {"n": runs, "runs": runs}
    ]
    assert project.sql("SELECT count(*) AS n FROM executions WHERE status <> 'ok'") == [{"n": 0}]
    assert project.sql("SELECT count(*) AS n, count(DISTINCT run) AS runs, sum(v)::INT AS v FROM swarm") == [
        {"n": 2 * runs, "runs": runs, "v": 5 * runs}
    ]
    assert project.sql("SELECT count(*) AS n, count(DISTINCT execution) AS e FROM artifacts WHERE kind = 'table'") == [
        {"n": runs, "e": runs}
    ]
    assert project.sql("SELECT count(*) AS n FROM batch_runs") == [{"n": runs}]
    assert project.work() == []
    assert project.left_running() == []


def ended_well(project: Any) -> set[str]:
    """Return the runs whose end is recorded in the store or in a journal."""
    ends = {e["run"] for e in project.journals() if e["event"] == "end" and e["exit_code"] == 0 and not e["stopped"]}
    if (project.folder / ".sierra" / "format").exists():
        ends |= {row["run"] for row in project.sql("SELECT run FROM executions WHERE status = 'ok'")}
    return ends


def kill(pid: int | None) -> None:
    with contextlib.suppress(ProcessLookupError):
        if pid is not None:
            os.kill(pid, signal.SIGKILL)


@pytest.mark.nightly
def test_a_run_that_stops_itself_is_reported_and_can_be_continued(simulate: Simulate) -> None:
    project = simulate(f"kill -STOP $$; {PRINTS}")
    asking = project.start("run", "size=1", "-j", "1", "--runs", "1", "--no-figures")
    said = next(line for line in asking.stderr if "makes no progress: a signal stopped its processes" in line)
    [pid] = re.findall(r"continue it with kill -CONT (\d+), or set wall in \[limits\] to end such runs", said)
    os.kill(int(pid), signal.SIGCONT)
    done = project.end_of(asking)
    assert done.returncode == 0, done.stderr
    assert project.sql("SELECT count(*) AS n FROM executions WHERE status = 'ok'") == [{"n": 1}]


def strike(victim: str, project: Any, sierra: subprocess.Popen[str]) -> None:
    worker = project.worker() if victim != "sierra" else None
    if victim in ("worker", "both", "everything"):
        kill(worker)
    if victim in ("sierra", "both", "everything"):
        kill(sierra.pid)
    if victim == "everything":
        project.kill_all()


@pytest.mark.nightly
@pytest.mark.parametrize("repetition", range(16))
def test_the_same_command_completes_the_batch_after_a_kill_at_any_time(simulate: Simulate, repetition: int) -> None:
    chance = random.Random(repetition)
    victim = ("sierra", "worker", "both", "everything")[repetition % 4]
    project = simulate()
    sierra = project.start(*ASKED)
    begun = chance.randint(0, RUNS + 4)
    project.until_executed(min(begun, RUNS), sierra)
    time.sleep(chance.uniform(0, 0.06 if 0 < begun < RUNS else 0.8))
    strike(victim, project, sierra)
    finished = ended_well(project)
    first = project.end_of(sierra)
    if victim == "worker":
        assert first.returncode in (0, 3)
        said = [text for text in first.stderr.splitlines() if text.startswith("sierra:")]
        assert len(said) == (first.returncode == 3)
    second = project.quick(*ASKED)
    assert second.returncode == 0, second.stderr
    assert_complete(project)
    assert {run: n for run, n in project.executed().items() if n > 1 and run in finished} == {}


def test_a_second_session_records_the_finished_runs_of_a_killed_one(simulate: Simulate) -> None:
    project = simulate(held(12))
    one = project.start(*ASKED)
    project.until_executed(3, one)
    two = project.start(*ASKED)
    until(lambda: len(project.work()) == 2)
    project.until_executed(13, one)
    kill(one.pid)
    finished = ended_well(project)
    project.end_of(one)
    project.open()
    assert project.end_of(two).returncode == 0
    assert_complete(project)
    assert {run: n for run, n in project.executed().items() if n > 1 and run in finished} == {}


@pytest.mark.nightly
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_session_keeps_finished_runs(simulate: Simulate, number: int) -> None:
    project = simulate(held(12))
    sierra = project.start(*ASKED)
    project.until_executed(8, sierra)
    sierra.send_signal(number)
    first = project.end_of(sierra)
    assert first.returncode == 130
    assert (project.work(), project.left_running()) == ([], [])
    good = {row["run"] for row in project.sql("SELECT run FROM executions WHERE status = 'ok'")}
    assert 6 <= len(good) < RUNS
    project.open()
    assert project.quick(*ASKED).returncode == 0
    assert_complete(project)
    assert {run for run, n in project.executed().items() if n > 1} & good == set()


@pytest.mark.nightly
def test_a_session_whose_terminal_is_closed_keeps_finished_runs(simulate: Simulate) -> None:
    project = simulate(held(12))
    terminal, theirs = pty.openpty()
    words = ["setsid", "--ctty", str(projects.SIERRA), *ASKED]
    sierra = subprocess.Popen(words, cwd=project.folder, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    project.until_executed(8, sierra)
    os.close(terminal)
    assert sierra.wait(PATIENCE_S) == 130
    assert (project.work(), project.left_running()) == ([], [])
    [counted] = project.sql("SELECT count(*) FILTER (status = 'ok') AS good, count(*) AS n FROM executions")
    assert 6 <= counted["good"] == counted["n"] < RUNS


@pytest.mark.nightly
def test_a_second_interrupt_ends_the_session_without_grace_time(simulate: Simulate) -> None:
    said = 'touch "${0%/*}/../asked"'
    project = simulate(f"""trap '{said}' TERM; {said.replace("asked", "deaf")}; for n in 1 2 3; do sleep 60 & wait; done""")
    config = project.folder / "sierra.toml"
    config.write_text(config.read_text().replace("grace = 2", "grace = 60"))
    sierra = project.start(*ASKED)
    until(project.folder.with_name("deaf").exists)
    sierra.send_signal(signal.SIGINT)
    until(project.folder.with_name("asked").exists)
    assert sierra.poll() is None
    sierra.send_signal(signal.SIGINT)
    assert project.end_of(sierra, timeout=40).returncode == 130
    assert (project.work(), project.left_running()) == ([], [])
    assert project.sql("SELECT count(*) AS n FROM executions") == [{"n": 0}]


@pytest.mark.nightly
@pytest.mark.parametrize("repetition", range(4))
def test_signals_at_any_time_do_not_damage_the_batch(simulate: Simulate, repetition: int) -> None:
    chance = random.Random(repetition)
    project = simulate()
    sierra = project.start(*ASKED)
    time.sleep(chance.uniform(0.5, 2))
    for _ in range(20):
        with contextlib.suppress(ProcessLookupError):
            sierra.send_signal(chance.choice([signal.SIGINT, signal.SIGTERM]))
        time.sleep(chance.uniform(0, 0.02))
    sierra.communicate(timeout=60)
    assert project.quick(*ASKED).returncode == 0
    assert_complete(project)


def test_failed_runs_are_recorded_and_the_other_runs_continue(simulate: Simulate) -> None:
    project = simulate('grep -q size=.2 "$1" && { echo "no room" >&2; exit 9; }\nprintf "t,v\\n1,1\\n" > swarm.csv')
    done = project.quick("run", "size.Log4", "--runs", "3", "--no-figures")
    assert done.returncode == 1
    assert "3 failed" in done.stdout
    assert "3 runs failed, e.g." in done.stdout
    assert done.stdout.count("exit status 9") == 1
    assert done.stdout.count("    no room") == 1
    rows = project.sql("SELECT status, count(*) AS n, max(log_tail) AS log FROM executions GROUP BY 1 ORDER BY 1")
    assert rows == [{"status": "failed", "n": 3, "log": "no room"}, {"status": "ok", "n": 6, "log": None}]
    again = project.quick("run", "size.Log4", "--runs", "3", "--no-figures")
    assert again.returncode == 1
    assert sorted(project.executed().values()) == [1] * 6 + [2] * 3


@pytest.mark.nightly
def test_the_first_failure_ends_the_batch_with_fail_fast(simulate: Simulate) -> None:
    project = simulate('grep -q size=.1 "$1" && { sleep 0.2; exit 1; }\nsleep 600')
    done = project.quick("run", "size=1,2", "--runs", "3", "-j", "4", "--fail-fast", "--no-figures")
    assert done.returncode == 1
    assert project.sql("SELECT DISTINCT status FROM executions") == [{"status": "failed"}]
    assert (project.work(), project.left_running()) == ([], [])


def test_a_killed_worker_is_reported_in_one_line(simulate: Simulate) -> None:
    project = simulate(held(8, f"setsid -f sleep 60; {PRINTS}"))
    sierra = project.start(*ASKED)
    project.until_executed(6, sierra)
    kill(project.worker())
    done = project.end_of(sierra)
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.endswith("sierra: the worker ended with signal 9; the finished runs are kept\n")
    assert (project.work(), project.left_running()) == ([], [])
    assert project.sql("SELECT count(*) >= 3 AS kept FROM executions WHERE status = 'ok'") == [{"kept": True}]
    project.open()
    assert project.quick(*ASKED).returncode == 0
    assert_complete(project)


@pytest.mark.nightly
def test_a_worker_that_gets_sigterm_is_replaced(simulate: Simulate) -> None:
    project = simulate(held(12))
    sierra = project.start(*ASKED)
    project.until_executed(6, sierra)
    worker = project.worker()
    assert worker is not None
    os.kill(worker, signal.SIGTERM)
    project.open()
    assert project.end_of(sierra).returncode == 0
    assert_complete(project)


def test_incomplete_files_of_a_killed_session_do_not_block_others(simulate: Simulate) -> None:
    project = simulate()
    half = (("context.json", '{"sess'), ("claims.json", '["ab'), ("journal.jsonl", '{"event":"end"}\n{"ev'), ("owner.0", ""))
    for number, (name, text) in enumerate(half):
        session = project.folder / ".sierra" / "work" / f"{number:016x}"
        session.mkdir(parents=True)
        (session / "owner.0").write_text('{"pid": 4194399, "born": 1, "boot": null, "where": ["here"]}')
        (session / name).write_text(text)
    (project.folder / ".sierra" / "work" / "0123456789abcdef").mkdir()
    assert project.quick(*ASKED).returncode == 0
    assert_complete(project)


def test_a_full_disk_is_reported_and_finished_runs_are_kept(simulate: Simulate, disk: Disk) -> None:
    project = simulate("head -c 150000 /dev/urandom > noise.bin; printf 't,v\\n1,1\\n2,4\\n' > swarm.csv")
    store = disk(project.folder / ".sierra", "3m")
    done = project.quick(*ASKED)
    assert done.returncode == 3
    assert "No space left on device" in done.stderr
    assert project.left_running() == []
    finished = ended_well(project)
    disk(store, "60m")
    assert project.quick(*ASKED).returncode == 0
    assert project.sql("SELECT count(*) AS n, count(DISTINCT run) AS r FROM executions WHERE status = 'ok'") == [
        {"n": RUNS, "r": RUNS}
    ]
    assert (project.work(), project.left_running()) == ([], [])
    assert {run: n for run, n in project.executed().items() if n > 1 and run in finished} == {}


def test_a_program_that_ignores_a_full_disk_gives_no_result(simulate: Simulate, disk: Disk) -> None:
    project = simulate("printf 't,v\\n1,1\\n2,4\\n' > swarm.csv; head -c 2000000 /dev/zero 2> /dev/null > noise.bin || true")
    store = disk(project.folder / ".sierra", "1500k")
    done = project.quick(*ASKED)
    assert done.returncode == 3
    assert [line for line in done.stderr.splitlines() if line.startswith("sierra:")] == done.stderr.splitlines()[-1:]
    assert "No space left on device" in done.stderr
    assert project.left_running() == []
    disk(store, "100m")
    assert project.quick(*ASKED).returncode == 0
    [found] = project.sql("SELECT count(*) AS n, min(size) AS least FROM artifacts WHERE path = 'noise.bin'")
    assert found == {"n": RUNS, "least": 2_000_000}


def test_a_link_instead_of_a_runs_folder_is_never_followed(simulate: Simulate, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign"
    for name in ("home", "tmp", "output"):
        (foreign / name).mkdir(parents=True)
        (foreign / name / "swarm.csv").write_text("t,v\n1,666\n")
    (foreign / "stdout").write_text("a secret")
    project = simulate(f'cd /; mv "$SIERRA_RUN_DIR" "$SIERRA_RUN_DIR.moved"; ln -s "{foreign}" "$SIERRA_RUN_DIR"')
    assert project.quick("run", "size=1", "--runs", "1", "--no-figures").returncode == 0
    assert len(list(foreign.glob("*/swarm.csv"))) == 3
    assert project.sql("SELECT count(*) AS n FROM artifacts") == [{"n": 0}]
    assert project.work() == []


def test_a_log_that_is_a_link_is_not_recorded(simulate: Simulate, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("a secret")
    project = simulate(f'cd ..; for log in stdout stderr; do rm $log; ln -s "{tmp_path}/secret" $log; done; exit 1')
    assert project.quick("run", "size=1", "--runs", "1", "--no-figures").returncode == 1
    assert project.sql("SELECT count(*) AS n FROM artifacts") == [{"n": 0}]
    assert project.sql("SELECT log_tail FROM executions") == [{"log_tail": None}]
