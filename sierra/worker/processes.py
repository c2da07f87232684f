"""Processes of this host by /proc (Linux): their states, their resources, and how they are ended.

Processes that leave their group are still found: the worker is their subreaper, so an orphan becomes a child of the worker's
main thread, which starts no process itself.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import time

from sierra.worker.files import entries_of

TYPE_CHECKING = False  # each run starts a conductor, and importing `typing` is a tenth of its time
if TYPE_CHECKING:
    from typing import IO, Callable, Iterable

POLL_S = 0.25
SETTLE_S = 2.0
SAMPLE_S = 0.05
FIRST_LOOK_S = 0.01
LINGER_S = 0.25  # for processes to end after the command that has started them
NAMED = 3  # processes that are reported
NAME_LENGTH = 80
STOP_S = 0.5  # for SIGCONT to reach all processes that it is sent to, and much longer than the time between two looks


def descendants(pid: int) -> list[int]:
    """Return the ids of a process and all its descendants, as far as /proc lists them."""
    pids = [pid]
    for parent in pids:
        for task in entries_of("/proc/%d/task" % parent):
            pids += children(parent, task)
    return pids


def read_proc(path: str) -> bytes:
    """Return the content of a file in /proc; empty if it cannot be read."""
    try:
        with open("/proc/" + path, "rb") as file:
            return file.read()
    except OSError:
        return b""


def boot_id() -> str:
    """Return the name that the kernel has given to this boot."""
    return read_proc("sys/kernel/random/boot_id").decode().strip()


def children(process: int | str, task: int | str) -> list[int]:
    return [int(word) for word in read_proc("%s/task/%s/children" % (process, task)).split()]


def usage_of(pids: list[int]) -> tuple[int, float]:
    """Return the resident bytes and the CPU seconds of processes (including their ended children's CPU seconds)."""
    page = os.sysconf("SC_PAGE_SIZE")
    resident = sum(int(fields[21]) for fields in map(stat_of, pids) if fields)
    return resident * page, sum(cpu_of(pids))


def cpu_of(pids: list[int]) -> tuple[float, float]:
    """Return the CPU seconds of processes and of their ended children, in user mode and in the kernel."""
    tick = os.sysconf("SC_CLK_TCK")
    times = [[int(field) for field in fields[11:15]] for fields in map(stat_of, pids) if fields]
    return sum(one[0] + one[2] for one in times) / tick, sum(one[1] + one[3] for one in times) / tick


def peak_of(pid: int) -> int:
    """Return the greatest resident size in bytes that a process has had; 0 if there is no such process."""
    return number_in(pid, b"VmHWM:") * 1024


def number_in(pid: int, field: bytes) -> int:
    """Return a number in /proc/PID/status; 0 if there is no such process."""
    lines = [line.split() for line in read_proc("%d/status" % pid).splitlines() if line.startswith(field)]
    return int(lines[0][1]) if lines else 0


def environment_of(pid: int) -> list[bytes]:
    """Return the environment with which a process was started, as NAME=value; nothing else if it cannot be read."""
    text = read_proc("%d/environ" % pid)
    if not text and state_of(pid) == b"Z":  # its first thread has ended, but perhaps not the others
        threads = ("%d/task/%s/environ" % (pid, task) for task in entries_of("/proc/%d/task" % pid))
        text = next(filter(None, map(read_proc, threads)), b"")
    return text.split(b"\0")


def stdin_of(process: subprocess.Popen[bytes]) -> IO[bytes]:
    """Return the pipe to a process. Raises BrokenPipeError if it is closed."""
    if process.stdin is None or process.stdin.closed:
        raise BrokenPipeError
    return process.stdin


def marked(marks: Iterable[bytes]) -> set[int]:
    """Return this host's processes that were started with one of these NAME=value (Linux): no zombies, and only this user's."""
    found = set(marks)
    return {pid for pid in all_processes() if not found.isdisjoint(environment_of(pid))}


def all_processes() -> list[int]:
    """Return the ids of all processes of this host."""
    return [int(name) for name in entries_of("/proc") if name.isdigit()]


def state_of(pid: int) -> bytes | None:
    """Return the state of a process: Z for one that has ended, and nobody has waited for. None if there is none."""
    return next(iter(stat_of(pid)), None)


def stat_of(pid: int) -> list[bytes]:
    """Return the fields of /proc/PID/stat after the program's name; empty if there is no such process."""
    return read_proc("%d/stat" % pid).rpartition(b")")[2].split()


class Stops:
    """Looks at a process that a run may stop by SIGSTOP.

    If this process was stopped too, then no run did it, but somebody who suspends and resumes everything. Therefore a stop
    only counts if the process is still stopped `STOP_S` later, and this one has looked at it in the meantime.
    """

    def __init__(self) -> None:
        self._since: float | None = None
        self._looked = 0.0

    def seen(self, pid: int, now: float) -> bool:
        """Look once more, at this time; return whether the process has been stopped for so long."""
        suspended = now - self._looked > STOP_S
        self._looked = now
        if state_of(pid) != b"T":
            self._since = None
            return False
        if suspended or self._since is None:
            self._since = now
        if now - self._since < STOP_S:
            return False
        self._since = None
        return True


def birth(pid: int) -> int | None:
    """Return the start time of a process in clock ticks since boot. With the process id, it identifies one process for ever."""
    fields = stat_of(pid)
    return int(fields[19]) if fields else None


ENDING_MASK = sum(1 << number - 1 for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM))
"""The signals that end a program, as in /proc/PID/status."""


def continue_ending(pid: int) -> None:
    """Continue a process that is stopped, if a signal waits that would end it: a run may stop the process of its session."""
    if state_of(pid) == b"T":
        pending = [
            line.split()[1] for line in read_proc("%d/status" % pid).splitlines() if line[:7] in (b"SigPnd:", b"ShdPnd:")
        ]
        if any(int(mask, 16) & ENDING_MASK for mask in pending):
            signal_process(pid, signal.SIGCONT)


def nobody(pid: int) -> bool:
    return False


def end_orphans(execution: str | None, group: int | None = None, is_tracer: Callable[[int], bool] = nobody) -> bool:
    """Kill processes that have left their group: orphans of one execution, or (None) all. Return whether no orphan is left.

    Orphans are children of this process's main thread. An orphan whose environment does not name an execution belongs to none,
    and is ended with the worker. One that is ending has no environment: it is awaited, because its children may be the run's.
    """
    give_up = time.monotonic() + SETTLE_S
    while time.monotonic() < give_up:
        living = reap()
        own = [
            pid
            for pid in living
            if (execution is None or belongs_to(pid, execution, group) or is_ending(pid)) and not is_tracer(pid)
        ]
        if not own:
            return not living
        for pid in own:
            signal_process(pid, signal.SIGKILL)
        select.select((), (), (), POLL_S / 50)  # no wait for one of them, which may never end if it is another user's
    return False


def reap() -> list[int]:
    """Return the orphans that have not ended. Waits for those that have, because no other code does.

    A process whose first thread has ended has not ended itself before its other threads: until then, its children are not
    orphans, so it is one of those that are returned. The list is read again after each end, because it was read before.
    """
    while True:
        living, has_ended = [], False
        for pid in orphans():
            fields = stat_of(pid)
            if fields and fields[0] == b"Z" and release(pid):
                has_ended = True
            elif fields:
                living.append(pid)
        if not has_ended:
            return living


def release(pid: int) -> bool:
    """Return whether a child has ended, and let the kernel forget it."""
    try:
        return os.waitpid(pid, os.WNOHANG)[0] == pid
    except ChildProcessError:
        return False


def orphans() -> list[int]:
    """Return the children of the main thread, which starts none itself."""
    return children("self", os.getpid())


def group_of(pid: int) -> int | None:
    fields = stat_of(pid)
    return int(fields[2]) if fields else None


def is_alive_in(pid: int, group: int) -> bool:
    """Return whether a process is in a group, and is not a zombie."""
    fields = stat_of(pid)
    return bool(fields) and fields[0] != b"Z" and int(fields[2]) == group


def belongs_to(pid: int, execution: str, group: int | None) -> bool:
    if group_of(pid) in (None, group):
        return True
    return b"SIERRA_EXECUTION=" + execution.encode() in environment_of(pid)


def is_ending(pid: int) -> bool:
    """Return whether all threads of a process are ending, so that it has no environment any more."""
    return state_of(pid) == b"Z" and environment_of(pid) == [b""]


def has_ended(pid: int) -> bool:
    """Return whether a child has ended, even if nobody has waited for it yet."""
    return hasattr(os, "waitid") and os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None


def signal_group(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, number)


def signal_process(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.kill(pid, number)


def adopt_orphans() -> None:
    """Become the parent of processes whose worker has died (Linux only).

    Unlike `become_subreaper`, it lets this process outlive the thread that started it, which a scheduler may end much earlier.
    """
    with contextlib.suppress(ImportError, OSError, AttributeError):
        import ctypes

        set_child_subreaper = 36
        ctypes.CDLL(None).prctl(set_child_subreaper, 1, 0, 0, 0)


def become_subreaper(*, secretive: bool) -> bool:
    """Become the parent of orphans, and end with the process that started this one (Linux only).

    Return whether all orphans will be found. `secretive`: processes without more rights cannot read this one's memory and
    pipes.
    """
    if sys.platform != "linux":
        return False
    try:
        import ctypes

        libc = ctypes.CDLL(None, use_errno=True)
        set_child_subreaper, set_parent_death_signal, set_dumpable = 36, 1, 4
        adopts = libc.prctl(set_child_subreaper, 1, 0, 0, 0) == 0
        libc.prctl(set_parent_death_signal, signal.SIGHUP, 0, 0, 0)
        if secretive:
            libc.prctl(set_dumpable, 0, 0, 0, 0)
    except (ImportError, OSError, AttributeError):
        return False
    return adopts and os.path.exists("/proc/self/task/%d/children" % os.getpid())


def is_alive(pid: int) -> bool:
    """Return whether a process that another one has started has not ended."""
    return state_of(pid) not in (None, b"Z", b"X")


def still_running(living: Callable[[], Iterable[int]]) -> list[str]:
    """Return the names of the processes that `living` yields, after a moment in which they may end by themselves."""
    give_up = time.monotonic() + LINGER_S
    while True:
        pids = list(living())
        if not pids or time.monotonic() >= give_up:
            names = [name for name in map(program_of, pids) if name]
            return list(dict.fromkeys(names))[:NAMED]
        time.sleep(FIRST_LOOK_S)


def program_of(pid: int) -> str:
    """Return the name of a process's program, with its words up to the first that is no option: `python3 sim.py`.

    Folders are left out, because those of each run are different.
    """
    words = read_proc("%d/cmdline" % pid).decode("utf-8", "replace").split("\0")[:-1]
    end = next((place for place, word in enumerate(words) if place and not word.startswith("-")), len(words))
    shown = " ".join(" ".join(os.path.basename(word) or word for word in words[: end + 1]).split())
    return shown if len(shown) <= NAME_LENGTH else shown[: NAME_LENGTH - 1] + "…"
