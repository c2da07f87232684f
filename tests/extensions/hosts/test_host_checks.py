"""Tests of the checks of a host, which is a folder of this machine here. `tests/extensions/robots` has real ones."""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from sierra.extensions.hosts import host_checks
from sierra.extensions.hosts.host_checks import HostToCheck
from sierra.extensions.robots import fleet_checks
from sierra.extensions.robots.fleet_table import FleetTable
from sierra.runners.links.base import Ended
from sierra.setup.doctor import Check
from tests.support.local_link import LocalLink


def robot(**declared: Any) -> HostToCheck:
    fleet = FleetTable(stop=(), fleet={"tb1": {"host": "tb1", **declared}})
    return HostToCheck("tb1", "tb1", own=partial(fleet_checks.checks_of_robot, fleet.robot("tb1"), fleet))


def checked(host: HostToCheck, home: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Check]:
    """Return the checks of a host by name, without the name of the host."""
    monkeypatch.setattr(host_checks, "_hosts", lambda *_: [host])
    link = LocalLink("tb1", home)
    monkeypatch.setattr(type(host_checks.LINKS), "make", lambda *_: link)
    found = {one.name.removeprefix("tb1: "): one for one in host_checks.all_checks(["tb1"])}
    for channel in link.channels:
        with channel.process as process:  # it is awaited, and its pipes are closed
            process.kill()
    return found


@pytest.mark.parametrize(
    ("declared", "name", "said"),
    [
        ({"setup": "export SPEED=1; exit 0"}, "setup", "its setup line ended the shell (by exit or exec)"),
        ({"battery": ("echo", "12000 mV")}, "battery", "not readable: '12000 mV' is not a charge from 0 to 100 %"),
        ({"battery": ("echo", "nan")}, "battery", "not readable: 'nan' is not a charge from 0 to 100 %"),
        ({"stop": ("motr", "0")}, "stop", "may be moving: the stop command cannot be started: motr: No such file or directory"),
        (
            {"stop": ("sh", "-c", "echo no power; exit 3")},
            "stop",
            "may be moving: the stop command ended with status 3: no power",
        ),
    ],
)
def test_what_no_run_could_use_is_missing(
    declared: dict[str, Any], name: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = checked(robot(**declared), tmp_path / "home", monkeypatch)
    [missing] = [(key, one.found) for key, one in found.items() if one.state == "missing"]
    assert missing[0] == name
    assert missing[1].startswith(said)


def test_the_stop_command_is_executed_and_firmware_and_calibration_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibration, stopped = tmp_path / "calibration", tmp_path / "stopped"
    calibration.write_text("radius: 1\n")
    declared = {"stop": ("touch", str(stopped)), "firmware": ("echo", "1.4"), "calibration": str(calibration)}
    found = checked(robot(**declared), tmp_path / "home", monkeypatch)
    assert {one.state for one in found.values()} == {"ok"}
    assert stopped.exists()
    assert found["stop"].found == f"touch {stopped}: succeeds"
    assert found["firmware"].found == "1.4"
    assert found["calibration"].found == f"{calibration} {hashlib.sha256(calibration.read_bytes()).hexdigest()[:10]}"
    assert found["runs"].found == f"a program was executed in {tmp_path}/home/.cache/sierra-robot"


@pytest.mark.parametrize("answer", [b"", b"hello\n", b"[]\n", b'{"python": "3"}\n'])
def test_a_host_that_answers_something_else_is_missing(answer: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_checks, "_hosts", lambda *_: [HostToCheck("tb1", "tb1")])
    monkeypatch.setattr(type(host_checks.LINKS), "make", lambda *_: LocalLink("tb1", tmp_path / "home"))
    monkeypatch.setattr(LocalLink, "run", lambda *_, **__: Ended(0, answer, b""))
    found = host_checks.all_checks(["tb1"])
    assert [one.state for one in found] == ["ok", "missing"]
