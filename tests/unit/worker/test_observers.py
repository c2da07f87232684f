"""Ways to observe runs: which can be used, and what they see while programs go on."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.util import worker_zip
from sierra.worker import observers, trace_log
from sierra.worker.observers import Strace
from tests.pythons import python_of
from tests.strace_logs import LOG, read


@pytest.mark.integration
@given(st.lists(st.integers(0, len(LOG)), max_size=5))
def test_what_living_programs_have_done_is_read_piece_by_piece_from_a_log_that_grows(
    tmp_path_factory: pytest.TempPathFactory, cuts: list[int]
) -> None:
    log, whole = tmp_path_factory.mktemp("log") / "log", read(LOG)
    growing = Strace("/usr/bin/strace").begin(str(log), "/w")
    for end in sorted((*cuts, len(LOG))):
        log.write_text(LOG[:end])
        seen = growing.trace(living=True)
        begun = "execve" in LOG[:end].rpartition("\n")[0]
        assert (seen.disturbed, "it had not begun" in seen.reasons) == (None, not begun)
    assert seen == whole


def test_a_living_program_may_be_observed_until_its_log_is_too_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, whole = tmp_path / "log", read(LOG)
    growing = Strace("/usr/bin/strace").begin(str(log), "/w")
    log.write_text(LOG)
    assert growing.trace(living=True).reason is None
    monkeypatch.setattr(trace_log, "LOG_BYTES", 10)
    growing.limit()
    log.write_text("a log that begins anew")
    cut = growing.trace(living=True)
    assert (cut.read, cut.reason, cut.disturbed) == (whole.read, "its log is longer than 10 bytes", None)


def fake(folder: Path, script: str) -> Strace:
    program = folder / "strace"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    return Strace(str(program))


@pytest.mark.parametrize(
    ("script", "trouble"),
    [
        ("echo 'strace -- version 5.2'", "strace -- version 5.2; 5.3 or newer is needed"),
        ("exit 1", "of an unknown version"),
        (
            'test "$1" = -V && { echo "strace -- version 6.1"; exit; }\necho "ptrace: Operation not permitted" >&2; exit 1',
            "cannot trace here: ptrace: Operation not permitted",
        ),
        ('test "$1" != -V || echo "strace -- version 6.1"', "the log of .* is not understood"),
    ],
)
def test_a_strace_that_cannot_be_used_says_why_in_one_line(script: str, trouble: str, tmp_path: Path) -> None:
    said = fake(tmp_path, script).trouble()
    assert said is not None
    assert len(said.splitlines()) == 1
    assert re.search(trouble, said)
    assert Strace(str(tmp_path / "none")).trouble() is not None


def test_another_way_is_used_with_the_reason(tmp_path: Path) -> None:
    way, troubles = observers.usable([fake(tmp_path, "exit 1"), observers.Maps()])
    assert way is not None
    assert way.name == "maps"
    assert len(troubles) == 1


def test_it_runs_alone_on_python_3_8(require: Callable[..., str], tmp_path: Path) -> None:
    oldest = python_of("3.8")
    require("Python 3.8", there=oldest is not None)
    (tmp_path / "worker.pyz").write_bytes(worker_zip.packed())
    text = """
import os, sys, zipimport
programs = {"__name__": "programs", "__file__": sys.argv[1] + "/__main__.py"}
exec(zipimport.zipimporter(sys.argv[1]).get_code("__main__"), programs)
programs["add_package"]()
from sierra.worker import file_names, observed_record, observers, trace_log
log = trace_log.Log(b"/w")
log.read(sys.stdin.buffer)
trace = log.trace("strace")
assert trace.complete, trace.reason
names = file_names.Names({"project": "/w"})
print([names.name(path) for path in names.inputs(trace).found], len(observed_record.contents(trace, 10**20).files) > 1)
print(observers.usable()[0].name)
"""
    command = [str(oldest), "-I", "-S", "-c", text, str(tmp_path / "worker.pyz")]
    done = subprocess.run(command, input=LOG, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout.splitlines()[0] == "['{project}/sub', '{project}/there'] True"
