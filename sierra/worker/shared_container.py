"""A container that executes all runs of a slot, one after the other.

It is started with the first of them, with a folder of its own (the NUL in its argv). The worker also runs inside the container:
it takes jobs from its standard input and, with the argument `-`, writes its journal to its standard output. Everything that a
run leaves in one of PLACES, folders of the container's own, is removed when the run ends, so that the next run finds them
unchanged. Of the container's folder, runs can reach only `runs`. Runs can also write to the container's standard output
(/proc/1/fd/1), stop the worker in the container, or change what earlier runs have left. Therefore each job has a `seal`, a word
that its run cannot know, and events without it are ignored. When a run has ended, none of its processes is left alive, and its
folder is taken out of the container before it is read. If the worker in a container is late in ending a run, the whole
container is ended.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import signal
import subprocess
import threading
import time
from typing import Iterator, Mapping

from sierra.worker.containers import CLEAN_S, end_container
from sierra.worker.files import last_line_of
from sierra.worker.job import GRACE_S, Job, Limits, Program, with_folder
from sierra.worker.journal import Event
from sierra.worker.layout import RUNS
from sierra.worker.processes import SETTLE_S, signal_group, stdin_of
from sierra.worker.running import START_S

LINE_BYTES = 1 << 16


class Container:
    """The container that the runs of a slot share: a client here, and this worker inside, connected by pipes."""

    def __init__(self, client: Program, folder: str) -> None:
        self.runs = os.path.join(folder, RUNS)
        os.makedirs(self.runs)
        self.client = with_folder(client, folder)
        self.log = os.path.join(folder, "log")
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                self.client["argv"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=self.client["environment"],
                start_new_session=True,
            )
        self.pid = self.process.pid
        self.kill_at: float | None = None
        self.deadline: float | None = None
        self.late = False
        self.lock = threading.Lock()

    def execute(self, job: Job) -> Iterator[Event]:
        """Yield the events of the worker in the container about a run, until the run or the container has ended."""
        seal = base64.b64encode(os.urandom(18)).decode()
        inner = {name: value for name, value in job.items() if name not in ("client", "shared", "observe")}
        self.allow(job["limits"], START_S)
        try:
            self.send({**inner, "seal": seal})
        except OSError:
            return
        for event in self.events(seal):
            self.allow(job["limits"], CLEAN_S)
            yield event
            if event["event"] == "end":
                self.deadline = None
                return

    def allow(self, limits: Limits, spare: float) -> None:
        """Set the deadline for a run's end: its time limit and grace time, plus `spare` seconds."""
        wall = limits.get("wall_s")
        if wall is not None:
            self.deadline = time.monotonic() + wall + limits.get("grace_s", GRACE_S) + spare

    def events(self, seal: str) -> Iterator[Event]:
        """Yield the events of the worker in the container. Lines without the seal are ignored; a run cannot know it."""
        output = self.process.stdout
        for line in iter(lambda: output.readline(LINE_BYTES) if output else b"", b""):
            try:
                event = json.loads(line)
                sealed = event.pop("seal") == seal
            except (ValueError, AttributeError, LookupError, TypeError, RecursionError):
                continue
            if sealed:
                yield event

    def send(self, record: Mapping[str, object]) -> None:
        with self.lock:
            pipe = stdin_of(self.process)
            pipe.write(json.dumps(record, separators=(",", ":")).encode() + b"\n")
            pipe.flush()

    def stop(self) -> None:
        """Close the pipe, so that the worker inside ends the running run and itself."""
        self.kill_at = self.kill_at or time.monotonic() + GRACE_S + CLEAN_S
        if self.lock.acquire(blocking=False):  # else a job is being sent that is not read yet; tried again later
            try:
                self.close_pipe()
            finally:
                self.lock.release()

    def close_pipe(self) -> None:
        with contextlib.suppress(OSError):
            stdin_of(self.process).close()

    def skip_grace(self) -> None:
        if self.kill_at is not None:
            self.kill_at = min(self.kill_at, time.monotonic() + SETTLE_S)

    def kill(self) -> None:
        self.kill_at = self.deadline = None
        signal_group(self.pid, signal.SIGKILL)

    def expire(self, now: float) -> None:
        """Kill the container if the worker in it is too late in ending a run."""
        if self.deadline is not None and now >= self.deadline:
            self.late = True
            self.kill()

    def close(self) -> str:
        """End the container, regularly if possible. Return the last line of its standard error, or else its status."""
        try:
            self.send({"end": True})
            self.process.wait(CLEAN_S)
        except (OSError, subprocess.TimeoutExpired):
            signal_group(self.pid, signal.SIGKILL)
        if self.process.wait() != 0:
            end_container(self.client)
        self.close_pipe()
        if self.process.stdout is not None:
            self.process.stdout.close()
        return last_line_of(self.log) or "status %s" % self.process.returncode
