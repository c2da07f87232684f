"""Services that all runs of a worker share."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from typing import TYPE_CHECKING, Callable, Mapping, Sequence

from sierra.worker import program
from sierra.worker.conductor_report import ports_of, read_report, report_of
from sierra.worker.files import unlink
from sierra.worker.free_ports import BLOCK
from sierra.worker.job import GRACE_S, Job
from sierra.worker.layout import LOGS, SHARED, TRACE
from sierra.worker.processes import SAMPLE_S, SETTLE_S, descendants, end_orphans, number_in, orphans, signal_process

if TYPE_CHECKING:
    from sierra.worker.file_trace import Trace, Way

UNOBSERVED = "services that all runs share were not observed"
OF_ONE_RUN = ("SIERRA_RUN_ID", "SIERRA_SEED", "SIERRA_EXECUTION")  # variables


class SharedServices:
    """Services that all runs of this worker share: their conductor, which ends when one of them has ended.

    If they are observed, the files that they have used until a run ends are part of what is observed of this run.
    """

    def __init__(
        self, job: Job, plan: Mapping[str, object], folder: str, way: Way | None = None, reasons: Sequence[str] = (UNOBSERVED,)
    ) -> None:
        """Start the conductor in a new folder, with the environment of a run without what belongs to one run.

        `way` to observe them; `reasons` why this is not possible, or not complete.
        """
        self.reasons = tuple(reasons)
        self.observation = way.begin(folder + TRACE, os.path.join(folder, "output")) if way else None
        self.looking = threading.Lock()
        self.tracer = 0
        self.folder = folder
        self.path = os.path.join(folder, SHARED)
        self.grace = job["limits"].get("grace_s", GRACE_S)
        os.makedirs(os.path.join(folder, "output"))
        for name in ("home", "tmp"):
            os.mkdir(os.path.join(folder, name))
        environment = {
            name: value.replace("\0", folder) for name, value in job["environment"].items() if name not in OF_ONE_RUN
        }
        own = {**plan, "shared": [], "services": plan["shared"], "before": [], "argv": [], "after": []}
        argv = program.words("conductor", folder, json.dumps(own))
        cwd = os.path.join(folder, "output")
        if self.observation:
            argv = self.observation.prefixed(argv, environment, cwd, conducted=True)
        with open(os.path.join(folder, LOGS[1]), "ab") as log:
            self.process = subprocess.Popen(
                argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=cwd, env=environment, start_new_session=True
            )

    def await_ready(self, is_stopping: Callable[[], bool]) -> None:
        """Wait until the services are ready, or have failed: the runs then fail with the reason."""
        while not os.path.exists(self.path) and self.process.poll() is None and not is_stopping():
            time.sleep(SAMPLE_S)
        if self.observation and not self.tracer:
            self.tracer = number_in(self.process.pid, b"TracerPid:")

    def seen(self) -> Trace | None:
        """Return what the services have done with files until now; None if they are not observed. Reads only what is new."""
        if self.observation is None:
            return None
        with self.looking:
            lost = self.tracer and self.process.poll() is None and number_in(self.process.pid, b"TracerPid:") != self.tracer
            trace = self.observation.trace(os.path.join(self.folder, LOGS[1]), living=True)
        return trace._replace(disturbed="their tracer has ended") if lost else trace

    def disturbed(self) -> str | None:
        """Return why the observation may have changed what the services do; None if it has not, or if there is none."""
        trace = self.seen()
        return trace.disturbed if trace else None

    def look(self) -> None:
        """Look at the living processes of the services, and keep the log of their tracer below its limit."""
        if self.observation and self.looking.acquire(blocking=False):  # else a run that has ended looks what they have done
            try:
                self.observation.limit()
                self.observation.look(pid for pid in descendants(self.process.pid) if pid != self.process.pid)
            finally:
                self.looking.release()

    def word(self) -> str:
        """Return what the conductor of a run needs to know."""
        try:
            with open(self.path, encoding="ascii") as file:
                return file.read()
        except OSError:
            reason = read_report(self.folder).error or "the services that all runs share have ended"
            return json.dumps({"ports": {}, "pids": {}, "log": os.path.join(self.folder, LOGS[1]), "error": reason})

    def end(self, skip_grace: Callable[[], bool]) -> None:
        """End the services: SIGTERM lets their conductor end them, and SIGKILL follows after the grace time."""
        self.process.terminate()
        deadline = time.monotonic() + self.grace + SETTLE_S
        while self.process.poll() is None:
            if skip_grace() or time.monotonic() >= deadline:
                for pid in descendants(self.process.pid):
                    signal_process(pid, signal.SIGKILL)
            time.sleep(SAMPLE_S)
        if self.observation:
            end_orphans(None, is_tracer=self.observation.is_tracer)  # the tracer waits for them
            self.observation.end(orphans)
            unlink(self.folder + TRACE)


def own_ports(job: Job, folder: str, services: SharedServices | None) -> list[int]:
    """Return the ports that only this run uses, and those of services that runs share on purpose."""
    given = [port + number for port in job.get("own_ports", ()) for number in range(BLOCK)]
    shared = ports_of(json.loads(services.word())) if services else []
    return [*given, *report_of(job, folder).ports, *shared]


def trouble_of_services(services: SharedServices | None) -> str | None:
    """Return why services that all runs share cannot be trusted any more; None if they can."""
    reason = services.disturbed() if services else None
    return reason and 'observing the services that all runs share may have changed them: %s; set observe = "none"' % reason


def with_reasons(trace: Trace, services: SharedServices, shared: Trace | None) -> Trace:
    """Return the trace of a run with the notes on services, and with the reasons why their observation is not complete."""
    found = shared.reasons if shared else ()
    reasons = (*trace.reasons, *services.reasons, *("services that all runs share: " + reason for reason in found))
    notes = (*trace.notes, *(shared.notes if shared else ()))
    return trace._replace(reasons=tuple(dict.fromkeys(reasons)), notes=tuple(dict.fromkeys(notes)))
