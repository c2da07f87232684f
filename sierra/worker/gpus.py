"""The GPUs of this machine that a process may use, found without the libraries of CUDA or ROCm."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Mapping, NamedTuple, Sequence

from sierra.worker.devices import CUDA, DEVICES, ROCR, NoDevices, ids_in

HIP = "HIP_VISIBLE_DEVICES"
NVIDIA = Path("/proc/driver/nvidia/gpus")
AMD = Path("/sys/class/kfd/kfd/topology/nodes")
DEV = Path("/dev")


AUTO = "auto"
"""All GPUs that a process may use."""


class Gpus(NamedTuple):
    """GPUs that runs may use, and the variable that lists them."""

    variable: str
    ids: tuple[str, ...]
    """Indices, or what the variable already lists."""


def with_gpus(environment: Mapping[str, str], gpus: float, wanted: str | int | Sequence[str] = AUTO) -> dict[str, str]:
    """Return the variables for a worker whose runs hold `gpus` GPUs each: as given, but they list only the GPUs for runs.

    `wanted` are these: AUTO, a number of them, or their indices or UUIDs. Raises NoDevices if there are too few.
    """
    variable, ids = of_this_machine(environment)
    seen = "this machine has %s%s" % (counted(ids), " in %s" % variable if variable in environment else "")
    if isinstance(wanted, int):
        if wanted > len(ids):
            raise NoDevices("[runners.local] gpus = %d, but %s" % (wanted, seen))
        ids = ids[:wanted]
    elif wanted != AUTO:
        # a UUID, such as that of a part of a GPU (MIG), is not in a list of indices
        unknown = [name for name in wanted if name not in ids and (name.isdigit() or variable in environment or not ids)]
        if unknown:
            raise NoDevices("[runners.local] gpus: there is no %s; %s" % (unknown[0], seen))
        ids = tuple(wanted)
    if len(ids) < max(gpus, 1):
        seen = seen if wanted == AUTO else "[runners.local] gpus has %s" % counted(ids)
        raise NoDevices("runs request %g GPU%s each ([limits] gpus), but %s" % (gpus, "s" if gpus > 1 else "", seen))
    others = {name: value for name, value in environment.items() if name not in DEVICES}
    return {**others, variable: ",".join(ids)}


def without_limit(gpus: float | None) -> str:
    """Return a note that this machine has no GPU, so that runs which request some execute again without; empty if it has."""
    if gpus is None or of_this_machine(os.environ).ids:
        return ""
    return "[limits] gpus = %g is not heeded: this machine has no GPU, so the runs get none" % gpus


def counted(ids: Sequence[str]) -> str:
    return "%d GPU%s (%s)" % (len(ids), "" if len(ids) == 1 else "s", ", ".join(ids)) if ids else "no GPU"


def of_this_machine(environment: Mapping[str, str]) -> Gpus:
    """Return the GPUs that a process with these variables may use: all, or those that CUDA or ROCm would show it."""
    if count := number_of_nvidia():
        return Gpus(CUDA, tuple(visible([str(index) for index in range(count)], environment.get(CUDA))))
    everything = [str(index) for index in range(number_of_amd())]
    shown = visible(everything, environment.get(ROCR))
    chosen = visible([str(index) for index in range(len(shown))], environment.get(HIP, environment.get(CUDA)))
    return Gpus(ROCR, tuple(shown[int(index)] if index.isdigit() else index for index in chosen))


def visible(ids: Sequence[str], listed: str | None) -> Sequence[str]:
    """Return the devices that a variable with this value shows; None: all. As in CUDA, an unknown one ends the list."""
    if listed is None:
        return ids
    shown = []
    for name in ids_in(listed):
        if name.isdigit() and name not in ids:
            break
        shown.append(name)
    return shown


def number_of_nvidia() -> int:
    """Return the number of NVIDIA's GPUs: by NVML, or by the files of the driver."""
    count = number_by_nvml()
    if count:
        return count
    listed = sum(1 for _ in NVIDIA.glob("*/information"))
    return listed or sum(re.fullmatch(r"nvidia\d+", path.name) is not None for path in DEV.glob("nvidia*"))


def number_by_nvml() -> int:
    try:
        from sierra.worker import nvml
    except ImportError:  # a Python without ctypes
        return 0
    library = nvml.opened()
    return nvml.count(library) if library else 0


def number_of_amd() -> int:
    """Return the number of AMD's GPUs: nodes of the kernel's driver with processors of their kind."""
    return sum(has_processors(path) for path in AMD.glob("*/properties"))


def has_processors(properties: Path) -> bool:
    try:
        words = properties.read_text("ascii", "replace").split()
    except OSError:
        return False
    return any(name == "simd_count" and value != "0" for name, value in zip(words, words[1:]))
