"""Tests call a fork of a process that has imported SIERRA: it behaves like the program that users start."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest

from tests import forkserver, projects

CALLS = (("--version",), ("nonsense",), ("ls",), ("run", "population_size=1", "--dry-run", "--json"), ("schema", "sierra.toml"))


def streams(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate()
    return process.returncode, out, err


def started(folder: Path, *words: str) -> subprocess.Popen[str]:
    """Start the program itself, as users do."""
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([forkserver.SIERRA, *words], cwd=folder, text=True, **pipes)


@pytest.mark.integration
@pytest.mark.parametrize("words", CALLS)
def test_forked_command_has_the_output_and_exit_code_of_the_program(tmp_path: Path, words: tuple[str, ...]) -> None:
    root = projects.make(tmp_path / "project")
    forked = projects.start(root, *words, stdin=subprocess.DEVNULL)
    assert is_fork(forked)
    assert streams(forked) == streams(started(root, *words))


def is_fork(process: subprocess.Popen[str]) -> bool:
    return getattr(process, "_forked", None) is not None


@pytest.mark.integration
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_signals_end_the_forked_command_and_set_its_exit_code(tmp_path: Path, number: signal.Signals) -> None:
    process = projects.start(projects.make(tmp_path / "project"), "sql", stdin=subprocess.PIPE)
    assert process.poll() is None
    process.send_signal(number)
    process.communicate()
    assert process.returncode in (-number, 130)  # 130 if SIERRA had already installed its handler


def test_forked_command_has_its_own_folder_and_environment(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    asked = ("run", "population_size=1", "--dry-run")
    wrong = projects.sierra(root, "run", "population_size=1", environment={"SIERRA_JOBS": "many"})
    assert (wrong.returncode, "SIERRA_JOBS='many'" in wrong.stderr) == (2, True)
    assert projects.sierra(root, *asked).returncode == 0
    (root / "sierra.toml").unlink()
    assert "sierra.toml" in projects.sierra(root, *asked).stderr


def test_variables_that_the_interpreter_reads_at_start_prevent_a_fork(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONUTF8": "0"}
    process = projects.start(projects.make(tmp_path / "project"), "--version", env=environment)
    assert not is_fork(process)
    assert streams(process) == (0, projects.sierra(tmp_path, "--version").stdout, "")


def test_two_forked_commands_run_at_once(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    both = [projects.start(root, "run", "population_size=1", "--dry-run", "--json") for _ in range(2)]
    assert both[0].pid != both[1].pid
    answers = [streams(process) for process in both]
    assert [code for code, *_ in answers] == [0, 0]
    assert json.loads(answers[0][1]) == json.loads(answers[1][1])
