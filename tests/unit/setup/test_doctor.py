"""`sierra doctor` says where the temporary files of runs are, and what to do if no folder for them has a short path."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.projects import quick


@pytest.mark.integration
def test_temporary_files_need_a_folder_with_a_short_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("sierra.setup.doctor.temporary_folders", lambda: ["/scratch", "/tmp"])
    assert "ok       temporary files: those of runs are below /scratch\n" in quick(tmp_path, "doctor").stdout
    monkeypatch.setattr("sierra.setup.doctor.temporary_folders", list)
    said = quick(tmp_path, "doctor").stdout
    assert "absent   temporary files: those of runs are in their own folders" in said
    assert "set TMPDIR to a folder whose path has at most 48 characters" in said
