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
from sierra.errors import Missing
from sierra.model import OutputFile, Result, Status
from sierra.store.layout import RUN_OUTPUT, RUN_STDOUT
from sierra.util.shortage import PASSING
from sierra.worker.files import unlock
from sierra.worker.outputs import describe

DECLARED = f'[outputs] has file = "{RUN_STDOUT}"'
OWN = f"wrote a file or folder {RUN_STDOUT!r}, but {DECLARED}, which is what the run prints; give it another name"
OF_ROBOTS = f"{DECLARED}, but robots have no common standard output; let each robot write a file"
NO_FILE = f"its standard output is no file that can be read, but {DECLARED}"
OF_DISKS = PASSING | {errno.EROFS, errno.EIO}
"""Errors that do not concern this run alone."""


def is_in(outputs: Mapping[str, Output]) -> bool:
    """Return True if an output is made of standard output."""
    return any(output.is_stdout for output in outputs.values())


def added(result: Result, outputs: Mapping[str, Output]) -> Result:
    """Return a result with its standard output among its files, if an output is made of it and anything was printed.

    Raises Missing for a full disk.
    """
    began = result.error is None or result.exit_code is not None or result.signal is not None
    if result.stopped == Status.INTERRUPTED or not began or not is_in(outputs):
        return result
    if result.robots:
        return _failed(result, OF_ROBOTS)
    if any(file.path.split("/")[0] == RUN_STDOUT for file in result.outputs):
        return _failed(result, OWN)
    if result.printed is not None:
        size, sha256 = result.printed
        return _with(result, OutputFile(RUN_STDOUT, size, sha256, 0, True, ""))
    log, target = Path(result.directory, RUN_STDOUT), Path(result.directory, RUN_OUTPUT, RUN_STDOUT)
    try:
        if log.parent.is_symlink() or target.parent.is_symlink() or log.is_symlink() or (log.exists() and not log.is_file()):
            return _failed(result, NO_FILE)
        return _with(result, _linked(log, target)) if log.exists() else result
    except OSError as error:
        if error.errno in OF_DISKS:
            raise Missing(f"{log}: {error.strerror}") from error
        return _failed(result, f"{NO_FILE}: {error.strerror}")


def _linked(log: Path, target: Path) -> OutputFile:
    """Give standard output its second name; return its description."""
    unlock(str(log), 0o400)
    seen = OutputFile(**describe(str(log), RUN_STDOUT))
    if seen.bytes:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)  # of an earlier try to record the run
        try:
            os.link(log, target)
        except OSError:  # not all file systems have links
            shutil.copyfile(log, target)
    return seen


def _with(result: Result, file: OutputFile) -> Result:
    return replace(result, outputs=(*result.outputs, file)) if file.bytes else result


def _failed(result: Result, reason: str) -> Result:
    return replace(result, error=result.error or reason)
