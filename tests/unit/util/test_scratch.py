from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sierra.util import scratch

HOLD = """
import sys, time
from pathlib import Path
from sierra.util.scratch import scratch
with scratch(Path(sys.argv[1]), ".sierra-test-") as folder:
    (folder / "inner").mkdir()
    (folder / "inner" / "file").write_text("text")
    print(folder, flush=True)
    time.sleep(60)
"""


def held(parent: Path) -> tuple[subprocess.Popen[str], Path]:
    """Start a process that works in a temporary folder in `parent`; return it and the folder."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(parent)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def test_a_folder_of_a_killed_process_is_removed_and_that_of_a_living_one_stays(tmp_path: Path) -> None:
    (killed, left), (living, used) = held(tmp_path), held(tmp_path)
    try:
        killed.send_signal(signal.SIGKILL)
        killed.communicate()
        assert left.is_dir()
        with scratch.scratch(tmp_path, ".sierra-test-") as own:
            assert sorted(tmp_path.iterdir()) == sorted((used, own))
        assert (used / "inner" / "file").read_text() == "text"
    finally:
        living.kill()
        living.communicate()


@pytest.mark.parametrize("mark", [None, b"", b"a temporary folder of SIERRA on another-host\n"])
def test_a_folder_without_the_mark_of_this_host_stays(tmp_path: Path, mark: bytes | None) -> None:
    other = tmp_path / ".sierra-test-other"
    other.mkdir()
    (other / "file").write_text("text")
    if mark is not None:
        (other / scratch.MARK).write_bytes(mark)
    (tmp_path / ".sierra-test-link").symlink_to(other)
    with scratch.scratch(tmp_path, ".sierra-test-"):
        pass
    assert (other / "file").read_text() == "text"
    assert (tmp_path / ".sierra-test-link").is_symlink()
