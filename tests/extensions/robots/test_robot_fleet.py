"""The robots of the tests are separate machines, and the faults that tests inject are real."""

from __future__ import annotations

import subprocess
import time

import pytest

from tests.support.robot_fleet import REPOSITORY, Fleet, Proxy
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.integration


def ssh(fleet: Fleet, name: str, command: str) -> subprocess.CompletedProcess[str]:
    argv = ["ssh", "-F", str(fleet.ssh_config), "-o", "BatchMode=yes", name, command]
    return subprocess.run(argv, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def test_robots_are_separate_machines(fleet: Fleet) -> None:
    one, other, third = fleet.names
    assert ssh(fleet, one, f"hostname; touch ~/kept /tmp/lost; ls -A /root; ls -A {REPOSITORY}").stdout == f"{one}\n"
    assert ssh(fleet, other, "ls ~ /tmp").stdout.split() == ["/home/robot:", "/tmp:"]
    fleet.power_cut(one)
    fleet.boot(one)
    assert ssh(fleet, one, "ls ~ /tmp").stdout.split() == ["/home/robot:", "kept", "/tmp:"]
    assert ssh(fleet, fleet.through(third, jump=other), "hostname").stdout == f"{third}\n"
    fleet.set_machine(third, "i686")
    assert ssh(fleet, third, "python3 -c 'import os; print(os.uname().machine)'").stdout == "i686\n"
    fleet.heal()
    assert ssh(fleet, one, "ls ~").stdout == ""


@pytest.mark.nightly
def test_faults_of_disks_clocks_and_logins_are_real(fleet: Fleet) -> None:
    one, other, third = fleet.names
    fleet.fill_disk(one)
    assert "No space left" in ssh(fleet, one, "echo all > ~/file").stderr
    fleet.read_only(other)
    assert "Read-only" in ssh(fleet, other, "touch ~/file").stderr
    for offset in (137, -20):
        fleet.set_clock(third, offset)
        assert abs(float(ssh(fleet, third, "date +%s.%N").stdout) - time.time() - offset) < 5
    fleet.heal()
    fleet.refuse_logins(one)
    assert "Permission denied (publickey)" in ssh(fleet, one, ":").stderr
    fleet.new_host_key(other)
    assert "has changed" in ssh(fleet, other, ":").stderr
    fleet.forget_host_key(third)
    assert "No ED25519 host key is known" in ssh(fleet, third, ":").stderr


@pytest.mark.nightly
def test_a_proxy_delays_stalls_and_cuts(fleet: Fleet) -> None:
    name = fleet.names[0]
    with Proxy(fleet.robots[name].address, delay=0.05) as proxy:
        alias = fleet.through(name, proxy.port)
        began = time.monotonic()
        assert ssh(fleet, alias, "hostname").stdout == f"{name}\n"
        assert time.monotonic() - began > 0.5
        argv = ["ssh", "-F", str(fleet.ssh_config), alias, "echo ready; cat"]
        with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout
            assert process.stdin
            assert process.stdout.readline() == "ready\n"
            proxy.stall()
            process.stdin.write("again\n")
            process.stdin.flush()
            time.sleep(0.3)
            proxy.stall(stalled=False)
            assert process.stdout.readline() == "again\n"
            proxy.cut()
            assert process.wait(timeout=10) == 255
