"""The rates at which topics of ROS 1 have messages on a robot, as `rostopic hz` measures them.

This file needs only the standard library (Python 3.8 or newer), and works alone on a robot. `rostopic hz` never ends. Each
second, it prints the mean rate of all messages since its start, or that there were no new ones. It is ended as soon as two
reports are good enough, or after `LIMIT_S`.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import signal
import subprocess
import time
from typing import Mapping

LIMIT_S = 8.0
ENOUGH = 2
"""The number of good reports after which a topic counts as fast enough."""
END_S = 2.0
SILENT = "no new messages"
MEAN = re.compile(r"average rate: ([0-9.]+)")
CHUNK = 1 << 16


class Reports:
    """The reports of `rostopic hz` on one topic."""

    def __init__(self, least: float) -> None:
        self.least = least
        self.mean: float | None = None
        """The last reported rate."""
        self.good = 0
        self.silent_s = 0
        """The seconds since the last message."""
        self.last = ""
        """The last line."""

    def read(self, line: str) -> None:
        found = MEAN.search(line)
        if found:
            self.mean, self.silent_s = float(found.group(1)), 0
            self.good += self.mean >= self.least
        elif SILENT in line:
            self.silent_s += 1
        self.last = line.strip() or self.last

    def problem(self) -> str | None:
        """Return why the topic is too slow; None if it is not."""
        if self.mean is None:
            return self.last or "no messages within %g s" % LIMIT_S
        if self.silent_s * self.least > ENOUGH:
            return "no messages for %d s; at least %g a second are required" % (self.silent_s, self.least)
        if self.mean < self.least:
            return "%.3g messages a second; at least %g are required" % (self.mean, self.least)
        return None


def shortfall(topic: str, least: float, environment: Mapping[str, str]) -> str | None:
    """Return the line that says why a topic has fewer messages a second than required; None if it has enough."""
    variables = {**environment, "PYTHONUNBUFFERED": "1"}  # into a pipe, it would write nothing for minutes
    try:
        process = subprocess.Popen(
            ["rostopic", "hz", topic],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=variables,
            start_new_session=True,
        )
    except OSError as error:
        return "%s: rostopic cannot be started: %s" % (topic, error.strerror)
    reports = Reports(least)
    try:
        follow(process, reports)
    finally:
        end(process)
    problem = reports.problem()
    return None if problem is None else "%s: %s" % (topic, problem)


def follow(process: subprocess.Popen[bytes], reports: Reports) -> None:
    """Read reports until enough of them are good, or the time is over."""
    assert process.stdout is not None  # noqa: S101 - it is a pipe
    held, deadline = b"", time.monotonic() + LIMIT_S
    while reports.good < ENOUGH:
        left = deadline - time.monotonic()
        if left <= 0 or not select.select([process.stdout], [], [], left)[0]:
            return
        data = os.read(process.stdout.fileno(), CHUNK)
        if not data:
            return
        *lines, held = (held + data).split(b"\n")
        for line in lines:
            reports.read(line.decode("utf-8", "replace"))


def end(process: subprocess.Popen[bytes]) -> None:
    """End `rostopic`, which then tells the master that it listens no more."""
    for number in (signal.SIGINT, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(END_S)
            break
    if process.stdout is not None:
        process.stdout.close()
