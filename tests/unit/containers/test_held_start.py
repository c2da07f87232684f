from __future__ import annotations

import os
import subprocess
from pathlib import Path

from sierra.containers import held_start
from sierra.model import Result
from tests.waiting import PATIENCE_S


def result(status: int) -> Result:
    return Result("1", "2", "", 0.0, 0.0, status, None, None, None, None, None, "host", 0, ())


def test_a_program_that_cannot_be_started_is_an_error() -> None:
    for status, line in (  # as dash, bash and busybox wrote them on Debian 12
        (127, "sierra-start: 1: exec: ./a b: not found"),
        (126, "sierra-start: 1: exec: ./a b: Permission denied"),
        (127, "sierra-start: line 1: ./a b: No such file or directory"),
        (126, "sierra-start: line 1: exec: ./a b: cannot execute: Permission denied"),
        (127, "sierra-start: exec: line 0: ./a b: not found"),
    ):
        found = held_start.classify(result(status), f"a line before\n{line}\n")
        assert found.exit_code is None
        assert found.error is not None
        assert found.error.startswith("the command cannot be started in the container: ./a b: ")


def test_the_status_of_a_program_stays() -> None:
    for status, errors in ((127, "sh: 1: other: not found"), (1, "sierra-start: 1: exec: x: not found"), (127, "")):
        assert held_start.classify(result(status), errors) == result(status)


def test_the_shell_of_this_machine_becomes_the_program_at_a_line_and_ends_without_one(tmp_path: Path) -> None:
    pipe = tmp_path / ".start"
    os.mkfifo(pipe)
    argv = held_start.waiting(("env",), {"A": "x y"})
    argv = tuple(word.replace("/run/sierra/run", str(tmp_path)) for word in argv)
    for text, said in (("\n", "A=x y\n"), ("", "")):
        with subprocess.Popen(argv, env={"A": "x y"}, stdout=subprocess.PIPE, text=True) as process:
            pipe.write_text(text)
            assert process.communicate(timeout=PATIENCE_S)[0] == said
        assert (process.returncode == 0) == bool(text)


def test_variables_that_a_shell_would_drop_are_noticed() -> None:
    assert held_start.passes({"PATH": "", "_a1": ""})
    assert not held_start.passes({"a.b": ""})
