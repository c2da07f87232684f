"""Programs that are executed within limits, and what is left of them."""

from __future__ import annotations

import os
import resource
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.util import bounded_program
from sierra.util.bounded_program import Ended


def shell(text: str, folder: Path, **options: object) -> Ended:
    return bounded_program.execute(["sh", "-c", text], cwd=folder, **options)  # type: ignore[arg-type]


def is_running(marker: str) -> bool:
    return marker in subprocess.run(["ps", "-e", "-o", "args="], capture_output=True, text=True, check=True).stdout


def wait_for(condition: Callable[[], bool]) -> None:
    give_up = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.01)


def test_a_program_returns_its_status_its_output_and_its_messages(tmp_path: Path) -> None:
    assert shell("pwd; echo why >&2; exit 3", tmp_path) == Ended(3, f"{tmp_path}\n".encode(), b"why\n")
    assert shell("kill -9 $$", tmp_path).status == -signal.SIGKILL
    assert shell("read line || echo none", tmp_path).output == b"none\n"
    assert shell('echo "$A"', tmp_path, env={"A": "b"}).output == b"b\n"


def test_a_program_that_cannot_be_started_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        bounded_program.execute(["absent-program"], cwd=tmp_path)
    with pytest.raises(ValueError, match="null byte"):
        bounded_program.execute(["a\0b"], cwd=tmp_path)


def test_a_program_that_exceeds_a_limit_has_no_status(tmp_path: Path) -> None:
    began = time.monotonic()
    assert shell("echo begun; sleep 60", tmp_path, wall=0.3) == Ended(None, b"begun\n", b"")
    endless = shell("yes", tmp_path, most=1000)
    assert endless.status is None
    assert 1000 < len(endless.output) <= 1000 + bounded_program.KEPT
    assert shell("exec > /dev/null 2>&1; sleep 60", tmp_path, wall=0.3).status is None
    assert time.monotonic() - began < 30


def test_the_end_of_long_messages_is_kept(tmp_path: Path) -> None:
    ended = shell("yes | head -c 1000000 >&2; echo last >&2", tmp_path)
    assert len(ended.errors) <= bounded_program.KEPT
    assert ended.errors.endswith(b"\nlast\n")


def test_a_program_writes_to_a_file(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as file:
        assert shell("echo out; echo err >&2", tmp_path, stdout=file, stderr=subprocess.STDOUT) == Ended(0, b"", b"")
    assert (tmp_path / "log").read_text() == "out\nerr\n"


def test_output_of_processes_that_a_program_leaves_counts_without_a_mark(tmp_path: Path) -> None:
    assert shell("(sleep 0.3; echo late) & echo early", tmp_path) == Ended(0, b"early\nlate\n", b"")
    assert shell("sleep 60 & echo early", tmp_path, wall=0.3) == Ended(None, b"early\n", b"")


def test_processes_that_keep_only_the_messages_open_are_not_awaited(tmp_path: Path) -> None:
    assert shell("sleep 60 > /dev/null & echo early; echo why >&2", tmp_path, wall=30.0) == Ended(0, b"early\n", b"why\n")


def test_an_interruption_is_not_lost_if_the_program_cannot_be_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        raise FileNotFoundError

    monkeypatch.setattr(bounded_program.subprocess, "Popen", interrupted)
    with pytest.raises(KeyboardInterrupt):
        shell("true", tmp_path)


def test_nothing_of_the_group_is_left(tmp_path: Path) -> None:
    marker = f"1.{time.time_ns()}"
    assert shell(f"sleep 6{marker} > /dev/null 2>&1 & echo 1", tmp_path).output == b"1\n"
    assert shell(f"trap '' TERM; sleep 6{marker} & sleep 6{marker}", tmp_path, wall=0.3).status is None
    wait_for(lambda: not is_running(marker))


def test_marked_processes_end_with_their_program_even_outside_its_group(tmp_path: Path) -> None:
    marker = f"2.{time.time_ns()}"
    ended = shell(f"(setsid sleep 6{marker} &); sleep 6{marker} & echo 1", tmp_path, wall=60.0, mark="SIERRA_MARKED")
    assert ended == Ended(0, b"1\n", b"")
    assert not is_running(marker)


def test_output_just_before_the_end_is_read_even_if_this_process_has_to_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Late(selectors.DefaultSelector):
        def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
            ready = super().select(timeout)
            time.sleep(0 if ready else 0.5)
            return ready

    monkeypatch.setattr(bounded_program.selectors, "DefaultSelector", Late)
    assert shell("sleep 0.2; echo 1", tmp_path, mark="SIERRA_MARKED") == Ended(0, b"1\n", b"")


def test_limits_of_the_kernel_are_set(tmp_path: Path) -> None:
    limited = "until [ $(ulimit -f) != unlimited ]; do sleep 0.01; done"  # set just after the program has begun
    shell(f"{limited}; head -c 100000 /dev/zero > large", tmp_path, limits={resource.RLIMIT_FSIZE: 4096})
    assert (tmp_path / "large").stat().st_size <= 4096


def test_an_interruption_ends_the_program(tmp_path: Path) -> None:
    marker = f"3.{time.time_ns()}"
    code = f"from sierra.util import bounded_program; bounded_program.execute(['sh', '-c', 'sleep 6{marker}; :'], cwd='.')"
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, stderr=subprocess.DEVNULL, start_new_session=True
    ) as caller:
        wait_for(lambda: is_running(f"sleep 6{marker}\n"))
        os.kill(caller.pid, signal.SIGINT)
        assert caller.wait(30) != 0
    wait_for(lambda: not is_running(f"sleep 6{marker}\n"))
