"""Both links fulfil the contract, on a real sshd with all faults; and both refuse hostile and unfit hosts."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from sierra.links.base import Link, LinkOptions, Unreachable, UntrustedHost
from sierra.links.fabric import Fabric
from sierra.links.openssh import OpenSsh, OpenSshOptions
from sierra.testing import links
from tests.support import robot_fleet
from tests.support.robot_fleet import Fleet

pytestmark = pytest.mark.real
MAKERS: dict[str, Callable[[str, Fleet], Link]] = {
    "fabric": lambda host, fleet: Fabric(host, LinkOptions(ssh_config=str(fleet.ssh_config))),
    "openssh": lambda host, fleet: OpenSsh(host, OpenSshOptions(ssh_config=str(fleet.ssh_config))),
}


@dataclass
class Behind:
    """A host behind a proxy."""

    name: str
    proxy: robot_fleet.Proxy

    def stall(self, *, stalled: bool = True) -> None:
        self.proxy.stall(stalled=stalled)

    def cut(self) -> None:
        self.proxy.cut()


@dataclass
class Robot:
    """The host of the conformance suite: one robot of the fleet."""

    fleet: Fleet
    name: str

    def heal(self) -> None:
        self.fleet.heal()

    def radio(self, *, up: bool) -> None:
        self.fleet.radio(self.name, up=up)

    def power_cut(self) -> None:
        self.fleet.power_cut(self.name)

    def boot(self) -> None:
        self.fleet.boot(self.name)

    def fill_disk(self) -> None:
        self.fleet.fill_disk(self.name, 50_000)

    def read_only(self) -> None:
        self.fleet.read_only(self.name)

    def slow(self) -> None:
        self.fleet.slow(self.name)

    def new_host_key(self) -> None:
        self.fleet.new_host_key(self.name)

    def forget_host_key(self) -> None:
        self.fleet.forget_host_key(self.name)

    def refuse_logins(self) -> None:
        self.fleet.refuse_logins(self.name)

    def only_passwords(self) -> None:
        self.fleet.configure(self.name, "PasswordAuthentication yes", "PubkeyAuthentication no")

    @contextlib.contextmanager
    def proxy(self, delay: float) -> Iterator[Behind]:
        with robot_fleet.Proxy(self.fleet.robots[self.name].address, delay) as proxy:
            yield Behind(self.fleet.through(self.name, proxy.port), proxy)


SLOW = (links.notices_a_lost_host, links.notices_a_power_cut)
"""Claims that take half a minute."""


@pytest.mark.parametrize(
    ("kind", "claim"),
    [
        pytest.param(
            kind,
            claim,
            id=f"{kind}-{claim.__name__}",
            marks=[pytest.mark.nightly] if kind != "fabric" and claim in SLOW else [],
        )
        for kind in MAKERS
        for claim in links.CLAIMS
    ],
)
def test_it_is_a_link(kind: str, claim: Callable[[links.Trial], None], fleet: Fleet, tmp_path: Path) -> None:
    links.call(claim, links.Trial(lambda host: MAKERS[kind](host, fleet), Robot(fleet, fleet.names[0]), tmp_path))


@pytest.mark.each_case
@pytest.mark.parametrize("kind", MAKERS)
def test_hosts_on_the_way_are_checked_too(kind: str, fleet: Fleet) -> None:
    jump, name, _ = fleet.names
    host = fleet.through(name, jump=jump)
    link = MAKERS[kind](host, fleet)
    assert link.run(["hostname"]).stdout.decode() == f"{name}\n"
    link.close()
    fleet.forget_host_key(jump)
    with pytest.raises((UntrustedHost, Unreachable), match=host):
        link.run(["hostname"])
    link.close()


@pytest.mark.parametrize("kind", MAKERS)
def test_what_login_shells_print_is_dropped(kind: str, fleet: Fleet, tmp_path: Path) -> None:
    name = fleet.names[0]
    (fleet.robots[name].home / ".bashrc").write_text("echo welcome; echo to >&2; printf 'the robot'\n")
    link = MAKERS[kind](name, fleet)
    ended = link.run(["printf", "out"])
    assert (ended.stdout, ended.stderr) == (b"out", b"")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_text("content")
    assert link.push(tmp_path / "folder", "pushed").files == link.pull("pushed", tmp_path / "back").files
    fleet.robots[name].changed = True
    fleet.enter(name, "sh", "-c", "sed 's#/home/robot:/bin/bash#/home/robot:/usr/sbin/nologin#' /etc/passwd > /tmp/passwd")
    fleet.enter(name, "mount", "--bind", "/tmp/passwd", "/etc/passwd")
    link.close()
    with pytest.raises(Unreachable, match=f"{name}: .*not available"):
        MAKERS[kind](name, fleet).run(["true"])


@pytest.mark.nightly
@pytest.mark.parametrize("kind", MAKERS)
def test_aliases_of_host_keys_and_proxy_commands_are_those_of_openssh(kind: str, fleet: Fleet, tmp_path: Path) -> None:
    jump, name, _ = fleet.names
    key = (fleet.robots[name].own / "hostkey.pub").read_text()
    (tmp_path / "known").write_text(f"the-alias {key}")
    own = f"User robot\nHostKeyAlias the-alias\nIdentityFile {fleet.key}\nUserKnownHostsFile {tmp_path / 'known'}\n"
    through = f"ProxyCommand ssh -F {fleet.ssh_config} -W {fleet.robots[name].address}:22 {jump}"
    with fleet.ssh_config.open("a") as file:
        file.write(f"Host direct\nHostName {fleet.robots[name].address}\n{own}Host by-command\n{through}\n{own}")
    for host in ("direct", "by-command"):
        link = MAKERS[kind](host, fleet)
        if (kind, host) == ("fabric", "by-command"):
            with pytest.raises(Unreachable, match=r"by-command: its ProxyCommand needs .* use the link openssh"):
                link.run(["hostname"])
        else:
            assert link.run(["hostname"]).stdout.decode() == f"{name}\n"
            link.close()
            (tmp_path / "known").write_text("")
            with pytest.raises(UntrustedHost, match=host):
                link.run(["hostname"])
            (tmp_path / "known").write_text(f"the-alias {key}")
        link.close()


def test_commands_that_end_at_once_leave_the_connection(fleet: Fleet) -> None:
    robot = fleet.robots[fleet.names[0]]
    link, before = MAKERS["fabric"](robot.name, fleet), robot.log.count("Accepted publickey")
    with ThreadPoolExecutor(8) as pool:
        assert {one.status for one in pool.map(lambda _: link.run(["true"]), range(300))} == {0}
    assert robot.log.count("Accepted publickey") == before + 1
    link.close()
