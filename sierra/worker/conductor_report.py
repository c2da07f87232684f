"""The report that a conductor leaves in a run's folder. A run without one has failed."""

from __future__ import annotations

import json
import os
from typing import Mapping, NamedTuple, Sequence

from sierra.worker.job import Job, is_conducted
from sierra.worker.layout import REPORT

REPORT_BYTES = 1 << 16


def ports_of(report: Mapping[str, object]) -> list[int]:
    """Return the ports of services in a conductor's report."""
    found = report.get("ports")
    return [port for port in found.values() if isinstance(port, int)] if isinstance(found, dict) else []


class Report(NamedTuple):
    """The report of a conductor."""

    error: str | None
    """Why the run has failed; None if all was executed."""
    left_running: Sequence[str] = ()
    """The processes that still ran when the command had ended."""
    after_marker: float | None = None
    """The command was ended so many seconds after its marker."""
    ports: Sequence[int] = ()
    """The ports of its services."""


def report_of(job: Job, folder: str) -> Report:
    """Return the conductor's report on a run; an empty one if there is no conductor."""
    return read_report(folder) if is_conducted(job) else Report(None)


def read_report(folder: str) -> Report:
    """Return the report of a conductor in its folder."""
    unread = Report("the program that executes its services and commands has ended without a report")
    try:  # a run may have put anything there
        descriptor = os.open(os.path.join(folder, REPORT), os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            record = json.loads(file.read(REPORT_BYTES))
        error, left, after = record["error"], record.get("left_running", []), record.get("after_marker")
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return unread
    texts = isinstance(left, list) and all(isinstance(name, str) for name in left)
    if not texts or not isinstance(error, (str, type(None))) or not isinstance(after, (int, float, type(None))):
        return unread
    return Report(error, left, after, ports_of(record))
