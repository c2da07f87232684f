"""Both links fulfil the contract, on a real sshd with all faults; and both refuse hostile and unfit hosts."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from sierra.extensions.hosts.fabric import Fabric
from sierra.extensions.hosts.openssh import OpenSsh, OpenSshOptions
from sierra.runners.links.base import Link, LinkOptions, Unreachable, UntrustedHost
from sierra.testing import links
from tests.support import robot_fleet
from tests.support.robot_fleet import Fleet

pytestmark = [pytest.mark.integration, pytest.mark.real]
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


@pytest.fixture(scope="module")
def other_key(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the public key of no host."""
    return public(robot_fleet.make_key(tmp_path_factory.mktemp("key") / "other"))


def public(key: Path) -> str:
    return " ".join(key.with_name(f"{key.name}.pub").read_text().split()[:2])


@pytest.mark.each_case
@pytest.mark.parametrize(
    ("lines", "trusts"),
    [
        ("{host} {key}\n@revoked {host} {key}", ""),
        ("@revoked * {key}\n{host} {key}", ""),
        ("@revoked * {key}", ""),
        ("{host} {other}\n{host} {key}\n@revoked * {key}", ""),
        ("{host} {other}\n{host} {key}\n@revoked * {other}", "fabric openssh"),
        ("{host} {key}\n{host} {other}\n@revoked * {other}", "fabric openssh"),
        ("{host} {key}\n@revoked other {key}", "openssh"),
        ("@cert-authority {host} {key}", ""),
        ("{host} {key}\n@cert-authority {host} {other}", "fabric openssh"),
    ],
)
def test_a_revoked_key_is_refused_and_a_mark_makes_no_key_known(lines: str, trusts: str, fleet: Fleet, other_key: str) -> None:
    name = fleet.names[0]
    host, key = f"{name},{fleet.robots[name].address}", public(fleet.robots[name].own / "hostkey")
    fleet.known_hosts.write_text(lines.format(host=host, key=key, other=other_key) + "\n")
    assert trusting(fleet) == trusts.split()


@pytest.mark.each_case
@pytest.mark.parametrize(
    ("lines", "trusts"),
    [
        ("@cert-authority {host} {authority}", "openssh"),
        ("@cert-authority {host} {authority}\n{host} {key}", "fabric openssh"),
        ("@cert-authority {host} {authority}\n@revoked {host} {key}\n{host} {key}", ""),
        ("@revoked {host} {authority}\n{host} {key}", "fabric"),
    ],
)
def test_fabric_trusts_the_key_of_a_host_with_a_certificate_and_not_the_certificate(
    lines: str, trusts: str, fleet: Fleet, tmp_path: Path
) -> None:
    robot = fleet.robots[fleet.names[0]]
    host, key = f"{robot.name},{robot.address}", public(robot.own / "hostkey")
    authority = robot_fleet.make_key(tmp_path / "authority")
    subprocess.run(
        ["ssh-keygen", "-q", "-s", authority, "-h", "-I", "robot", "-n", host, robot.own / "hostkey.pub"], check=True
    )
    fleet.configure(robot.name, "HostCertificate /run/robot/hostkey-cert.pub")
    fleet.known_hosts.write_text(lines.format(host=host, key=key, authority=public(authority)) + "\n")
    assert trusting(fleet) == trusts.split()


@pytest.mark.parametrize("kind", MAKERS)
def test_a_key_in_the_file_of_revoked_keys_is_not_accepted(kind: str, fleet: Fleet, tmp_path: Path) -> None:
    name = fleet.names[0]
    (tmp_path / "revoked").write_text(public(fleet.robots[name].own / "hostkey") + "\n")
    with fleet.ssh_config.open("a") as file:
        file.write(f"Host *\n  RevokedHostKeys {tmp_path / 'revoked'}\n")
    with pytest.raises(UntrustedHost, match="RevokedHostKeys; use the link openssh" if kind == "fabric" else name):
        MAKERS[kind](name, fleet).run(["true"])


def test_a_revoked_key_is_named_as_such(fleet: Fleet) -> None:
    robot = fleet.robots[fleet.names[0]]
    key = public(robot.own / "hostkey")
    with fleet.known_hosts.open("a") as file:
        file.write(f"@revoked * {key}\n")
    refused = rf"^{robot.name}: the host key of {robot.address} is revoked in your known_hosts \(ssh-ed25519 SHA256:.*\)$"
    with pytest.raises(UntrustedHost, match=refused):
        MAKERS["fabric"](robot.name, fleet).run(["true"])


def trusting(fleet: Fleet) -> list[str]:
    """Return the links that trust the first robot of a fleet."""
    found = []
    for kind, make in MAKERS.items():
        link = make(fleet.names[0], fleet)
        with contextlib.suppress(UntrustedHost):
            assert link.run(["hostname"]).stdout.decode() == f"{fleet.names[0]}\n"
            found.append(kind)
        link.close()
    return found


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
