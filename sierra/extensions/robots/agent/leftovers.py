"""The end of runs whose agent was killed: its guard ends them at once, and the next agent what is left of them."""

from __future__ import annotations

import collections
import contextlib
import json
import os
import select
import signal
import time

from sierra.extensions.robots.agent.processes import LOOK_S, SETTLE_S, Forked, is_running, keep_open, kill_all
from sierra.extensions.robots.agent.records import Record, read_record
from sierra.extensions.robots.agent.standstill import Standstill
from sierra.worker.containers import end_container
from sierra.worker.files import entries_of, write_all
from sierra.worker.processes import boot_id, marked, read_proc

FIRST = "1"  # the folder in which a worker executes its only run
PROCESS, ENDED = "process.json", "ended.json"
GUARD_S = 60.0  # for the guard of an agent that was killed


class Guard(Forked):
    """A second process, which brings the robot to a standstill if the agent is killed while it has a run.

    The agent gives it the record of the run that it has, or an empty line if it has none any more. It must not have a run when
    it closes this.
    """

    def __init__(self, standstill: Standstill) -> None:
        """Start the process. Raises OSError."""
        super().__init__(lambda pipe: guard(pipe, standstill), reads=True)

    def is_alive(self) -> bool:
        return is_running(self.pid)

    def tell(self, run: Record | None) -> None:
        with contextlib.suppress(OSError):  # it is gone; there is a new one with the next run
            write_all(self.pipe, (json.dumps(run) if run else "").encode() + b"\n")


def guard(pipe: int, standstill: Standstill) -> None:
    """Wait until the agent is gone. If it has a run then, end this as the agent would, with the stop command."""
    os.setsid()
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    keep_open(pipe, standstill.null)
    with open(pipe, "rb") as lines:
        last = collections.deque(lines, maxlen=1)
    if last and last[0].strip():
        standstill.demand()
        try:
            end_run(json.loads(last[0]), standstill)
        finally:  # the line is cut off if the agent was killed while it wrote it, before the run was armed
            standstill.execute()


def end_run(run: Record, standstill: Standstill) -> None:
    """Wait until the worker has ended a run, as it does if its agent is gone, and end what is left after its grace time."""
    give_up = time.monotonic() + run["grace"] + SETTLE_S
    while is_running(run["pid"], run["born"]) and time.monotonic() < give_up:
        standstill.look()
        select.select((), (), (), LOOK_S / 20)
    end_processes_of(run)
    if run["client"]:
        standstill.execute()  # the engine may take long
        end_container(run["client"])


def end_leftovers(root: str) -> list[Record]:
    """End what earlier agents left running in a folder of runs; return a description of each run, whose folder stays."""
    leftovers = []
    for attempt in sorted(entries_of(root)):
        folder = os.path.join(root, attempt)
        record = read_record(os.path.join(folder, PROCESS)) or {}
        await_guard(record)
        ended = end_processes_of(record)
        report = read_record(os.path.join(folder, ENDED))
        known = {name: record.get(name) for name in ("who", "execution", "place", "client")}
        known["files"] = os.path.isdir(os.path.join(folder, FIRST))
        leftovers.append({"attempt": attempt, "ended": ended, "report": report, **known})
    return leftovers


def await_guard(record: Record) -> None:
    """Wait until the guard of a killed agent has ended the run in this record, so that it does not disturb the next one."""
    give_up = time.monotonic() + GUARD_S
    while record.get("boot") == boot_id() and is_guard(record.get("guard")) and time.monotonic() < give_up:
        select.select((), (), (), LOOK_S / 10)


def is_guard(pid: int | None) -> bool:
    """Return whether a process is an agent, as guards are."""
    return pid is not None and is_running(pid) and b"robot_agent" in read_proc("%d/cmdline" % pid)


def end_processes_of(record: Record) -> int:
    """Kill the processes of an earlier agent's run that are alive; return how many were. After a reboot there are none."""
    if record.get("boot") != boot_id():
        return 0
    pid = record.get("pid", 0)
    marks = [b"SIERRA_EXECUTION=" + execution.encode() for execution in record.get("executions", ())]
    ended: set[int] = set()
    give_up = time.monotonic() + SETTLE_S
    while time.monotonic() < give_up:
        alive = {pid} if record.get("born") is not None and is_running(pid, record["born"]) else set()
        alive |= {process for process in marked(marks) if is_running(process)}
        if not alive:
            break
        ended |= alive
        for process in alive:
            kill_all(process)
        time.sleep(LOOK_S / 10)
    return len(ended)
