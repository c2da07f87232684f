"""Files that a run has written and then read: locks among them have no data."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.worker.file_names import Names
from tests.strace_logs import calls


def reread(roots: dict[str, str], *paths: str) -> tuple[str, ...]:
    """Return those of the paths that are noted if a run opens them for both."""
    opened = 'openat(AT_FDCWD</w>, "{0}", O_RDWR|O_CREAT, 0666) = 3<{0}>'
    return Names({"run": "/r", **roots}).inputs(calls(*map(opened.format, paths))).reread


def test_locks_are_no_data_of_a_run(tmp_path: Path) -> None:
    sizes = {"empty": 0, "full": 1, "pid.lock": 64, "data.lock": 65}
    for name, size in sizes.items():
        (tmp_path / name).write_bytes(b"1" * size)
    kept = reread({}, *(f"{tmp_path}/{name}" for name in sizes), "/x/a.lock", "/x/.lock", "/x/block")
    assert kept == (f"{tmp_path}/data.lock", f"{tmp_path}/full", "/x/block")


LOCKED = 'openat(AT_FDCWD</w>, "/x/.lock", {0}, 0600) = 3</x/.lock>'


@pytest.mark.parametrize(
    ("flags", "then", "doubtful"),
    [
        ("O_WRONLY|O_CREAT|O_TRUNC", "O_RDONLY", True),
        ("O_RDWR|O_CREAT|O_TRUNC", "O_RDWR|O_CREAT|O_TRUNC", False),
        ("O_WRONLY|O_CREAT|O_EXCL", "O_RDONLY", False),
    ],
)
def test_a_lock_that_is_gone_was_made_new_or_not_read_for_itself(flags: str, then: str, doubtful: bool) -> None:
    trace = calls(LOCKED.format(flags), LOCKED.format(then), 'unlink("/x/.lock") = 0')
    assert (len(trace.reread), trace.reread_new) == (doubtful, ())
