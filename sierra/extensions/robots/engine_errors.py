"""The ends of programs in containers on robots, as their engine explains them."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from sierra.containers.on_hosts import HostContainer
from sierra.extensions.robots.trial import Part
from sierra.runners.journal_reader import result_of
from sierra.store.layout import RUN_STDERR

SHOWN = 2000


def classify(part: Part, container: HostContainer) -> None:
    """Replace the end of the engine's client by that of the program, in the report of a part whose files were pulled."""
    end = part.end
    if end is None or end["exit_code"] == 0 or part.files is None:
        return
    errors = b""
    with contextlib.suppress(OSError), Path(part.files, RUN_STDERR).open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - SHOWN))
        errors = file.read()
    result = container.classify(result_of(end), errors.decode("utf-8", "replace"))
    end["exit_code"], end["signal"] = result.exit_code, result.signal
    end["stopped"], end["error"] = result.stopped, result.error
