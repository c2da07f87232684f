"""Tests of the checks of a host, which is a folder of this machine here. `tests/integration/robots` has real ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.links.base import Ended
from sierra.setup import host_checks
from sierra.setup.host_checks import HostToCheck
from tests.support.local_link import LocalLink


@pytest.mark.parametrize(
    ("host", "said"),
    [
        (HostToCheck("tb1", "tb1", setup="export SPEED=1; exit 0"), ("setup", "it ends the shell, by exit or exec")),
        (
            HostToCheck("tb1", "tb1", battery=("echo", "12000 mV")),
            ("battery", "not readable: '12000 mV' is not a charge from 0 to 100 %"),
        ),
        (
            HostToCheck("tb1", "tb1", battery=("echo", "nan")),
            ("battery", "not readable: 'nan' is not a charge from 0 to 100 %"),
        ),
    ],
)
def test_values_that_mean_nothing_are_missing(
    host: HostToCheck, said: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host_checks, "_hosts", lambda *_: [host])
    link = LocalLink("tb1", tmp_path / "home")
    monkeypatch.setattr(type(host_checks.LINKS), "make", lambda *_: link)
    missing = [(one.name, one.found) for one in host_checks.all_checks(["tb1"]) if one.state == "missing"]
    for channel in link.channels:
        with channel.process as process:  # it is awaited, and its pipes are closed
            process.kill()
    assert missing == [(f"tb1: {said[0]}", said[1])]


@pytest.mark.parametrize("answer", [b"", b"hello\n", b"[]\n", b'{"python": "3"}\n'])
def test_a_host_that_answers_something_else_is_missing(answer: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_checks, "_hosts", lambda *_: [HostToCheck("tb1", "tb1")])
    monkeypatch.setattr(type(host_checks.LINKS), "make", lambda *_: LocalLink("tb1", tmp_path / "home"))
    monkeypatch.setattr(LocalLink, "run", lambda *_, **__: Ended(0, answer, b""))
    found = host_checks.all_checks(["tb1"])
    assert [one.state for one in found] == ["ok", "missing"]
