"""The tracer that is remembered: tried once, and again if something has changed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.provenance import tracer
from sierra.worker import observers


@pytest.fixture
def strace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]) -> Path:
    """A script that executes strace, and notes each of its executions in the file `calls`."""
    real = require("strace")
    script = tmp_path / "bin" / "strace"
    script.parent.mkdir()
    script.write_text(f'#!/bin/sh\necho >> "{tmp_path}/calls"\nexec {real} "$@"\n')
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{script.parent}:/usr/bin:/bin")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return script


def usable() -> str | None:
    """Return the tracer that a new process finds."""
    observers.trouble_of.cache_clear()
    return tracer.usable()


def calls(tmp_path: Path) -> int:
    file = tmp_path / "calls"
    return len(file.read_text().splitlines()) if file.exists() else 0


def test_a_tracer_that_works_is_tried_once(strace: Path, tmp_path: Path) -> None:
    assert usable() == str(strace)
    tried = calls(tmp_path)
    assert tried > 0
    assert usable() == str(strace)
    assert calls(tmp_path) == tried


def test_a_tracer_that_has_changed_is_tried_again(strace: Path) -> None:
    assert usable() == str(strace)
    strace.write_text("#!/bin/sh\nexit 1\n")
    assert usable() is None


def test_a_tracer_that_does_not_work_is_not_remembered(strace: Path) -> None:
    working = strace.read_text()
    strace.write_text("#!/bin/sh\nexit 1\n")
    assert usable() is None
    strace.write_text(working)
    assert usable() == str(strace)


def test_without_a_tracer_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert usable() is None
