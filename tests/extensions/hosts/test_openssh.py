"""Links by OpenSSH: the socket of their connection has a short path."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.extensions.hosts.openssh import folder_of_sockets
from sierra.worker.temporary_folders import TEMPORARY_LENGTH


def test_sockets_have_a_short_path_although_tmpdir_is_long(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    long = tmp_path / ("x" * 90)
    long.mkdir()
    monkeypatch.setenv("TMPDIR", str(long))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    assert len(folder_of_sockets() or "") in range(1, TEMPORARY_LENGTH + 1)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "none"))
    assert folder_of_sockets() != str(tmp_path / "none")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert folder_of_sockets() == str(tmp_path)
