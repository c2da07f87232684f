"""Host keys that links of Fabric accept, without a connection. `tests/extensions/robots` has real hosts."""

from __future__ import annotations

from pathlib import Path

import paramiko
import pytest

from sierra.errors import SierraError
from sierra.extensions.hosts.fabric import Fabric
from sierra.runners.links.base import LinkOptions, UntrustedHost

KEY = paramiko.ECDSAKey.generate()
LINE = f"{KEY.get_name()} {KEY.get_base64()}"


def error(folder: Path, more: str = "") -> SierraError:
    """Return the error of a connection to a host of a strange `known_hosts`; nobody listens on its port 1."""
    known, config = folder / "known_hosts", folder / "config"
    known.write_text(f"# robots\n@cert-authority *.lab {LINE}\n@revoked\nno key\nhost ssh-rsa A\ntb0,[127.0.0.1]:1 {LINE}\n")
    config.write_text(f"Host tb1\n  HostName 127.0.0.1\n  Port 1\n  UserKnownHostsFile {known}\n{more}")
    with pytest.raises(SierraError) as raised:
        Fabric("tb1", LinkOptions(ssh_config=str(config), connect=1.0)).run(("true",))
    return raised.value


def test_lines_of_known_hosts_that_openssh_ignores_are_ignored(tmp_path: Path) -> None:
    assert "tb1: not reachable" in str(error(tmp_path))
    assert "tb1: not reachable" in str(error(tmp_path, "RevokedHostKeys none"))


def test_a_host_with_a_file_of_revoked_keys_is_refused_because_fabric_cannot_read_it(tmp_path: Path) -> None:
    refused = error(tmp_path, "RevokedHostKeys /etc/ssh/revoked")
    assert isinstance(refused, UntrustedHost)
    assert str(refused) == "tb1: only the OpenSSH client reads the file of RevokedHostKeys; use the link openssh"
