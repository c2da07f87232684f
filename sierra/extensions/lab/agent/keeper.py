"""The process that executes the tasks of a session on a host: it needs no connection.

    python3 -I -S worker.pyz sierra.extensions.lab.agent.keeper FOLDER SLOTS GPUS CORES

GPUS is the number of GPUs that a run requests, its share of one, or 0: each slot has GPUs of its own. CORES is the number of
cores that a run holds: a task has as many slots, of which there are SLOTS times CORES. FOLDER is that of the session: see
`host_folder`. There is one keeper for each session: another one ends at once. It starts tasks in the order of their numbers,
each in a slot of the host. Drivers share the slots by locks, which only the task has: a slot is free when its task has executed
its last run, or has ended, also if its keeper was killed before. When the lease is over, nobody waits for the results any more:
no task is started, and running ones are told to end. Results stay.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from typing import Mapping, NamedTuple

from sierra.extensions.lab.agent import host_folder
from sierra.extensions.lab.agent.host_folder import CLAIMED, ENDED, LOGS, QUEUE, RUNNING
from sierra.worker import gpus, program
from sierra.worker.devices import DEVICES
from sierra.worker.files import unlink
from sierra.worker.layout import SLOT_LOCKS
from sierra.worker.processes import birth, boot_id, marked

BUSY_S, IDLE_S = 0.05, 0.5
ENTRY = "SIERRA_LAB_ENTRY"
LEASE_OVER = "the host heard nothing from the driver until its lease was over"
CANCELLED = "cancelled"
REBOOTED = "the host was restarted"
LOST = "its process was killed"


class Slot(NamedTuple):
    """A slot of this host that a task has, or several adjacent ones if its run holds several cores."""

    number: int
    locks: tuple[int, ...]
    """The descriptors of their locks."""

    def free(self) -> None:
        for lock in self.locks:
            os.close(lock)


class Keeper:
    """The tasks of one session."""

    def __init__(self, folder: str, slots: int, gpus: float, cores: int) -> None:
        self._folder = folder
        self._slots, self._cores = slots, cores
        self._gpus = gpus
        self._locks = os.path.join(folder, "..", "..", "..", "slots", os.uname().nodename)
        self._tasks: dict[str, subprocess.Popen[bytes]] = {}
        """The tasks that this process has started."""
        self._told = False
        self._over = ""
        os.makedirs(self._locks, mode=0o700, exist_ok=True)
        self._adopt()

    def _adopt(self) -> None:
        """Record the tasks that a keeper has started before it was killed, if it could not record them."""
        for entry in host_folder.entries(self._folder, CLAIMED):
            processes = marked([self._mark(entry).encode()])
            if processes:
                self._note_start(entry, min(processes, key=lambda pid: birth(pid) or 0))
                unlink(self._path(CLAIMED, entry))
            else:
                os.rename(self._path(CLAIMED, entry), self._path(QUEUE, entry))

    def execute(self) -> None:
        """Execute tasks until there are none."""
        pause = BUSY_S
        while True:
            ended = [entry for entry, task in self._tasks.items() if task.poll() is not None]
            for entry in ended:
                self._end(entry)
            self._end_orphans()
            waiting = host_folder.entries(self._folder, QUEUE)
            self._over = self._why_over()
            if self._over:
                self._stop(waiting)
                waiting = []
            else:
                self._told = False
            started = 0
            while started < len(waiting) and self._start(waiting[started]):
                started += 1
            if not (self._tasks or waiting or host_folder.entries(self._folder, RUNNING)):
                return
            pause = BUSY_S if ended or started or waiting else min(IDLE_S, 1.5 * pause)
            self._wait(pause)

    def _wait(self, seconds: float) -> None:
        """Wait for so long, or until a task of this process ends."""
        give_up = time.monotonic() + seconds
        while time.monotonic() < give_up and all(task.poll() is None for task in self._tasks.values()):
            time.sleep(BUSY_S)

    def _why_over(self) -> str:
        """Return why no task may execute any more; empty if tasks may."""
        if os.path.exists(os.path.join(self._folder, "cancelled")):
            return CANCELLED
        return LEASE_OVER if host_folder.lease_is_over(self._folder) else ""

    def _stop(self, waiting: list[str]) -> None:
        """Start nothing more, and tell running tasks once to end."""
        for entry in waiting:
            if self._claim(entry):
                self._note_end(entry, None, self._over)
                unlink(self._path(CLAIMED, entry))
        for entry in () if self._told else host_folder.entries(self._folder, RUNNING):
            process = host_folder.read_record(self._path(RUNNING, entry))
            if host_folder.is_alive(process):
                os.kill(process["pid"], signal.SIGTERM)
        self._told = True

    def _start(self, entry: str) -> bool:
        """Start a task if a slot is free; return whether one was."""
        slot = self._free_slot()
        if slot is None:
            return False
        if not self._claim(entry):
            slot.free()
            return True
        try:
            self._tasks[entry] = self._started(entry, slot)
        except OSError as error:
            self._note_end(entry, 3, "%s: %s" % (os.uname().nodename, error.strerror))
        finally:
            slot.free()  # the task has inherited the locks
        unlink(self._path(CLAIMED, entry))
        return True

    def _claim(self, entry: str) -> bool:
        """Take a task from the queue; return False if the driver has taken it back."""
        try:
            os.rename(self._path(QUEUE, entry), self._path(CLAIMED, entry))
        except FileNotFoundError:
            return False
        return True

    def _free_slot(self) -> Slot | None:
        """Lock a slot of this host that nobody has, or as many as a run holds cores, and return it; None if there is none."""
        for number in range(self._slots):
            first = number * self._cores
            locks: tuple[int, ...] = ()
            while len(locks) < self._cores:
                lock = host_folder.lock(os.path.join(self._locks, str(first + len(locks))))
                if lock is None:
                    break
                locks = (*locks, lock)
            slot = Slot(number, locks)
            if len(locks) == self._cores:
                return slot
            slot.free()
        return None

    def _started(self, entry: str, slot: Slot) -> subprocess.Popen[bytes]:
        """Start a task that was claimed, and record its process. Raises OSError."""
        asked = host_folder.read_record(self._path(CLAIMED, entry))
        argv = [sys.executable, "-I", "-S", program.PROGRAM, "array_task", self._folder, entry.partition(".")[2]]
        variables = {"SIERRA_LAB_%s" % name.upper(): str(asked.get(name, "")) for name in ("task", "job", "host", "clock")}
        variables[ENTRY] = self._mark(entry).partition("=")[2]
        variables[SLOT_LOCKS] = " ".join(map(str, slot.locks))
        with open(self._path(LOGS, entry + ".out"), "ab") as log:
            process = subprocess.Popen(
                argv,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**with_gpus_of(slot.number, self._gpus, os.environ), **variables},
                pass_fds=slot.locks,
                start_new_session=True,
            )
        try:
            self._note_start(entry, process.pid)
        except OSError:
            process.kill()
            process.wait()
            raise
        return process

    def _mark(self, entry: str) -> str:
        """Return the variable that tells the processes of a task, as NAME=value."""
        return "%s=%s/%s" % (ENTRY, self._folder, entry)

    def _note_start(self, entry: str, pid: int) -> None:
        record = {"pid": pid, "born": birth(pid), "boot": boot_id()}
        host_folder.write_record(self._path(RUNNING, entry), record)

    def _end(self, entry: str) -> None:
        """Record the end of a task that this process has started."""
        status = self._tasks.pop(entry).wait()
        self._note_end(entry, status, "signal %d" % -status if status < 0 else self._over if status else "")
        unlink(self._path(RUNNING, entry))

    def _end_orphans(self) -> None:
        """Record the ends of tasks that an earlier keeper has started."""
        for entry in host_folder.entries(self._folder, RUNNING):
            if entry in self._tasks:
                continue
            process = host_folder.read_record(self._path(RUNNING, entry))
            if not host_folder.is_alive(process):
                reason = LOST if process.get("boot") == boot_id() else REBOOTED
                self._note_end(entry, None, reason)
                unlink(self._path(RUNNING, entry))

    def _note_end(self, entry: str, status: int | None, reason: str) -> None:
        """Record the end of a task. If the disk is full, the driver learns it from the front, which records nothing."""
        try:
            host_folder.write_record(self._path(ENDED, entry), {"status": status, "reason": reason})
        except OSError as error:
            os.write(2, ("keeper: %s\n" % error).encode("utf-8", "backslashreplace"))

    def _path(self, kind: str, name: str) -> str:
        return os.path.join(self._folder, kind, name)


def with_gpus_of(slot: int, wanted: float, environment: Mapping[str, str]) -> Mapping[str, str]:
    """Return the variables for a task in a slot, whose runs want so many GPUs each: as given, but they list only its GPUs."""
    if not wanted:
        return environment
    variable, ids = gpus.of_this_machine(environment)
    each = max(1, int(wanted))
    chosen = ids[slot * each : (slot + 1) * each] if each > 1 else ids[slot % len(ids) :][:1] if ids else ()
    return {**{name: value for name, value in environment.items() if name not in DEVICES}, variable: ",".join(chosen)}


def main(arguments: list[str]) -> int:
    folder, slots, wanted, cores = os.path.abspath(arguments[0]), int(arguments[1]), float(arguments[2]), int(arguments[3])
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    if os.fork():  # so that it is nobody's child, and in no session of a login
        os._exit(0)
    os.setsid()
    own = host_folder.lock(os.path.join(folder, "keeper"))
    if own is not None:
        Keeper(folder, slots, wanted, cores).execute()
    return 0
