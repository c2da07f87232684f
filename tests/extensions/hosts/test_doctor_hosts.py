"""`sierra doctor --hosts` reports the state of each host, with a remedy for what is missing."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests import projects
from tests.support.robot_fleet import Fleet
from tests.support.robot_project import STOP

pytestmark = pytest.mark.integration


@pytest.fixture
def project(tmp_path: Path, fleet: Fleet) -> Path:
    folder = projects.make(tmp_path / "project")
    with (folder / "sierra.toml").open("a") as file:
        file.write(f'\n[links.fabric]\nssh_config = "{fleet.ssh_config}"\n[links.openssh]\nssh_config = "{fleet.ssh_config}"\n')
    return folder


NOTHING = 'setup = "", battery = [], firmware = [], calibration = ""'


def checks(folder: Path, *words: str, code: int = 0) -> dict[str, dict[str, str]]:
    done = projects.quick(folder, "doctor", "--hosts", *words, "--json")
    assert done.returncode == code, done.stdout + done.stderr
    return {check["name"]: check for check in json.loads(done.stdout)}


def test_hosts_are_reported_with_what_they_have_and_lack(project: Path, fleet: Fleet) -> None:
    one, other, third = fleet.names
    for link in ("fabric", "openssh"):
        found = checks(project, f"{one},{other}", "--link", link)
        assert {check["state"] for check in found.values()} == {"ok"}
        assert found[f"{one}: connection"]["found"].startswith(f"{link}, in ")
        assert found[f"{other}: python"]["found"].startswith("3.")
        assert "MB free in /home/robot" in found[f"{one}: disk"]["found"]
        assert "git" in found[f"{one}: installed"]["found"]
        assert found[f"{one}: time zone"]["found"] == found[f"{other}: time zone"]["found"]
    fleet.configure(other, "SetEnv TZ=NPT-5:45")
    fleet.set_clock(one, 137)
    fleet.read_only(other)
    fleet.new_host_key(third)
    found = checks(project, *fleet.names, "nowhere.invalid", code=3)
    assert found[f"{one}: clock"]["found"].startswith("+137.0")
    assert found[f"{one}: clock"]["state"] == "absent"
    assert "not writable" in found[f"{other}: disk"]["found"]
    assert found[f"{third}: key"]["state"] == "missing"
    assert "differs" in found[f"{third}: key"]["found"]
    assert found["nowhere.invalid: connection"]["state"] == "missing"
    assert len({name.partition(":")[0] for name in found}) == 4
    assert found[f"{other}: time zone"]["found"] == "UTC+5.75 h now"
    assert found[f"{one}: time zone"]["state"] == found[f"{other}: time zone"]["state"] == "absent"


def test_a_fleet_is_checked_for_what_its_runs_need(project: Path, fleet: Fleet) -> None:
    one, other, third = fleet.names
    (fleet.robots[one].home / "charge").write_text("12\n")
    with (project / "sierra.toml").open("a") as file:
        file.write(
            f'[runners.robots]\nstop = []\nsetup = "export LANG=C"\nbattery = "~/charge"\ndisk_min = "1 GB"\n'
            f'firmware = ["sh", "-c", "echo no board >&2; false"]\ncalibration = "~/charge"\n'
            f'[runners.robots.fleet]\nfirst = {{ host = "{one}" }}\n'
            f'second = {{ host = "{other}", battery = ["echo", "85 %"], firmware = ["echo", "1.4"], '
            f'variables = {{ TZ = "NPT-5:45" }} }}\n'
            f'third = {{ host = "{third}", setup = "source /opt/ros/none.bash" }}\n'
        )
    found = checks(project, code=3)
    assert (found["first: battery"]["state"], found["first: battery"]["found"]) == ("missing", "12 %")
    assert found["first: battery"]["remedy"] == "charge it: 20 % are needed"
    assert (found["second: battery"]["state"], found["second: battery"]["found"]) == ("ok", "85 %")
    assert found["first: firmware"]["found"] == "not readable: sh -c echo no board >&2; false: no board"
    assert found["first: calibration"]["found"].startswith("~/charge ")
    assert found["second: calibration"]["found"] == "not readable: /home/robot/charge: No such file or directory"
    assert found["second: firmware"] == {**found["second: firmware"], "state": "ok", "found": "1.4"}
    assert found["second: stop"]["found"] == "needs no command"
    assert found["second: time zone"]["found"] == "UTC+5.75 h now"
    assert "/opt/ros/none.bash: No such file" in found["third: setup"]["found"]
    assert found["second: disk"]["remedy"] == "free some space: 1000 MB are needed"
    assert {name.partition(":")[0] for name in checks(project, "second", code=3)} == {"second"}


def test_a_member_of_a_fleet_that_is_no_robot_has_nothing_to_read(project: Path, fleet: Fleet) -> None:
    one, other, _ = fleet.names
    with (project / "sierra.toml").open("a") as file:
        file.write(
            f'[runners.robots]\nstop = []\nsetup = "export LANG=C"\ndisk_min = "1 MB"\nbattery = "~/charge"\n'
            f'firmware = ["false"]\ncalibration = "~/charge"\n[runners.robots.fleet]\n'
            f'base = {{ host = "{fleet.through(one, jump=other)}", {NOTHING} }}\n'
        )
    found = checks(project)
    assert found["base: runs"]["state"] == "ok"
    assert not {"base: battery", "base: firmware", "base: calibration", "base: setup"} & found.keys()


def test_a_robot_is_checked_as_runs_use_it(project: Path, fleet: Fleet) -> None:
    one, other, third = fleet.names
    for name, robot in fleet.robots.items():
        subprocess.run(["sh", "-c", f"echo 0.5 > {robot.own}/motor"], check=True)
        fleet.motors[name].moves()
    with (project / "sierra.toml").open("a") as file:
        file.write(
            f"[runners.robots]\nstop = {json.dumps(STOP)}\n[runners.robots.fleet]\n"
            f'first = {{ host = "{one}" }}\nsecond = {{ host = "{other}", stop = ["motr", "0"] }}\n'
            f'third = {{ host = "{third}" }}\n'
        )
    fleet.robots[third].changed = True
    fleet.enter(third, "mount", "-o", "remount,bind,noexec", "/home")
    found = checks(project, code=3)
    assert found["first: stop"]["state"] == found["first: runs"]["state"] == "ok"
    assert (
        found["second: stop"]["found"] == "may be moving: the stop command cannot be started: motr: No such file or directory"
    )
    assert found["second: stop"]["remedy"] == "stop the robot by hand, and correct stop in sierra.toml"
    assert found["third: runs"]["found"].startswith("cannot execute programs in /home/robot/.cache/sierra-robot: ")
    assert {name: motor.speed for name, motor in fleet.motors.items()} == {one: 0.0, other: 0.5, third: 0.0}


@pytest.mark.nightly
def test_hosts_need_names_or_a_fleet(project: Path) -> None:
    for words, said in (((), "there is no fleet"), (("rb1", "--link", "carrier-pigeon"), "unknown link")):
        done = projects.quick(project, "doctor", "--hosts", *words)
        assert (done.returncode, said in done.stderr) == (2, True), done.stderr
    done = projects.quick(project, "doctor", "rb1")
    assert (done.returncode, "--hosts" in done.stderr) == (2, True)
