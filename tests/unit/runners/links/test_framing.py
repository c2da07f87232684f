"""Frames separate a command's output from everything else on its way, wherever the output is cut into pieces."""

from __future__ import annotations

import shlex
import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.runners.links.framing import Unframed, line, new_mark
from tests.waiting import PATIENCE_S

MARK = new_mark().encode()
PARTS = st.sampled_from([b"", b"a\n", MARK[:9], MARK[:-1], MARK, b":", b".", b"\0\xff"])


@given(st.binary(max_size=20), st.lists(PARTS, max_size=6).map(b"".join), st.integers(0, 255), st.data())
def test_output_is_exact_however_it_is_cut(before: bytes, payload: bytes, status: int, data: st.DataObject) -> None:
    if MARK + b"." in payload:
        return
    whole = before + MARK + b":" + payload + MARK + b".%d\nlater" % status
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=8)))
    unframed = Unframed(MARK.decode())
    pieces = [whole[start:end] for start, end in zip([0, *cuts], [*cuts, len(whole)], strict=True)]
    assert (b"".join(map(unframed.feed, pieces)), unframed.status) == (payload, status)


@pytest.mark.integration
@pytest.mark.parametrize("shell", ["sh", "bash"])
def test_a_shell_executes_the_command_as_it_is_within_its_time_limit(shell: str) -> None:
    mark = new_mark()
    words = ["", "a b", "c\nd", "'e'", '"', "$HOME", "`f`", "i\\j", "*", "-k", "!x", "ü"]
    for argv, limit, status, out in (
        (["printf", "<%s>", *words], None, 0, "".join(f"<{word}>" for word in words)),
        (["sh", "-c", "kill -9 $$"], None, 137, ""),
        (["nonexistent"], None, 127, ""),
        (["sleep", "1000"], -0.9, 124, ""),
    ):
        command = f"echo noise; echo noise >&2; {line(argv, mark, limit)}"
        done = subprocess.run([shell, "-c", command], capture_output=True, timeout=PATIENCE_S, check=False)
        outputs = Unframed(mark), Unframed(mark)
        assert outputs[0].feed(done.stdout).decode() == out
        outputs[1].feed(done.stderr)
        assert [one.status for one in outputs] == [status, status]


def test_a_command_without_input_does_not_wait_for_its_end() -> None:
    command = line(["cat"], MARK.decode(), alone=True)
    with subprocess.Popen(["sh", "-c", command], stdin=subprocess.PIPE, stderr=subprocess.PIPE) as shell:
        assert shell.wait(PATIENCE_S) == 0


@pytest.mark.parametrize("end", [b"x\n", b"\n", b"9" * 5000])
def test_an_end_without_a_number_is_no_status(end: bytes) -> None:
    with pytest.raises(ValueError, match="int"):
        Unframed(MARK.decode()).feed(MARK + b":" + MARK + b"." + end)


def test_the_words_of_a_login_shell_are_known_if_no_command_began() -> None:
    unframed = Unframed(MARK.decode())
    assert unframed.feed(b"This account is\nnot available.\n") == b""
    assert unframed.before == "This account is not available."
    assert shlex.split(line(["a b"], "m"))[-1] == "a b"
