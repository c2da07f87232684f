"""Standard output of a run as one of its output files, if an output has `file = "stdout"`.

A worker writes it beside the output folder. Before the run is judged, it gets a second name in that folder, and is from then on
a file like any other: it belongs to the result, and to the tables.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from sierra.config.output_tables import Output
from sierra.model import OutputFile, Result, Status
from sierra.store.layout import RUN_OUTPUT, RUN_STDOUT
from sierra.store.segments import disk_errors
from sierra.worker import worker

DECLARED = f'[outputs] has file = "{RUN_STDOUT}"'
OWN = f"wrote a file or folder {RUN_STDOUT!r}, but {DECLARED}, which is what the run prints; give it another name"
OF_ROBOTS = f"{DECLARED}, but robots have no common standard output; let each robot write a file"
NO_FILE = f"its standard output is no file that can be read, but {DECLARED}"
PASSING = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE)
"""Errors of disks, which do not concern this run alone."""


def added(result: Result, outputs: Mapping[str, Output]) -> Result:
    """Return a result with its standard output among its files, if an output is made of it. Raises Missing for a full disk."""
    if result.stopped == Status.INTERRUPTED or not any(output.is_stdout for output in outputs.values()):
        return result
    if result.robots:
        return _failed(result, OF_ROBOTS)
    if any(file.path.split("/")[0] == RUN_STDOUT for file in result.outputs):
        return _failed(result, OWN)
    if result.printed is not None:
        size, sha256 = result.printed
        return replace(result, outputs=(*result.outputs, OutputFile(RUN_STDOUT, size, sha256, 0, True, "")))
    log, target = Path(result.directory, RUN_STDOUT), Path(result.directory, RUN_OUTPUT, RUN_STDOUT)
    if log.parent.is_symlink() or target.parent.is_symlink() or log.is_symlink() or (log.exists() and not log.is_file()):
        return _failed(result, NO_FILE)
    try:
        with disk_errors(target.parent):
            _link(log, target)
    except OSError as error:
        return _failed(result, f"{NO_FILE}: {error.strerror}")
    return replace(result, outputs=(*result.outputs, OutputFile(**worker.describe(str(target), RUN_STDOUT))))


def counts(output: Output, file: OutputFile) -> bool:
    """Return True if a file belongs to an output, and is not a standard output to which nothing was printed."""
    return output.matches(file.path) and bool(file.bytes or not output.is_stdout)


def _link(log: Path, target: Path) -> None:
    """Give standard output its second name; a run that printed nothing may have no log."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)  # of an earlier try to record the run
    if not log.exists():
        target.touch()
        return
    try:
        os.link(log, target)
    except OSError:  # not all file systems have links
        shutil.copyfile(log, target)


def _failed(result: Result, reason: str) -> Result:
    return replace(result, error=result.error or reason)
