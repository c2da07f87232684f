"""The use of NVIDIA's GPUs by processes, as NVML (the library of nvidia-smi) reports it, where it is installed.

NVML tells the memory of each process at a moment, and the part of the time since the previous question in which a process kept
the GPU busy. So a thread asks at intervals. A GPU that is divided by MIG does not tell the latter. All structures are those of
`nvml.h`; NVML numbers GPUs by their PCI bus ids.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import threading
import time
from typing import Callable, Iterator, Mapping, NamedTuple, Sequence

LIBRARY = "libnvidia-ml.so.1"
SAMPLE_S = 1.0
COST = 100
"""A pause is at least so many times as long as the questions took."""
KEPT = 8
"""The snapshots that are kept for a main thread that is late."""
SUCCESS, NOT_FOUND = 0, 6
UNKNOWN = 2**64 - 1
"""The memory of a process that NVML cannot tell."""
MOST = 4096
"""The processes of one GPU that are read."""
RUNNING = ("nvmlDeviceGetComputeRunningProcesses_v3", "nvmlDeviceGetGraphicsRunningProcesses_v3")


class ProcessInfo(ctypes.Structure):
    """`nvmlProcessInfo_t`."""

    _fields_ = (
        ("pid", ctypes.c_uint),
        ("memory", ctypes.c_ulonglong),
        ("gpu_instance", ctypes.c_uint),
        ("compute_instance", ctypes.c_uint),
    )


class Utilization(ctypes.Structure):
    """`nvmlProcessUtilizationSample_t`."""

    _fields_ = (
        ("pid", ctypes.c_uint),
        ("time", ctypes.c_ulonglong),
        ("processors", ctypes.c_uint),
        ("memory", ctypes.c_uint),
        ("encoder", ctypes.c_uint),
        ("decoder", ctypes.c_uint),
    )


class Snapshot(NamedTuple):
    """The use of all GPUs at a moment, by process id."""

    number: int
    memory: Mapping[int, int]
    """Bytes on all GPUs together."""
    busy: Mapping[int, float] | None
    """Seconds since the previous snapshot, of all GPUs together; None if no GPU tells this."""


class GpuUsage:
    """The use of GPUs by one run: its greatest memory, and the time in which it kept GPUs busy; None if it was never seen."""

    def __init__(self, sampler: GpuSampler) -> None:
        self.memory: int | None = None
        self.seconds: float | None = None
        self._sampler = sampler
        self._seen = max((snapshot.number for snapshot in sampler.snapshots), default=-1)

    def read(self, pids: Callable[[], Sequence[int]]) -> None:
        """Add the snapshots that are new since the last call; `pids` returns the run's processes."""
        new = [snapshot for snapshot in self._sampler.snapshots if snapshot.number > self._seen]
        if not new:
            return
        self._seen = new[-1].number
        own = pids()
        for snapshot in new:
            used = [snapshot.memory[pid] for pid in own if pid in snapshot.memory]
            if used:
                self.memory = max(self.memory or 0, sum(used))
                if snapshot.busy is not None:
                    self.seconds = (self.seconds or 0.0) + sum(snapshot.busy.get(pid, 0.0) for pid in own)


def opened() -> ctypes.CDLL | None:
    """Return the library, initialised; None if it is not installed, or finds no driver."""
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(LIBRARY)
        if library.nvmlInit_v2() == SUCCESS:
            return library
    return None


def count(library: ctypes.CDLL) -> int:
    """Return the number of GPUs."""
    number = ctypes.c_uint()
    return number.value if library.nvmlDeviceGetCount_v2(ctypes.byref(number)) == SUCCESS else 0


class GpuSampler:
    """A thread that samples all GPUs until the process ends."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.snapshots: tuple[Snapshot, ...] = ()
        threading.Thread(target=self._sample, args=(library,), daemon=True).start()

    def _sample(self, library: ctypes.CDLL) -> None:
        devices = list(handles(library))
        before, since = time.monotonic(), microseconds()
        for number in itertools.count():
            now, asked = time.monotonic(), microseconds()
            busy = busy_by_process(library, devices, since, now - before)
            before, since = now, asked
            snapshot = Snapshot(number, memory_by_process(library, devices), busy)
            self.snapshots = (*self.snapshots[1 - KEPT :], snapshot)
            time.sleep(max(SAMPLE_S, COST * (time.monotonic() - now)))


def microseconds() -> int:
    return int(time.time() * 1e6)


def handles(library: ctypes.CDLL) -> Iterator[ctypes.c_void_p]:
    """Yield the GPUs that this process may use."""
    for index in range(count(library)):
        device = ctypes.c_void_p()
        if library.nvmlDeviceGetHandleByIndex_v2(ctypes.c_uint(index), ctypes.byref(device)) == SUCCESS:
            yield device


def memory_by_process(library: ctypes.CDLL, devices: Sequence[ctypes.c_void_p]) -> dict[int, int]:
    """Return the bytes that processes use on GPUs. One that computes and draws is in both lists of a GPU."""
    total: dict[int, int] = {}
    for device in devices:
        used: dict[int, int] = {}
        for name in RUNNING:
            listed, number = (ProcessInfo * MOST)(), ctypes.c_uint(MOST)
            with contextlib.suppress(AttributeError):  # an old driver
                if getattr(library, name)(device, ctypes.byref(number), listed) == SUCCESS:
                    known = (process for process in listed[: number.value] if process.memory != UNKNOWN)
                    used.update({process.pid: max(process.memory, used.get(process.pid, 0)) for process in known})
        for pid, memory in used.items():
            total[pid] = total.get(pid, 0) + memory
    return total


def busy_by_process(
    library: ctypes.CDLL, devices: Sequence[ctypes.c_void_p], since: int, elapsed: float
) -> dict[int, float] | None:
    """Return the seconds in which processes kept GPUs busy since a time, `elapsed` seconds ago; None if no GPU tells this."""
    told = [samples for device in devices if (samples := utilizations(library, device, since)) is not None]
    total: dict[int, float] = {}
    for samples in told:
        for pid, percents in samples.items():
            total[pid] = total.get(pid, 0.0) + elapsed * min(100.0, sum(percents) / len(percents)) / 100
    return total if told else None


def utilizations(library: ctypes.CDLL, device: ctypes.c_void_p, since: int) -> dict[int, list[int]] | None:
    """Return the percents of the time for which processes kept a GPU busy; None if the GPU does not tell this."""
    samples, number = (Utilization * MOST)(), ctypes.c_uint(MOST)
    try:
        status = library.nvmlDeviceGetProcessUtilization(device, samples, ctypes.byref(number), ctypes.c_ulonglong(since))
    except AttributeError:  # an old driver
        return None
    if status == NOT_FOUND:  # no process was busy
        return {}
    if status != SUCCESS:
        return None
    percents: dict[int, list[int]] = {}
    for sample in samples[: number.value]:
        if sample.pid and sample.time > since:
            percents.setdefault(sample.pid, []).append(sample.processors)
    return percents
