"""Runs that stop the worker, their session or themselves do not make a session hang, and a session ends when it is told to."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import projects
from tests.waiting import until

SIMULATOR = """\
import os, signal, sys, time
seed = int(open(sys.argv[1]).read().split('<random seed="')[1].split('"')[0])
{code}
open("swarm.csv", "w").write(f"tick,value\\n0,{{seed}}\\n")
"""
FOREVER = "\nwhile True: time.sleep(1)"
IGNORING = "signal.signal(signal.SIGTERM, signal.SIG_IGN)\nopen(os.environ['SIERRA_RUN_DIR'] + '/../begun', 'w')\n"
STOP_WORKER = "os.kill(os.getppid(), signal.SIGSTOP)"
STOP_SESSION = """
parent = int(open(f"/proc/{os.getppid()}/stat").read().rpartition(")")[2].split()[1])
os.kill(parent, signal.SIGSTOP)"""
pytestmark = pytest.mark.integration


@pytest.fixture
def make(tmp_path: Path) -> Callable[..., Path]:
    def make(code: str, *, runs: int = 3, more: str = "") -> Path:
        config = projects.CONFIG.replace("runs = 2", f"runs = {runs}\nobserve = 'none'") + more
        return projects.make(tmp_path / "project", config, simulator=SIMULATOR.format(code=code))

    return make


def query(folder: Path, jobs: int = 1) -> subprocess.CompletedProcess[str]:
    return projects.sierra(folder, "run", "population_size=1", "--jobs", str(jobs), "--no-figures")


def living(folder: Path) -> list[str]:
    """Return the command lines of the processes that work in a project, or for it."""
    found = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            words = (entry / "cmdline").read_bytes() if entry.name.isdigit() else b""
            if os.fsencode(folder) in words:
                found.append(words.replace(b"\0", b" ").decode())
    return found


def await_begin(folder: Path) -> None:
    until(lambda: list(folder.glob(".sierra/work/*/begun")), "the run has begun", 30)


def test_a_worker_that_was_stopped_once_is_continued(make: Callable[..., Path]) -> None:
    folder = make(STOP_WORKER, runs=1)
    done = query(folder)
    assert done.returncode == 0, done.stderr
    assert "stopped the worker; it was continued" in done.stdout + done.stderr


def test_runs_that_stop_the_worker_again_fail_and_the_session_goes_on(make: Callable[..., Path]) -> None:
    folder = make(f"{STOP_WORKER}\ntime.sleep(1)", runs=4)
    done = query(folder)
    assert "stopped the worker (SIGSTOP) although it had been continued before" in done.stdout + done.stderr
    counts = {row["status"]: row["n"] for row in projects.sql(folder, "SELECT status, count(*) n FROM runs GROUP BY ALL")}
    assert counts == {"ok": 1, "failed": 3}, done.stdout + done.stderr


def test_a_session_that_is_suspended_and_resumed_as_a_whole_goes_on(make: Callable[..., Path]) -> None:
    folder = make("open(os.environ['SIERRA_RUN_DIR'] + '/../begun', 'w')\ntime.sleep(4)", runs=1)
    process = projects.start(folder, "run", "population_size=1", "--jobs", "1", "--no-figures")
    await_begin(folder)
    [worker] = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    for _ in range(2):
        for pid in (process.pid, worker):
            os.kill(pid, signal.SIGSTOP)
        time.sleep(1)
        os.kill(process.pid, signal.SIGCONT)
        time.sleep(0.2)
        os.kill(worker, signal.SIGCONT)
        time.sleep(0.2)
    said = "".join(process.communicate(timeout=60))
    assert (process.returncode, "stopped" in said) == (0, False), said


@pytest.mark.parametrize("observe", ["none", "first"])
def test_the_program_that_executes_what_is_around_a_run_is_continued(
    make: Callable[..., Path], observe: str, require: Callable[..., str]
) -> None:
    require("strace")
    folder = make(f"{STOP_WORKER}\ntime.sleep(0.1)", runs=2)
    config = folder / "sierra.toml"
    config.write_text(f'before = "true"\n{config.read_text()}'.replace("'none'", f"'{observe}'"))
    done = query(folder)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.each_case
@pytest.mark.parametrize(
    ("code", "number"),
    [(STOP_WORKER, signal.SIGTERM), (STOP_SESSION, signal.SIGINT), ("os.kill(0, signal.SIGSTOP)", signal.SIGHUP)],
    ids=["worker", "session", "group"],
)
def test_a_session_ends_when_it_is_told_to(make: Callable[..., Path], code: str, number: signal.Signals) -> None:
    folder = make(f"{IGNORING}{code}{FOREVER}")
    process = projects.start(folder, "run", "population_size=1", "--jobs", "1", "--no-figures")
    await_begin(folder)
    time.sleep(0.5)
    process.send_signal(number)
    process.communicate(timeout=60)
    assert not living(folder)


def test_after_sigquit_nothing_is_left(make: Callable[..., Path]) -> None:
    folder = make(f"{IGNORING}{STOP_WORKER}{FOREVER}", runs=2)
    process = projects.start(folder, "run", "population_size=1", "--jobs", "2", "--no-figures")
    await_begin(folder)
    assert living(folder)
    process.send_signal(signal.SIGQUIT)
    until(lambda: not living(folder), "all processes have ended", 30)
    process.communicate(timeout=10)
    assert process.returncode == -signal.SIGQUIT
