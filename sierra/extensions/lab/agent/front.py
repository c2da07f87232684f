"""The program on a host with which a driver talks: it takes tasks and files, and sends what their result logs have gained.

    python3 -I -S worker.pyz sierra.extensions.lab.agent.front FOLDER

FOLDER is that of the session: see `host_folder`. It ends with its connection, and nothing depends on it: tasks are executed by
the keeper, which it starts if there is none. Both directions are lines of JSON, each followed by as many bytes as its `size`
says. All bytes of a result log are sent from the place on that the driver asks for, so that nothing is sent twice.

    from the driver                             to the driver
    hello slots? lease gpus cores have {…}      hello slots gpus machine python     have: bytes by log
    file name size                              state queued running ended {entry: [status, reason, last line]}
    queue entry task job host clock             log name at size
    withdraw entry                              cut name at           a log has become shorter, because its disk is full
    end entry                                   withdrawn entry
    cancel · beat · clock · remove              clock wall · trouble reason · beat · removed
    lease seconds?

`withdraw` takes a task back that has not begun. `remove` removes the folder, when the driver has everything.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import platform
import re
import select
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

from sierra.extensions.lab.agent import host_folder, keeper
from sierra.extensions.lab.agent.host_folder import CLAIMED, ENDED, LOGS, QUEUE, RESULTS, RUNNING, STATES, Record
from sierra.worker import gpus, machine, program
from sierra.worker.devices import runs_at_once
from sierra.worker.files import entries_of, last_line_of, remove, size_of_file, unlink, write_all

POLL_S = 0.1
BEAT_S = 1.0
SILENCE_S = 60.0
"""The seconds without a line from the driver after which the connection counts as lost."""
CHUNK = 1 << 20
PART = 4 << 20
"""The most bytes of a result log that are sent at a time."""
KEEPER = keeper.__name__


class Gone(Exception):
    """The driver has closed the connection, or is silent."""


class Front:
    """One connection of a driver to the session's folder."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._held = b""
        self._sent: dict[str, int] = {}
        """The bytes of each result log that the driver has."""
        self._state: Record = {}
        self._slots, self._gpus, self._cores = 1, 0.0, 1
        self._lease: float | None = None
        self._leased = 0.0
        self._beat_at = self._heard = self._keep_at = self._report_at = time.monotonic()
        self._removed = False

    def serve(self) -> None:
        """Serve the driver until it is gone, or until it has removed the folder."""
        while not self._removed:
            busy = self._send_logs()
            if not busy or time.monotonic() >= self._report_at:
                self._report()
            self._keep()
            self._beat()
            self._receive(0.0 if busy else POLL_S)

    def _beat(self) -> None:
        """Send a sign of life, if nothing was sent for some time."""
        if time.monotonic() > self._beat_at:
            self._send({"event": "beat"})

    def _receive(self, timeout: float) -> None:
        """Carry out what the driver asks for."""
        if select.select([0], [], [], timeout)[0]:
            self._read()
        elif time.monotonic() - self._heard > SILENCE_S:
            raise Gone
        while b"\n" in self._held and not self._removed:
            line, _, self._held = self._held.partition(b"\n")
            request = json.loads(line)
            while len(self._held) < request.get("size", 0):
                self._beat()
                if select.select([0], [], [], BEAT_S)[0]:
                    self._read()
                elif time.monotonic() - self._heard > SILENCE_S:
                    raise Gone
            self._beat()
            content, self._held = self._held[: request.get("size", 0)], self._held[request.get("size", 0) :]
            try:
                self._carry_out(request, content)
            except OSError as error:
                self._send_trouble(error)

    def _send_trouble(self, error: OSError) -> None:
        self._send({"event": "trouble", "reason": "%s: %s" % (error.filename or self._folder, error.strerror)})

    def _read(self) -> None:
        data = os.read(0, CHUNK)
        if not data:
            raise Gone
        self._held += data
        self._heard = time.monotonic()
        if self._state and self._heard > self._leased + BEAT_S:
            self._set_lease()

    def _set_lease(self) -> None:
        """Let the tasks go on for another lease. If the disk is full, they end when the last one is over."""
        self._leased = time.monotonic()
        try:
            host_folder.set_lease(self._folder, self._lease)
        except OSError as error:
            self._send_trouble(error)

    def _carry_out(self, request: Record, content: bytes) -> None:
        """Carry out one request. Raises OSError."""
        do = request["do"]
        if do == "hello":
            self._begin(request)
        elif do == "file" and host_folder.FILE.fullmatch(request["name"]):
            host_folder.write(os.path.join(self._folder, request["name"]), content)
        elif do == "queue":
            self._queue(checked(request["entry"]), request)
        elif do == "withdraw":
            self._withdraw(checked(request["entry"]))
        elif do == "end":
            self._end(checked(request["entry"]))
        elif do == "lease":
            self._lease = request["seconds"]
            self._set_lease()
        elif do == "cancel":
            host_folder.write(os.path.join(self._folder, "cancelled"), b"")
        elif do == "clock":
            self._send({"event": "clock", "wall": time.time_ns()})
        elif do == "remove":
            remove(self._folder)
            with contextlib.suppress(OSError):  # other hosts may use it
                os.rmdir(os.path.dirname(self._folder))
            self._removed = True
            self._send({"event": "removed"})

    def _begin(self, request: Record) -> None:
        host_folder.make(self._folder)
        unlink(os.path.join(self._folder, "cancelled"))
        self._gpus, self._cores, self._lease = request["gpus"] or 0.0, request["cores"], request["lease"]
        devices = len(gpus.of_this_machine(os.environ).ids) if self._gpus else 0
        self._slots = (request["slots"] or machine.usable_cores()) // self._cores
        if self._gpus:
            self._slots = min(self._slots, runs_at_once(devices, self._gpus))
        self._sent = dict(request["have"])
        python = platform.python_version()
        self._send({"event": "hello", "slots": self._slots, "gpus": devices, "machine": os.uname().machine, "python": python})
        self._state = {"none": True}
        self._set_lease()

    def _queue(self, entry: str, request: Record) -> None:
        """Queue a task, unless it is known: the connection may have been lost just after it was queued."""
        if not any(entry in host_folder.entries(self._folder, kind) for kind in STATES):
            asked = {name: request[name] for name in ("task", "job", "host", "clock")}
            host_folder.write_record(os.path.join(self._folder, QUEUE, entry), asked)
        self._keep_at = 0.0

    def _withdraw(self, entry: str) -> None:
        """Take a task back if the keeper has not begun with it. Only one of both can rename its file."""
        taken = os.path.join(self._folder, entry + ".withdrawn")
        try:
            os.rename(os.path.join(self._folder, QUEUE, entry), taken)
        except FileNotFoundError:  # it has begun, or it could not be queued because the disk is full
            if any(entry in host_folder.entries(self._folder, kind) for kind in STATES):
                return
        unlink(taken)
        self._send({"event": "withdrawn", "entry": entry})

    def _end(self, entry: str) -> None:
        process = host_folder.read_record(os.path.join(self._folder, RUNNING, entry))
        if host_folder.is_alive(process):
            os.kill(process["pid"], signal.SIGTERM)

    def _keep(self) -> None:
        """Start the keeper if there are tasks and none is alive. Where one is, the other ends at once."""
        if time.monotonic() < self._keep_at or not self._state:
            return
        self._keep_at = time.monotonic() + BEAT_S
        if not any(host_folder.entries(self._folder, kind) for kind in (QUEUE, CLAIMED, RUNNING)):
            return
        try:
            self._start_keeper()
        except OSError as error:
            self._send_trouble(error)

    def _start_keeper(self) -> None:
        """Start the keeper, unless one is alive. Raises OSError."""
        own = host_folder.lock(os.path.join(self._folder, "keeper"))
        if own is None:
            return
        os.close(own)
        with open(os.path.join(self._folder, LOGS, "keeper.out"), "ab") as log:
            # its parent ends at once, so that it is nobody's child here
            subprocess.run(
                [
                    sys.executable,
                    "-I",
                    "-S",
                    unpacked(program.PROGRAM),
                    KEEPER,
                    self._folder,
                    *map(str, (self._slots, self._gpus, self._cores)),
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                check=False,
            )

    def _send_logs(self) -> bool:
        """Send a part of each result log that has grown; return whether there may be more."""
        busy = False
        for name in sorted(entries_of(os.path.join(self._folder, RESULTS))) if self._state else ():
            if not name.endswith(".pack") or not re.match("[0-9]", name):
                continue
            at = self._sent.get(name, 0)
            try:
                with open(os.path.join(self._folder, RESULTS, name), "rb") as file:
                    size = os.fstat(file.fileno()).st_size
                    if size < at:
                        self._send({"event": "cut", "name": name, "at": size})
                        self._sent[name] = at = size
                    if size == at:
                        continue
                    length = min(size - at, PART)
                    self._send({"event": "log", "name": name, "at": at, "size": length})
                    send_file(file.fileno(), at, length)
            except FileNotFoundError:
                continue
            self._sent[name] = at + length
            busy = busy or at + length < size
        return busy

    def _report(self) -> None:
        """Send the state of the tasks, if it has changed. A task that goes on while they are listed is listed twice.

        A task is ended when the driver has all that it has recorded.
        """
        self._report_at = time.monotonic() + BEAT_S
        if not self._state:
            return
        queued, claimed, running, over = (host_folder.entries(self._folder, kind) for kind in STATES)
        known = self._state.get("ended", {})
        behind = self._behind() if any(entry not in known for entry in over) else set()
        ended = {entry: known.get(entry) or self._ended(entry) for entry in over if entry.partition(".")[2] not in behind}
        running += [entry for entry in over if entry not in ended]
        state = {"event": "state", "queued": queued + claimed, "running": running, "ended": ended}
        if state != self._state:
            self._send(state)
            self._state = state

    def _behind(self) -> set[str]:
        """Return the elements with result logs that were not sent completely."""
        folder = os.path.join(self._folder, RESULTS)
        names = [name for name in entries_of(folder) if size_of_file(os.path.join(folder, name)) > self._sent.get(name, 0)]
        return {name.partition(".")[0] for name in names}

    def _ended(self, entry: str) -> list[object]:
        record = host_folder.read_record(os.path.join(self._folder, ENDED, entry))
        line = last_line_of(os.path.join(self._folder, LOGS, entry + ".out"))
        return [record.get("status"), record.get("reason", ""), line]

    def _send(self, record: Record) -> None:
        write_all(1, json.dumps(record).encode() + b"\n")
        self._beat_at = time.monotonic() + BEAT_S


def send_file(file: int, at: int, length: int) -> None:
    """Send a part of a file, which was announced. Raises Gone if the file has become shorter meanwhile."""
    end = at + length
    while at < end:
        try:
            sent = os.sendfile(1, file, at, end - at)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOSYS):
                raise
            data = os.pread(file, min(end - at, CHUNK), at)  # a file system or an output without this call
            write_all(1, data)
            sent = len(data)
        if not sent:
            raise Gone
        at += sent


def unpacked(zipped: str) -> str:
    """Return the path of the programs in a folder instead of a zip, because Python keeps byte code only for files.

    Each task starts two Pythons, which take half of the time then. Return the zip itself if a file cannot be written, or if it
    is not as it was unpacked.
    """
    if not os.path.isfile(zipped) or not zipfile.is_zipfile(zipped):
        return zipped
    programs, name = os.path.split(os.path.dirname(zipped))
    target = os.path.join(os.path.dirname(programs), "unpacked", name)
    part = "%s.%s-%d" % (target, os.uname().nodename, os.getpid())  # hosts may share the folder
    try:
        with zipfile.ZipFile(zipped) as archive:
            if not os.path.isdir(target):
                archive.extractall(part)
                with contextlib.suppress(OSError):  # another driver may have been faster
                    os.rename(part, target)
            same = all(Path(target, member).read_bytes() == archive.read(member) for member in archive.namelist())
    except OSError:
        same = False
    remove(part)
    return os.path.join(target, "__main__.py") if same else zipped


def checked(entry: object) -> str:
    """Return the name of a task. Raises OSError for another text."""
    if not isinstance(entry, str) or not host_folder.ENTRY.fullmatch(entry):
        raise OSError(0, "is the name of no task", str(entry))
    return entry


def main(arguments: list[str]) -> int:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        Front(os.path.abspath(arguments[0])).serve()
    except (Gone, BrokenPipeError):
        return 1
    return 0
