"""The stream of a process may be closed while other threads use it."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from sierra.runners.links.process_stream import ProcessStream


def closed_meanwhile(stream: ProcessStream, monkeypatch: pytest.MonkeyPatch, other: Path) -> list[int]:
    """Let another thread close the stream as soon as there is output, and open files that get the numbers of its pipes."""
    selector, opened = stream._open, list[int]()
    select = selector.select

    def slow(timeout: float | None = None) -> Any:
        ready = select(timeout)
        stream.close()
        opened.extend(os.open(other, os.O_RDONLY) for _ in range(6))
        return ready

    monkeypatch.setattr(selector, "select", slow)
    return opened


def test_nothing_is_read_from_other_files_if_it_is_closed_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other").write_bytes(b"of another robot")
    stream = ProcessStream(["echo", "own"], os.environ)
    opened = closed_meanwhile(stream, monkeypatch, tmp_path / "other")
    try:
        assert stream.read(10.0) is None
        assert stream.read(10.0) is None
    finally:
        for number in opened:
            os.close(number)


def test_closing_it_at_the_moment_of_a_look_ends_the_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = ProcessStream(["cat"], os.environ)

    def closed(timeout: float | None = None) -> Any:
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))

    monkeypatch.setattr(stream._open, "select", closed)
    assert stream.read(10.0) is None
    stream.close()


def test_sending_to_a_closed_stream_is_a_broken_pipe() -> None:
    stream = ProcessStream(["cat"], os.environ)
    stream.send(b"x", 5.0)
    stream.close()
    with pytest.raises(BrokenPipeError):
        stream.send(b"y", 5.0)
