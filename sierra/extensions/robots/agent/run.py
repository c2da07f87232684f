"""A run on a robot, and the worker that executes it. `robot_agent` says how runs end."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from typing import Collection, Mapping

from sierra.extensions.robots.agent.leftovers import FIRST, PROCESS
from sierra.extensions.robots.agent.processes import (
    SETTLE_S,
    TAIL_BYTES,
    end_process,
    ending,
    is_running,
    kill_all,
    output_of,
)
from sierra.extensions.robots.agent.records import AGENT, Record, write_whole
from sierra.extensions.robots.agent.standstill import Standstill
from sierra.worker import program
from sierra.worker.containers import end_container
from sierra.worker.errors import explain
from sierra.worker.files import last_line_of
from sierra.worker.job import with_folder
from sierra.worker.journal import BEGUN, ENDING, GONE, OVER
from sierra.worker.processes import birth, boot_id, descendants, orphans, release, stat_of, stdin_of
from sierra.worker.worker import FULL, execute

WORKER = "worker"  # the only argument of a worker
WORKER_LOG = "worker.log"
IMMORTAL_S = 10.0  # for killed processes, until the run is reported although they are there
IMMORTAL = "a process of the run cannot be ended"
MOST_STOPS = 5  # when no process is left: one execution, and more if it leaves processes itself
HANG_S = 1.0  # for killed processes to be gone, before the stop command is executed nevertheless


class WorkerProcess:
    """A worker as a process, which executes one run after the other until one of them has to be ended."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Start it; it waits for the folder of a run (see `become_worker`). Raises OSError."""
        self.process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-B", program.PROGRAM, AGENT, WORKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=dict(environment),
            start_new_session=True,
        )
        self.pid = self.process.pid
        os.set_blocking(self.pipe, False)

    @property
    def pipe(self) -> int:
        """Return where it announces the states of a run."""
        return output_of(self.process)

    def is_alive(self) -> bool:
        return self.process.poll() is None

    def announced(self) -> str:
        """Return the states that it has announced since the last call."""
        try:
            return os.read(self.pipe, 1 << 10).decode("ascii", "replace")
        except (BlockingIOError, ValueError):
            return ""

    def end(self) -> None:
        """End it with all that it has started."""
        end_process(self.process)


def become_worker() -> int:
    """Execute runs one after the other, until one of them has to be ended.

    Each is a line with its folder on standard input, and the lines of a worker. Its states are announced on standard output.
    """
    states, null = os.dup(1), os.dup(2)
    os.dup2(null, 1)

    def announce(state: str) -> None:
        with contextlib.suppress(OSError):  # the agent is gone
            os.write(states, state.encode())

    for line in iter(sys.stdin.readline, ""):
        folder = json.loads(line)["folder"]
        with open(os.path.join(folder, WORKER_LOG), "wb") as log:
            os.dup2(log.fileno(), 2)
        done = execute([folder, "1"], announce)
        done.report_failure()
        if done.status:
            return int(done.status)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        done.close()
        os.dup2(null, 2)  # nothing of the run stays open
        announce(OVER)
    return 0


class Run:
    """One run on this robot, from arming to its end."""

    def __init__(
        self,
        folder: str,
        order: Record,
        worker: WorkerProcess,
        standstill: Standstill,
        grace: float,
        spared: Collection[int] = (),
        guard: int | None = None,
    ) -> None:
        """Make its folder, and let a worker prepare the job and wait for its moment. Raises OSError.

        `spared` are processes of the agent that belong to no run; `guard` is its guard.
        """
        self.folder = folder
        self.spared = spared
        self.attempt: str = order["attempt"]
        self.job: Record = order["job"]
        self.worker = worker
        self.standstill = standstill
        self.grace = grace
        self.states: set[str] = set()
        """The states that its worker has announced."""
        self.gated = self.reported = self.ending = self.over = self.last_stop = False
        self.owed = True
        """True if the stop command must be executed once more when no process is left."""
        self.stops = 0
        """The number of executions after the last process was gone."""
        self.give_up: float | None = None
        """The time after which processes that were killed are not waited for."""
        self.immortal = False
        """True if a process of the run cannot be ended."""
        self.armed: Record | None = {"event": "armed", "attempt": self.attempt, "id": order.get("id")}
        """The answer to the order, until the worker is ready for the job."""
        self.why: str | None = None
        self.kill_at: float | None = None
        self.problems: list[str] = []
        standstill.problems = []
        os.makedirs(os.path.dirname(folder), exist_ok=True)
        os.mkdir(folder)
        self.client = with_folder(self.job["client"], os.path.join(folder, FIRST)) if "client" in self.job else None
        self.known: Record = {
            "pid": worker.pid,
            "born": birth(worker.pid),
            "boot": boot_id(),
            "executions": [self.job["execution"]],
            "client": self.client,
            "who": order.get("who"),
            "execution": self.job["execution"],
            "place": order.get("place"),
            "grace": grace,
            "guard": guard,
        }
        """The data with which another process can end the run."""
        write_whole(os.path.join(folder, PROCESS), self.known)
        self.tell_worker({"folder": folder}, {**self.job, "waits": True})

    def begin(self, moment: float, wall: float) -> None:
        """Let the worker start the program at this moment of the monotonic clock, which is this one of the wall clock."""
        self.gated = True
        self.tell_worker({"begin": moment, "wall": wall}, {"end": True})

    def tell_worker(self, *records: Record) -> None:
        try:
            pipe = stdin_of(self.worker.process)
            for record in records:
                pipe.write(json.dumps(record, separators=(",", ":")).encode() + b"\n")
            pipe.flush()
        except OSError as error:
            self.problems.append("its worker is gone: " + explain(error))

    def end(self, why: str) -> None:
        """Tell the run to end. The first reason counts."""
        if self.why is not None or self.over:
            return
        self.why = why
        self.begin_end()
        self.kill_at = time.monotonic() + self.grace + SETTLE_S
        self.worker.process.terminate()

    def begin_end(self) -> None:
        """Demand a standstill at the first sign of an end."""
        if not self.ending:
            self.ending = True
            self.demand_standstill()

    def demand_standstill(self) -> None:
        """Demand a standstill, if the program may have begun."""
        if self.gated:
            self.standstill.demand()

    def look(self, now: float) -> bool:
        """Look at the run; return whether it has ended, with all of its processes, and the stop command after them."""
        gone = not self.worker.is_alive()
        self.hear()
        if not self.over and self.kill_at is not None and now >= self.kill_at:
            self.kill()
        if not self.over and (gone or OVER in self.states):
            self.over = True
            self.give_up = self.give_up or now + HANG_S
        if not self.over or self.end_remains():
            if not self.is_hanging(now):
                self.standstill.look()
                return False
        elif self.owed and self.stops < MOST_STOPS:
            self.owed = False
            self.stops += 1
            self.demand_standstill()
        return self.standstill.look()

    def is_hanging(self, now: float) -> bool:
        """Return whether processes have survived SIGKILL for too long. Before, demand a standstill in spite of them, once."""
        if self.give_up is None or now < self.give_up:
            return False
        if not self.last_stop:
            self.last_stop = True
            self.demand_standstill()
        self.immortal = now >= self.give_up + IMMORTAL_S
        return self.immortal

    def kill(self) -> None:
        """Kill the worker and all that it has started."""
        kill_all(self.worker.pid)
        if self.give_up is None:
            self.owed = True
            if self.client:  # which the worker did not do
                end_container(self.client)
            self.give_up = time.monotonic() + HANG_S

    def hear(self) -> None:
        """Take what the worker announces, and react to the first sign of an end, and to the last process being gone."""
        announced = self.worker.announced()
        self.states.update(announced)
        if ENDING in announced:
            self.begin_end()
        if GONE in announced:
            self.owed = False
            self.demand_standstill()

    def end_remains(self) -> bool:
        """Kill the processes that the run has left; return whether one was alive."""
        alive = end_children({self.standstill.pid, self.worker.pid, *self.spared})
        if self.worker.is_alive():  # it says that none is left
            for pid in descendants(self.worker.pid):
                if pid != self.worker.pid and is_running(pid):
                    alive = True
                    kill_all(pid)
        self.owed = self.owed or alive
        return alive

    def events(self) -> list[Record]:
        """Return all complete lines of the worker's journal; none if it cannot be read."""
        with contextlib.suppress(OSError, ValueError), open(os.path.join(self.folder, "journal.jsonl"), "rb") as file:
            return [json.loads(line) for line in file.read().split(b"\n")[:-1]]
        return []

    def ended(self) -> Record:
        """Return the report on the run's end, with the worker's own, if there is one."""
        events = self.events()
        record = next((event for event in reversed(events) if event["event"] == "end"), None)
        begun = BEGUN in self.states or any(event["event"] in ("start", "end") for event in events)
        if record is None and (begun or self.why is None):
            self.problems.append(self.failure_of_worker())
        return {
            "attempt": self.attempt,
            "started": begun,
            "why": self.why,
            "end": record,
            "problems": [*self.problems, *self.standstill.problems, *([IMMORTAL] if self.immortal else [])],
            "moving": (IMMORTAL if self.immortal else self.standstill.problem) if self.gated else None,
        }

    def failure_of_worker(self) -> str:
        """Return why the worker has left no report."""
        status = self.worker.process.returncode
        if status == FULL:
            return "its disk is full"
        line = last_line_of(os.path.join(self.folder, WORKER_LOG), TAIL_BYTES)
        return "its worker ended with %s%s" % (ending(status or 0), ": " + line if line else "")


def end_children(spared: Collection[int]) -> bool:
    """Kill the processes that have lost their worker; return whether one was alive."""
    living = 0
    for pid in orphans():
        fields = stat_of(pid)
        if pid in spared or not fields:
            continue
        if fields[0] != b"Z" or not release(pid):
            living += 1
            kill_all(pid)
            release(pid)
    return living > 0
