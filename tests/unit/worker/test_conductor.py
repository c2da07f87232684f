"""The conductor alone: one file that executes services, and commands before and after a command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sierra.util import worker_zip
from sierra.worker.layout import REPORT
from sierra.worker.processes import stat_of
from sierra.worker.program import PROGRAM
from tests.pythons import python_of
from tests.waiting import until

SERVICE = {"name": "a", "argv": ["sh", "-c", "echo on \2a\2; sleep 1000"], "ready": ["output", "^on [0-9]+$"], "timeout": 100}


def conduct(
    folder: Path, program: Path | str = PROGRAM, python: str = sys.executable, **plan: Any
) -> tuple[subprocess.CompletedProcess[str], str | None]:
    """Execute a plan in a folder; return the conductor's end and the reason in its report."""
    (folder / "home").mkdir()
    whole = {"services": [], "before": [], "argv": ["true"], "after": [], "success": [0], "grace": 5.0, **plan}
    command = [python, "-I", "-S", str(program), "conductor", str(folder), json.dumps(whole)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return done, json.loads((folder / REPORT).read_text())["error"]


def test_it_ends_with_the_exit_status_of_the_command(tmp_path: Path) -> None:
    done, reason = conduct(tmp_path, services=[SERVICE], argv=["sh", "-c", "echo \0; exit 3"], success=[3], after=[["true"]])
    assert (done.returncode, done.stdout, reason) == (3, f"{tmp_path}\n", None)


def test_it_ends_by_the_signal_that_ended_the_command(tmp_path: Path) -> None:
    done, reason = conduct(tmp_path, argv=["sh", "-c", "kill -SEGV $$"])
    assert (done.returncode, reason) == (-signal.SIGSEGV, None)


def test_services_have_different_ports_that_commands_and_variables_know(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BOTH", "\2a\2 \2b\2")
    services = [SERVICE, {**SERVICE, "name": "b"}]
    done, reason = conduct(tmp_path, services=services, argv=["sh", "-c", "echo $BOTH; echo \2a\2 \2b\2"])
    assert reason is None
    first, second = done.stdout.splitlines()
    assert first == second
    assert len(set(first.split())) == 2


def test_output_without_a_line_end_is_kept(tmp_path: Path) -> None:
    service = {**SERVICE, "argv": ["sh", "-c", "trap 'printf bye; exit' TERM; echo on 1; while :; do sleep 0.05; done"]}
    done, reason = conduct(tmp_path, services=[service])
    assert (done.stderr.splitlines()[-1], reason) == ("[a] bye", None)


def test_the_rest_of_the_group_of_a_command_is_ended(tmp_path: Path) -> None:
    done, _ = conduct(tmp_path, before=[["sh", "-c", "sleep 1000 >&- 2>&- & echo $! > pid"]])
    pid = int((tmp_path / "pid").read_text())
    assert done.returncode == 0
    until(lambda: stat_of(pid)[:1] in ([], [b"Z"]))


def test_what_a_run_has_put_in_place_of_the_report_is_replaced(tmp_path: Path) -> None:
    target = tmp_path / "target"
    done, reason = conduct(tmp_path, argv=["ln", "-s", str(target), str(tmp_path / REPORT)])
    assert (done.returncode, reason) == (0, None)
    assert not target.exists()


def test_a_run_without_a_home_has_no_report(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        conduct(tmp_path, argv=["rm", "-r", str(tmp_path / "home")])


def test_it_runs_alone_on_python_3_8(require: Callable[..., str], tmp_path: Path) -> None:
    oldest = python_of("3.8")
    require("Python 3.8", there=oldest is not None)
    alone = tmp_path / "alone.pyz"
    alone.write_bytes(worker_zip.packed())
    ready = {**SERVICE, "name": "b", "argv": ["sh", "-c", "touch here; sleep 1000"], "ready": ["file", "\0/here"]}
    done, reason = conduct(
        tmp_path, alone, str(oldest), services=[SERVICE, ready], before=[["echo", "1"]], after=[["echo", "2"]]
    )
    assert (done.returncode, reason) == (0, None)
    assert os.linesep.join(done.stderr.splitlines()[1:]) == "== before: echo 1\n1\n== after: echo 2\n2"
