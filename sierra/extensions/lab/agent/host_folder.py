"""The folder of a session on a host, and the tasks in it.

    ROOT/slots/NODE/K               the lock of slot K of this computer, which all drivers of this user share
    ROOT/sessions/SESSION/HOST/     the folder of a submission for the host of this name: computers may share their home folders
        element.json, elements/, results/, cancelled        as array tasks expect them: see `sierra.worker.array_task`
        worker.pyz, engine/         the programs and files that containers need
        logs/ENTRY.out              the output of a task
        queue/ENTRY                 a task that waits for a slot: JSON with `task`, `job`, `host` and `clock`
        claimed/ENTRY               the same file, while the task is started
        running/ENTRY               a task that has begun: its process
        ended/ENTRY                 a task that has ended: its exit status (null: unknown), and the reason
        lease                       the seconds since boot until which the driver waits for results (null: without end)
        keeper                      the lock of the process that starts the tasks

An ENTRY is `NUMBER.INDEX`: the INDEX of an element, and the NUMBER of its start in the session. Each file is written beside its
name and then renamed. Times are seconds since boot (CLOCK_BOOTTIME), because the clock of a host may be set at any time; with
the id of the boot, they mean the same to all processes of the host.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import time
from typing import Any, Dict

from sierra.worker.processes import birth, boot_id

ENTRY = re.compile(r"[0-9]{1,9}\.[0-9]{1,9}")
FILE = re.compile(r"element\.json|worker\.pyz|engine/[A-Za-z0-9_-][A-Za-z0-9_.-]*|elements/[0-9]{1,9}\.(jobs|failed|alone)")
"""The names of files that a driver sends."""
QUEUE, CLAIMED, RUNNING, ENDED, LOGS, RESULTS = "queue", "claimed", "running", "ended", "logs", "results"
FOLDERS = ("elements", "engine", QUEUE, CLAIMED, RUNNING, ENDED, LOGS, RESULTS)
STATES = (QUEUE, CLAIMED, RUNNING, ENDED)
"""The folders through which a task goes, in this order. It is written to the next one before it leaves one."""
Record = Dict[str, Any]


def now() -> float:
    """Return the seconds since boot, in which a suspended host also counts."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def make(folder: str) -> None:
    """Make the folder of a session. Raises OSError."""
    for name in ("", *FOLDERS):
        os.makedirs(os.path.join(folder, name), mode=0o700, exist_ok=True)


def write(path: str, content: bytes) -> None:
    """Write a file that appears whole or not at all. Raises OSError."""
    part = path + ".part"
    with open(part, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def write_record(path: str, record: Record) -> None:
    write(path, json.dumps(record).encode())


def read_record(path: str) -> Record:
    """Return the record in a file; an empty one if there is none, or if it is damaged."""
    try:
        with open(path, "rb") as file:
            record = json.load(file)
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def entries(folder: str, kind: str) -> list[str]:
    """Return the entries of a kind, in the order of their numbers."""
    with contextlib.suppress(FileNotFoundError):
        names = [name for name in os.listdir(os.path.join(folder, kind)) if ENTRY.fullmatch(name)]
        return sorted(names, key=lambda name: tuple(map(int, name.split("."))))
    return []


def lock(path: str) -> int | None:
    """Return the descriptor of a file that this process has locked; None if another process has. Raises OSError."""
    descriptor = os.open(path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def set_lease(folder: str, seconds: float | None) -> None:
    """Let tasks execute for so long from now on; None: without end. Raises OSError."""
    write_record(os.path.join(folder, "lease"), {"boot": boot_id(), "until": None if seconds is None else now() + seconds})


def lease_is_over(folder: str) -> bool:
    """Return whether the driver has given up this host. After a restart of the host it has, unless it has said otherwise."""
    lease = read_record(os.path.join(folder, "lease"))
    if lease.get("boot") != boot_id():
        return True
    return lease.get("until") is not None and now() > lease["until"]


def is_alive(process: Record) -> bool:
    """Return whether the process of a task is alive: one with this id that was born in this boot at this time."""
    return process.get("boot") == boot_id() and birth(process.get("pid", 0)) == process.get("born")
