"""Host keys that links of Fabric accept, without a connection. `tests/integration/robots` has real hosts."""

from __future__ import annotations

from pathlib import Path

import paramiko
import pytest

from sierra.errors import SierraError
from sierra.links.base import LinkOptions, UntrustedHost
from sierra.links.fabric import Fabric

KEY = paramiko.ECDSAKey.generate()
LINE = f"{KEY.get_name()} {KEY.get_base64()}"


@pytest.mark.parametrize("revoked", [False, True])
def test_a_revoked_key_is_not_accepted(tmp_path: Path, revoked: bool) -> None:
    known, config = tmp_path / "known_hosts", tmp_path / "config"
    mark = f"@revoked * {LINE}\n" if revoked else ""
    known.write_text(f"# robots\n@cert-authority *.lab {LINE}\nno key\nhost ssh-rsa A\ntb0,[127.0.0.1]:1 {LINE}\n{mark}")
    config.write_text(f"Host tb1\n  HostName 127.0.0.1\n  Port 1\n  UserKnownHostsFile {known}\n")
    with pytest.raises(SierraError) as raised:  # nobody listens on port 1
        Fabric("tb1", LinkOptions(ssh_config=str(config), connect=1.0)).run(("true",))
    assert isinstance(raised.value, UntrustedHost) == revoked
    assert ("is revoked in your known_hosts" in str(raised.value)) == revoked
