"""Addresses of hosts are names of OpenSSH, or users, hosts and ports; anything else is refused before a connection."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.errors import NotInstalled, UsageError
from sierra.extensions.hosts.fabric import Fabric
from sierra.extensions.hosts.openssh import OpenSsh, OpenSshOptions
from sierra.runners.links.address import parse
from sierra.runners.links.base import LinkOptions


@pytest.mark.parametrize(
    ("text", "by_hand"),
    [
        ("robot1", "ssh robot1"),
        ("pi@192.168.1.21", "ssh pi@192.168.1.21"),
        ("pi@robot:2222", "ssh -p 2222 pi@robot"),
        ("fe80::1", "ssh fe80::1"),
    ],
)
def test_addresses_are_those_of_ssh(text: str, by_hand: str, tmp_path: Path) -> None:
    assert parse(text, "").by_hand == by_hand
    (tmp_path / "a b").touch()
    assert parse(text, f"{tmp_path}/a b").by_hand.startswith(f"ssh -F '{tmp_path}/a b' ")


@pytest.mark.parametrize(
    "text", ["", " ", "a b", "-oProxyCommand=id", "pi@-x", "@a", "a@", "a:", ":22", "a:0", "a:x", "a:65536", "a\nb"]
)
def test_anything_else_is_refused_by_both_links(text: str) -> None:
    for make in (lambda: Fabric(text, LinkOptions()), lambda: OpenSsh(text, OpenSshOptions())):
        with pytest.raises(UsageError, match=r"is not a host|has the port") as raised:
            make()
        assert len(str(raised.value).splitlines()) == 1


def test_a_configuration_that_is_missing_is_an_error() -> None:
    with pytest.raises(UsageError, match="/nonexistent/config, which is not a file"):
        Fabric("robot1", LinkOptions(ssh_config="/nonexistent/config"))


def test_fabric_may_be_absent_until_it_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "fabric", None)
    with pytest.raises(NotInstalled, match="sierra-experiments\\[robots\\]"):
        Fabric("robot1", LinkOptions()).run(["true"])
