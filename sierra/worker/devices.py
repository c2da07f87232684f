"""Devices of runs: those that a scheduler has allotted to a job of a cluster, or that this machine lends to runs.

In an environment (and in a client's argv), the character \\1 followed by a name from NAMES stands for the value of that name
for the run, or for nothing if there is none. It comes from the worker's variables:

- A job without the limit `gpus`: if a list of several devices can be divided among the slots, each slot gets its own part.
- A job with it: the run holds as many devices until it has ended, or its share of one. It waits until they are free. With a
  share, the run's programs by XLA (JAX) take only their part of the memory; otherwise, each takes most of it.

A word of a client's argv that ends with \\1 and CDI is repeated for each device. Such a container has no other devices, so that
programs in it count them from 0.
"""

from __future__ import annotations

import os
import re
import threading
from typing import Callable, Iterator, Mapping, NamedTuple, Sequence

from sierra.worker.job import Job
from sierra.worker.processes import POLL_S

ALLOTTED = "\1"
CUDA, ROCR = "CUDA_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES"
BELOW_ROCR = (CUDA, "HIP_VISIBLE_DEVICES", "GPU_DEVICE_ORDINAL")  # for AMD, indices into ROCR's list
DEVICES = (*BELOW_ROCR, ROCR, "NVIDIA_VISIBLE_DEVICES", "ZE_AFFINITY_MASK")
ORDER = "CUDA_DEVICE_ORDER"
"""The variable by which CUDA numbers devices as NVML, nvidia-smi and CDI do, if its value is PCI_BUS_ID."""
FRACTION = "XLA_PYTHON_CLIENT_MEM_FRACTION"
NEW_FRACTION = "XLA_CLIENT_MEM_FRACTION"  # JAX refuses to start with both
FRACTION_OF_SHARE = 0.9
"""The part of its share that a run's program may reserve: the rest is for contexts of CUDA, which XLA does not count."""
OF_LIMIT = (ORDER, FRACTION)
"""The further variables of runs with the limit `gpus`."""
CDI = "CDI"
CDI_MARK = ALLOTTED + CDI
NAMES = (*DEVICES, *OF_LIMIT, CDI)
ID = re.compile(r"\d+|(?:GPU|MIG)-[\w./-]+")
EXACT = 1e-9  # so that three shares of 0.3333333333333333, or ten of 0.1, are one device


def requested(environment: Mapping[str, str], gpus: float | None) -> dict[str, str]:
    """Return the marks for a run with these variables. `gpus` is its limit."""
    names = DEVICES if gpus is None else (*DEVICES, *OF_LIMIT)
    taken = {*environment, FRACTION} if NEW_FRACTION in environment else environment
    return {name: ALLOTTED + name for name in names if name not in taken}


class NoDevices(Exception):
    """Devices that a run requests do not exist."""


class Lease(NamedTuple):
    """The devices that a run holds: their positions in the list, and the part of each."""

    indices: tuple[int, ...]
    part: float
    variables: Mapping[str, str]
    ids: tuple[str, ...]


def requests_devices(job: Job) -> bool:
    return any(job["environment"].get(name) == ALLOTTED + name for name in DEVICES)


def with_own_devices(job: Job, slot: int, slots: int) -> Job:
    """Return the job with the devices of its slot, if it requests any."""
    return with_given(job, devices(slot, slots)) if requests_devices(job) else job


def with_leased(job: Job, lease: Lease) -> Job:
    """Return the job with devices that it holds alone, or of which it has a share."""
    given = {**lease.variables, ORDER: os.environ.get(ORDER, "PCI_BUS_ID")}
    if lease.part < 1:
        given[FRACTION] = "%.4g" % (FRACTION_OF_SHARE * lease.part)
    return with_given(job, given, lease.ids)


def with_given(job: Job, given: Mapping[str, str], ids: Sequence[str] = ()) -> Job:
    """Return the job with these values of variables, and with devices of these ids for CDI."""
    argv = job["client"]["argv"] if "client" in job else ()
    if any(word.endswith(CDI_MARK) for word in argv):
        others = {name: value for name, value in given.items() if name not in DEVICES}
        given = {**others, CUDA: ",".join(map(str, range(len(ids))))}
    filled: Job = {**job, "environment": with_devices(job["environment"], given)}
    if "client" in job:
        client = job["client"]
        words = [filled_word for word in argv for filled_word in with_device_words(word, given, ids)]
        filled["client"] = {**client, "argv": words, "environment": with_devices(client["environment"], given)}
    held = ids or ids_in(next((given[name] for name in (CUDA, ROCR) if name in given), ""))
    if held:
        filled["gpus"] = list(held)
    return filled


def with_devices(variables: Mapping[str, str], given: Mapping[str, str]) -> dict[str, str]:
    filled = {name: with_device(value, given) for name, value in variables.items()}
    return {name: value for name, value in filled.items() if value is not None}


def with_device_words(word: str, given: Mapping[str, str], ids: Sequence[str]) -> Iterator[str]:
    """Yield the words that take the place of one in argv."""
    head, mark, name = word.partition(ALLOTTED)
    if mark and name == CDI:
        yield from (head + device for device in ids)
    elif (filled := with_device(word, given)) is not None:
        yield filled


def with_device(text: str, given: Mapping[str, str]) -> str | None:
    """Return the text with the value of the variable that it ends with; None if there is no such variable."""
    head, mark, name = text.partition(ALLOTTED)
    if not mark or name not in NAMES:
        return text
    return head + given[name] if name in given else None


def devices(slot: int, slots: int) -> dict[str, str]:
    """Return the devices that a slot may use, from the scheduler's variables: its part of them, or all."""
    whole = {name: os.environ[name] for name in DEVICES if name in os.environ}
    parts = {name: part_of(value.split(","), slot, slots) for name, value in whole.items()}
    return without_indices(parts) if parts != whole else parts


def without_indices(parts: dict[str, str]) -> dict[str, str]:
    """Return a part of the variables; for AMD, without those that are indices into the whole list of devices."""
    if ROCR in parts and os.path.exists("/dev/kfd"):
        return {name: value for name, value in parts.items() if name not in BELOW_ROCR}
    return parts


def part_of(values: list[str], slot: int, slots: int) -> str:
    """Return a slot's part of the devices if they can be divided equally among the slots, or the slots among them; else all."""
    if len(values) % slots == 0:
        each = len(values) // slots
        values = values[slot * each : (slot + 1) * each]
    elif slots % len(values) == 0:
        values = [values[slot % len(values)]]
    return ",".join(values)


def ids_in(text: str) -> list[str]:
    """Return the devices of a list in a variable. As for CUDA, the list ends before the first value that is no device."""
    ids: list[str] = []
    for word in map(str.strip, text.split(",")):
        if not ID.fullmatch(word) or word in ids:
            break
        ids.append(word)
    return ids


def listed_in(variables: Mapping[str, str]) -> list[str]:
    """Return the devices that the first of these variables lists."""
    return next((ids for ids in (ids_in(variables.get(name, "")) for name in DEVICES) if ids), [])


def runs_at_once(count: int, gpus: float) -> int:
    """Return how many runs can execute at a time on `count` devices if each run requests `gpus` of them."""
    return int(count // gpus) if gpus >= 1 else count * int((1 + EXACT) / gpus)


class Pool:
    """The devices of this worker, which it lends to runs. The run that asks first gets them first."""

    def __init__(self, variables: Mapping[str, str]) -> None:
        """Take the devices that the worker's variables list."""
        self._whole = {name: variables[name] for name in DEVICES if name in variables}
        lists = {name: ids_in(self._whole.get(name, "")) for name in DEVICES}
        self._ids = listed_in(variables)
        self._lists = {name: ids for name, ids in lists.items() if ids and len(ids) == len(self._ids)}
        self._used: list[float] = [0.0] * len(self._ids)
        self._turn = threading.Lock()
        self._changed = threading.Condition()

    def take(self, gpus: float, is_stopping: Callable[[], bool]) -> Lease | None:
        """Wait for devices, and lend them; None if the worker was told to stop meanwhile. Raises NoDevices."""
        if len(self._ids) < max(gpus, 1):
            listed = "%d GPUs are" % len(self._ids) if len(self._ids) > 1 else "one GPU is" if self._ids else "no GPU is"
            raise NoDevices("[limits] gpus = %g, but %s listed in %s or %s" % (gpus, listed, CUDA, ROCR))
        with self._turn, self._changed:
            while not is_stopping():
                indices = self._free(gpus)
                if indices is not None:
                    part = min(gpus, 1.0)
                    for index in indices:
                        self._used[index] += part
                    return Lease(indices, part, self._variables(indices), tuple(self._ids[index] for index in indices))
                self._changed.wait(POLL_S)
        return None

    def give_back(self, lease: Lease) -> None:
        with self._changed:
            for index in lease.indices:
                self._used[index] = max(0.0, self._used[index] - lease.part)
            self._changed.notify_all()

    def _free(self, gpus: float) -> tuple[int, ...] | None:
        """Return the positions of devices with room for a run, the least used ones first; None if there are too few."""
        room = [index for index, used in enumerate(self._used) if used + min(gpus, 1.0) <= 1 + EXACT]
        count = max(1, int(gpus))
        chosen = sorted(room, key=self._used.__getitem__)[:count]
        return tuple(sorted(chosen)) if len(chosen) == count else None

    def _variables(self, indices: Sequence[int]) -> dict[str, str]:
        parts = {name: ",".join(ids[index] for index in indices) for name, ids in self._lists.items()}
        return without_indices({**self._whole, **parts})
